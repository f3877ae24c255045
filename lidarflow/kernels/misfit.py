"""How far points are from a surface: from its nearest points, and from the planes through them."""

import math

import numba
import numpy as np

from lidarflow.kernels import queue
from lidarflow.kernels import tree as trees
from lidarflow.kernels.compiled import njit
from lidarflow.kernels.linalg import moved, turned
from lidarflow.kernels.tree import Tree


def counterparts(
    points: np.ndarray, normals: np.ndarray, target: Tree, target_normals: np.ndarray, reach_m: float,
    min_agreement: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The nearest of a surface to points (N, 3) with normals (N, 3), of those within `reach_m`.

    Returns rows (N,), distances (N,), whether normals agree (N,), and offsets (N,). `target_normals` are
    aligned with the rows of `target`. Normals agree whose |cosine| is over `min_agreement`. Offsets tell how
    far along its normal the plane lies from the point, NaN where normals do not agree. Row -1 and an infinite
    distance where nothing is near.
    """
    found = (np.full(len(points), -1), np.full(len(points), np.inf), np.zeros(len(points), bool),
             np.full(len(points), np.nan))
    kernel = _counterparts_in_chunks if len(points) > trees.CHUNK else _counterparts
    kernel(np.ascontiguousarray(points), np.ascontiguousarray(normals), target, target_normals,
           float(reach_m), min_agreement, *found)
    return found


@njit(parallel=True)
def _counterparts_in_chunks(points, normals, target, target_normals, reach_m, min_agreement, row, distance_m,
                            agrees, offset_m):
    waiting = queue.tasks()
    for _ in numba.prange(queue.PLACES):
        chunk = queue.take(waiting)
        while chunk < (len(points) + trees.CHUNK - 1) // trees.CHUNK:
            start, end = chunk * trees.CHUNK, (chunk + 1) * trees.CHUNK
            _counterparts(
                points[start:end], normals[start:end], target, target_normals, reach_m, min_agreement,
                row[start:end], distance_m[start:end], agrees[start:end], offset_m[start:end])
            chunk = queue.take(waiting)


@njit()
def _counterparts(points, normals, target, target_normals, reach_m, min_agreement, row, distance_m, agrees,
                  offset_m):
    for i in range(len(points)):
        place, apart_sq = trees.nearest(
            target, points[i, 0], points[i, 1], points[i, 2], reach_m * reach_m, -1)
        if place < 0:
            continue
        row[i], distance_m[i] = target.rows[place], math.sqrt(apart_sq)
        plane = target_normals[row[i]]
        if agree(plane, normals[i, 0], normals[i, 1], normals[i, 2], min_agreement):
            agrees[i] = True
            offset_m[i] = (plane[0] * (target.points[place, 0] - points[i, 0])
                           + plane[1] * (target.points[place, 1] - points[i, 1])
                           + plane[2] * (target.points[place, 2] - points[i, 2]))


@njit(inline="always")
def agree(normal, x, y, z, min_agreement):
    """Whether a normal (3,) and x, y, z of unit length lie along nearly one line; NaN agrees with none."""
    return abs(normal[0] * x + normal[1] * y + normal[2] * z) > min_agreement


@njit()
def after(points, normals, rows, motion, target, target_normals, beside, cap_m, min_agreement,
          distance_m, plane_m):
    """Fill distances (K,) and plane distances (K,) of the `rows` (K,) of a cloud after a motion (4, 4).

    Both are at most `cap_m`. Distances are to the nearest of `target` and `beside`; plane distances are to
    the plane of the nearest of `target` within twice the cap where normals agree, and never more.
    """
    for k in range(len(rows)):
        x, y, z = moved(points[rows[k]], motion)
        place, apart_sq = trees.nearest(target, x, y, z, 4.0 * cap_m * cap_m, -1)
        _, nearest_sq = trees.nearest(beside, x, y, z, min(apart_sq, cap_m * cap_m), -1)
        distance_m[k] = math.sqrt(nearest_sq)
        plane_m[k] = min(distance_m[k], plane_distance(
            x, y, z, place, normals[rows[k]], motion, target, target_normals, min_agreement))


@njit()
def plane_distance(x, y, z, place, normal, motion, target, target_normals, min_agreement):
    """How far x, y, z is from the plane at a place of the target; infinite without one, or if normals differ.

    The normal (3,) is that of the point before a motion (4, 4) took it there.
    """
    if place < 0:
        return math.inf
    plane, at = target_normals[target.rows[place]], target.points[place]
    nx, ny, nz = turned(normal, motion)
    if not agree(plane, nx, ny, nz, min_agreement):
        return math.inf
    return abs(plane[0] * (at[0] - x) + plane[1] * (at[1] - y) + plane[2] * (at[2] - z))


def mean_sq_after(points, normals, rows, bounds, group, motions, target, target_normals, beside, cap_m,
                  min_agreement, distance_weight):
    """Mean (H,) of plane² + weight · distance² after each of motions (H, 4, 4), which moves group[h].

    Groups are rows[bounds[g]: bounds[g + 1]] of points (N, 3) with normals (N, 3).
    """
    mean_sq = np.empty(len(group))
    _mean_sq_each(points, normals, rows, bounds, group, motions, target, target_normals, beside, cap_m,
                  min_agreement, distance_weight, queue.tasks(), numba.get_num_threads(), mean_sq)
    return mean_sq


@njit(parallel=True)
def _mean_sq_each(points, normals, rows, bounds, group, motions, target, target_normals, beside, cap_m,
                  min_agreement, distance_weight, waiting, threads, mean_sq):
    """Each thread takes the next motion when it is done with one."""
    for _ in numba.prange(threads):
        h = queue.take(waiting)
        while h < len(group):
            own = rows[bounds[group[h]]: bounds[group[h] + 1]]
            distance_m, plane_m = np.empty(len(own)), np.empty(len(own))
            after(points, normals, own, motions[h], target, target_normals, beside, cap_m, min_agreement,
                  distance_m, plane_m)
            total = 0.0
            for k in range(len(own)):
                total += plane_m[k] * plane_m[k] + distance_weight * distance_m[k] * distance_m[k]
            mean_sq[h] = total / len(own)
            h = queue.take(waiting)
