"""Every other format that KISS-ICP reads, through KISS-ICP's own loaders."""

import contextlib
import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from lidarflow import pose
from lidarflow.datasets.base import DEFAULT_PERIOD_NS, Source, check_index
from lidarflow.datasets.clouds import one_line
from lidarflow.datasets.kitti_correction import correct_vertical_angle, is_wanted
from lidarflow.errors import DataError, InstallError
from lidarflow.types import Scan, Truth

STREAMS = ("mcap", "rosbag")     # read forwards only, whatever index is asked for
MAX_MESSAGE_CHARS = 300


class KissLoader:
    """Scans and poses as KISS-ICP's loader of this name gives them; times assume 10 Hz.

    For recordings of several topics (mcap, rosbag) the sequence is the topic.
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
        self._data = self._call(lambda: datasets.dataset_factory(
            loader, Path(folder), sequence=sequence, topic=sequence, meta=None))
        self._length = self._call(lambda: len(self._data))
        if not self._length:
            raise DataError(f"{self._origin} found no scans; is this the right folder for it?")
        self._poses = _checked_poses(vars(self._data).get("gt_poses"), self._length)
        self._next, self._last = 0, (-1, None)
        self.note = f"read by KISS-ICP's loader '{loader}', 10 Hz assumed"
        if self._correct:
            self.note += "; KITTI vertical-angle correction on"

    def __len__(self) -> int:
        return self._length

    def scan(self, index: int) -> Scan:
        """The scan at `index`; DataError where the loader cannot read it."""
        check_index(self, index)
        if self._last[0] != index:
            self._last = index, self._call(lambda: self._item(index))
        item = self._last[1]
        points = np.array(item[0] if isinstance(item, tuple | list) else item, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] < 3 or not np.isfinite(points[:, :3]).any():
            raise DataError(f"{self._origin} gave an array {points.shape} for scan {index}; "
                            "expected points (N, 3)")
        points = np.ascontiguousarray(points[:, :3])
        points = correct_vertical_angle(points) if self._correct else points
        return Scan(points, index * DEFAULT_PERIOD_NS, f"{index:06d}")

    def truth(self, index: int) -> Truth | None:
        """KISS-ICP's loaders know of no flow."""
        return None

    def world_from_sensor(self) -> np.ndarray | None:
        """Given poses (N, 4, 4) where the loader has one per scan."""
        return self._poses

    def _item(self, index: int) -> Any:
        if self.loader not in STREAMS:
            return self._data[index]
        if index < self._next:
            self._data.reset()
            self._next = 0
        while True:
            item = self._data[self._next]
            self._next += 1
            if self._next > index:
                return item

    def _call(self, action: Callable[[], Any]) -> Any:
        """What `action` returns; what it prints, raises or exits with becomes DataError or InstallError."""
        printed = io.StringIO()
        try:
            with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
                return action()
        except ModuleNotFoundError as error:
            package = error.name
            raise InstallError(f"{self._origin} needs the package {package}; pip install {package}") from None
        except (Exception, SystemExit) as error:
            said = printed.getvalue().replace("--topic", "--sequence").replace("-" * 50, "")
            said = " ".join(said.split())
            kind = InstallError if "install" in said else DataError
            reason = f"{type(error).__name__}: {one_line(error)}"
            if kind is InstallError or (isinstance(error, SystemExit) and said):
                reason = said
            raise kind(f"{self._origin} failed ({reason[:MAX_MESSAGE_CHARS]})") from None


def _checked_poses(given: Any, count: int) -> np.ndarray | None:
    """`given` as (count, 4, 4) float64, None where it is no such array of rigid motions."""
    if given is None:
        return None
    poses = np.asarray(given, dtype=np.float64)
    return poses if poses.shape == (count, 4, 4) and pose.is_rigid(poses, 1e-3) else None
