"""First guesses of the ego-motion along a sequence."""

from typing import Protocol

import numpy as np

from lidarflow import pose
from lidarflow.config import Config
from lidarflow.lidar import preparation
from lidarflow.types import FlowResult, Scan, ScanPair


class Odometry(Protocol):
    """First guesses of the ego-motion along a sequence."""

    def step(self, points: np.ndarray, dt_s: float) -> np.ndarray | None:
        """current_from_previous (4, 4) for the next scan's points (N, 3), `dt_s` after the last; if known."""

    def found(self, motion: np.ndarray, dt_s: float) -> None:
        """Hear what the motion (4, 4) to the last scan was."""


def begun(config: Config) -> Odometry:
    """What gives first guesses, as the settings want it."""
    return KissIcp(config) if config.ego.method == "kiss_icp" else LastMotion()


def follow(odometry: Odometry, last: Scan | None, scan: Scan, known: FlowResult | None) -> None:
    """Show odometry a scan after the `last` one whose motion is known already, or nothing of it."""
    dt_s = ScanPair(last, scan).dt_s if last is not None else 0.0
    odometry.step(scan.points, dt_s)
    if last is not None and known is not None:
        odometry.found(known.ego_motion, dt_s)


class LastMotion:
    """The sensor goes on as it did from the scan before to the last one."""

    def __init__(self) -> None:
        self._last: tuple[np.ndarray, float] | None = None

    def step(self, _points: np.ndarray, dt_s: float) -> np.ndarray | None:
        """As the last motion, which is forgotten until the next one is found."""
        last, self._last = self._last, None
        if last is None:
            return None
        return pose.lasting(*last, dt_s)

    def found(self, motion: np.ndarray, dt_s: float) -> None:
        """Hear what the motion (4, 4) to the last scan was."""
        self._last = motion, dt_s


class KissIcp:
    """What KISS-ICP says (Vizzo et al. 2023), whatever else is found."""

    def __init__(self, config: Config):
        self._limits = config.preparation
        self._kiss_icp = _kiss_icp(self._limits)
        self._world_from_previous: np.ndarray | None = None

    def step(self, points: np.ndarray, _dt_s: float) -> np.ndarray | None:
        """current_from_previous (4, 4) for the next scan's points (N, 3); None for the first."""
        usable = preparation.usable(points, self._limits)
        self._kiss_icp.register_frame(points[usable], np.empty(0))
        world_from_current = np.array(self._kiss_icp.last_pose)
        previous, self._world_from_previous = self._world_from_previous, world_from_current
        return None if previous is None else pose.inverse(world_from_current) @ previous

    def found(self, motion: np.ndarray, dt_s: float) -> None:
        """It has a map of its own."""


def _kiss_icp(limits):
    from kiss_icp.config import KISSConfig
    from kiss_icp.kiss_icp import KissICP

    config = KISSConfig()
    config.data.min_range, config.data.max_range = limits.min_range_m, limits.max_range_m
    config.data.deskew = False   # flow is between the points as they were measured
    config.mapping.voxel_size = limits.max_range_m / 100.0   # as its own loader of settings has it
    return KissICP(config)
