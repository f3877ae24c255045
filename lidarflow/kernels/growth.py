"""Moving bodies grown from seeds, each by itself, so that all can grow at once."""

import math
from typing import NamedTuple

import numba
import numpy as np

from lidarflow.kernels import grid, ground_plane, icp, links, misfit, neighbours, queue
from lidarflow.kernels import tree as trees
from lidarflow.kernels.compiled import njit
from lidarflow.kernels.linalg import moved

ASKED, TAKEN = 1, 2   # what growth did with a row; 0 for those it never came near


class Points(NamedTuple):
    """Points that bodies grow over.

    points          (N, 3) float64
    normals         (N, 3) float64   NaN where unknown
    tolerance_m     (N,) float64     how far they may be from the target and still be explained
    by_ego_m        (N,) float64     how far they are from it, at most the cap, without moving,
    by_ego_plane_m  (N,) float64     and from its planes
    """

    points: np.ndarray
    normals: np.ndarray
    tolerance_m: np.ndarray
    by_ego_m: np.ndarray
    by_ego_plane_m: np.ndarray


class Limits(NamedTuple):
    """How bodies grow; metres.

    first_reach_m, reach_m, rounds   how far from its seeds, then from itself, a body looks, and how often
    min_points, link_m               a body hangs together at this distance, and has so many points
    clearly_better_m, as_good_m      differences between distances that count, and that do not
    cap_m, min_agreement             of distances, as in misfit.after
    least_shift_m                    what its motion shifts less along the ground is given up,
    most_left                        and what it leaves more of the squared misfit to planes, as a share
    """

    first_reach_m: float
    reach_m: float
    rounds: int
    min_points: int
    link_m: float
    clearly_better_m: float
    as_good_m: float
    cap_m: float
    min_agreement: float
    least_shift_m: float
    most_left: float


class Fit(NamedTuple):
    """How motions are fitted to planes: as in icp.onto_planes, after thinning to voxels and along the ground.

    voxel_m, voxel_points                        more points than these are thinned to such voxels
    slope_radius_m, min_slope_points, max_slope  where, and of what, the ground's slope is believed
    """

    voxel_m: float
    voxel_points: int
    slope_radius_m: float
    min_slope_points: int
    max_slope: float
    along_ground: float
    plane_scale_m: float
    point_scale_m: float
    point_weight: float


def grow_each(
    seeds, bounds, starts, free, source, own, target, target_normals, ground, limits, fit, gates_m
):
    """What each of H growths did with each row (H, N) uint8, and the motions (H, 4, 4) of the bodies.

    Growth h begins at the rows seeds[bounds[h]: bounds[h + 1]] with the motion starts[h]; only rows that are
    `free` (N,) are taken. One that is given up takes none. `source` is the tree over `own`, the others
    are of the surface that bodies move onto and of its ground.
    """
    did, motions = np.zeros((len(starts), len(own.points)), np.uint8), starts.copy()
    threads = min(numba.get_num_threads(), len(starts))
    _grow_each(seeds, bounds, queue.tasks(), threads, free, source, own, target, target_normals, ground,
               limits, fit, gates_m, did, motions)
    return did, motions


@njit(parallel=True)
def _grow_each(
    seeds, bounds, waiting, threads, free, source, own, target, target_normals, ground, limits, fit, gates_m,
    did, motions
):
    """Each thread takes the next growth when it has done one: they differ in size, and it changes nothing."""
    for _ in numba.prange(threads):
        nearest = icp.nothing_known(len(own.points))
        h = queue.take(waiting)
        while h < len(motions):
            _grow(seeds[bounds[h]: bounds[h + 1]], free, source, own, target, target_normals, ground, limits,
                  fit, gates_m, nearest, did[h], motions[h])
            h = queue.take(waiting)


@njit()
def _grow(
    seed, free, source, own, target, target_normals, ground, limits, fit, gates_m, nearest, did, motion
):
    is_seed = np.zeros(len(did), np.bool_)
    is_seed[seed] = True
    near, rows, reach_m = np.empty(0, np.int64), seed, limits.first_reach_m
    for _ in range(limits.rounds):
        new = _newly_asked(neighbours.rows_near(source, trees.grown(own.points[rows]), reach_m), did, nearest)
        if len(new) == 0:
            break
        near, reach_m = np.sort(np.concatenate((near, new))), limits.reach_m
        rows = _agreeing(near, free, motion, own, target, target_normals, ground, limits, nearest)
        if len(rows) >= limits.min_points:
            rows = _hanging_together(rows, own.points, is_seed, limits.link_m)
        if len(rows) < limits.min_points:
            return
        shift_m = _fit(rows, own, target, target_normals, ground, limits, fit, gates_m, motion)
        if shift_m < limits.least_shift_m or _leaves_too_much(
                rows, motion, own, target, target_normals, ground, limits, nearest):
            return
    did[rows] = TAKEN


