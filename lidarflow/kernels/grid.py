"""Uniform grid over points: neighbours within a radius of at most one cell.

Points are sorted by cell, z fastest, so that the cells above and below one another are one contiguous
run: a query reads nine runs.
"""

import math

import numpy as np

from lidarflow.kernels import cells
from lidarflow.kernels.compiled import njit

_MOST_CELLS = 2.0**20     # along an axis, so that keys fit into int64; what is beyond shares the last


def build(points: np.ndarray, cell_m: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Grid of finite points (N, 3): order (N,), sorted keys (N,), lower corner (3,), cells per axis (3,)."""
    keys, lower, shape = _keys(np.ascontiguousarray(points, float), float(cell_m))
    order = np.argsort(keys, kind="stable")
    return order, keys[order], lower, shape


@njit()
def _keys(points, cell_m):
    """The key (N,) of each point's cell, the lower corner of the grid (3,) and its cells per axis (3,)."""
    lower, upper = np.zeros(3), np.zeros(3)
    for k in range(3 if len(points) else 0):
        lower[k], upper[k] = points[:, k].min() - cell_m, points[:, k].max()
    shape, keys = np.empty(3, np.int64), np.empty(len(points), np.int64)
    for k in range(3):
        shape[k] = _cells_along(upper[k] - lower[k], cell_m) + 3
    for i in range(len(points)):
        x, y, z = cell_of(points[i], lower, cell_m)
        keys[i] = (x * shape[1] + y) * shape[2] + z
    return keys, lower, shape


def first_per_voxel(points: np.ndarray, voxel_m: float) -> np.ndarray:
    """Indices (V,), ascending, of the point nearest to the centre of each occupied voxel; points (N, 3)."""
    return first_of_each(np.ascontiguousarray(points), float(voxel_m))


def voxels(points: np.ndarray, voxel_m: float) -> tuple[np.ndarray, np.ndarray]:
    """The number (N,) of each point's voxel, and how many points each voxel has (V,).

    Voxels are numbered in the order they first appear in points (N, 3).
    """
    return cells.numbered(np.ascontiguousarray(points), float(voxel_m))


def means(points: np.ndarray, voxel_m: float) -> np.ndarray:
    """The mean (V, 3) of the points (N, 3) in each occupied voxel, in the order voxels first appear.

    The lowest point along each axis is in the middle of a voxel.
    """
    return averaged(np.ascontiguousarray(points), float(voxel_m))


@njit()
def averaged(points, voxel_m):
    """As `means`, for other kernels."""
    lower, placed = np.full(3, np.inf), np.empty_like(points)
    for i in range(len(points)):
        for k in range(3):
            lower[k] = min(lower[k], points[i, k])
    for i in range(len(points)):
        for k in range(3):
            placed[i, k] = points[i, k] - (lower[k] - 0.5 * voxel_m)
    number, counts = cells.numbered(placed, voxel_m)
    total = np.zeros((len(counts), 3))
    for i in range(len(points)):
        for k in range(3):
            total[number[i], k] += points[i, k]
    for voxel in range(len(counts)):
        for k in range(3):
            total[voxel, k] /= counts[voxel]
    return total


@njit()
def first_of_each(points, voxel_m):
    """As `first_per_voxel`, for other kernels."""
    number, counts = cells.numbered(points, voxel_m)
    first, least_sq = np.full(len(counts), -1), np.full(len(counts), np.inf)
    for i in range(len(points)):
        off_sq = 0.0
        for k in range(3):
            place = points[i, k] / voxel_m
            off_sq += (place - math.floor(place) - 0.5) ** 2
        if first[number[i]] < 0 or off_sq < least_sq[number[i]]:     # it may overflow
            least_sq[number[i]], first[number[i]] = off_sq, i
    is_first = np.zeros(len(points), np.bool_)     # the way to sort them that takes no comparisons
    for voxel in range(len(counts)):
        is_first[first[voxel]] = True
    return np.flatnonzero(is_first)


@njit(inline="always")
def room(starts, ends, run_count):
    """How many points the runs hold."""
    count = 0
    for run in range(run_count):
        count += ends[run] - starts[run]
    return count


@njit(inline="always")
def lower_bound(keys, key):
    """Index of the first entry of sorted `keys` that is not below `key`."""
    low, high = 0, len(keys)
    while low < high:
        middle = (low + high) // 2
        if keys[middle] < key:
            low = middle + 1
        else:
            high = middle
    return low


@njit()
def runs(query, keys, lower, shape, cell_m, starts, ends):
    """Fill the up to nine runs [start, end) of sorted points around `query` (3,); returns how many."""
    return runs_around(cell_of(query, lower, cell_m), keys, shape, starts, ends)


@njit(inline="always")
def cell_of(query, lower, cell_m):
    """Indices of the cell of `query` (3,), which may lie outside the grid."""
    return (_cells_along(query[0] - lower[0], cell_m), _cells_along(query[1] - lower[1], cell_m),
            _cells_along(query[2] - lower[2], cell_m))


@njit(inline="always")
def _cells_along(distance_m, cell_m):
    """How many cells are in a distance along an axis, at most 2^20 either way: neighbours stay so."""
    return math.floor(min(max(distance_m / cell_m, -_MOST_CELLS), _MOST_CELLS))


@njit()
def runs_around(cell, keys, shape, starts, ends):
    """As `runs`, for all queries in one cell."""
    ix, iy, iz = cell
    count = 0
    z_low, z_high = max(iz - 1, 0), min(iz + 1, shape[2] - 1)
    if z_low > z_high:
        return 0
    for jx in range(max(ix - 1, 0), min(ix + 1, shape[0] - 1) + 1):
        for jy in range(max(iy - 1, 0), min(iy + 1, shape[1] - 1) + 1):
            base = (jx * shape[1] + jy) * shape[2]
            start = lower_bound(keys, base + z_low)
            end = lower_bound(keys, base + z_high + 1)
            if end > start:
                starts[count], ends[count] = start, end
                count += 1
    return count
