"""Rigid motion of a small group of points onto the next scan, turning about the vertical only."""

import numpy as np
from scipy.spatial import cKDTree

from lidarflow import pose

_GATES_M = (1.0, 0.5, 0.3)   # how far a point may be from its counterpart, coarse to fine
_ROUNDS_PER_GATE = 5
_MAX_TURN_RAD = 0.15
_MIN_TURNING_POINTS = 16     # fewer points do not fix a turn
_MIN_POINTS = 4
_SETTLED = 1e-4              # a round that changes less, in metres and radians, ends its gate


def onto(points: np.ndarray, target: cKDTree, translation: np.ndarray) -> np.ndarray:
    """Motion (4, 4) of points (N, 3) onto the points of `target`, by ICP in yaw and translation.

    It starts from `translation` (3,) in metres. What stands upright on the ground turns about the vertical.
    """
    centre = points.mean(axis=0)
    turn, shift = 0.0, np.asarray(translation, float)
    for gate_m in _GATES_M:
        for _ in range(_ROUNDS_PER_GATE):
            moved = pose.apply(_about(centre, turn, shift), points)
            distance_m, nearest = target.query(moved, distance_upper_bound=gate_m)
            paired = np.isfinite(distance_m)
            if paired.sum() < _MIN_POINTS:
                break
            before = turn, shift
            turn, shift = _best(points[paired] - centre, target.data[nearest[paired]] - centre)
            if abs(turn - before[0]) < _SETTLED and np.abs(shift - before[1]).max() < _SETTLED:
                break
    return _about(centre, turn, shift)


def _best(a: np.ndarray, b: np.ndarray) -> tuple[float, np.ndarray]:
    """Turn about z and shift that bring points a (K, 3) closest to b (K, 3) in least squares."""
    mean_a, mean_b = a.mean(axis=0), b.mean(axis=0)
    turn = 0.0
    if len(a) >= _MIN_TURNING_POINTS:
        from_mean_a, from_mean_b = (a - mean_a)[:, :2], (b - mean_b)[:, :2]
        sine = (from_mean_a[:, 0] * from_mean_b[:, 1] - from_mean_a[:, 1] * from_mean_b[:, 0]).sum()
        cosine = (from_mean_a * from_mean_b).sum()
        turn = float(np.clip(np.arctan2(sine, cosine), -_MAX_TURN_RAD, _MAX_TURN_RAD))
    return turn, mean_b - pose.apply(pose.from_yaw(turn), mean_a)


def _about(centre: np.ndarray, turn: float, shift: np.ndarray) -> np.ndarray:
    """Motion (4, 4) that turns about the vertical through `centre` (3,), then shifts."""
    return pose.from_translation(centre + shift) @ pose.from_yaw(turn) @ pose.from_translation(-centre)
