"""A scan made ready for registration: one kernel, so that nothing of it waits for the interpreter."""

import math

import numba
import numpy as np
from numba.extending import register_jitable

from lidarflow.kernels import cells, grid, normals
from lidarflow.kernels import tree as trees
from lidarflow.kernels.compiled import njit
from lidarflow.kernels.tree import Tree

_LEAST_RADIUS_M = 1e-6    # of a place that is one point


@register_jitable
def voxel_for(wanted_m: float, scene_share: float, median_m: float) -> float:
    """The wanted voxel, or a smaller one in a small place: `scene_share` of the median range; metres."""
    return min(wanted_m, scene_share * median_m)


@njit()
def in_range(points, min_range_m, max_range_m):
    """Those (M, 3) of points (N, 3) whose range lies between the two, and their median range; none have 0.

    Points that are not finite have no range.
    """
    found, range_sq, count = np.empty_like(points), np.empty(len(points)), 0
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        own_sq = x * x + y * y + z * z
        if min_range_m * min_range_m <= own_sq <= max_range_m * max_range_m:
            found[count, 0], found[count, 1], found[count, 2] = x, y, z
            range_sq[count] = own_sq
            count += 1
    median_m = math.sqrt(np.median(range_sq[:count])) if count else 0.0
    return found[:count], median_m


def planes(points: np.ndarray, normal_radius_m: float, min_width_m: float) -> tuple[Tree, np.ndarray]:
    """The tree over points (N, 3), and a normal (N, 3) at each in its order.

    As normals.estimate, and as normals.level where a neighbourhood is narrower than `min_width_m`.
    """
    _launch_threads()
    grown, found = _planes(np.ascontiguousarray(points), float(normal_radius_m), float(min_width_m))
    return Tree(*grown), found


def thinned(
    points: np.ndarray, min_range_m: float, max_range_m: float, voxel_m: float, scene_share: float,
    radius_voxels: float, width_voxels: float,
) -> tuple[np.ndarray, Tree, np.ndarray, float, int]:
    """What is in range of points (N, 3), averaged per voxel (M, 3), and its `planes`.

    Returns the voxel in metres and how many points were in range as well. A voxel is at most `scene_share` of
    the median range; normals are fitted within `radius_voxels`, to what is as wide as `width_voxels`.
    """
    _launch_threads()
    means, grown, found, voxel_m, count = _thinned(
        np.ascontiguousarray(points), float(min_range_m), float(max_range_m), float(voxel_m), scene_share,
        radius_voxels, width_voxels)
    return means, Tree(*grown), found, voxel_m, count


def _launch_threads() -> None:
    # A kernel that comes from the cache does not launch those that a kernel within it needs.
    numba.get_num_threads()


@njit()
def _planes(points, normal_radius_m, min_width_m):
    grown = trees.grown(points)
    near = cells.built(grown.points, normal_radius_m)
    found, is_narrow = normals.estimated(grown.points, near, grown.points, near, min_width_m)
    normals.level(found, is_narrow)
    return grown[:], found


@njit()
def _thinned(points, min_range_m, max_range_m, voxel_m, scene_share, radius_voxels, width_voxels):
    kept, median_m = in_range(points, min_range_m, max_range_m)
    voxel_m = voxel_for(voxel_m, scene_share, median_m)
    means = grid.averaged(kept, voxel_m) if voxel_m > 0.0 else kept
    grown, found = _planes(means, max(radius_voxels * voxel_m, _LEAST_RADIUS_M), width_voxels * voxel_m)
    return means, grown, found, voxel_m, len(kept)
