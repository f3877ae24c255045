"""Argoverse 2 sensor logs: sweeps and poses as .feather tables."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lidarflow import pose
from lidarflow.datasets import clouds
from lidarflow.datasets.base import ScanFiles
from lidarflow.datasets.kitti_correction import is_wanted
from lidarflow.errors import DataError, InstallError
from lidarflow.types import Truth

SPLITS = ("val", "train", "test")
BOX_MARGIN_M = 0.1
_POSE_COLUMNS = ("tx_m", "ty_m", "tz_m", "qx", "qy", "qz", "qw")
_SIZE_COLUMNS = ("length_m", "width_m", "height_m")
_FLOW_COLUMNS = ("flow_tx_m", "flow_ty_m", "flow_tz_m")


class Argoverse2(ScanFiles):
    """FOLDER/val/<log>/sensors/lidar/<time_ns>.feather, or the folder of the log itself.

    Sweeps are in the frame of the vehicle, times come from the file names and poses from
    city_SE3_egovehicle.feather. Truth of the first pair comes from FOLDER/truth/flow_labels.feather
    where there is such a file; ground does not count in it.
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
        """The labelled flow of the first sweep where the folder has it."""
        file = self.folder.absolute().parent.parent / "truth" / "flow_labels.feather"
        poses = self.world_from_sensor()
        if index != 0 or len(self) < 2 or poses is None or not file.is_file():
            return None
        labels = read_columns(file, (*_FLOW_COLUMNS, "classes", "dynamic", "is_ground_0"))
        points = self._read(self.files[0])
        rows = len(labels["classes"])
        if rows != len(points):
            raise DataError(f"{file}: {rows} rows, but {self.files[0].name} has {len(points)} points; "
                            "expected one row per point")
        flow = np.stack([labels[name] for name in _FLOW_COLUMNS], axis=1).astype(np.float64)
        return Truth(
            flow=flow,
            ego_motion=pose.inverse(poses[1]) @ poses[0],
            valid=np.isfinite(flow).all(axis=1) & ~labels["is_ground_0"].astype(bool),
            is_dynamic=labels["dynamic"].astype(bool),
            object_id=np.where(labels["classes"] > 0, self._boxes_of(points, self.times_ns[0]), -1),
        )

    def world_from_sensor(self) -> np.ndarray | None:
        """Poses (N, 4, 4) of the vehicle in the city's frame; None where a sweep has none."""
        file = self.folder / "city_SE3_egovehicle.feather"
        if not file.is_file():
            return None
        table = read_columns(file, ("timestamp_ns", *_POSE_COLUMNS))
        row_at = {time: row for row, time in enumerate(table["timestamp_ns"].tolist())}
        picked = [row_at.get(time) for time in self.times_ns]
        return None if None in picked else _motions(file, table)[picked]

    def _read(self, file: Path) -> np.ndarray:
        table = read_columns(file, ("x", "y", "z"))
        points = np.stack([table[axis] for axis in "xyz"], axis=1).astype(np.float64)
        if not np.isfinite(points).any():
            raise DataError(f"{file}: empty scan (no finite point among {len(points)}); leave this file out")
        return points

    def _boxes_of(self, points: np.ndarray, time_ns: int) -> np.ndarray:
        """Number (N,) of the labelled box around each point at `time_ns`, -1 = none."""
        box = np.full(len(points), -1, dtype=np.int64)
        file = self.folder / "annotations.feather"
        if not file.is_file():
            return box
        table = read_columns(file, ("timestamp_ns", *_SIZE_COLUMNS, *_POSE_COLUMNS))
        rows = np.flatnonzero(table["timestamp_ns"] == time_ns)
        half = np.stack([table[name] for name in _SIZE_COLUMNS], axis=1) / 2 + BOX_MARGIN_M
        box_from_sensor = pose.inverse(_motions(file, table)[rows])
        for number, row in enumerate(rows):
            local = pose.apply(box_from_sensor[number], points)
            box[(np.abs(local) <= half[row]).all(axis=1)] = number
        return box


def read_columns(file: Path, names: Sequence[str]) -> dict[str, np.ndarray]:
    """Columns of a .feather table by name; DataError where it is damaged or lacks one."""
    try:
        from pyarrow import ArrowException, feather
    except ImportError:
        raise InstallError(f"{file}: .feather needs the package pyarrow; pip install pyarrow") from None
    try:
        table = feather.read_table(file, memory_map=False)
    except (ArrowException, OSError, ValueError) as error:
        raise DataError(f"{file}: not a readable .feather table ({clouds.one_line(error)})") from None
    missing = [name for name in names if name not in table.column_names]
    if missing:
        raise DataError(f"{file}: lacks the columns {', '.join(missing)}; "
                        f"it has {', '.join(table.column_names)}")
    return {name: table.column(name).to_numpy() for name in names}


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
