"""Every other format that KISS-ICP reads, through KISS-ICP's own loaders."""

import weakref
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from lidarflow import pose
from lidarflow.datasets import point_cloud2
from lidarflow.datasets.base import Scans, Source, assumed_times
from lidarflow.datasets.foreign import Stream, guarded
from lidarflow.datasets.kitti_correction import correct_vertical_angle, is_wanted
from lidarflow.errors import DataError
from lidarflow.types import Scan, Truth

STREAMS = ("mcap", "rosbag")     # read forwards only, whatever index is asked for


class KissLoader(Scans):
    """Scans and poses as KISS-ICP's loader of this name gives them; times assume 10 Hz.

    For recordings of several topics (mcap, rosbag) the sequence is the topic, and times are those of the
    messages; for nuScenes it is the scene, and times are its own.
    """

    source: Source | None = None

    def __init__(self, loader: str, folder: Path, sequence: str | None = None,
                 kitti_correction: str = "auto"):
        from kiss_icp import datasets

        self.loader = loader
        self.name = f"{loader} {sequence or Path(folder).absolute().name}"
        self._correct = is_wanted(kitti_correction, False)
        self._origin = f"{folder}: KISS-ICP's loader '{loader}'"
        if loader in datasets.sequence_dataloaders() and not sequence:
            raise DataError(f"{self._origin} needs a sequence; choose one with --sequence")
        self._data = guarded(self._origin, lambda: datasets.dataset_factory(
            loader, Path(folder), sequence=sequence, topic=sequence, meta=None))
        if hasattr(self._data, "read_point_cloud") and loader in STREAMS:
            # KISS-ICP's own stumbles over messages of mcap-ros2-support (its pull request 498).
            self._data.read_point_cloud = point_cloud2.read
        self._length = guarded(self._origin, lambda: len(self._data))
        if not self._length:
            raise DataError(f"{self._origin} found no scans; is this the right folder for it?")
        self._poses = _checked_poses(vars(self._data).get("gt_poses"), self._length)
        self._times_ns = assumed_times(self._length)
        self._stream = None
        if loader == "nuscenes":
            self._times_ns = guarded(self._origin, lambda: _nuscenes_times(self._data))
        elif loader in STREAMS:
            self._stream = Stream(self._from_start)
            weakref.finalize(self, _close, self._data)
        assumed = "" if loader in (*STREAMS, "nuscenes") else ", 10 Hz assumed"
        self.note = f"read by KISS-ICP's loader '{loader}'{assumed}"
        if self._correct:
            self.note += "; KITTI vertical-angle correction on"

    def __len__(self) -> int:
        return self._length

    def scan(self, index: int) -> Scan:
        """The scan at `index`; DataError where the loader cannot read it."""
        index = self.check_index(index)
        item, time_ns = guarded(self._origin, lambda: self._read(index))
        points = np.array(item[0] if isinstance(item, tuple | list) else item, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] < 3 or not np.isfinite(points[:, :3]).any():
            raise DataError(f"{self._origin} gave an array {points.shape} for scan {index}; "
                            "expected points (N, 3)")
        points = np.ascontiguousarray(points[:, :3])
        points = correct_vertical_angle(points) if self._correct else points
        return Scan(points, time_ns, f"{index:06d}")

    def truth(self, index: int) -> Truth | None:
        """KISS-ICP's loaders know of no flow."""
        return None

    def world_from_sensor(self) -> np.ndarray | None:
        """Given poses (N, 4, 4) where the loader has one per scan."""
        return self._poses

    def _read(self, index: int) -> tuple[Any, int]:
        """What the loader has for `index`, and its time in ns."""
        if self._stream is not None:
            return self._stream.item(index)
        return self._data[index], self._times_ns[index]

    def _from_start(self) -> Iterator[tuple[Any, int]]:
        """Items of a stream and their times, from the first one on."""
        _end_messages(self._data)
        self._data.reset()
        for index in range(self._length):
            item = self._data[index]
            stamps = self._data.get_frames_timestamps()
            yield item, round(stamps[-1] * 1e9)


def _nuscenes_times(data: Any) -> list[int]:
    """Times in ns of all scans of a nuScenes scene, whose LiDAR turns at 20 Hz."""
    return [data.nusc.get("sample_data", token)["timestamp"] * 1000 for token in data.lidar_tokens]


def _end_messages(data: Any) -> None:
    """End the reading of messages: a bag that is closed meanwhile fails."""
    messages = vars(data).get("msgs")
    if messages is not None:
        messages.close()


def _close(data: Any) -> None:
    """Close a stream's bag: KISS-ICP's loader would do it too late, and complain, when Python ends."""
    _end_messages(data)
    bag = vars(data).pop("bag", None)
    if hasattr(bag, "close"):
        bag.close()


def _checked_poses(given: Any, count: int) -> np.ndarray | None:
    """`given` as (count, 4, 4) float64, None where it is no such array of rigid motions."""
    if given is None:
        return None
    poses = np.asarray(given, dtype=np.float64)
    return poses if poses.shape == (count, 4, 4) and pose.is_rigid(poses, 1e-3) else None
