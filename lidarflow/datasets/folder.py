"""Folders of cloud files: any sensor's, and KITTI's raw recordings."""

from pathlib import Path

import numpy as np

from lidarflow.datasets import clouds, oxts, tables
from lidarflow.datasets.base import ScanFiles
from lidarflow.datasets.kitti_correction import is_wanted
from lidarflow.datasets.kitti_labels import Labels, read_table, read_tracklets
from lidarflow.datasets.kitti_truth import labelled_truth, with_classes
from lidarflow.errors import DataError
from lidarflow.types import Truth

INDEXED_POSE_FILES = ("ego_poses.txt", "derived_ego_icp.txt")
_ODD_SIZE_RATIO = 2
KITTI_FOLDERS = ("velodyne", "velodyne_points/data")


class CloudFolder(ScanFiles):
    """Every cloud file of a folder, in natural order of the names.

    Times come from times.txt (seconds), from names that are nanoseconds, or seconds with a point, else 10 Hz
    is assumed. Poses come from ego_poses.txt or derived_ego_icp.txt (frame number, 3x4) or *poses_kitti.txt
    (3x4), all of the sensor. Truth lies in truth/<scan>.npz.
    """

    loader = "folder"

    def __init__(self, folder: Path, sequence: str | None = None, kitti_correction: str = "auto"):
        folder = Path(folder)
        files = clouds.list_clouds(folder / sequence if sequence else folder)
        is_kitti = files[0].suffix.lower() == ".bin" and clouds.is_kitti_folder(files[0].parent)
        times_ns, notes = _read_times(files[0].parent, files)
        self._poses, pose_notes = _read_poses(files[0].parent, files)
        super().__init__(folder_name(files[0].parent), files, times_ns, is_wanted(kitti_correction, is_kitti),
                         [*notes, *pose_notes, *_odd_sizes(files)])

    def truth(self, index: int) -> Truth | None:
        """Truth of truth/<scan>.npz where there is such a file."""
        return self.stored_truth(self.files[0].parent / "truth", index)

    def world_from_sensor(self) -> np.ndarray | None:
        """Given poses (N, 4, 4), where a file beside the scans holds them."""
        return self._poses


class KittiRaw(ScanFiles):
    """A drive as KITTI's raw recordings lay it out: scans in velodyne_points/data, or in velodyne.

    The vertical-angle correction is on for .bin files. Poses as in CloudFolder, else from oxts/data and the
    date's calib_imu_to_velo.txt. Truth lies in truth/<scan>.npz, else it is made of the labelled boxes in
    tracklet_labels.xml or boxes.csv, which also tell the classes.
    """

    loader = "kitti_raw"

    def __init__(self, folder: Path, sequence: str | None = None, kitti_correction: str = "auto"):
        self.folder = Path(folder) / sequence if sequence else Path(folder)
        scan_folder = kitti_scan_folder(self.folder)
        if scan_folder is None:
            raise DataError(f"{self.folder}: no folder 'velodyne' or 'velodyne_points/data'; "
                            "expected a KITTI drive")
        files = clouds.list_clouds(scan_folder)
        times_ns, notes = _read_times(self.folder, files)
        self._poses, pose_notes = _read_poses(self.folder, files)
        if self._poses is None and not pose_notes:
            self._poses, pose_notes = _navigated(self.folder, files)
        correct = is_wanted(kitti_correction, files[0].suffix.lower() == ".bin")
        super().__init__(f"kitti_raw {folder_name(self.folder)}", files, times_ns, correct,
                         [*notes, *pose_notes])

    def truth(self, index: int) -> Truth | None:
        """Truth of truth/<scan>.npz where there is such a file, else flow from labelled boxes and poses."""
        stored, labels = self.stored_truth(self.folder / "truth", index), self.labels()
        if stored is not None and stored.category is None and labels is not None:
            return with_classes(stored, labels)
        if stored is not None or labels is None or self._poses is None:
            return stored
        return labelled_truth(self, index, labels, self._poses)

    def world_from_sensor(self) -> np.ndarray | None:
        """Given poses (N, 4, 4), where a file beside the scan folder holds them."""
        return self._poses

    def labels(self) -> Labels | None:
        """The drive's labelled boxes, where a file holds them."""
        for name, read in (("tracklet_labels.xml", read_tracklets), ("boxes.csv", read_table)):
            if (self.folder / name).is_file():
                return read(self.folder / name)
        return None


def kitti_scan_folder(folder: Path) -> Path | None:
    """The sub-folder that holds a KITTI drive's scans, None where there is none."""
    for name in KITTI_FOLDERS:
        if (folder / name).is_dir():
            return folder / name
    return None


def folder_name(folder: Path) -> str:
    """The name of a folder, also of "." and ".."."""
    return folder.resolve().name


def _odd_sizes(files: list[Path]) -> list[str]:
    """A note where the files are so different in size that they may be of several sensors."""
    by_size = sorted(files, key=lambda file: file.stat().st_size)
    smallest, largest = by_size[0], by_size[-1]
    if largest.stat().st_size <= _ODD_SIZE_RATIO * smallest.stat().st_size:
        return []
    return [f"{largest.name} is more than {_ODD_SIZE_RATIO} times as large as {smallest.name}; "
            "are all of them scans of one sensor?"]


def _read_times(folder: Path, files: list[Path]) -> tuple[list[int] | None, list[str]]:
    dates, seconds = folder / "velodyne_points" / "timestamps.txt", folder / "times.txt"
    if dates.is_file():
        return tables.times_of_scans(dates, tables.read_dates(dates), files)
    if seconds.is_file():
        return tables.times_of_scans(seconds, tables.read_seconds(seconds), files)
    return None, []


def _read_poses(folder: Path, files: list[Path]) -> tuple[np.ndarray | None, list[str]]:
    for name in INDEXED_POSE_FILES:
        if (folder / name).is_file():
            return tables.indexed_motions_of_scans(folder / name, files)
    found = sorted(file for file in clouds.visible_files(folder) if file.name.endswith("poses_kitti.txt"))
    if len(found) == 1:
        return tables.motions_of_scans(found[0], files)
    return None, [f"{len(found)} files *poses_kitti.txt, none of them used"] if found else []


def _navigated(folder: Path, files: list[Path]) -> tuple[np.ndarray | None, list[str]]:
    """Poses (N, 4, 4) of the scans from the drive's navigation, None where it lacks some."""
    calibration = folder.absolute().parent / "calib_imu_to_velo.txt"
    packets = [folder / "oxts" / "data" / f"{file.stem}.txt" for file in files]
    if not calibration.is_file() or not packets[0].parent.is_dir():
        return None, []
    missing = sum(not packet.is_file() for packet in packets)
    if missing:
        return None, [f"oxts/data lacks {missing} of {len(files)} packets and is ignored"]
    named = tables.read_named(calibration)
    if not {"R", "T"} <= named.keys():
        return None, [f"{calibration.name} has no R and T, so oxts is ignored"]
    lidar_from_imu = tables.motion_of_texts(calibration, named["R"], named["T"])
    return oxts.world_from_lidar(oxts.read_packet_files(packets), lidar_from_imu), ["poses from oxts"]
