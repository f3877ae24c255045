"""A spinning LiDAR as a fan of rays."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True, eq=False)
class Sensor:
    """A spinning LiDAR.

    elevations_rad    (R,) float   of the rings over the horizon, top ring first
    columns           int          rays of a ring in one revolution
    range_noise_m     float        standard deviation, along the ray
    drop_probability  float        chance that a return is lost
    height_m          float        over ground
    """

    name: str
    elevations_rad: np.ndarray
    columns: int
    max_range_m: float
    range_noise_m: float
    drop_probability: float
    height_m: float

    def __post_init__(self):
        if self.elevations_rad.ndim != 1 or not (np.diff(self.elevations_rad) < 0).all():
            raise ValueError("Sensor.elevations_rad: expected (R,), top ring first")
        if self.columns < 1 or self.max_range_m <= 0 or self.range_noise_m < 0:
            raise ValueError("Sensor: expected columns >= 1, max_range_m > 0, range_noise_m >= 0")
        if not 0 <= self.drop_probability <= 1:
            raise ValueError(f"Sensor.drop_probability: expected 0..1, got {self.drop_probability}")

    def directions(self, phase: float = 0.0) -> np.ndarray:
        """Unit vectors (R * columns, 3), ring by ring, azimuth from x over y; `phase` in columns, 0..1."""
        azimuth = (np.arange(self.columns) + phase) * (2 * np.pi / self.columns)
        elevation = self.elevations_rad[:, None]
        x, y = np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth)
        z = np.broadcast_to(np.sin(elevation), x.shape)
        return np.stack([x, y, z], axis=-1).reshape(-1, 3)


def hdl64e(columns: int = 2000, range_noise_m: float = 0.02, drop_probability: float = 0.04) -> Sensor:
    """A Velodyne HDL-64E as on the KITTI car: an upper block of 32 lasers and a coarser lower one."""
    upper_deg, lower_deg = 2.0 - np.arange(32) / 3.0, -8.83 - np.arange(32) / 2.0
    elevations_rad = np.deg2rad(np.concatenate([upper_deg, lower_deg]))
    return Sensor("HDL-64E", elevations_rad, columns, 120.0, range_noise_m, drop_probability, 1.73)


def hdl32e(columns: int = 1800, range_noise_m: float = 0.02, drop_probability: float = 0.04) -> Sensor:
    """A Velodyne HDL-32E as on the nuScenes car: 32 lasers at 4/3 degrees."""
    elevations_rad = np.deg2rad(10.67 - np.arange(32) * (41.34 / 31.0))
    return Sensor("HDL-32E", elevations_rad, columns, 70.0, range_noise_m, drop_probability, 1.84)
