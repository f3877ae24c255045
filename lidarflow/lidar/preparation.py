"""Which returns of a scan take part: finite, outside the ego vehicle, inside the range limit."""

import numpy as np

from lidarflow.config import PreparationConfig
from lidarflow.errors import DataError
from lidarflow.types import Scan

_NEAREST_M = 1e-3        # nearer than this lie no returns: files have zeros where there was no echo
_FARTHEST_M = 1e4        # nor farther, whatever the settings: int32 has to do for counting cells


def range_limits_m(config: PreparationConfig) -> tuple[float, float]:
    """The least and the largest range of returns that take part, metres."""
    return max(config.min_range_m, _NEAREST_M), min(config.max_range_m, _FARTHEST_M)


def usable(points: np.ndarray, config: PreparationConfig) -> np.ndarray:
    """Mask (N,) of the points (N, 3), metres in the sensor frame, that take part."""
    nearest_m, farthest_m = range_limits_m(config)
    with np.errstate(invalid="ignore", over="ignore"):
        range_sq = np.einsum("ij,ij->i", points, points)
        return (range_sq >= nearest_m**2) & (range_sq <= farthest_m**2)


def require_points(scan: Scan, config: PreparationConfig) -> None:
    """Raise DataError for a scan without a point that takes part."""
    if not usable(scan.points, config).any():
        raise DataError(
            f"{scan.name}: none of {len(scan)} points lies between {config.min_range_m:g} and "
            f"{config.max_range_m:g} m from the sensor; is the scan empty, or not in metres?")
