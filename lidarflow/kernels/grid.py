"""Uniform grid over points: neighbours within a radius of at most one cell.

Points are sorted by cell, z fastest, so that the cells above and below one another are one contiguous
run: a query reads nine runs.
"""

import numba
import numpy as np


def build(points: np.ndarray, cell_m: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Grid of finite points (N, 3): order (N,), sorted keys (N,), lower corner (3,), cells per axis (3,)."""
    lower = points.min(axis=0) - cell_m if len(points) else np.zeros(3)
    upper = points.max(axis=0) if len(points) else np.zeros(3)
    shape = np.floor((upper - lower) / cell_m).astype(np.int64) + 3
    cells = np.floor((points - lower) / cell_m).astype(np.int64)
    keys = (cells[:, 0] * shape[1] + cells[:, 1]) * shape[2] + cells[:, 2]
    order = np.argsort(keys, kind="stable")
    return order, keys[order], lower, shape


def first_per_voxel(points: np.ndarray, voxel_m: float) -> np.ndarray:
    """Indices (V,), ascending, of the point nearest to the centre of each occupied voxel; points (N, 3)."""
    if len(points) == 0:
        return np.empty(0, np.int64)
    cells = np.floor(points / voxel_m)
    off_centre_sq = ((points / voxel_m - cells - 0.5) ** 2).sum(axis=1)
    cells = (cells - cells.min(axis=0)).astype(np.int64)
    shape = cells.max(axis=0) + 1
    keys = (cells[:, 0] * shape[1] + cells[:, 1]) * shape[2] + cells[:, 2]
    order = np.lexsort((off_centre_sq, keys))
    first = np.ones(len(order), bool)
    first[1:] = keys[order][1:] != keys[order][:-1]
    return np.sort(order[first])


@numba.njit(cache=True, inline="always")
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


@numba.njit(cache=True)
def runs(query, keys, lower, shape, cell_m, starts, ends):
    """Fill the up to nine runs [start, end) of sorted points around `query` (3,); returns how many."""
    ix = int(np.floor((query[0] - lower[0]) / cell_m))
    iy = int(np.floor((query[1] - lower[1]) / cell_m))
    iz = int(np.floor((query[2] - lower[2]) / cell_m))
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
