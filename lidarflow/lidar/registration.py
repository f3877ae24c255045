"""Registration of two clouds with Open3D: what ego-motion and the baselines have in common."""

import numpy as np

from lidarflow import pose
from lidarflow.errors import DataError
from lidarflow.open3d_import import open3d

_SCENE_VOXEL_SHARE = 0.04    # a voxel is at most this share of the median range: indoors all is smaller
_NORMAL_RADIUS_VOXELS = 5.0
_NORMAL_NEIGHBOURS = 40
_MIN_POINTS = 30
_SETTLED = 1e-7              # relative change of fit and residual that ends an ICP
_REPRODUCIBLE_DECIMALS = 9


def voxel_for(points: np.ndarray, wanted_m: float) -> float:
    """Voxel in metres to thin points (N, 3) to: the wanted one, or a smaller one in a small place."""
    scene_m = float(np.median(np.linalg.norm(points, axis=1))) if len(points) else 0.0
    return min(wanted_m, _SCENE_VOXEL_SHARE * scene_m)


def thinned(points: np.ndarray, voxel_m: float):
    """Open3D cloud of points (N, 3), averaged per voxel; DataError where too few are left."""
    o3d = open3d()
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    cloud = cloud.voxel_down_sample(voxel_m) if voxel_m > 0 else cloud
    if len(cloud.points) < _MIN_POINTS:
        raise DataError(
            f"registration: a scan has {len(points)} points in range, {len(cloud.points)} after thinning to "
            f"{voxel_m:.2g} m, and registration needs {_MIN_POINTS}; is the scan complete and in metres, is "
            "preparation.min_range_m too large for the place?")
    return cloud


def with_normals(cloud, voxel_m: float):
    """`cloud`, thinned to `voxel_m`, with a normal per point."""
    search = open3d().geometry.KDTreeSearchParamHybrid(_NORMAL_RADIUS_VOXELS * voxel_m, _NORMAL_NEIGHBOURS)
    cloud.estimate_normals(search)
    return cloud


def robust_point_to_plane(source, target, reach_m: float, start: np.ndarray) -> np.ndarray:
    """target_from_source (4, 4) from `start` (4, 4); Tukey's loss, `reach_m` wide, lets moving objects go."""
    registration = open3d().pipelines.registration
    method = registration.TransformationEstimationPointToPlane(registration.TukeyLoss(reach_m))
    return _icp(source, target, reach_m, start, method, iterations=50)


def point_to_point(source, target, reach_m: float, start: np.ndarray) -> np.ndarray:
    """target_from_source (4, 4) from `start` (4, 4) by the distances of nearest points within `reach_m`."""
    method = open3d().pipelines.registration.TransformationEstimationPointToPoint()
    return _icp(source, target, reach_m, start, method, iterations=100)


def overlap(source, target, reach_m: float, target_from_source: np.ndarray) -> float:
    """Share of the source that comes within `reach_m` of the target."""
    registration = open3d().pipelines.registration
    return registration.evaluate_registration(source, target, reach_m, target_from_source).fitness


def reproducible(motion: np.ndarray) -> np.ndarray:
    """`motion` (4, 4) with its twist rounded to nanometres and nanoradians.

    Registrations sum in parallel and in no fixed order; without their last digits equal runs give equal
    bytes.
    """
    return pose.exp(np.round(pose.log(motion), _REPRODUCIBLE_DECIMALS))


def _icp(source, target, reach_m: float, start: np.ndarray, method, iterations: int) -> np.ndarray:
    registration = open3d().pipelines.registration
    criteria = registration.ICPConvergenceCriteria(_SETTLED, _SETTLED, iterations)
    found = registration.registration_icp(source, target, reach_m, start, method, criteria)
    return np.array(found.transformation)
