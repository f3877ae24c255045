"""Argoverse 2 sensor logs: sweeps, poses and labelled boxes as .feather tables."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO

import numpy as np

from lidarflow import pose
from lidarflow.datasets import argoverse2_map, clouds
from lidarflow.datasets.base import ScanFiles
from lidarflow.datasets.boxes import Box, box_around, truth_of_boxes
from lidarflow.datasets.categories import categories_of_argoverse2, category_of
from lidarflow.datasets.kitti_correction import is_wanted
from lidarflow.errors import DataError, InstallError
from lidarflow.types import Category, Truth

SPLITS = ("val", "train", "test")
BOX_MARGIN_M = (0.1, 0.1, 0.0)     # the official labels widen a box by 0.2 m in length and width
_POSE_COLUMNS = ("tx_m", "ty_m", "tz_m", "qx", "qy", "qz", "qw")
_SIZE_COLUMNS = ("length_m", "width_m", "height_m")
_FLOW_COLUMNS = ("flow_tx_m", "flow_ty_m", "flow_tz_m")


class Argoverse2(ScanFiles):
    """FOLDER/val/<log>/sensors/lidar/<time_ns>.feather, or the folder of the log itself.

    Sweeps are in the frame of the vehicle, times come from the file names and poses from
    city_SE3_egovehicle.feather. Truth of the first pair comes from FOLDER/truth/flow_labels.feather
    where there is such a file, of all others from the boxes in annotations.feather; ground does not count in
    it. The log's map tells what is ground where there is one.
    """

    loader = "argoverse2"

    def __init__(self, folder: Path, sequence: str | None = None, kitti_correction: str = "auto"):
        self.folder = _log_folder(Path(folder), sequence)
        sweeps = self.folder / "sensors" / "lidar"
        files = clouds.natural_sorted(sweeps.glob("*.feather"))
        if not files:
            raise DataError(f"{sweeps}: no .feather files; expected the sweeps of a log")
        super().__init__(f"argoverse2 {self.folder.absolute().name[:8]}", files,
                         correct=is_wanted(kitti_correction, False),
                         notes=["points are stored as float16, 3 cm steps beyond 32 m"])

    def truth(self, index: int) -> Truth | None:
        """The official flow of the first sweep where the folder has it, else flow from the labelled boxes."""
        poses = self.world_from_sensor()
        if not 0 <= index < len(self) - 1 or poses is None:
            return None
        ego_motion = pose.inverse(poses[index + 1]) @ poses[index]
        file = self.folder.absolute().parent.parent / "truth" / "flow_labels.feather"
        if index == 0 and file.is_file():
            return self._official_truth(file, ego_motion)
        return self._truth_of_boxes(index, ego_motion, poses[index])

    def world_from_sensor(self) -> np.ndarray | None:
        """Poses (N, 4, 4) of the vehicle in the city's frame; None where a sweep has none."""
        file = self.folder / "city_SE3_egovehicle.feather"
        if not file.is_file():
            return None
        table = read_columns(file, ("timestamp_ns", *_POSE_COLUMNS))
        row_at = {time: row for row, time in enumerate(table["timestamp_ns"].tolist())}
        picked = [row_at.get(time) for time in self.times_ns]
        return None if None in picked else _motions(file, table)[picked]

    def boxes(self, *indices: int) -> list[list[Box]]:
        """The labelled boxes of each of the sweeps; none where they are not labelled."""
        file = self.folder / "annotations.feather"
        if not file.is_file():
            return [[] for _ in indices]
        table = read_columns(file, ("timestamp_ns", "track_uuid", "category", *_SIZE_COLUMNS, *_POSE_COLUMNS))
        _, track = np.unique(table["track_uuid"].astype(str), return_inverse=True)
        motions, size = _motions(file, table), np.stack([table[name] for name in _SIZE_COLUMNS], axis=1)
        return [[Box(int(track[row]), category_of(table["category"][row]), motions[row], size[row])
                 for row in np.flatnonzero(table["timestamp_ns"] == self.times_ns[index])]
                for index in indices]

    def _read(self, file: Path) -> np.ndarray:
        table = read_columns(file, ("x", "y", "z"))
        points = np.stack([table[axis] for axis in "xyz"], axis=1).astype(np.float64)
        if not np.isfinite(points).any():
            raise DataError(f"{file}: empty scan (no finite point among {len(points)}); leave this file out")
        return points

    def _official_truth(self, file: Path, ego_motion: np.ndarray) -> Truth:
        labels = read_columns(file, (*_FLOW_COLUMNS, "classes", "dynamic", "is_ground_0"))
        points = self._read(self.files[0])
        rows = len(labels["classes"])
        if rows != len(points):
            raise DataError(f"{file}: {rows} rows, but {self.files[0].name} has {len(points)} points; "
                            "expected one row per point")
        flow = np.stack([labels[name] for name in _FLOW_COLUMNS], axis=1).astype(np.float64)
        is_ground = labels["is_ground_0"].astype(bool)
        boxes, = self.boxes(0)
        track = np.array([*(box.track for box in boxes), -1])[box_around(points, boxes, BOX_MARGIN_M)]
        category = categories_of_argoverse2(labels["classes"])
        return Truth(
            flow=flow,
            ego_motion=ego_motion,
            valid=np.isfinite(flow).all(axis=1) & ~is_ground,
            is_dynamic=labels["dynamic"].astype(bool),
            object_id=np.where(category != Category.BACKGROUND, track, -1),
            category=category,
            is_ground=is_ground,
            origin="flow (official labels)",
        )

    def _truth_of_boxes(
        self, index: int, ego_motion: np.ndarray, city_from_vehicle: np.ndarray
    ) -> Truth | None:
        """Flow from the boxes of a sweep and the next, made as the official labels are."""
        source, target = self.boxes(index, index + 1)
        if not source or not target:
            return None
        points = self._read(self.files[index])
        row = box_around(points, source, BOX_MARGIN_M)
        truth = truth_of_boxes(points, row, source, target, ego_motion, "boxes (no map, so ground counts)")
        is_ground = argoverse2_map.is_ground(self.folder / "map", pose.apply(city_from_vehicle, points))
        if is_ground is None:
            return truth
        return replace(truth, valid=truth.valid & ~is_ground, is_ground=is_ground,
                       origin="boxes (ground from the map)")


