"""Surface normals by principal component analysis of a neighbourhood."""

import math

import numba
import numpy as np

from lidarflow.kernels import cells, lanes, queue
from lidarflow.kernels.compiled import njit
from lidarflow.kernels.linalg import plane_eigen3

_MIN_NEIGHBOURS = 4
_CHUNK = 64          # cells of points that one thread takes at a time
_MIN_SPREAD = 1e-3   # a neighbourhood thinner than this share of its length is a line, not a surface
_LEVEL = 0.5         # cosine to the vertical, of what may be ground
_ROWS = 3            # of a block: offsets along x, y, z
_SUMS = 10           # number, offsets, and products of two of them


def estimate(points: np.ndarray, surface: np.ndarray, radius_m: float) -> np.ndarray:
    """Unit normals (N, 3) at `points` (N, 3), fitted to `surface` (S, 3) within `radius_m`.

    They face the sensor at the origin. NaN where there are too few neighbours or they lie on a line.
    """
    asked, seen = cells.build(points, radius_m), cells.build(surface, radius_m)
    normals, _ = estimated(np.ascontiguousarray(points), asked, np.ascontiguousarray(surface), seen, 0.0)
    return normals


@njit(parallel=True)
def estimated(points, asked, surface, seen, min_width_m):
    """As `estimate`, for other kernels: points and surface also by cells of the radius.

    Returns as well which neighbourhoods (N,) are narrower than `min_width_m`, a standard deviation.
    """
    normals, is_narrow = np.full((len(points), 3), np.nan), np.zeros(len(points), np.bool_)
    count = len(asked.place)
    waiting = queue.tasks()
    for _ in numba.prange(queue.PLACES):
        chunk = queue.take(waiting)
        while chunk < (count + _CHUNK - 1) // _CHUNK:
            _estimate_some(
                points, asked, surface, seen, chunk * _CHUNK, min((chunk + 1) * _CHUNK, count), min_width_m,
                normals, is_narrow)
            chunk = queue.take(waiting)
    return normals, is_narrow


@njit()
def level(normals, is_narrow):
    """Give normals (N, 3) that are level and of narrow pieces (N,) the mean of the others, no other such any.

    Without others that are level, no narrow piece has a normal.
    """
    up = np.zeros(3)
    for i in range(len(normals)):
        if not is_narrow[i] and abs(normals[i, 2]) > _LEVEL:
            for k in range(3):
                up[k] += math.copysign(1.0, normals[i, 2]) * normals[i, k]
    length = math.sqrt(up[0] * up[0] + up[1] * up[1] + up[2] * up[2])
    for i in range(len(normals)):
        if is_narrow[i]:
            along = up[0] * normals[i, 0] + up[1] * normals[i, 1] + up[2] * normals[i, 2]
            scale = math.copysign(1.0 / length, along) if abs(along) > _LEVEL * length else np.nan
            for k in range(3):
                normals[i, k] = scale * up[k]


@njit()
def _estimate_some(points, asked, surface, seen, start, end, min_width_m, normals, is_narrow):
    """Fill the normals (N, 3) of the points in the cells from `start` to `end`, and what is narrow (N,)."""
    near, corner = np.empty(cells.NEAR, np.int64), np.empty(3)
    values, across = np.empty(3), np.empty(3)
    sums = np.empty(_SUMS * lanes.WIDTH, np.float32)
    for cell in range(start, end):
        block = lanes.gathered_around(surface, seen, asked.place[cell], near, corner)
        for i in asked.order[asked.bounds[cell]: asked.bounds[cell + 1]]:
            _add_up(block, np.float32(points[i, 0] - corner[0]), np.float32(points[i, 1] - corner[1]),
                    np.float32(points[i, 2] - corner[2]), np.float32(seen.cell_m * seen.cell_m), sums)
            width_sq = _fit(points[i], sums, values, across, normals[i])
            is_narrow[i] = width_sq <= min_width_m * min_width_m


@njit()
def _add_up(block, px, py, pz, radius_sq, sums):
    """Fill the `sums` over what lies within a radius of a place: number, offsets from it, their products."""
    width = lanes.WIDTH
    one, zero = np.float32(1.0), np.float32(0.0)
    for k in range(_SUMS * width):
        sums[k] = zero
    for start in range(0, len(block), _ROWS * width):
        own = block[start: start + _ROWS * width]
        for k in range(width):
            x, y, z = own[k] - px, own[width + k] - py, own[2 * width + k] - pz
            inside = one if x * x + y * y + z * z <= radius_sq else zero
            ix, iy, iz = inside * x, inside * y, inside * z
            sums[k] += inside
            sums[width + k] += ix
            sums[2 * width + k] += iy
            sums[3 * width + k] += iz
            sums[4 * width + k] += ix * x
            sums[5 * width + k] += ix * y
            sums[6 * width + k] += ix * z
            sums[7 * width + k] += iy * y
            sums[8 * width + k] += iy * z
            sums[9 * width + k] += iz * z


@njit()
def _fit(p, sums, values, across, normal):
    """Fill `normal` (3,) at p (3,) from the sums over its neighbours, if it has one; returns their width².

    It is infinite where there is no normal.
    """
    count = lanes.total(sums, 0)
    if count < _MIN_NEIGHBOURS:
        return np.inf
    mx, my, mz = lanes.total(sums, 1) / count, lanes.total(sums, 2) / count, lanes.total(sums, 3) / count
    plane_eigen3(
        lanes.total(sums, 4) / count - mx * mx, lanes.total(sums, 5) / count - mx * my,
        lanes.total(sums, 6) / count - mx * mz, lanes.total(sums, 7) / count - my * my,
        lanes.total(sums, 8) / count - my * mz, lanes.total(sums, 9) / count - mz * mz, values, across)
    if values[1] <= _MIN_SPREAD * values[2]:
        return np.inf
    sign = -1.0 if across[0] * p[0] + across[1] * p[1] + across[2] * p[2] > 0.0 else 1.0
    for k in range(3):
        normal[k] = sign * across[k]
    return values[1]
