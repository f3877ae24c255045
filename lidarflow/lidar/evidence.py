"""What ego-motion alone leaves unexplained, and whether the sensor looked there at all.

What hides a place does not excuse it: a car that comes nearer hides the place where it was.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from lidarflow.config import ObjectsConfig

_MAX_ANGLE_RAD = np.radians(1.5)
_MIN_DIRECTIONS = 2


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """What a cloud, brought to another scan's frame, finds there.

    left_m       (N,) float   distance to the nearest point of the other scan
    unexplained  (N,) bool    too far from it, although the sensor looked in that direction
    blind        (N,) bool    too far from it, but out of view: no evidence of anything
    """

    left_m: np.ndarray
    unexplained: np.ndarray
    blind: np.ndarray


def gather(points: np.ndarray, other: np.ndarray, config: ObjectsConfig) -> Evidence:
    """Evidence of `points` (N, 3) against `other` (M, 3), metres, both in the sensor frame of `other`."""
    left_m, _ = cKDTree(other).query(points, workers=-1)
    range_m = np.linalg.norm(points, axis=1)
    far = np.flatnonzero(left_m > tolerance(range_m, config))
    seen = _looked_there(points[far] / np.maximum(range_m[far], 1e-6)[:, None], other)
    unexplained, blind = np.zeros((2, len(points)), bool)
    unexplained[far[seen]] = True
    blind[far[~seen]] = True
    return Evidence(left_m, unexplained, blind)


def tolerance(range_m: np.ndarray, config: ObjectsConfig) -> np.ndarray:
    """How far (N,) in metres a point may be from the next scan's nearest: scan lines spread with range."""
    return config.near_m + config.near_share * range_m


def _looked_there(directions: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Whether (N,) the other scan (M, 3) has returns around each direction (N, 3), of unit length."""
    if len(directions) == 0:
        return np.zeros(0, bool)
    other_range_m = np.linalg.norm(other, axis=1)
    apart, _ = cKDTree(other / np.maximum(other_range_m, 1e-6)[:, None]).query(
        directions, k=_MIN_DIRECTIONS, distance_upper_bound=_MAX_ANGLE_RAD, workers=-1)
    return np.isfinite(apart).all(axis=1)