def read_columns(file: Path, names: Sequence[str]) -> dict[str, np.ndarray]:
    """Columns of a .feather table by name; DataError where it is damaged or lacks one."""
    return columns_of(file, str(file), names)


def columns_of(content: Path | BinaryIO, place: str, names: Sequence[str]) -> dict[str, np.ndarray]:
    """`read_columns` of a file or of one that is open; `place` is what messages call it."""
    try:
        from pyarrow import ArrowException, feather
    except ImportError:
        raise InstallError(f"{place}: .feather needs the package pyarrow; pip install pyarrow") from None
    try:
        table = feather.read_table(content, memory_map=False)
        table.validate(full=True)     # pyarrow reads past its buffers where offsets lie
        missing = [name for name in names if name not in table.column_names]
        if not missing:
            return {name: table.column(name).to_numpy() for name in names}
    except (ArrowException, OSError, ValueError, MemoryError) as error:
        raise DataError(f"{place}: not a readable .feather table ({clouds.one_line(error)})") from None
    held = ", ".join(table.column_names)
    raise DataError(f"{place}: lacks the columns {', '.join(missing)}; it has {held}")


def log_folders(folder: Path) -> dict[str, Path]:
    """The logs under a folder by name, in val, train and test or in the folder itself."""
    places = [folder / split for split in SPLITS] + [folder]
    found = [scans.parent.parent for place in places for scans in sorted(place.glob("*/sensors/lidar"))]
    return {log.name: log for log in found}


def is_log(folder: Path) -> bool:
    """Whether a folder is a log by itself."""
    return (folder / "sensors" / "lidar").is_dir()


def _log_folder(folder: Path, sequence: str | None) -> Path:
    if is_log(folder):
        return folder
    logs = log_folders(folder)
    chosen = [log for name, log in logs.items() if sequence is None or name.startswith(sequence)]
    if len(chosen) == 1:
        return chosen[0]
    if not logs:
        raise DataError(f"{folder}: no folder 'val/<log>/sensors/lidar'; "
                        "expected Argoverse 2 sensor data or a log")
    names = ", ".join(list(logs)[:5]) + (" ..." if len(logs) > 5 else "")
    found = f"holds {len(logs)} logs"
    if sequence is not None:
        found = f"{len(chosen)} logs are called '{sequence}...'"
    raise DataError(f"{folder}: {found}; choose one with --sequence out of {names}")


def _motions(file: Path, table: dict[str, np.ndarray]) -> np.ndarray:
    try:
        return pose.from_translation_quaternion(np.stack([table[name] for name in _POSE_COLUMNS], axis=1))
    except ValueError as error:
        raise DataError(f"{file}: holds a pose that is none ({clouds.one_line(error)})") from None