@njit()
def _newly_asked(rows, did, nearest):
    """Those of the rows that were not asked before; they are from now on."""
    new, count = np.empty(len(rows), np.int64), 0
    for row in rows:
        if did[row] == 0:
            did[row] = ASKED
            icp.forget(nearest, row)
            new[count] = row
            count += 1
    return new[:count]


@njit()
def _agreeing(near, free, motion, own, target, target_normals, ground, limits, nearest):
    """The free ones of the rows that the motion explains clearly better, or in place and about as well."""
    rows, count = np.empty(len(near), np.int64), 0
    for row in near:
        if not free[row]:
            continue
        x, y, z = moved(own.points[row], motion)
        own_m, plane_m = _misfit(x, y, z, row, motion, own, target, target_normals, limits, nearest)
        agrees = _is_explained(own_m, min(plane_m, own_m), row, own, limits)
        if not agrees:     # near ground speaks for a motion, never against it
            below, ground_sq = trees.nearest(ground, x, y, z, own_m * own_m, -1)
            own_m = math.sqrt(ground_sq)
            agrees = below >= 0 and _is_explained(own_m, min(plane_m, own_m), row, own, limits)
        if agrees:
            rows[count] = row
            count += 1
    return rows[:count]


@njit()
def _misfit(x, y, z, row, motion, own, target, target_normals, limits, nearest):
    """How far a row is from the target, at most the cap, and from its plane, where the motion took it."""
    place, apart_sq = icp.follow(target, x, y, z, 2.0 * limits.cap_m, row, nearest)
    plane_m = misfit.plane_distance(
        x, y, z, place, own.normals[row], motion, target, target_normals, limits.min_agreement)
    return min(math.sqrt(apart_sq), limits.cap_m), plane_m


@njit()
def _is_explained(own_m, plane_m, row, own, limits):
    """Whether a row agrees with a motion that leaves it so far from the target, and from its plane."""
    ego_m, ego_plane_m = own.by_ego_m[row], own.by_ego_plane_m[row]
    better_m, as_good_m = limits.clearly_better_m, limits.as_good_m
    if own_m < ego_m - better_m:     # whatever planes say
        return True
    if own_m > own.tolerance_m[row] or plane_m > ego_plane_m + as_good_m:
        return False
    plane_better = plane_m < ego_plane_m - as_good_m
    return plane_better or (own_m < ego_m + as_good_m and plane_m < ego_plane_m + better_m)


@njit()
def _leaves_too_much(rows, motion, own, target, target_normals, ground, limits, nearest):
    """Whether a motion leaves more than a share of the rows' squared misfit at rest, to planes and ground."""
    left_sq, at_rest_sq = 0.0, 0.0
    for row in rows:
        x, y, z = moved(own.points[row], motion)
        own_m, plane_m = _misfit(x, y, z, row, motion, own, target, target_normals, limits, nearest)
        left_m = min(plane_m, own_m)
        _, nearest_sq = trees.nearest(ground, x, y, z, left_m * left_m, -1)
        left_sq += nearest_sq
        at_rest_sq += own.by_ego_plane_m[row] ** 2
    return left_sq > limits.most_left * at_rest_sq


@njit()
def _hanging_together(rows, points, is_seed, link_m):
    """Those of the rows that steps of `link_m` lead to from a seed among them."""
    label = links.joined(points[rows], link_m)
    holds_seed = np.zeros(len(rows), np.bool_)   # by label
    for i in range(len(rows)):
        if is_seed[rows[i]]:
            holds_seed[label[i]] = True
    return rows[holds_seed[label]]


@njit()
def _fit(rows, own, target, target_normals, ground, limits, fit, gates_m, motion):
    """Bring `motion` (4, 4) to that of the rows onto the target's planes; returns their shift along x, y."""
    points = own.points[rows]
    if len(rows) > fit.voxel_points:
        rows = rows[grid.first_of_each(points, fit.voxel_m)]
        points = own.points[rows]
    centre = icp.mean(points)
    x, y, z = moved(centre, motion)
    shift = np.array([x - centre[0], y - centre[1], z - centre[2]])
    motion[:] = icp.onto_planes(
        points, own.normals[rows], target, target_normals, math.atan2(motion[1, 0], motion[0, 0]), shift,
        gates_m, _ground_normal(ground, centre, fit), fit.along_ground, fit.plane_scale_m, fit.point_scale_m,
        fit.point_weight, limits.min_agreement)
    x, y, _ = moved(centre, motion)
    return math.hypot(x - centre[0], y - centre[1])


@njit()
def _ground_normal(ground, centre, fit):
    """Unit normal (3,) of the ground around `centre` (3,), upright where too little of it is seen."""
    rise_x, rise_y, count = ground_plane.slope(ground, centre, fit.slope_radius_m)
    normal = np.array([-rise_x, -rise_y, 1.0])
    if count < fit.min_slope_points or math.hypot(rise_x, rise_y) > fit.max_slope:
        normal[0] = normal[1] = 0.0
    length = math.sqrt(normal[0] * normal[0] + normal[1] * normal[1] + 1.0)
    for k in range(3):
        normal[k] /= length
    return normal
