"""Poses as text: KITTI's twelve numbers a line, or TUM's time, translation and quaternion.

KITTI's have a line for every scan, since only its number says whose pose it is; TUM's have one for every scan
whose time is known.
"""

from collections.abc import Iterator
from pathlib import Path

from lidarflow import pose
from lidarflow.datasets.kitti import KittiOdometry
from lidarflow.errors import DataError
from lidarflow.export.finished_run import FinishedRun
from lidarflow.io import write_poses_kitti, write_poses_tum


def write_kitti(run: FinishedRun, out: Path) -> Iterator[Path]:
    """world_from_sensor of the LiDAR, row-major 3x4."""
    write_poses_kitti(out, run.every_pose())
    yield out


def write_kitti_camera(run: FinishedRun, out: Path) -> Iterator[Path]:
    """world_from_camera of the left camera, as the benchmark's own files: needs KITTI odometry data."""
    dataset = run.dataset()
    camera_from_lidar = dataset.camera_from_lidar() if isinstance(dataset, KittiOdometry) else None
    if camera_from_lidar is None:
        raise DataError(f"{run.folder}: its data have no calibration of a camera, expected KITTI odometry "
                        "with Tr in calib.txt; for poses of the LiDAR use --format kitti")
    world_from_camera = camera_from_lidar @ run.every_pose() @ pose.inverse(camera_from_lidar)
    write_poses_kitti(out, world_from_camera)
    yield out


def write_tum(run: FinishedRun, out: Path) -> Iterator[Path]:
    """Seconds, translation and quaternion x y z w of the LiDAR."""
    write_poses_tum(out, run.world_from_sensor, run.times_ns.tolist())
    yield out
