"""A scan made ready for registration: one kernel, so that nothing of it waits for the interpreter."""

import math

import numpy as np

from lidarflow.kernels import cells, grid, normals
from lidarflow.kernels import tree as trees
from lidarflow.kernels.compiled import njit

NEAREST_M = 1e-3          # nearer than this lie no returns: files have zeros where there was no echo
FARTHEST_M = 1e4          # nor farther, whatever the limits: int32 has to do for counting cells
_LEAST_RADIUS_M = 1e-6    # of a place that is one point


@njit()
def in_range(points, min_range_m, max_range_m):
    """Those (M, 3) of points (N, 3) whose range lies between the two, and their median range; none have 0.

    Points that are not finite have no range, nor have those that are nearer or farther than any return.
    """
    least_sq, most_sq = max(min_range_m, NEAREST_M) ** 2, min(max_range_m, FARTHEST_M) ** 2
    found, range_sq, count = np.empty_like(points), np.empty(len(points)), 0
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        own_sq = x * x + y * y + z * z
        if least_sq <= own_sq <= most_sq:
            found[count, 0], found[count, 1], found[count, 2] = x, y, z
            range_sq[count] = own_sq
            count += 1
    median_m = math.sqrt(np.median(range_sq[:count])) if count else 0.0
    return found[:count], median_m


@njit()
def planes(points, normal_radius_m):
    """The tree over points (N, 3), and a normal (N, 3) at each in its order, fitted within a radius."""
    grown = trees.grown(points)
    near = cells.built(grown.points, normal_radius_m)
    return grown, normals.estimated(grown.points, near, grown.points, near)


@njit()
def thinned(points, min_range_m, max_range_m, voxel_m, scene_share, radius_voxels):
    """What is in range of points (N, 3), averaged per voxel (M, 3), and its `planes`.

    Returns the voxel in metres and how many points were in range as well.
    A voxel is at most `scene_share` of the median range, normals are fitted within `radius_voxels` of them.
    """
    kept, median_m = in_range(points, min_range_m, max_range_m)
    voxel_m = min(voxel_m, scene_share * median_m)
    means = grid.averaged(kept, voxel_m) if voxel_m > 0.0 else kept
    grown, found = planes(means, max(radius_voxels * voxel_m, _LEAST_RADIUS_M))
    return means, grown, found, voxel_m, len(kept)
