"""Rigid motion of a small group of points onto the next scan, turning about the vertical only."""

import numpy as np

from lidarflow.kernels import icp
from lidarflow.kernels.tree import Tree

_GATES_M = np.array([1.0, 0.5, 0.3])   # how far a point may be from its counterpart, coarse to fine
_ROUNDS_PER_GATE = 5

# Onto planes, by robust point-to-plane ICP (icp.onto_planes): rings of a spinning sensor stand still on a
# body that moves under them; nearest points follow the rings, planes do not. A small weight on the points
# themselves holds what no plane does. What drives or walks moves along the ground: the shift along the
# ground's normal is held back with `along_ground` times the weight of all pairs.
PLANE_GATES_M = np.array([0.5] * 5 + [0.3] * 10)
PLANE_SCALE_M = 0.05        # plane distances beyond it lose weight
POINT_SCALE_M = 0.15        # and distances between points beyond this
POINT_WEIGHT = 0.05         # of a pair of points, where the plane of the same pair has 1


def onto(
    groups: list[np.ndarray], starts: list[tuple[int, np.ndarray]], target: Tree
) -> np.ndarray:
    """Motions (H, 4, 4) of groups of points (N, 3) onto those of `target`, by ICP in yaw and translation.

    Each start is the number of a group and a translation (3,) in metres to start from. What stands upright on
    the ground turns about the vertical.
    """
    return icp.onto_points(
        *concatenated(groups), np.array([group for group, _ in starts], np.int64),
        np.array([translation for _, translation in starts], float).reshape(-1, 3), target, _GATES_M,
        _ROUNDS_PER_GATE)


def concatenated(groups: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """All rows of the groups (N, …), one group after the other, and where each begins and ends (G + 1,)."""
    bounds = np.zeros(len(groups) + 1, np.int64)
    np.cumsum([len(group) for group in groups], out=bounds[1:])
    return np.concatenate(groups), bounds
