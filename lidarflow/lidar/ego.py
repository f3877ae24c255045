"""Ego-motion: the rigid motion of the static world between two scans, or along a sequence."""

import numpy as np

from lidarflow import pose
from lidarflow.config import EgoConfig
from lidarflow.errors import DataError
from lidarflow.open3d_import import open3d

# Coarse to fine: how far apart corresponding surfaces may be, in voxels. With voxels of 0.2 m the first stage
# reaches 4 m, the motion of a 10 Hz sensor at 40 m/s, and the last 0.15 m.
_STAGES_VOXELS = (20.0, 7.5, 3.0, 1.5, 0.75)
_COARSE_VOXELS = 5.0         # the first stage works on a cloud thinned this much more
_SCENE_VOXEL_SHARE = 0.04    # a voxel is at most this share of the median range: indoors all is smaller
_NORMAL_RADIUS_VOXELS = 5.0
_NORMAL_NEIGHBOURS = 40
_MIN_POINTS = 30
_MIN_OVERLAP = 0.3           # of the source within the third stage's reach of the target, at the end


def register(
    source: np.ndarray, target: np.ndarray, start: np.ndarray | None, config: EgoConfig
) -> np.ndarray:
    """target_from_source (4, 4) of two clouds (N, 3) and (M, 3) in metres, by robust point-to-plane ICP.

    Tukey's loss lets moving objects go. `start` is a first guess; without one the search begins wide, at
    the identity. Raises DataError when the clouds have too little in common.
    """
    scene_m = float(np.median(np.linalg.norm(source, axis=1))) if len(source) else 0.0
    voxel_m = min(config.voxel_m, _SCENE_VOXEL_SHARE * scene_m)
    fine = _thinned(source, voxel_m), _with_normals(_thinned(target, voxel_m), voxel_m)
    target_from_source = start
    if start is None:
        coarse_m = _COARSE_VOXELS * voxel_m
        coarse = _thinned(source, coarse_m), _with_normals(_thinned(target, coarse_m), coarse_m)
        target_from_source = _icp(*coarse, _STAGES_VOXELS[0] * voxel_m, np.eye(4))
    for reach_voxels in _STAGES_VOXELS[1:]:
        target_from_source = _icp(*fine, reach_voxels * voxel_m, target_from_source)
    _require_overlap(*fine, _STAGES_VOXELS[2] * voxel_m, target_from_source)
    return target_from_source


def _thinned(points: np.ndarray, voxel_m: float):
    o3d = open3d()
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    cloud = cloud.voxel_down_sample(voxel_m) if voxel_m > 0 else cloud
    if len(cloud.points) < _MIN_POINTS:
        raise DataError(
            f"ego-motion: a scan has {len(points)} points in range, {len(cloud.points)} after thinning to "
            f"{voxel_m:.2g} m, and registration needs {_MIN_POINTS}; is the scan complete and in metres, is "
            "preparation.min_range_m too large for the place?")
    return cloud


def _with_normals(cloud, voxel_m: float):
    search = open3d().geometry.KDTreeSearchParamHybrid(_NORMAL_RADIUS_VOXELS * voxel_m, _NORMAL_NEIGHBOURS)
    cloud.estimate_normals(search)
    return cloud


def _icp(source, target, reach_m: float, start: np.ndarray) -> np.ndarray:
    registration = open3d().pipelines.registration
    method = registration.TransformationEstimationPointToPlane(registration.TukeyLoss(reach_m))
    criteria = registration.ICPConvergenceCriteria(1e-7, 1e-7, 50)
    found = registration.registration_icp(source, target, reach_m, start, method, criteria)
    return np.array(found.transformation)


def _require_overlap(source, target, reach_m: float, target_from_source: np.ndarray) -> None:
    """Raise DataError unless the motion is rigid and brings the clouds together."""
    overlap = 0.0
    if pose.is_rigid(target_from_source, tolerance=1e-4):
        registration = open3d().pipelines.registration
        overlap = registration.evaluate_registration(source, target, reach_m, target_from_source).fitness
    if overlap < _MIN_OVERLAP:
        raise DataError(
            f"ego-motion: {overlap:.0%} of the first scan comes within {reach_m:.2g} m of the second, at "
            f"least {_MIN_OVERLAP:.0%} should; are these consecutive scans of one sensor?")


class Odometry:
    """KISS-ICP along a sequence (Vizzo et al. 2023)."""

    def __init__(self, min_range_m: float, max_range_m: float):
        from kiss_icp.config import KISSConfig
        from kiss_icp.kiss_icp import KissICP

        config = KISSConfig()
        config.data.min_range, config.data.max_range = min_range_m, max_range_m
        config.data.deskew = False   # flow is between the points as they were measured
        config.mapping.voxel_size = max_range_m / 100.0
        self._odometry = KissICP(config)
        self._world_from_previous: np.ndarray | None = None

    def step(self, points: np.ndarray) -> np.ndarray | None:
        """current_from_previous (4, 4) for the next cloud (N, 3) of finite points; None for the first."""
        self._odometry.register_frame(points, np.empty(0))
        world_from_current = np.array(self._odometry.last_pose)
        previous, self._world_from_previous = self._world_from_previous, world_from_current
        return None if previous is None else pose.inverse(world_from_current) @ previous
