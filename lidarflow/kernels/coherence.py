"""Local translation of a surface from signed plane distances: Lucas and Kanade's step, on points."""

import math

import numba
import numpy as np

from lidarflow.kernels import cells, lanes, queue
from lidarflow.kernels.compiled import njit
from lidarflow.kernels.linalg import solve_positive3

_DAMPING = 0.02   # share of a full plane that an unseen direction is held back by
_CHUNK = 64       # cells of points that one thread takes at a time
_ROWS = 7         # of a block: offsets along x, y, z, the normal, the plane's distance
_SUMS = 11        # number, r², n r, n nᵀ


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
    known = np.flatnonzero(np.isfinite(normals[:, 0]) & np.isfinite(offsets_m))
    planes = np.empty((len(known), 7))
    planes[:, :3], planes[:, 3:6] = points.take(known, axis=0), normals.take(known, axis=0)
    planes[:, 6] = offsets_m.take(known)
    asked, seen = cells.build(points, radius_m), cells.build(planes[:, :3], radius_m)
    return _local_shifts(np.ascontiguousarray(points), asked, planes, seen, min_planes, min_rms_m)


@njit(parallel=True)
def _local_shifts(points, asked, planes, seen, min_planes, min_rms_m):
    n, cell_count = len(points), len(asked.place)
    shifts, counts = np.zeros((n, 3)), np.zeros(n, np.int64)
    before_m, after_m = np.zeros(n), np.zeros(n)
    waiting = queue.tasks()
    for _ in numba.prange(queue.PLACES):
        chunk = queue.take(waiting)
        while chunk < (cell_count + _CHUNK - 1) // _CHUNK:
            start, end = chunk * _CHUNK, min((chunk + 1) * _CHUNK, cell_count)
            _some_shifts(points, asked, planes, seen, start, end, min_planes, min_rms_m, shifts, counts,
                         before_m, after_m)
            chunk = queue.take(waiting)
    return shifts, counts, before_m, after_m


@njit()
def _some_shifts(points, asked, planes, seen, start, end, min_planes, min_rms_m, shifts, counts, before_m,
                 after_m):
    """As `local_shifts`, of the points in the cells from `start` to `end`."""
    near, corner = np.empty(cells.NEAR, np.int64), np.empty(3)
    factor, t = np.empty((3, 3)), np.empty(3)
    sums = np.empty(_SUMS * lanes.WIDTH, np.float32)
    for cell in range(start, end):
        block = lanes.gathered_around(planes, seen, asked.place[cell], near, corner)
        for i in asked.order[asked.bounds[cell]: asked.bounds[cell + 1]]:
            _add_up(block, np.float32(points[i, 0] - corner[0]), np.float32(points[i, 1] - corner[1]),
                    np.float32(points[i, 2] - corner[2]), np.float32(seen.cell_m * seen.cell_m), sums)
            counts[i] = int(lanes.total(sums, 0))
            if counts[i] == 0:
                continue
            before_m[i] = after_m[i] = math.sqrt(lanes.total(sums, 1) / counts[i])
            if counts[i] >= min_planes and before_m[i] >= min_rms_m:
                after_m[i] = _shift(sums, counts[i], factor, t)
                shifts[i] = t


@njit()
def _add_up(block, px, py, pz, radius_sq, sums):
    """Fill the `sums` over the planes within a radius of a place."""
    width = lanes.WIDTH
    one, zero = np.float32(1.0), np.float32(0.0)
    for k in range(_SUMS * width):
        sums[k] = zero
    for start in range(0, len(block), _ROWS * width):
        own = block[start: start + _ROWS * width]
        for k in range(width):
            x, y, z = own[k] - px, own[width + k] - py, own[2 * width + k] - pz
            inside = one if x * x + y * y + z * z <= radius_sq else zero
            nx, ny, nz = own[3 * width + k], own[4 * width + k], own[5 * width + k]
            r = inside * own[6 * width + k]
            ix, iy, iz = inside * nx, inside * ny, inside * nz
            sums[k] += inside
            sums[width + k] += r * r
            sums[2 * width + k] += r * nx
            sums[3 * width + k] += r * ny
            sums[4 * width + k] += r * nz
            sums[5 * width + k] += ix * nx
            sums[6 * width + k] += ix * ny
            sums[7 * width + k] += ix * nz
            sums[8 * width + k] += iy * ny
            sums[9 * width + k] += iy * nz
            sums[10 * width + k] += iz * nz


@njit()
def _shift(sums, count, factor, t):
    """Fill the shift t (3,) that explains most, and return the root mean square of what it leaves."""
    total_sq = lanes.total(sums, 1)
    rx, ry, rz = lanes.total(sums, 2), lanes.total(sums, 3), lanes.total(sums, 4)
    xx, xy, xz = lanes.total(sums, 5), lanes.total(sums, 6), lanes.total(sums, 7)
    yy, yz, zz = lanes.total(sums, 8), lanes.total(sums, 9), lanes.total(sums, 10)
    damping = _DAMPING * count
    factor[0, 0], factor[1, 0], factor[2, 0] = xx + damping, xy, xz
    factor[1, 1], factor[2, 1], factor[2, 2] = yy + damping, yz, zz + damping
    t[0], t[1], t[2] = rx, ry, rz
    solve_positive3(factor, t)
    # |r − n·t|² summed, from the sums at hand.
    quadratic = (xx * t[0] * t[0] + yy * t[1] * t[1] + zz * t[2] * t[2]
                 + 2.0 * (xy * t[0] * t[1] + xz * t[0] * t[2] + yz * t[1] * t[2]))
    left_sq = total_sq - 2.0 * (rx * t[0] + ry * t[1] + rz * t[2]) + quadratic
    return math.sqrt(max(left_sq, 0.0) / count)
