"""End-point error by distance from the sensor and by speed over ground."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lidarflow.metrics.epe import MeanError, mean_error, pooled

RANGE_EDGES_M = (0.0, 35.0, 50.0, 75.0, 100.0, np.inf)
SPEED_EDGES_M = (0.0, 0.05, 0.2, 0.5, 1.0, 2.0, np.inf)      # metres from one scan to the next


@dataclass(frozen=True, slots=True)
class Interval:
    """Error of the points between two values, low ≤ value < high, in metres."""

    low_m: float
    high_m: float
    all: MeanError
    static: MeanError
    dynamic: MeanError


def by_range(points: np.ndarray, error: np.ndarray, is_dynamic: np.ndarray) -> tuple[Interval, ...]:
    """Errors (N,) of points (N, 3) by distance from the sensor: 0, 35, 50, 75, 100 m and beyond."""
    return _intervals(np.linalg.norm(points, axis=1), error, is_dynamic, RANGE_EDGES_M)


def by_speed(residual_flow: np.ndarray, error: np.ndarray, is_dynamic: np.ndarray) -> tuple[Interval, ...]:
    """Errors (N,) by the length of the true residual flow (N, 3), in metres a frame."""
    return _intervals(np.linalg.norm(residual_flow, axis=1), error, is_dynamic, SPEED_EDGES_M)


def pooled_intervals(pairs: Sequence[tuple[Interval, ...]]) -> tuple[Interval, ...]:
    """The intervals of several pairs together, every point counting alike."""
    return tuple(
        Interval(same[0].low_m, same[0].high_m, pooled([part.all for part in same]),
                 pooled([part.static for part in same]), pooled([part.dynamic for part in same]))
        for same in zip(*pairs, strict=True))


def _intervals(
    values: np.ndarray, error: np.ndarray, is_dynamic: np.ndarray, edges: tuple[float, ...]
) -> tuple[Interval, ...]:
    found = []
    for low, high in itertools.pairwise(edges):
        rows = (values >= low) & (values < high)
        found.append(Interval(low, high, mean_error(error[rows]), mean_error(error[rows & ~is_dynamic]),
                              mean_error(error[rows & is_dynamic])))
    return tuple(found)
