"""Normal equations of robust point-to-plane registration."""

import math

import numba
import numpy as np

from lidarflow.kernels import lanes, queue
from lidarflow.kernels.compiled import njit
from lidarflow.kernels.icp import Nearest, follow
from lidarflow.kernels.linalg import moved

_CHUNK = 512     # points that one thread takes at a time; their sums are added in order
_ROWS = 8        # of a block: where a point is, the plane it meets, how far off that is, what the pair weighs
_SUMS = 28       # lower triangle of the matrix, right side, number of pairs


def normal_equations(points, motion, target, target_normals, reach_m, nearest: Nearest):
    """Matrix (6, 6) and right side (6,) of one Gauss-Newton step, and how many points it rests on.

    The step is a twist (rotation first) to be applied after `motion` (4, 4); it lowers Σ ρ(n · (T p − q)) of
    points p (N, 3) whose nearest q in the tree `target` is within `reach_m`. ρ is Tukey's, as wide as the
    reach, n of target_normals (M, 3) in the order of the tree, NaN where there is none. `nearest` is
    kept from round to round.
    """
    sums = _sums(points, motion, target, target_normals, float(reach_m), nearest)
    matrix = np.zeros((6, 6))
    matrix[_LOWER] = sums[:21]
    return matrix + np.tril(matrix, -1).T, sums[21:27], int(sums[27])


_LOWER = np.tril_indices(6)


@njit(parallel=True)
def _sums(points, motion, target, target_normals, reach_m, nearest):
    chunks = (len(points) + _CHUNK - 1) // _CHUNK
    parts = np.zeros((chunks, _SUMS))
    waiting = queue.tasks()
    for _ in numba.prange(queue.PLACES):
        chunk = queue.take(waiting)
        while chunk < chunks:
            start, end = chunk * _CHUNK, min((chunk + 1) * _CHUNK, len(points))
            block = np.zeros(_ROWS * lanes.padded(end - start))     # columns that stay empty weigh nothing
            parts[chunk, -1] = _meet(
                points, start, end, motion, target, target_normals, reach_m, nearest, block)
            _add_up(block, parts[chunk])
            chunk = queue.take(waiting)
    total = np.zeros(_SUMS)
    for chunk in range(chunks):
        total += parts[chunk]
    return total


@njit()
def _meet(points, start, end, motion, target, target_normals, reach_m, nearest, block):
    """Fill a block with the points from `start` to `end` that meet a plane; returns how many do."""
    count, width = 0, lanes.WIDTH
    for i in range(start, end):
        x, y, z = moved(points[i], motion)
        near, _ = follow(target, x, y, z, reach_m, i, nearest)
        if near < 0 or math.isnan(target_normals[near, 0]):
            continue
        nx, ny, nz = target_normals[near, 0], target_normals[near, 1], target_normals[near, 2]
        at = target.points[near]
        off_m = nx * (at[0] - x) + ny * (at[1] - y) + nz * (at[2] - z)
        share = 1.0 - (off_m / reach_m) ** 2
        k = lanes.column(_ROWS, count)
        block[k], block[k + width], block[k + 2 * width] = x, y, z
        block[k + 3 * width], block[k + 4 * width], block[k + 5 * width] = nx, ny, nz
        block[k + 6 * width], block[k + 7 * width] = off_m, share * share
        count += 1
    return count


@njit()
def _add_up(block, total):
    """Add the pairs of a block to the sums (_SUMS,), all but their number."""
    width = lanes.WIDTH
    sums = np.zeros((_SUMS - 1) * width)
    for start in range(0, len(block), _ROWS * width):
        own = block[start: start + _ROWS * width]
        for k in range(width):
            x, y, z = own[k], own[width + k], own[2 * width + k]
            d, e, f = own[3 * width + k], own[4 * width + k], own[5 * width + k]
            off_m, weight = own[6 * width + k], own[7 * width + k]
            a, b, c = y * f - z * e, z * d - x * f, x * e - y * d
            wa, wb, wc, wd, we, wf = weight * a, weight * b, weight * c, weight * d, weight * e, weight * f
            sums[k] += wa * a
            sums[width + k] += wb * a
            sums[2 * width + k] += wb * b
            sums[3 * width + k] += wc * a
            sums[4 * width + k] += wc * b
            sums[5 * width + k] += wc * c
            sums[6 * width + k] += wd * a
            sums[7 * width + k] += wd * b
            sums[8 * width + k] += wd * c
            sums[9 * width + k] += wd * d
            sums[10 * width + k] += we * a
            sums[11 * width + k] += we * b
            sums[12 * width + k] += we * c
            sums[13 * width + k] += we * d
            sums[14 * width + k] += we * e
            sums[15 * width + k] += wf * a
            sums[16 * width + k] += wf * b
            sums[17 * width + k] += wf * c
            sums[18 * width + k] += wf * d
            sums[19 * width + k] += wf * e
            sums[20 * width + k] += wf * f
            sums[21 * width + k] += wa * off_m
            sums[22 * width + k] += wb * off_m
            sums[23 * width + k] += wc * off_m
            sums[24 * width + k] += wd * off_m
            sums[25 * width + k] += we * off_m
            sums[26 * width + k] += wf * off_m
    for row in range(_SUMS - 1):
        total[row] += lanes.total(sums, row)
