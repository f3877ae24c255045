"""Which returns of a scan take part: finite, outside the ego vehicle, inside the range limit."""

import numpy as np

from lidarflow.config import PreparationConfig


def usable(points: np.ndarray, config: PreparationConfig) -> np.ndarray:
    """Mask (N,) of the points (N, 3), metres in the sensor frame, that take part."""
    with np.errstate(invalid="ignore", over="ignore"):
        range_sq = np.einsum("ij,ij->i", points, points)
        return (range_sq >= config.min_range_m**2) & (range_sq <= config.max_range_m**2)
