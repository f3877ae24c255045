"""Local translation of a surface from signed plane distances: Lucas and Kanade's step, on points."""

import math

import numba
import numpy as np

from lidarflow.kernels import grid
from lidarflow.kernels.compiled import njit
from lidarflow.kernels.linalg import solve_positive3

_DAMPING = 0.02   # share of a full plane that an unseen direction is held back by
_CHUNK = 256      # points that one thread takes at a time


def local_shifts(
    points: np.ndarray, normals: np.ndarray, offsets_m: np.ndarray, radius_m: float, min_planes: int = 1,
    min_rms_m: float = 0.0,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The translation (S, 3) that best explains the plane distances around every point, in metres.

    points (S, 3); normals (S, 3) of the planes they are compared with, NaN where there is none; offsets_m
    (S,), how far along its normal a plane lies from its point. Around each point, t minimises
    Σ (n·t − r)² + damping |t|² over the neighbourhood (Lucas and Kanade 1981). Also returns the number of
    planes (S,) and the root mean square of r before (S,) and of r − n·t after (S,). Where there are fewer
    than `min_planes` planes, or r is less than `min_rms_m`, t is 0.
    """
    known = np.flatnonzero(np.isfinite(normals).all(axis=1) & np.isfinite(offsets_m))
    order, keys, lower, shape = grid.build(points[known], radius_m)
    rows = known[order]
    return _local_shifts(points, points[rows], normals[rows], offsets_m[rows], keys, lower, shape, radius_m,
                         min_planes, min_rms_m)


@njit(parallel=True)
def _local_shifts(points, at, normals, offsets_m, keys, lower, shape, radius_m, min_planes,
                  min_rms_m):
    n = len(points)
    shifts, counts = np.zeros((n, 3)), np.zeros(n, np.int64)
    before_m, after_m = np.zeros(n), np.zeros(n)
    for chunk in numba.prange((n + _CHUNK - 1) // _CHUNK):
        start, end = chunk * _CHUNK, (chunk + 1) * _CHUNK
        _some_shifts(points[start:end], at, normals, offsets_m, keys, lower, shape, radius_m, min_planes,
                     min_rms_m, shifts[start:end], counts[start:end], before_m[start:end], after_m[start:end])
    return shifts, counts, before_m, after_m


@njit()
def _some_shifts(points, at, normals, offsets_m, keys, lower, shape, radius_m, min_planes, min_rms_m, shifts,
                 counts, before_m, after_m):
    starts, ends = np.empty(9, np.int64), np.empty(9, np.int64)
    last, run_count = (0, 0, 0), 0
    factor, t = np.empty((3, 3)), np.empty(3)
    near = np.empty(len(at) + 1, np.int64)
    for i in range(len(points)):
        # Points that follow one another are often in one cell.
        cell = grid.cell_of(points[i], lower, radius_m)
        if i == 0 or cell != last:
            last = cell
            run_count = grid.runs_around(cell, keys, shape, starts, ends)
        count, total_sq = 0, 0.0
        for run in range(run_count):
            for j in range(starts[run], ends[run]):
                # Without a branch, which would be guessed wrong for every third.
                near[count] = j
                count += _distance_sq(points, i, at, j) <= radius_m * radius_m
        for j in near[:count]:
            total_sq += offsets_m[j] * offsets_m[j]
        counts[i] = count
        if count == 0:
            continue
        before_m[i] = after_m[i] = math.sqrt(total_sq / count)
        if count < min_planes or before_m[i] < min_rms_m:
            continue
        xx = xy = xz = yy = yz = zz = rx = ry = rz = 0.0
        for j in near[:count]:
            r, nx, ny, nz = offsets_m[j], normals[j, 0], normals[j, 1], normals[j, 2]
            rx, ry, rz = rx + nx * r, ry + ny * r, rz + nz * r
            xx, xy, xz = xx + nx * nx, xy + nx * ny, xz + nx * nz
            yy, yz, zz = yy + ny * ny, yz + ny * nz, zz + nz * nz
        damping = _DAMPING * count
        factor[0, 0], factor[1, 0], factor[2, 0] = xx + damping, xy, xz
        factor[1, 1], factor[2, 1], factor[2, 2] = yy + damping, yz, zz + damping
        t[0], t[1], t[2] = rx, ry, rz
        solve_positive3(factor, t)
        # |r − n·t|² summed, from the sums at hand.
        quadratic = (xx * t[0] * t[0] + yy * t[1] * t[1] + zz * t[2] * t[2]
                     + 2.0 * (xy * t[0] * t[1] + xz * t[0] * t[2] + yz * t[1] * t[2]))
        left_sq = total_sq - 2.0 * (rx * t[0] + ry * t[1] + rz * t[2]) + quadratic
        shifts[i, 0], shifts[i, 1], shifts[i, 2] = t[0], t[1], t[2]
        after_m[i] = math.sqrt(max(left_sq, 0.0) / count)


@njit(inline="always")
def _distance_sq(a, i, b, j):
    return (a[i, 0] - b[j, 0]) ** 2 + (a[i, 1] - b[j, 1]) ** 2 + (a[i, 2] - b[j, 2]) ** 2
