"""The KITTI odometry benchmark: sequences of scans with times and camera poses."""

from pathlib import Path

import numpy as np

from lidarflow import pose
from lidarflow.datasets import clouds, tables
from lidarflow.datasets.base import ScanFiles
from lidarflow.datasets.folder import folder_name
from lidarflow.datasets.kitti_correction import is_wanted
from lidarflow.errors import DataError
from lidarflow.types import Truth


class KittiOdometry(ScanFiles):
    """DATA/sequences/SS/velodyne/*.bin with calib.txt, times.txt and DATA/poses/SS.txt.

    DATA may be the sequence folder itself. Poses of the left camera become poses of the LiDAR. The
    vertical-angle correction is on unless switched off. Truth, where there is any, lies in
    sequences/SS/truth/<scan>.npz.
    """

    loader = "kitti"

    def __init__(self, folder: Path, sequence: str | None = None, kitti_correction: str = "auto"):
        self.folder = _sequence_folder(Path(folder), sequence)
        files = clouds.list_clouds(self.folder / "velodyne")
        times_ns, notes = None, []
        if (self.folder / "times.txt").is_file():
            times_file = self.folder / "times.txt"
            times_ns, notes = tables.times_of_scans(times_file, tables.read_seconds(times_file), files)
        self._poses, pose_notes = _lidar_poses(self.folder, files)
        super().__init__(f"kitti {folder_name(self.folder)}", files, times_ns,
                         is_wanted(kitti_correction, True), [*notes, *pose_notes])

    def truth(self, index: int) -> Truth | None:
        """Truth of truth/<scan>.npz where there is such a file."""
        return self.stored_truth(self.folder / "truth", index)

    def world_from_sensor(self) -> np.ndarray | None:
        """Poses (N, 4, 4) of the LiDAR in the first camera's world, turned into the LiDAR's axes."""
        return self._poses

    def camera_from_lidar(self) -> np.ndarray | None:
        """Where the LiDAR is in the left camera's frame (4, 4): Tr of calib.txt; None where that has none."""
        return _read_calibration(self.folder / "calib.txt")


def sequence_folders(folder: Path) -> dict[str, Path]:
    """The sequences of a KITTI odometry folder by name."""
    found = sorted((folder / "sequences").glob("*/velodyne"))
    return {scans.parent.name: scans.parent for scans in found if scans.is_dir()}


def _sequence_folder(folder: Path, sequence: str | None) -> Path:
    sequences = sequence_folders(folder)
    if not sequences:
        if not (folder / "velodyne").is_dir():
            raise DataError(f"{folder}: no folder 'sequences/*/velodyne' and no 'velodyne'; "
                            "expected KITTI odometry data or one of its sequences")
        if sequence and sequence.zfill(2) != folder_name(folder):
            raise DataError(f"{folder}: is the sequence '{folder_name(folder)}', not '{sequence}'")
        return folder
    return choose_sequence(folder, sequences, sequence, 2)


def choose_sequence(folder: Path, sequences: dict[str, Path], sequence: str | None, digits: int) -> Path:
    """The folder of the wanted sequence, or of the only one; names may lack leading zeros."""
    names = ", ".join(sequences)
    if sequence is None:
        if len(sequences) > 1:
            raise DataError(f"{folder}: holds the sequences {names}; choose one with --sequence")
        return next(iter(sequences.values()))
    chosen = sequences.get(sequence, sequences.get(sequence.zfill(digits)))
    if chosen is None:
        raise DataError(f"{folder}: no sequence '{sequence}'; there is {names}")
    return chosen


def _lidar_poses(sequence_folder: Path, files: list[Path]) -> tuple[np.ndarray | None, list[str]]:
    """LiDAR poses (N, 4, 4), None where they are not known, and notes why."""
    place = sequence_folder.absolute()
    file = place.parent.parent / "poses" / f"{place.name}.txt"
    if not file.is_file():
        return None, []
    camera_from_lidar = _read_calibration(sequence_folder / "calib.txt")
    if camera_from_lidar is None:
        return None, ["calib.txt has no Tr, so the camera poses are ignored"]
    return poses_of_camera(file, files, camera_from_lidar)


def poses_of_camera(
    file: Path, files: list[Path], camera_from_lidar: np.ndarray
) -> tuple[np.ndarray | None, list[str]]:
    """LiDAR poses (N, 4, 4) of `files` from a file of camera poses, None where they do not fit, and why."""
    world_from_camera, notes = tables.motions_of_scans(file, files)
    if world_from_camera is None:
        return None, notes
    return pose.inverse(camera_from_lidar) @ world_from_camera @ camera_from_lidar, notes


def _read_calibration(file: Path) -> np.ndarray | None:
    """camera_from_lidar (4, 4), the entry Tr; None where there is no file or no such entry."""
    if not file.is_file():
        return None
    text = tables.read_named(file).get("Tr")
    return None if text is None else tables.motion_of_text(file, text)
