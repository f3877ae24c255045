"""Three-way end-point error and dynamic IoU, as on the Argoverse 2 leaderboard."""

from dataclasses import dataclass

import numpy as np

from lidarflow.metrics.epe import mean_of

DYNAMIC_M = 0.05             # residual flow from one scan to the next, 0.1 s apart
HALF_WIDTH_M = 50.0


@dataclass(frozen=True, slots=True)
class ThreeWay:
    """End-point errors in metres, each a mean over its points, and their mean; NaN where a set is empty.

    dynamic_iou  overlap of the points called moving with those that move: TP / (TP + FP + FN)
    """

    foreground_dynamic: float
    foreground_static: float
    background_static: float
    mean: float
    dynamic_iou: float


def evaluated(points: np.ndarray, is_ground: np.ndarray) -> np.ndarray:
    """Points (N,) that the leaderboard counts: |x|, |y| ≤ 50 m of points (N, 3), no ground."""
    return (np.abs(points[:, :2]) <= HALF_WIDTH_M).all(axis=1) & ~is_ground


def three_way(
    error: np.ndarray, residual_flow: np.ndarray, is_foreground: np.ndarray, called_dynamic: np.ndarray
) -> ThreeWay:
    """Three-way error of N points; choose them by `evaluated`.

    error           (N,)    end-point error, metres
    residual_flow   (N, 3)  true flow over ground, metres; a point moves from 0.05 m a frame on
    is_foreground   (N,)    the point is on a labelled object
    called_dynamic  (N,)    the point is said to move
    """
    moves = np.linalg.norm(residual_flow, axis=1) >= DYNAMIC_M
    parts = [mean_of(error[rows]) for rows in
             (is_foreground & moves, is_foreground & ~moves, ~is_foreground & ~moves)]
    either = (moves | called_dynamic).sum()
    iou = float((moves & called_dynamic).sum() / either) if either else float("nan")
    return ThreeWay(*parts, mean=float(np.mean(parts)), dynamic_iou=iou)
