"""Data sets: folders of scans opened by the name of their loader, or by what lies in them."""

import difflib
import importlib
import pkgutil
from pathlib import Path

from lidarflow.checks import as_path
from lidarflow.datasets import argoverse2, clouds, kitti, kitti_tracking, range_images, velodyne
from lidarflow.datasets.base import Dataset, Source
from lidarflow.datasets.clouds import read_points, read_scan
from lidarflow.datasets.folder import kitti_scan_folder
from lidarflow.datasets.kiss import KissLoader
from lidarflow.errors import DataError, InstallError

__all__ = ["LOADERS", "Dataset", "Source", "guess_loader", "loader_names", "open_dataset", "read_points",
           "read_scan"]

LOADERS = {
    "kitti": "lidarflow.datasets.kitti:KittiOdometry",
    "kitti_raw": "lidarflow.datasets.folder:KittiRaw",
    "kitti_tracking": "lidarflow.datasets.kitti_tracking:KittiTracking",
    "argoverse2": "lidarflow.datasets.argoverse2:Argoverse2",
    "range_images": "lidarflow.datasets.range_images:RangeImages",
    "ouster": "lidarflow.datasets.ouster:OusterRecording",
    "velodyne": "lidarflow.datasets.velodyne:VelodyneRecording",
    "folder": "lidarflow.datasets.folder:CloudFolder",
}
_RECORDINGS = ("ouster", "velodyne")     # one file; all other loaders of ours want a folder
_BY_SUFFIX = {".mcap": "mcap", ".bag": "rosbag", ".db3": "rosbag", ".osf": "ouster"}


def open_dataset(folder: Path | str, dataloader: str | None = None,
                 sequence: str | int | None = None, kitti_correction: str = "auto") -> Dataset:
    """The data set in `folder`, by the named loader or by what lies in it.

    sequence          its name, or a number: KITTI's "00" is 0
    kitti_correction  "auto" = on for KITTI data, "on" or "off"

    Raises DataError for a folder that is missing, empty or holds nothing readable, and for an unknown
    loader; InstallError where a loader's package is missing.
    """
    folder = as_path("open_dataset", folder)
    if not folder.exists():
        raise DataError(f"{folder}: no such folder")
    if folder.suffix.lower() == ".db3" and folder.is_file():
        folder = folder.absolute().parent     # a ROS 2 bag is a folder
    if dataloader in (None, "kitti", "kitti_raw"):
        dataloader = dataloader or guess_loader(folder)
        folder = _data_root(folder)
    name = None if sequence is None else str(sequence)
    dataset = _opened(folder, dataloader, name, kitti_correction)
    dataset.source = Source(folder.resolve(), dataloader, name, kitti_correction)
    return dataset


def loader_names() -> list[str]:
    """Names of the loaders: ours, then those that only KISS-ICP has."""
    try:
        from kiss_icp import datasets
    except ImportError as error:
        reason = clouds.one_line(error)
        raise InstallError(f"KISS-ICP cannot be imported ({reason}); pip install kiss-icp") from None
    theirs = [module.name for module in pkgutil.iter_modules(datasets.__path__)]
    return [*LOADERS, *sorted(set(theirs) - set(LOADERS))]


def guess_loader(folder: Path) -> str:
    """The loader for what lies in `folder`; DataError, which says what was found, where none fits."""
    folder = Path(folder)
    if folder.is_file():
        suffix = folder.suffix.lower()
        if suffix in _BY_SUFFIX:
            return _BY_SUFFIX[suffix]
        if suffix == ".pcap":
            return "velodyne" if velodyne.holds_packets(folder) else "ouster"
        raise DataError(_not_a_folder(folder))
    if not folder.is_dir():
        raise DataError(f"{folder}: no such folder")
    root = _data_root(folder)
    files = clouds.visible_files(root)
    if kitti.sequence_folders(root) or ((root / "velodyne").is_dir() and (root / "calib.txt").is_file()):
        return "kitti"
    if kitti_tracking.is_sequence(root) or kitti_tracking.sequence_folders(root):
        return "kitti_tracking"
    if kitti_scan_folder(root) is not None:
        return "kitti_raw"
    if argoverse2.is_log(root) or argoverse2.log_folders(root):
        return "argoverse2"
    if (root / "v1.0-mini" / "sample_data.json").is_file():
        return "nuscenes"
    if (root / "img.cfg").is_file() and range_images.list_images(root):
        return "range_images"
    if clouds.kinds_of(files) in ([], [".csv"]):     # of a recording there may be tables
        suffixes = {file.suffix.lower() for file in files}
        if suffixes & {".bag", ".db3"} or (".mcap" in suffixes and (root / "metadata.yaml").is_file()):
            return "rosbag"
        clouds.list_clouds(root)     # says what was found instead
    return "folder"


def _opened(folder: Path, dataloader: str, sequence: str | None, kitti_correction: str) -> Dataset:
    if dataloader not in LOADERS:
        if dataloader not in loader_names():
            raise DataError(f"unknown loader '{dataloader}'{_nearest(dataloader)}")
        return KissLoader(dataloader, folder, sequence, kitti_correction)
    if not folder.is_dir() and dataloader not in _RECORDINGS:
        raise DataError(_not_a_folder(folder))
    module, _, name = LOADERS[dataloader].partition(":")
    return getattr(importlib.import_module(module), name)(folder, sequence, kitti_correction)


def _data_root(folder: Path) -> Path:
    """The folder of the drive or sequence where `folder` is KITTI's folder of .bin scans."""
    is_scan_folder = folder.is_dir() and clouds.is_kitti_folder(folder)
    if not is_scan_folder or not any(file.suffix.lower() == ".bin" for file in clouds.visible_files(folder)):
        return folder
    place = folder.absolute()
    return place.parent if place.name == "velodyne" else place.parent.parent


def _not_a_folder(file: Path) -> str:
    return f"{file}: is a file; expected a folder of scans (for two files there is 'lidarflow pair')"


def _nearest(name: str) -> str:
    known = loader_names()
    close = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    return f" - did you mean '{close[0]}'?" if close else f"; known are {', '.join(known)}"
