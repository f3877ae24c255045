"""Generated drives as a KITTI odometry folder, with the truth beside the scans."""

from pathlib import Path

import numpy as np

from lidarflow import pose
from lidarflow.errors import DataError
from lidarflow.types import Scan, Truth

CAMERA_FROM_VELODYNE = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])


def write_kitti(folder: Path, sequence: list[tuple[Scan, Truth | None]]) -> None:
    """Write a sequence as sequence 00 of the KITTI odometry layout into a new or empty folder.

    sequences/00/velodyne/<frame>.bin   float32 x y z reflectance (0)
    sequences/00/truth/<frame>.npz      flow, ego_flow, valid, dynamic, track, target_from_source
    sequences/00/times.txt, calib.txt   seconds; Tr = camera from velodyne
    poses/00.txt                        camera 0 at the first scan from camera 0 at each scan
    """
    folder = Path(folder)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise DataError(f"{folder}: exists and is not an empty folder; choose a new one")
    if any(truth is None for _, truth in sequence[:-1]):
        raise DataError("a sequence needs the truth of every scan but the last to chain its poses")

    base = folder / "sequences" / "00"
    for part in (base / "velodyne", base / "truth", folder / "poses"):
        part.mkdir(parents=True)
    for k, (scan, truth) in enumerate(sequence):
        rows = np.zeros((len(scan), 4), "<f4")
        rows[:, :3] = scan.points
        rows.tofile(base / "velodyne" / f"{k:06d}.bin")
        if truth is not None:
            np.savez_compressed(base / "truth" / f"{k:06d}.npz", **_truth_arrays(scan, truth))
    np.savetxt(base / "times.txt", [scan.time_ns * 1e-9 for scan, _ in sequence], fmt="%e")
    numbers = " ".join(f"{value:e}" for value in CAMERA_FROM_VELODYNE[:3].ravel())
    (base / "calib.txt").write_text(f"Tr: {numbers}\n", encoding="utf-8")
    poses = [camera_pose[:3].ravel() for camera_pose in _camera_poses(sequence)]
    np.savetxt(folder / "poses" / "00.txt", poses, fmt="%.9e")


def _truth_arrays(scan: Scan, truth: Truth) -> dict[str, np.ndarray]:
    ego_flow = pose.apply(truth.ego_motion, scan.points) - scan.points
    return {
        "flow": truth.flow.astype(np.float32),
        "ego_flow": ego_flow.astype(np.float32),
        "valid": truth.valid,
        "dynamic": truth.is_dynamic,
        "track": truth.object_id.astype(np.int16),
        "target_from_source": truth.ego_motion.astype(np.float64),
    }


def _camera_poses(sequence: list[tuple[Scan, Truth | None]]) -> list[np.ndarray]:
    """Poses (4, 4) first_camera_from_camera of every scan."""
    first_from_current, poses = pose.identity(), []
    velodyne_from_camera = pose.inverse(CAMERA_FROM_VELODYNE)
    for _, truth in sequence:
        poses.append(CAMERA_FROM_VELODYNE @ first_from_current @ velodyne_from_camera)
        if truth is not None:
            first_from_current = first_from_current @ pose.inverse(truth.ego_motion)
    return poses
