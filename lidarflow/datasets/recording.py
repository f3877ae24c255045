"""What recordings of a sensor share: one file, scans by index, times of the sensor, nothing else known."""

from abc import abstractmethod
from pathlib import Path

import numpy as np

from lidarflow.datasets.base import Scans, Source
from lidarflow.datasets.foreign import guarded
from lidarflow.datasets.kitti_correction import correct_vertical_angle, is_wanted
from lidarflow.errors import DataError
from lidarflow.types import Scan, Truth


class Recording(Scans):
    """A file that the package called `reader` reads; loaders count and read its scans."""

    loader: str
    reader: str
    suffixes: tuple[str, ...]
    source: Source | None = None

    def __init__(self, file: Path, kitti_correction: str):
        if not file.is_file():
            raise DataError(f"{file}: is a folder; expected one file, {' or '.join(self.suffixes)}")
        self.file = file
        self.name = f"{self.loader} {file.name}"
        self._origin = f"{file}: {self.reader}"
        self._correct = is_wanted(kitti_correction, False)
        self.note = "times by the sensor's clock"
        if self._correct:
            self.note += "; KITTI vertical-angle correction on"

    def scan(self, index: int) -> Scan:
        """The scan at `index`; DataError where it cannot be read, or nothing was seen."""
        index = self.check_index(index)
        points, time_ns = guarded(self._origin, lambda: self._read(index))
        if not np.isfinite(points).all(axis=1).any():
            raise DataError(f"{self.file}: scan {index} is empty (no return); see --jump and --n-scans")
        points = correct_vertical_angle(points) if self._correct else points
        return Scan(points, time_ns, f"{index:06d}")

    def truth(self, index: int) -> Truth | None:
        """Recordings hold no flow."""
        return None

    def world_from_sensor(self) -> np.ndarray | None:
        """Recordings hold no poses."""
        return None

    @abstractmethod
    def _read(self, index: int) -> tuple[np.ndarray, int]:
        """Points (N, 3) float64 in metres, sensor frame, and the time in ns; may raise anything."""
