"""Registration of two clouds: what ego-motion and the baselines have in common."""

from dataclasses import dataclass

import numpy as np

from lidarflow import pose
from lidarflow.config import PreparationConfig
from lidarflow.errors import DataError
from lidarflow.kernels import grid, icp, neighbours, thinning
from lidarflow.kernels import registration as kernel
from lidarflow.kernels.tree import Tree
from lidarflow.lidar import preparation
from lidarflow.open3d_import import open3d
from lidarflow.rows import every_few

_SCENE_VOXEL_SHARE = 0.04    # a voxel is at most this share of the median range: indoors all is smaller
_NORMAL_RADIUS_VOXELS = 3.5
# A piece of one ring on the road is as wide as ranges are noisy: along the line of sight, or anywhere across
# where coordinates are rounded. Planes fitted to such pieces lean or stand all around the sensor, travel with
# it, and say that it rests. What is narrower than this, as a standard deviation, has the normal of the
# ground where it is level, and none where it is not.
_MIN_WIDTH_VOXELS = 0.2
_MIN_POINTS = 30             # of a scan, and of pairs that a step rests on
_SETTLED = 1e-5              # a step that stays below it, in metres and radians, ends a registration
_NEARLY_SETTLED = 1e-4       # and that ends a stage another one follows
_SETTLED_SHARE = 1e-7        # relative change of fit and residual that ends a point-to-point ICP
_MOST_ROUNDS = 30
_LEADING_POINTS = 8000       # points that lead a registration to its last reach, about
_OVERLAP_SAMPLE = 2000       # points; they tell a share to 0.02
_HOLD = 1e-9                 # share of the normal equations' trace that is added to their diagonal
_REPRODUCIBLE_DECIMALS = 9   # of metres and radians


def voxel_for(points: np.ndarray, wanted_m: float) -> float:
    """Voxel in metres to thin points (N, 3) to: the wanted one, or a smaller one in a small place."""
    range_sq = np.einsum("ij,ij->i", points, points)
    scene_m = float(np.sqrt(np.median(range_sq))) if len(points) else 0.0
    return thinning.voxel_for(wanted_m, _SCENE_VOXEL_SHARE, scene_m)


def thinned(points: np.ndarray, voxel_m: float, name: str = "") -> np.ndarray:
    """Points (N, 3) averaged per voxel (M, 3).

    Raises DataError, which says whose points they are (`name`), where too few are left or all are in one
    place.
    """
    found = grid.means(points, voxel_m) if voxel_m > 0 else points
    _require_enough(found, len(points), voxel_m, name)
    return found


def _require_enough(found: np.ndarray, count: int, voxel_m: float, name: str) -> None:
    where = f"{name}: registration" if name else "registration"
    if len(found) < _MIN_POINTS:
        raise DataError(
            f"{where}: a scan has {count} points in range, {len(found)} after thinning to "
            f"{voxel_m:.2g} m, and registration needs {_MIN_POINTS}; is the scan complete and in metres, is "
            "preparation.min_range_m too large for the place?")
    if voxel_m <= 0:
        raise DataError(f"{where}: a scan of {count} points has no extent; do most lie at the sensor?")


@dataclass(frozen=True, slots=True, eq=False)
class Planes:
    """A cloud as a tree, with a normal (N, 3) per point in the tree's order; NaN where there is none."""

    tree: Tree
    normals: np.ndarray

    @classmethod
    def of(cls, points: np.ndarray, voxel_m: float) -> "Planes":
        """Of points (N, 3) in metres, thinned to `voxel_m`."""
        return cls(*thinning.planes(
            points, _NORMAL_RADIUS_VOXELS * voxel_m, _MIN_WIDTH_VOXELS * voxel_m))

    @classmethod
    def in_range(
        cls, points: np.ndarray, limits: PreparationConfig, wanted_m: float, name: str = ""
    ) -> "tuple[np.ndarray, Planes, float]":
        """Those in range of points (N, 3), thinned (M, 3); a cloud of these; and the voxel, as `voxel_for`.

        Raises DataError, which says whose points they are (`name`), where too few are left.
        """
        means, tree, normals, voxel_m, count = thinning.thinned(
            points, *preparation.range_limits_m(limits), wanted_m, _SCENE_VOXEL_SHARE,
            _NORMAL_RADIUS_VOXELS, _MIN_WIDTH_VOXELS)
        _require_enough(means, count, voxel_m, name)
        return means, cls(tree, normals), voxel_m


def robust_point_to_plane(
    source: np.ndarray, target: Planes, reaches_m: list[float], start: np.ndarray
) -> np.ndarray:
    """target_from_source (4, 4) of points (N, 3) from `start` (4, 4), by Gauss-Newton steps.

    Tukey's loss lets moving objects go. It is as wide as one reach after the other, the widest first. What is
    found within the last reach counts; before, some of the points, evenly over their order, lead there.
    """
    leading = every_few(len(source), _LEADING_POINTS)
    some, of_all = source[leading], icp.nothing_known(len(source))
    motion, nearest = start, icp.nothing_known(len(some))
    for reach_m in reaches_m:
        motion = _settled(some, target, reach_m, motion, nearest, _NEARLY_SETTLED)
    for known, of_some in zip(of_all, nearest, strict=True):
        known[leading] = of_some
    return _settled(source, target, reaches_m[-1], motion, of_all, _SETTLED)


def _settled(
    source: np.ndarray, target: Planes, reach_m: float, motion: np.ndarray, nearest: icp.Nearest,
    settled: float,
) -> np.ndarray:
    """`motion` (4, 4) after steps within one reach, until one is smaller than `settled`."""
    for _ in range(_MOST_ROUNDS):
        matrix, right, count = kernel.normal_equations(
            source, motion, target.tree, target.normals, reach_m, nearest)
        if count < _MIN_POINTS:
            break
        # What no plane holds, as in a corridor, is left where it is.
        step = np.linalg.solve(matrix + _HOLD * np.trace(matrix) * np.eye(6), right)
        motion = pose.exp(step) @ motion
        if np.abs(step).max() < settled:
            break
    return motion


def point_to_point(source: np.ndarray, target: np.ndarray, reach_m: float, start: np.ndarray) -> np.ndarray:
    """target_from_source (4, 4) of points (N, 3) onto points (M, 3), metres, by ICP from `start` (4, 4).

    A point's counterpart is the nearest one within `reach_m`.
    """
    o3d = open3d()
    registration = o3d.pipelines.registration
    method = registration.TransformationEstimationPointToPoint()
    criteria = registration.ICPConvergenceCriteria(_SETTLED_SHARE, _SETTLED_SHARE, 100)
    clouds = [o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)) for points in (source, target)]
    found = registration.registration_icp(*clouds, reach_m, start, method, criteria)
    return np.array(found.transformation)


def overlap(source: np.ndarray, target: Tree, reach_m: float, target_from_source: np.ndarray) -> float:
    """Share of the source (N, 3) that comes within `reach_m` of the target, by a sample."""
    sample = source[every_few(len(source), _OVERLAP_SAMPLE)]
    return float(neighbours.any_within(
        target, pose.apply(target_from_source, sample), np.full(len(sample), reach_m)).mean())


def reproducible(motion: np.ndarray) -> np.ndarray:
    """`motion` (4, 4) with its twist rounded to nanometres and nanoradians.

    Open3D and KISS-ICP sum in parallel and in no fixed order; without their last digits equal runs give equal
    bytes.
    """
    return pose.exp(np.round(pose.log(motion), _REPRODUCIBLE_DECIMALS))
