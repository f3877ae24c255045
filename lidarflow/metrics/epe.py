"""End-point errors, and the shares and angles that are derived from them; all of total flow.

Thresholds are those of the field (FlowNet3D, HPLFlowNet, Argoverse 2): a point counts as right when its error
is small in metres or beside the length of its true flow.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

STRICT, RELAXED = 0.05, 0.1                     # metres, and share of the true flow
OUTLIER_M, OUTLIER_SHARE = 0.3, 0.1
SWEEP_S = 0.1                                   # what the Argoverse form of the angle takes as time


@dataclass(frozen=True, slots=True)
class ErrorSummary:
    """End-point error in metres over a set of points; NaN where the set is empty."""

    points: int
    mean: float
    median: float


@dataclass(frozen=True, slots=True)
class MeanError:
    """Mean end-point error in metres over a set of points; NaN where it is empty."""

    points: int
    mean: float


@dataclass(frozen=True, slots=True)
class Accuracy:
    """Shares of a set of points, and mean angles; NaN where the set is empty.

    strict               AccS: error < 0.05 m or < 5 % of the true flow
    relaxed              AccR: error < 0.1 m or < 10 %
    outliers             error > 0.3 m or > 10 %
    angle_rad            between the directions of flow and true flow, over points where both have one
    space_time_angle_rad the same with 0.1 s as fourth component (Argoverse 2)
    """

    strict: float
    relaxed: float
    outliers: float
    angle_rad: float
    space_time_angle_rad: float


def end_point_error(flow: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Distance (N,) in metres between estimated and true flow (N, 3)."""
    return np.linalg.norm(flow - truth, axis=1)


def relative_error(flow: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """End-point error (N,) as a share of the length of the true flow (N, 3); of no flow, 0 or infinite."""
    error, length = end_point_error(flow, truth), np.linalg.norm(truth, axis=1)
    return np.divide(error, length, out=np.where(error > 0, np.inf, 0.0), where=length > 0)


def summarise(error: np.ndarray) -> ErrorSummary:
    """Count, mean and median of errors (N,) in metres."""
    if len(error) == 0:
        return ErrorSummary(0, float("nan"), float("nan"))
    return ErrorSummary(len(error), float(error.mean()), float(np.median(error)))


def mean_error(error: np.ndarray) -> MeanError:
    """Count and mean of errors (N,) in metres."""
    return MeanError(len(error), mean_of(error))


def pooled(parts: Sequence[MeanError]) -> MeanError:
    """The error of several sets of points together, every point counting alike."""
    points = sum(part.points for part in parts)
    total_m = sum(part.points * part.mean for part in parts if part.points)
    return MeanError(points, total_m / points if points else float("nan"))


def accuracy(flow: np.ndarray, truth: np.ndarray) -> Accuracy:
    """Shares and angles of estimated against true flow (N, 3), metres, all rows finite."""
    error, relative = end_point_error(flow, truth), relative_error(flow, truth)
    return Accuracy(
        strict=mean_of((error < STRICT) | (relative < STRICT)),
        relaxed=mean_of((error < RELAXED) | (relative < RELAXED)),
        outliers=mean_of((error > OUTLIER_M) | (relative > OUTLIER_SHARE)),
        angle_rad=mean_of(angle_error(flow, truth)),
        space_time_angle_rad=mean_of(space_time_angle_error(flow, truth)),
    )


def angle_error(flow: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Angle (N,) in radians between the directions of flow and true flow (N, 3); NaN where one is zero."""
    return _angle(flow, truth)


def space_time_angle_error(flow: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Angle (N,) in radians between flows (N, 3) with 0.1 s as fourth component (Argoverse 2)."""
    time = np.full((len(flow), 1), SWEEP_S)
    return _angle(np.hstack([flow, time]), np.hstack([truth, time]))


def error_over_speed(error: np.ndarray, residual_flow: np.ndarray) -> float:
    """Mean end-point error (N,) over the mean length of the true residual flow (N, 3) of the same points.

    1 is what the ego-motion alone scores. The ratio of means, as in a bucket of the bucketed metric, and not
    the mean of ratios, which the slowest points would rule.
    """
    if len(error) == 0:
        return float("nan")
    speed_m = np.linalg.norm(residual_flow, axis=1).mean()
    return float(error.mean() / speed_m) if speed_m > 0 else float("nan")


def mean_of(values: np.ndarray) -> float:
    """Mean of the values (N,) that are not NaN; NaN where there are none."""
    values = values[~np.isnan(values)]
    return float(values.mean()) if len(values) else float("nan")


def _angle(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angle (N,) between rows of a and b (N, D), exact for small angles too; NaN where a row is zero."""
    lengths = np.linalg.norm(a, axis=1), np.linalg.norm(b, axis=1)
    known = (lengths[0] > 0) & (lengths[1] > 0)
    u, v = a[known] / lengths[0][known, None], b[known] / lengths[1][known, None]
    angle = np.full(len(a), np.nan)
    # The arc cosine of a dot product is blind below 1e-8 rad (Kahan).
    angle[known] = 2.0 * np.arctan2(np.linalg.norm(u - v, axis=1), np.linalg.norm(u + v, axis=1))
    return angle
