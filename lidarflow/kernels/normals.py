"""Surface normals by principal component analysis of a neighbourhood."""

import numba
import numpy as np

from lidarflow.kernels import grid
from lidarflow.kernels.compiled import njit
from lidarflow.kernels.linalg import plane_eigen3

_MIN_NEIGHBOURS = 4
_CHUNK = 256         # points that one thread takes at a time
_MIN_SPREAD = 1e-3   # a neighbourhood thinner than this share of its length is a line, not a surface


def estimate(points: np.ndarray, surface: np.ndarray, radius_m: float) -> np.ndarray:
    """Unit normals (N, 3) at `points` (N, 3), fitted to `surface` (S, 3) within `radius_m`.

    They face the sensor at the origin. NaN where there are too few neighbours or they lie on a line.
    """
    order, keys, lower, shape = grid.build(surface, radius_m)
    return _estimate(points, surface[order], keys, lower, shape, radius_m)


@njit(parallel=True)
def _estimate(points, surface, keys, lower, shape, radius_m):
    normals = np.full((len(points), 3), np.nan)
    for chunk in numba.prange((len(points) + _CHUNK - 1) // _CHUNK):
        start, end = chunk * _CHUNK, (chunk + 1) * _CHUNK
        _estimate_some(points[start:end], surface, keys, lower, shape, radius_m, normals[start:end])
    return normals


@njit()
def _estimate_some(points, surface, keys, lower, shape, radius_m, normals):
    starts, ends = np.empty(9, np.int64), np.empty(9, np.int64)
    values, across = np.empty(3), np.empty(3)
    offsets = np.empty((0, 3))
    last, run_count = (0, 0, 0), 0
    for i in range(len(points)):
        # Points that follow one another are often in one cell.
        cell = grid.cell_of(points[i], lower, radius_m)
        if i == 0 or cell != last:
            last = cell
            run_count = grid.runs_around(cell, keys, shape, starts, ends)
            room = grid.room(starts, ends, run_count) + 1
            if room > len(offsets):
                offsets = np.empty((2 * room, 3))
        count = _gather(points[i], surface, radius_m * radius_m, starts, ends, run_count, offsets)
        if count >= _MIN_NEIGHBOURS:
            _fit(points[i], offsets, count, values, across, normals[i])


@njit()
def _gather(p, surface, radius_sq, starts, ends, run_count, offsets):
    """How many of the surface are within the radius of p (3,); fills their offsets (·, 3) from it."""
    px, py, pz = p[0], p[1], p[2]
    count = 0
    for run in range(run_count):
        for j in range(starts[run], ends[run]):
            x, y, z = surface[j, 0] - px, surface[j, 1] - py, surface[j, 2] - pz
            # Written anyway, and overwritten by the next where it is too far: branches take longer.
            offsets[count, 0], offsets[count, 1], offsets[count, 2] = x, y, z
            count += 1 if x * x + y * y + z * z <= radius_sq else 0
    return count


@njit()
def _fit(p, offsets, count, values, across, normal):
    """Fill `normal` (3,) at p (3,) from the offsets (·, 3) of its neighbours, if it has one."""
    sx = sy = sz = sxx = sxy = sxz = syy = syz = szz = 0.0
    for k in range(count):
        x, y, z = offsets[k, 0], offsets[k, 1], offsets[k, 2]
        sx += x
        sy += y
        sz += z
        sxx += x * x
        sxy += x * y
        sxz += x * z
        syy += y * y
        syz += y * z
        szz += z * z
    mx, my, mz = sx / count, sy / count, sz / count
    plane_eigen3(sxx / count - mx * mx, sxy / count - mx * my, sxz / count - mx * mz,
                 syy / count - my * my, syz / count - my * mz, szz / count - mz * mz, values, across)
    if values[1] <= _MIN_SPREAD * values[2]:
        return
    sign = -1.0 if across[0] * p[0] + across[1] * p[1] + across[2] * p[2] > 0.0 else 1.0
    for k in range(3):
        normal[k] = sign * across[k]
