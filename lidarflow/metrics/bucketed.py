"""Bucketed normalised end-point error: the share of a motion that is missed (Khatri et al. 2024)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lidarflow.metrics.epe import mean_of
from lidarflow.types import Category

CLASSES = (Category.BACKGROUND, Category.CAR, Category.OTHER_VEHICLES, Category.PEDESTRIAN,
           Category.WHEELED_VRU)
SPEED_EDGES_M = np.append(np.linspace(0.0, 2.0, 51), np.inf)     # metres from one scan to the next
HALF_WIDTH_M = 35.0


@dataclass(frozen=True, slots=True, eq=False)
class Buckets:
    """Sums over the points of every class (row) and speed bucket (column); sums of pairs can be added.

    points   (5, 51) int     how many
    error_m  (5, 51) float   sum of end-point errors
    speed_m  (5, 51) float   sum of the lengths of the true residual flow
    """

    points: np.ndarray
    error_m: np.ndarray
    speed_m: np.ndarray


@dataclass(frozen=True, slots=True)
class ClassErrors:
    """Errors of one class, or the mean over classes; NaN where there is no such point.

    static_m  mean end-point error in metres in the first bucket, slower than 0.04 m a frame
    dynamic   mean over the other buckets of mean error / mean speed: 0 = right, 1 = as good as no motion
    """

    static_m: float
    dynamic: float


@dataclass(frozen=True, slots=True)
class Bucketed:
    """Bucketed errors by the names of CLASSES, and their means over the classes that occur."""

    mean: ClassErrors
    classes: dict[str, ClassErrors]


def buckets(
    points: np.ndarray, error: np.ndarray, residual_flow: np.ndarray, category: np.ndarray
) -> Buckets:
    """Sums over the points (N, 3) with |x|, |y| < 35 m; give no ground, which the leaderboard leaves out.

    error          (N,)    end-point error, metres
    residual_flow  (N, 3)  true flow without the ego-motion, metres
    category       (N,)    a Category each; OTHER is in no class
    """
    near = (np.abs(points[:, :2]) < HALF_WIDTH_M).all(axis=1) & np.isin(category, CLASSES)
    speed_m = np.linalg.norm(residual_flow[near], axis=1)
    row = np.searchsorted(CLASSES, category[near])
    column = np.searchsorted(SPEED_EDGES_M[1:-1], speed_m, side="right")     # of a huge flow, inf
    cells = (len(CLASSES), len(SPEED_EDGES_M) - 1)
    cell = np.ravel_multi_index((row, column), cells)

    def summed(weights: np.ndarray | None) -> np.ndarray:
        return np.bincount(cell, weights, minlength=cells[0] * cells[1]).reshape(cells)

    return Buckets(summed(None), summed(error[near]), summed(speed_m))


def pooled_buckets(parts: Sequence[Buckets]) -> Buckets:
    """The sums of several pairs together; at least one."""
    return Buckets(sum(part.points for part in parts), sum(part.error_m for part in parts),
                   sum(part.speed_m for part in parts))


def bucketed(sums: Buckets) -> Bucketed:
    """The errors that the sums stand for: means over buckets first, then over classes."""
    with np.errstate(invalid="ignore"):
        mean_error = sums.error_m / sums.points
        normalised = mean_error[:, 1:] / (sums.speed_m / sums.points)[:, 1:]
    static = mean_error[:, 0]
    dynamic = np.array([mean_of(row) for row in normalised])
    by_class = {kind.name: ClassErrors(float(static[row]), float(dynamic[row]))
                for row, kind in enumerate(CLASSES)}
    return Bucketed(ClassErrors(mean_of(static), mean_of(dynamic)), by_class)
