"""The way of the sensor along a run, gaps included."""

from pathlib import Path

import numpy as np

from lidarflow import io, pose
from lidarflow.rgbd_types import RgbdPair
from lidarflow.types import ScanPair


class Trajectory:
    """Poses of the scans `frames` (consecutive indices) in the first one's frame, from pair to pair.

    Where a pair is missing the sensor is taken to go on as in the pair before, and to stand still where there
    is none, so that every scan has a pose.
    """

    def __init__(self, frames: list[int]):
        self._first, self._count = frames[0], len(frames)
        self._poses = [pose.identity()]
        self._step = pose.identity()
        self._times_ns: dict[int, int] = {}

    def reached(self, index: int) -> np.ndarray:
        """world_from_sensor (4, 4) at the scan `index`, not before the last one added."""
        while len(self._poses) <= index - self._first:
            self._poses.append(self._poses[-1] @ self._step)
        return self._poses[index - self._first]

    def go(self, index: int, ego_motion: np.ndarray) -> None:
        """Go from the scan `index` to the next by its ego_motion (4, 4), target_from_source."""
        world_from_source, self._step = self.reached(index), pose.inverse(ego_motion)
        self._poses.append(world_from_source @ self._step)

    def add(self, index: int, pair: ScanPair | RgbdPair, ego_motion: np.ndarray) -> None:
        """Go from the scan `index` to the next, and learn their times."""
        self.go(index, ego_motion)
        self._times_ns |= {index: pair.source.time_ns, index + 1: pair.target.time_ns}

    def poses(self) -> np.ndarray:
        """world_from_sensor (N, 4, 4) at all scans, also where their time is not known."""
        self.reached(self._first + self._count - 1)
        return np.stack(self._poses)

    def timed(self) -> tuple[list[int], np.ndarray, list[int]]:
        """Indices (K,), poses (K, 4, 4) and times of the scans whose time is known, those of the pairs."""
        timed = sorted(self._times_ns)
        return timed, np.stack([self.reached(index) for index in timed]), [self._times_ns[k] for k in timed]

    def write_tum(self, out: Path) -> None:
        """Write poses_tum.txt, without scans of unknown time."""
        _, poses, times_ns = self.timed()
        io.write_poses_tum(out / "poses_tum.txt", poses, times_ns)

    def write(self, out: Path) -> None:
        """Write poses_kitti.txt, a row for every scan, and poses_tum.txt."""
        io.write_poses_kitti(out / "poses_kitti.txt", self.poses())
        self.write_tum(out)
