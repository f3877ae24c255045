"""The way of the sensor along a run, gaps included."""

from pathlib import Path

import numpy as np

from lidarflow import io, pose
from lidarflow.rgbd_types import RgbdPair
from lidarflow.types import ScanPair


class Trajectory:
    """Poses of the scans `frames` (consecutive indices) in the first one's frame, from pair to pair.

    Where pairs are missing the sensor is taken to go on as in the pair before, for as long as the times on
    both sides of the gap say, else one such step a scan; and to stand still where there is no pair before, so
    that every scan has a pose.
    """

    def __init__(self, frames: list[int]):
        self._first, self._count = frames[0], len(frames)
        self._poses = [pose.identity()]
        self._step, self._took_ns = pose.identity(), 0
        self._times_ns: dict[int, int] = {}

    def go(self, index: int, times_ns: tuple[int, int], ego_motion: np.ndarray) -> np.ndarray:
        """Go from the scan `index` to the next by its ego_motion (4, 4), target_from_source.

        times_ns are those of the two scans. Returns world_from_source (4, 4); scans come in order.
        """
        self._bridge(index, times_ns[0])
        world_from_source = self._poses[-1]
        self._step, self._took_ns = pose.inverse(ego_motion), times_ns[1] - times_ns[0]
        self._poses.append(world_from_source @ self._step)
        self._times_ns |= {index: times_ns[0], index + 1: times_ns[1]}
        return world_from_source

    def add(self, index: int, pair: ScanPair | RgbdPair, ego_motion: np.ndarray) -> np.ndarray:
        """As `go`, with the times of a pair."""
        return self.go(index, (pair.source.time_ns, pair.target.time_ns), ego_motion)

    def poses(self) -> np.ndarray:
        """world_from_sensor (N, 4, 4) at all scans, also where their time is not known."""
        behind = [self._poses[-1]]
        while len(self._poses) + len(behind) <= self._count:
            behind.append(behind[-1] @ self._step)
        return np.stack([*self._poses, *behind[1:]])

    def timed(self) -> tuple[list[int], np.ndarray, list[int]]:
        """Indices (K,), poses (K, 4, 4) and times of the scans whose time is known, those of the pairs."""
        timed = sorted(self._times_ns)
        poses = np.stack([self._poses[index - self._first] for index in timed])
        return timed, poses, [self._times_ns[index] for index in timed]

    def _bridge(self, index: int, time_ns: int) -> None:
        """Go on over a gap, in equal steps, to the scan `index`."""
        last = self._first + len(self._poses) - 1
        gap_ns = time_ns - self._times_ns.get(last, time_ns)
        step = self._step
        if gap_ns > 0 and self._took_ns > 0:
            step = pose.lasting(step, self._took_ns * (index - last), gap_ns)
        for _ in range(last, index):
            self._poses.append(self._poses[-1] @ step)

    def write_tum(self, out: Path) -> None:
        """Write poses_tum.txt, without scans of unknown time."""
        _, poses, times_ns = self.timed()
        io.write_poses_tum(out / "poses_tum.txt", poses, times_ns)

    def write(self, out: Path) -> None:
        """Write poses_kitti.txt, a row for every scan, and poses_tum.txt."""
        io.write_poses_kitti(out / "poses_kitti.txt", self.poses())
        self.write_tum(out)
