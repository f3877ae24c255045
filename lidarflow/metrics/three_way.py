"""Three-way end-point error and dynamic IoU, as on the Argoverse 2 leaderboard."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lidarflow.metrics.epe import MeanError, mean_error, pooled

HALF_WIDTH_M = 50.0


@dataclass(frozen=True, slots=True)
class ThreeWay:
    """Errors of three kinds of points, and how well moving points are told from others.

    true_movers, false_movers, missed_movers   points rightly called moving (TP), wrongly (FP), and not (FN)
    """

    foreground_dynamic: MeanError
    foreground_static: MeanError
    background_static: MeanError
    true_movers: int
    false_movers: int
    missed_movers: int

    @property
    def mean_m(self) -> float:
        """Mean of the three mean errors in metres; NaN unless there are points of every kind."""
        parts = self.foreground_dynamic, self.foreground_static, self.background_static
        return float(np.mean([part.mean for part in parts]))

    @property
    def dynamic_iou(self) -> float:
        """Overlap of the points called moving with those that move; NaN where there are neither."""
        either = self.true_movers + self.false_movers + self.missed_movers
        return self.true_movers / either if either else float("nan")


def evaluated(points: np.ndarray, is_ground: np.ndarray) -> np.ndarray:
    """Points (N,) that the leaderboard counts: |x|, |y| ≤ 50 m of points (N, 3), no ground."""
    return (np.abs(points[:, :2]) <= HALF_WIDTH_M).all(axis=1) & ~is_ground


def three_way(
    error: np.ndarray, moves: np.ndarray, is_foreground: np.ndarray, called_dynamic: np.ndarray
) -> ThreeWay:
    """Three-way error of N points; choose them by `evaluated`.

    error           (N,)  end-point error, metres
    moves           (N,)  the point moves, by the labels of the truth, as the leaderboard has it
    is_foreground   (N,)  the point is on a labelled object
    called_dynamic  (N,)  the point is said to move
    """
    return ThreeWay(
        foreground_dynamic=mean_error(error[is_foreground & moves]),
        foreground_static=mean_error(error[is_foreground & ~moves]),
        background_static=mean_error(error[~is_foreground & ~moves]),
        true_movers=int((moves & called_dynamic).sum()),
        false_movers=int((~moves & called_dynamic).sum()),
        missed_movers=int((moves & ~called_dynamic).sum()),
    )


def pooled_three_way(pairs: Sequence[ThreeWay]) -> ThreeWay:
    """The three-way error of several pairs together, every point counting alike."""
    return ThreeWay(
        pooled([pair.foreground_dynamic for pair in pairs]),
        pooled([pair.foreground_static for pair in pairs]),
        pooled([pair.background_static for pair in pairs]),
        sum(pair.true_movers for pair in pairs),
        sum(pair.false_movers for pair in pairs),
        sum(pair.missed_movers for pair in pairs),
    )
