"""Surface normals by principal component analysis of a neighbourhood."""

import numba
import numpy as np

from lidarflow.kernels import cells, lanes
from lidarflow.kernels.compiled import njit
from lidarflow.kernels.linalg import plane_eigen3

_MIN_NEIGHBOURS = 4
_CHUNK = 64          # cells of points that one thread takes at a time
_MIN_SPREAD = 1e-3   # a neighbourhood thinner than this share of its length is a line, not a surface
_MOST_FACING = 0.15  # cosine to the line of sight: on a narrow piece noise makes what faces the sensor more
_ROWS = 3            # of a block: offsets along x, y, z
_SUMS = 10           # number, offsets, and products of two of them


def estimate(
    points: np.ndarray, surface: np.ndarray, radius_m: float, min_width_m: float = 0.0
) -> np.ndarray:
    """Unit normals (N, 3) at `points` (N, 3), fitted to `surface` (S, 3) within `radius_m`.

    They face the sensor at the origin. NaN where there are too few neighbours or they lie on a line, and
    where they are narrower than `min_width_m`, a standard deviation, and not seen from the side.
    """
    asked, seen = cells.build(points, radius_m), cells.build(surface, radius_m)
    return estimated(np.ascontiguousarray(points), asked, np.ascontiguousarray(surface), seen,
                     float(min_width_m))


@njit(parallel=True)
def estimated(points, asked, surface, seen, min_width_m):
    """As `estimate`, for other kernels: points and surface also by cells of the radius."""
    normals = np.full((len(points), 3), np.nan)
    count = len(asked.place)
    for chunk in numba.prange((count + _CHUNK - 1) // _CHUNK):
        _estimate_some(
            points, asked, surface, seen, chunk * _CHUNK, min((chunk + 1) * _CHUNK, count), min_width_m,
            normals)
    return normals


@njit()
def _estimate_some(points, asked, surface, seen, start, end, min_width_m, normals):
    """Fill the normals (N, 3) of the points in the cells from `start` to `end`."""
    near, corner = np.empty(cells.NEAR, np.int64), np.empty(3)
    values, across = np.empty(3), np.empty(3)
    sums = np.empty(_SUMS * lanes.WIDTH, np.float32)
    for cell in range(start, end):
        block = lanes.gathered_around(surface, seen, asked.place[cell], near, corner)
        for i in asked.order[asked.bounds[cell]: asked.bounds[cell + 1]]:
            _add_up(block, np.float32(points[i, 0] - corner[0]), np.float32(points[i, 1] - corner[1]),
                    np.float32(points[i, 2] - corner[2]), np.float32(seen.cell_m * seen.cell_m), sums)
            _fit(points[i], sums, min_width_m, values, across, normals[i])


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
def _fit(p, sums, min_width_m, values, across, normal):
    """Fill `normal` (3,) at p (3,) from the sums over its neighbours, if it has one."""
    count = lanes.total(sums, 0)
    if count < _MIN_NEIGHBOURS:
        return
    mx, my, mz = lanes.total(sums, 1) / count, lanes.total(sums, 2) / count, lanes.total(sums, 3) / count
    plane_eigen3(
        lanes.total(sums, 4) / count - mx * mx, lanes.total(sums, 5) / count - mx * my,
        lanes.total(sums, 6) / count - mx * mz, lanes.total(sums, 7) / count - my * my,
        lanes.total(sums, 8) / count - my * mz, lanes.total(sums, 9) / count - mz * mz, values, across)
    if values[1] <= _MIN_SPREAD * values[2]:
        return
    facing_m = across[0] * p[0] + across[1] * p[1] + across[2] * p[2]
    range_sq = p[0] * p[0] + p[1] * p[1] + p[2] * p[2]
    is_narrow = values[1] <= min_width_m * min_width_m
    if is_narrow and facing_m * facing_m > _MOST_FACING * _MOST_FACING * range_sq:
        return
    sign = -1.0 if facing_m > 0.0 else 1.0
    for k in range(3):
        normal[k] = sign * across[k]
