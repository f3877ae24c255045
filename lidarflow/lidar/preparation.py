"""Which returns of a scan take part: finite, outside the ego vehicle, inside the range limit."""

import numpy as np

from lidarflow.config import PreparationConfig
from lidarflow.errors import DataError
from lidarflow.kernels.thinning import FARTHEST_M, NEAREST_M
from lidarflow.types import Scan


def usable(points: np.ndarray, config: PreparationConfig) -> np.ndarray:
    """Mask (N,) of the points (N, 3), metres in the sensor frame, that take part."""
    nearest_m, farthest_m = max(config.min_range_m, NEAREST_M), min(config.max_range_m, FARTHEST_M)
    with np.errstate(invalid="ignore", over="ignore"):
        range_sq = np.einsum("ij,ij->i", points, points)
        return (range_sq >= nearest_m**2) & (range_sq <= farthest_m**2)


def require_points(scan: Scan, config: PreparationConfig) -> None:
    """Raise DataError for a scan without a point that takes part."""
    if not usable(scan.points, config).any():
        raise DataError(
            f"{scan.name}: none of {len(scan)} points lies between {config.min_range_m:g} and "
            f"{config.max_range_m:g} m from the sensor; is the scan empty, or not in metres?")
