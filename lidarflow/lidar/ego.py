"""Ego-motion: the rigid motion of the static world between two scans, or along a sequence."""

import numpy as np

from lidarflow import pose
from lidarflow.config import EgoConfig
from lidarflow.errors import DataError
from lidarflow.open3d_import import open3d

# Coarse to fine: how far apart corresponding surfaces may be. The first stage reaches 4 m, the motion of a
# 10 Hz sensor at 40 m/s.
_STAGES_M = (4.0, 1.5, 0.6, 0.3, 0.15)
_COARSE_VOXEL_M = 1.0
_MIN_POINTS = 30
_NORMAL_RADIUS_SHARE = 5.0   # normals see five voxels around a point


def register(
    source: np.ndarray, target: np.ndarray, start: np.ndarray | None, config: EgoConfig
) -> np.ndarray:
    """target_from_source (4, 4) of two clouds (N, 3) and (M, 3) in metres, by robust point-to-plane ICP.

    Tukey's loss lets moving objects go. `start` is a first guess; without one the search begins wide, at
    the identity. Raises DataError when the clouds have too little in common.
    """
    stages = _STAGES_M if start is None else _STAGES_M[1:]
    target_from_source = np.eye(4) if start is None else start
    clouds: dict[float, tuple] = {}
    for reach_m in stages:
        voxel_m = max(config.voxel_m, _COARSE_VOXEL_M) if reach_m == _STAGES_M[0] else config.voxel_m
        if voxel_m not in clouds:
            clouds[voxel_m] = _cloud(source, voxel_m, normals=False), _cloud(target, voxel_m, normals=True)
        target_from_source = _icp(*clouds[voxel_m], reach_m, target_from_source)
    if not pose.is_rigid(target_from_source, tolerance=1e-4):
        raise DataError("ego-motion: registration found no rigid motion; are these two scans of one place?")
    return target_from_source


def _cloud(points: np.ndarray, voxel_m: float, normals: bool):
    o3d = open3d()
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)).voxel_down_sample(voxel_m)
    if len(cloud.points) < _MIN_POINTS:
        raise DataError(
            f"ego-motion: {len(cloud.points)} points are left of a scan after thinning to {voxel_m} m, "
            f"at least {_MIN_POINTS} are needed; is the scan complete, in metres?")
    if normals:
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(_NORMAL_RADIUS_SHARE * voxel_m, 40))
    return cloud


def _icp(source, target, reach_m: float, start: np.ndarray) -> np.ndarray:
    registration = open3d().pipelines.registration
    method = registration.TransformationEstimationPointToPlane(registration.TukeyLoss(reach_m))
    criteria = registration.ICPConvergenceCriteria(1e-7, 1e-7, 50)
    found = registration.registration_icp(source, target, reach_m, start, method, criteria)
    return np.array(found.transformation)


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
