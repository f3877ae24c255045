"""What ego-motion alone leaves unexplained, and whether the sensor looked there at all.

What hides a place does not excuse it: a car that comes nearer hides the place where it was.
"""

from dataclasses import dataclass

import numpy as np

from lidarflow.config import ObjectsConfig
from lidarflow.kernels import directions
from lidarflow.rows import lengths

_MAX_ANGLE_RAD = np.radians(1.5)
_MIN_DIRECTIONS = 2


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """What a cloud, brought to another scan's frame, finds there.

    unexplained  (N,) bool    too far from the other scan, although the sensor looked in that direction
    blind        (N,) bool    too far from it, but out of view: no evidence of anything
    """

    unexplained: np.ndarray
    blind: np.ndarray


def gather(
    points: np.ndarray, left_m: np.ndarray, tolerance_m: np.ndarray, other: np.ndarray
) -> Evidence:
    """Evidence of `points` (N, 3), which lie `left_m` (N,) from the nearest of `other` (M, 3).

    They are explained up to `tolerance_m` (N,). Metres, both clouds in the sensor frame of `other`.
    """
    far = np.flatnonzero(left_m > tolerance_m)
    towards = points.take(far, axis=0)
    towards /= np.maximum(lengths(towards), 1e-6)[:, None]
    seen = directions.looked_at(towards, other, _MAX_ANGLE_RAD, _MIN_DIRECTIONS)
    unexplained, blind = np.zeros((2, len(points)), bool)
    unexplained[far[seen]] = True
    blind[far[~seen]] = True
    return Evidence(unexplained, blind)


def tolerance(range_m: np.ndarray, config: ObjectsConfig) -> np.ndarray:
    """How far (N,) in metres a point may be from the next scan's nearest: scan lines spread with range."""
    return config.near_m + config.near_share * range_m
