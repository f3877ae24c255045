"""The KITTI tracking benchmark: sequences of scans with labelled boxes and navigation."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lidarflow.datasets import clouds, oxts, tables
from lidarflow.datasets.base import ScanFiles, rows_of_scans
from lidarflow.datasets.kitti import choose_sequence, poses_of_camera
from lidarflow.datasets.kitti_correction import is_wanted
from lidarflow.datasets.kitti_labels import read_tracking
from lidarflow.datasets.kitti_truth import labelled_truth
from lidarflow.errors import DataError
from lidarflow.types import Truth

PARTS = ("training", "testing")
DIGITS = 4


class KittiTracking(ScanFiles):
    """DATA/training/velodyne/SSSS/*.bin with calib/SSSS.txt, label_02/SSSS.txt, oxts/SSSS.txt beside it.

    DATA may be the folder `training` itself, or the folder of one sequence's scans. Poses come from
    poses/SSSS.txt (the rectified camera's, 3x4 per line) where there is such a file, else from oxts. Truth is
    made of the labelled boxes. The vertical-angle correction is on unless switched off.
    """

    loader = "kitti_tracking"

    def __init__(self, folder: Path, sequence: str | None = None, kitti_correction: str = "auto"):
        self.part, scans = _scan_folder(Path(folder), sequence)
        self.sequence = scans.name
        files = clouds.list_clouds(scans)
        self._calibration = read_calibration(self._file("calib"))
        self._poses, notes = self._read_poses(files)
        super().__init__(f"kitti_tracking {self.sequence}", files, None,
                         is_wanted(kitti_correction, True), notes)

    def truth(self, index: int) -> Truth | None:
        """Flow from the labelled boxes, where there are labels, a calibration and poses."""
        file, calibration = self._file("label_02"), self._calibration
        if self._poses is None or not file.is_file() or calibration.rectified_from_lidar is None:
            return None
        labels = read_tracking(file, calibration.rectified_from_lidar)
        return labelled_truth(self, index, labels, self._poses, calibration.image_from_lidar)

    def world_from_sensor(self) -> np.ndarray | None:
        """Poses (N, 4, 4) of the LiDAR; None where none are given."""
        return self._poses

    def _file(self, kind: str) -> Path:
        return self.part / kind / f"{self.sequence}.txt"

    def _read_poses(self, files: list[Path]) -> tuple[np.ndarray | None, list[str]]:
        """Poses (N, 4, 4) of the LiDAR, None where they are not known, and notes why."""
        given, packets = self._file("poses"), self._file("oxts")
        if given.is_file() and self._calibration.rectified_from_lidar is not None:
            return poses_of_camera(given, files, self._calibration.rectified_from_lidar)
        if not packets.is_file() or self._calibration.lidar_from_imu is None:
            return None, []
        poses = oxts.world_from_lidar(oxts.read_packets(packets), self._calibration.lidar_from_imu)
        picked = rows_of_scans(len(poses), files)
        if picked is None:
            return None, [f"oxts/{packets.name} has {len(poses)} lines for {len(files)} scans and is ignored"]
        return poses[picked], ["poses from oxts"]


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """What a sequence's calibration file says; None where it does not.

    rectified_from_lidar  (4, 4)
    image_from_lidar      (3, 4)   projection into image 2, pixels
    lidar_from_imu        (4, 4)
    """

    rectified_from_lidar: np.ndarray | None = None
    image_from_lidar: np.ndarray | None = None
    lidar_from_imu: np.ndarray | None = None


def read_calibration(file: Path) -> Calibration:
    """The calibration in `file`, an empty one where there is no such file.

    The tracking benchmark writes R_rect, Tr_velo_cam and Tr_imu_velo, the object benchmark R0_rect,
    Tr_velo_to_cam and Tr_imu_to_velo; both are understood.
    """
    named = tables.read_named(file) if file.is_file() else {}

    def text(*spellings: str) -> str | None:
        return next((named[name] for name in spellings if name in named), None)

    rectification, camera = text("R_rect", "R0_rect"), text("Tr_velo_cam", "Tr_velo_to_cam")
    projection, imu = text("P2"), text("Tr_imu_velo", "Tr_imu_to_velo")
    rectified_from_lidar = image_from_lidar = None
    if rectification is not None and camera is not None:
        rectified_from_lidar = (tables.motion_of_texts(file, rectification, "0 0 0")
                                @ tables.motion_of_text(file, camera))
        if projection is not None:
            image_from_lidar = (tables.numbers_of_text(file, projection, 12).reshape(3, 4)
                                @ rectified_from_lidar)
    lidar_from_imu = None if imu is None else tables.motion_of_text(file, imu)
    return Calibration(rectified_from_lidar, image_from_lidar, lidar_from_imu)


def sequence_folders(folder: Path) -> dict[str, Path]:
    """The scan folders of a tracking folder (or of its part `training` or `testing`) by sequence."""
    for part in (*(folder / name for name in PARTS), folder):
        found = {scans.name: scans for scans in sorted((part / "velodyne").glob("*"))
                 if scans.is_dir() and any(scans.glob("*.bin"))}
        if found:
            return found
    return {}


def is_sequence(folder: Path) -> bool:
    """Whether a folder is that of one sequence's scans, with its calibration where the benchmark puts it."""
    place = folder.absolute()
    return place.parent.name == "velodyne" and (place.parent.parent / "calib" / f"{place.name}.txt").is_file()


def _scan_folder(folder: Path, sequence: str | None) -> tuple[Path, Path]:
    """The part of the benchmark, and the folder of scans of one of its sequences."""
    place = folder.absolute()
    if is_sequence(folder):
        if sequence and sequence.zfill(DIGITS) != place.name:
            raise DataError(f"{folder}: is the sequence '{place.name}', not '{sequence}'")
        return place.parent.parent, place
    found = sequence_folders(folder)
    if not found:
        raise DataError(f"{folder}: no folder 'training/velodyne/*' with .bin files; "
                        "expected KITTI tracking data or one of its sequences")
    scans = choose_sequence(folder, found, sequence, DIGITS)
    return scans.parent.parent, scans
