"""Local translation of a surface from signed plane distances: Lucas and Kanade's step, on points."""

import numba
import numpy as np

from lidarflow.kernels import grid

_DAMPING = 0.02   # share of a full plane that an unseen direction is held back by


def local_shifts(
    points: np.ndarray, normals: np.ndarray, offsets_m: np.ndarray, radius_m: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The translation (S, 3) that best explains the plane distances around every point, in metres.

    points (S, 3); normals (S, 3) of the planes they are compared with, NaN where there is none; offsets_m
    (S,), how far along its normal a plane lies from its point. Around each point, t minimises
    Σ (n·t − r)² + damping |t|² over the neighbourhood (Lucas and Kanade 1981). Also returns the number of
    planes (S,) and the root mean square of r before (S,) and of r − n·t after (S,).
    """
    known = np.flatnonzero(np.isfinite(normals).all(axis=1) & np.isfinite(offsets_m))
    order, keys, lower, shape = grid.build(points[known], radius_m)
    rows = known[order]
    return _local_shifts(points, points[rows], normals[rows], offsets_m[rows], keys, lower, shape, radius_m)


@numba.njit(cache=True, parallel=True)
def _local_shifts(points, at, normals, offsets_m, keys, lower, shape, radius_m):
    n = len(points)
    shifts = np.zeros((n, 3))
    counts = np.zeros(n, np.int64)
    before_m, after_m = np.zeros(n), np.zeros(n)
    for i in numba.prange(n):
        starts, ends = np.empty(9, np.int64), np.empty(9, np.int64)
        normal_matrix, right = np.zeros((3, 3)), np.zeros(3)
        count, total_sq = 0, 0.0
        for run in range(grid.runs(points[i], keys, lower, shape, radius_m, starts, ends)):
            for j in range(starts[run], ends[run]):
                if _distance_sq(points[i], at[j]) > radius_m * radius_m:
                    continue
                count += 1
                total_sq += offsets_m[j] * offsets_m[j]
                for a in range(3):
                    right[a] += normals[j, a] * offsets_m[j]
                    for b in range(3):
                        normal_matrix[a, b] += normals[j, a] * normals[j, b]
        counts[i] = count
        if count == 0:
            continue
        damped = normal_matrix + _DAMPING * count * np.eye(3)
        t = np.linalg.solve(damped, right)
        # |r − n·t|² summed, from the sums at hand.
        left_sq = total_sq - 2.0 * (right @ t) + t @ (normal_matrix @ t)
        shifts[i] = t
        before_m[i] = np.sqrt(total_sq / count)
        after_m[i] = np.sqrt(max(left_sq, 0.0) / count)
    return shifts, counts, before_m, after_m


@numba.njit(cache=True)
def _distance_sq(a, b):
    return (a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2
