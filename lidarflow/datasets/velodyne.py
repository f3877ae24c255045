"""Packets of Velodyne sensors (.pcap), through the package velodyne-decoder."""

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from lidarflow.datasets.foreign import Stream, guarded
from lidarflow.datasets.recording import Recording
from lidarflow.errors import DataError

PACKET_BYTES = 1206                  # of every Velodyne sensor, whatever the model
_HEADERS_BYTES = (42, 46, 28, 44)    # Ethernet, IP and UDP; with VLAN; raw IP; Linux's cooked capture
_MAGIC = (0xA1B2C3D4, 0xA1B23C4D)    # times in microseconds, in nanoseconds
_LOOKED_AT = 200                     # packets; other devices on the wire may come first
_WHOLE_SHARE = 0.9                   # of the usual duration: less is the cut-off end of a recording


class VelodyneRecording(Recording):
    """Revolutions of a VLP-16, HDL-32E, VLP-32 or another model, which the packets tell.

    Points are in the sensor's frame (x forward, azimuth 0), ring by ring and in order of time within a ring.
    Angles are nominal unless the packets hold a calibration. A scan's time is that of its first packet. What
    is left at the end of a recording is no scan unless it is a whole revolution. Read forwards only.
    """

    loader = "velodyne"
    reader = "the decoder of Velodyne packets"
    suffixes = (".pcap",)

    def __init__(self, file: Path, sequence: str | None = None, kitti_correction: str = "auto"):
        super().__init__(file, kitti_correction)
        if sequence is not None:
            raise DataError(f"{file}: a Velodyne recording has no sequences; leave --sequence out")
        self._revolutions = Stream(lambda: _revolutions(file))
        durations_s = guarded(self._origin, lambda: [_duration_s(points) for _, points in _revolutions(file)])
        if not durations_s:
            raise DataError(f"{file}: no packet of a Velodyne sensor; of another make? see --dataloader")
        is_whole = durations_s[-1] >= _WHOLE_SHARE * float(np.median(durations_s))
        self._length = len(durations_s) if is_whole else len(durations_s) - 1

    def __len__(self) -> int:
        return self._length

    def _read(self, index: int) -> tuple[np.ndarray, int]:
        time, rows = self._revolutions.item(index)
        rows = rows[np.argsort(rows["ring"], kind="stable")]
        points = np.stack([rows[axis] for axis in "xyz"], axis=1).astype(np.float64)
        return points, round(time.device * 1e9)


def _revolutions(file: Path) -> Iterator[tuple[Any, np.ndarray]]:
    """Time and points of every revolution, in order."""
    import velodyne_decoder

    config = velodyne_decoder.Config(timestamp_first_packet=True)
    yield from velodyne_decoder.read_pcap(str(file), config, as_pcl_structs=True)


def _duration_s(rows: np.ndarray) -> float:
    return float(np.ptp(rows["time"])) if len(rows) else 0.0


def holds_packets(file: Path) -> bool:
    """Whether a .pcap has packets as Velodyne sensors send them among its first."""
    with file.open("rb") as content:
        start = content.read(24)[:4]
        order = {int.from_bytes(start, "little"): "<", int.from_bytes(start, "big"): ">"}
        order = next((order[magic] for magic in _MAGIC if magic in order), None)
        if order is None:
            return False
        for _ in range(_LOOKED_AT):
            header = content.read(16)
            if len(header) < 16:
                return False
            stored, sent = struct.unpack(f"{order}8xII", header)
            if sent - PACKET_BYTES in _HEADERS_BYTES:
                return True
            content.seek(stored, 1)
    return False
