"""Recordings of Ouster sensors, .osf and .pcap, through Ouster's own SDK."""

from pathlib import Path
from typing import Any

import numpy as np

from lidarflow.datasets.foreign import guarded
from lidarflow.datasets.recording import Recording
from lidarflow.errors import DataError


class OusterRecording(Recording):
    """Frames of one sensor of a recording; where it has several, the sequence is the sensor's number, from 0.

    A .pcap needs the sensor's metadata (.json) beside it. Points are in the sensor's frame, row by row of the
    image of returns, pixels without a return left out. A scan's time is that of its first column.
    """

    loader = "ouster"
    reader = "the Ouster SDK"
    suffixes = (".osf", ".pcap")

    def __init__(self, file: Path, sequence: str | None = None, kitti_correction: str = "auto"):
        super().__init__(file, kitti_correction)
        self._frames, infos, self._points_of = guarded(self._origin, lambda: _open(file))
        self._sensor = _choose(file, len(infos), sequence)
        self._info = infos[self._sensor]
        if not len(self):
            raise DataError(f"{file}: no frame of the sensor; expected a recording of its packets")

    def __len__(self) -> int:
        return len(self._frames)

    def _read(self, index: int) -> tuple[np.ndarray, int]:
        from ouster.sdk import core

        frame = self._frames[index][self._sensor]
        if frame is None:
            return np.empty((0, 3)), 0
        seen = core.destagger(self._info, frame.field(core.ChanField.RANGE)) != 0
        points = core.destagger(self._info, self._points_of[self._sensor](frame))[seen]
        times_ns = frame.timestamp[frame.timestamp > 0]
        return np.ascontiguousarray(points, np.float64), int(times_ns.min()) if len(times_ns) else 0


def _open(file: Path) -> tuple[Any, list, list]:
    """Frames of a recording by index; what is known of each sensor, and what makes points of its frames."""
    from ouster.sdk import core, open_source

    # Packets have no index of their own.
    indexed = {"index": True} if file.suffix.lower() == ".pcap" else {}
    frames = open_source(str(file), **indexed)
    infos = list(frames.sensor_info)
    return frames, infos, [core.XYZLut(info) for info in infos]


def _choose(file: Path, sensors: int, sequence: str | None) -> int:
    """The number of the wanted sensor, or of the only one."""
    if sequence is None and sensors == 1:
        return 0
    if sequence is not None and sequence.isdecimal() and int(sequence) < sensors:
        return int(sequence)
    wanted = "" if sequence is None else f"no sensor '{sequence}', "
    raise DataError(f"{file}: {wanted}{sensors} in all; choose one with --sequence 0 to {sensors - 1}")
