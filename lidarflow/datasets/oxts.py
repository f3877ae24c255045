"""Poses of KITTI's inertial and satellite navigation (OXTS)."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lidarflow import pose
from lidarflow.datasets import tables

EARTH_RADIUS_M = 6378137.0
COLUMNS = 30


def read_packets(path: Path) -> np.ndarray:
    """The packets (N, 30) of a file with one per line, as in the tracking benchmark."""
    return tables.read_numbers(path, COLUMNS)


def world_from_imu(packets: np.ndarray) -> np.ndarray:
    """Poses (N, 4, 4) of packets (N, 30): latitude, longitude [deg], altitude [m], roll, pitch, yaw [rad], …

    The world is the first position's Mercator plane: x east, y north, z up.
    """
    latitude, longitude = np.radians(packets[:, 0]), np.radians(packets[:, 1])
    scale = np.cos(latitude[:1])
    place = np.stack([
        scale * EARTH_RADIUS_M * longitude,
        scale * EARTH_RADIUS_M * np.log(np.tan(np.pi / 4 + latitude / 2)),
        packets[:, 2]], axis=1)
    roll, pitch, yaw = packets[:, 3:6].T
    turned = _about(2, yaw) @ _about(1, pitch) @ _about(0, roll)
    return pose.from_translation(place - place[:1]) @ turned


def world_from_lidar(packets: np.ndarray, lidar_from_imu: np.ndarray) -> np.ndarray:
    """Poses (N, 4, 4) of the LiDAR in the world of `world_from_imu`."""
    return world_from_imu(packets) @ pose.inverse(lidar_from_imu)


def read_packet_files(files: Sequence[Path]) -> np.ndarray:
    """The packets (N, 30) of files with one each, as in the raw recordings."""
    return np.concatenate([read_packets(file)[:1] for file in files])


def _about(axis: int, angle: np.ndarray) -> np.ndarray:
    twist = np.zeros((len(angle), 6))
    twist[:, axis] = angle
    return pose.exp(twist)
