"""Normal equations of robust point-to-plane registration."""

import math

import numba
import numpy as np

from lidarflow.kernels.compiled import njit
from lidarflow.kernels.icp import follow
from lidarflow.kernels.linalg import moved

_CHUNK = 512     # points that one thread takes at a time; their sums are added in order


class Pairs:
    """Which point of a target each of N points is nearest to, kept from one round to the next.

    place (N,) was nearest when the point was at asked (N, 3), and nothing else was within clear_m (N,).
    """

    __slots__ = ("asked", "clear_m", "place")

    def __init__(self, count: int):
        self.place = np.full(count, -1)
        self.asked = np.zeros((count, 3))
        self.clear_m = np.full(count, -np.inf)


def normal_equations(points, motion, target, target_normals, reach_m, pairs: Pairs):
    """Matrix (6, 6) and right side (6,) of one Gauss-Newton step, and how many points it rests on.

    The step is a twist (rotation first) to be applied after `motion` (4, 4); it lowers Σ ρ(n · (T p − q)) of
    points p (N, 3) whose nearest q in the tree `target` is within `reach_m`. ρ is Tukey's, as wide as the
    reach, n of target_normals (M, 3) in the order of the tree, NaN where there is none.
    """
    sums = _sums(
        points, motion, target, target_normals, float(reach_m), pairs.place, pairs.asked, pairs.clear_m)
    matrix = np.zeros((6, 6))
    matrix[_LOWER] = sums[:21]
    return matrix + np.tril(matrix, -1).T, sums[21:27], int(sums[27])


_LOWER = np.tril_indices(6)


@njit(parallel=True)
def _sums(points, motion, target, target_normals, reach_m, place, asked, clear_m):
    chunks = (len(points) + _CHUNK - 1) // _CHUNK
    parts = np.zeros((chunks, 28))
    for chunk in numba.prange(chunks):
        _add(points, chunk * _CHUNK, min((chunk + 1) * _CHUNK, len(points)), motion, target, target_normals,
             reach_m, place, asked, clear_m, parts[chunk])
    total = np.zeros(28)
    for chunk in range(chunks):
        total += parts[chunk]
    return total


@njit()
def _add(points, start, end, motion, target, target_normals, reach_m, place, asked, clear_m, total):
    row = np.empty(6)
    for i in range(start, end):
        x, y, z = moved(points[i], motion)
        near, _ = follow(target, x, y, z, reach_m, i, place, asked, clear_m)
        if near < 0 or math.isnan(target_normals[near, 0]):
            continue
        nx, ny, nz = target_normals[near, 0], target_normals[near, 1], target_normals[near, 2]
        at = target.points[near]
        off_m = nx * (at[0] - x) + ny * (at[1] - y) + nz * (at[2] - z)
        share = 1.0 - (off_m / reach_m) ** 2
        weight = share * share
        row[0], row[1], row[2] = y * nz - z * ny, z * nx - x * nz, x * ny - y * nx
        row[3], row[4], row[5] = nx, ny, nz
        k = 0
        for a in range(6):
            for b in range(a + 1):
                total[k] += weight * row[a] * row[b]
                k += 1
            total[21 + a] += weight * off_m * row[a]
        total[27] += 1.0
