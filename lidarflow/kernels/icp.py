"""Iterated closest points for small groups that turn about the vertical and shift: one loop per group.

A motion is a turn in radians about the vertical through the group's centre, then a shift (3,) in metres.
"""

import math
from typing import NamedTuple

import numba
import numpy as np
from numba.extending import register_jitable

from lidarflow.kernels import queue
from lidarflow.kernels import tree as trees
from lidarflow.kernels.compiled import njit
from lidarflow.kernels.linalg import solve_positive4
from lidarflow.kernels.misfit import agree

MAX_TURN_RAD = 0.15
MIN_TURNING_POINTS = 16      # fewer points do not fix a turn
MIN_POINTS = 4
_SETTLED = 1e-4              # a round that changes less, in metres and radians, ends its gate
_ROUNDING_M = 1e-9           # distances are taken as equal up to this
_BEYOND_GATE = 1.5           # nearest points are searched for this much farther than the gate
_REGULARISATION = 1e-6       # share of all weight that directions nothing holds are held back by


class Nearest(NamedTuple):
    """Which place of a target each of N points is nearest to, kept from one round to the next by `follow`.

    place    (N,) int64       nearest when the point was at `asked`, -1 = none
    asked    (N, 3) float64
    clear_m  (N,) float64     nothing else was as near as this
    """

    place: np.ndarray
    asked: np.ndarray
    clear_m: np.ndarray


@register_jitable
def nothing_known(count):
    """Nearest places of so many points before any is searched for."""
    return Nearest(np.full(count, -1), np.zeros((count, 3)), np.full(count, -np.inf))


@njit(inline="always")
def forget(nearest, i):
    """Let point i be searched for when it is next asked for."""
    nearest.place[i], nearest.clear_m[i] = -1, -np.inf


def onto_points(points, bounds, group, translations, target, gates_m, rounds_per_gate):
    """Motions (H, 4, 4) of groups of points onto the points of a tree, from `translations` (H, 3).

    Start h moves group[h], the points (N, 3) from bounds[group[h]] up to bounds[group[h] + 1].
    """
    motions = np.empty((len(group), 4, 4))
    largest_first = np.argsort(-np.diff(bounds)[group], kind="stable")
    _onto_points_each(points, bounds, group, translations, target, gates_m, rounds_per_gate, largest_first,
                      queue.tasks(), numba.get_num_threads(), motions)
    return motions


@njit(parallel=True)
def _onto_points_each(
    points, bounds, group, translations, target, gates_m, rounds_per_gate, order, waiting, threads, motions
):
    """Each thread takes the next start when it is done with one: they differ in size."""
    for _ in numba.prange(threads):
        task = queue.take(waiting)
        while task < len(order):
            h = order[task]
            own = points[bounds[group[h]]: bounds[group[h] + 1]]
            _onto_points(own, target, translations[h], gates_m, rounds_per_gate, motions[h])
            task = queue.take(waiting)


@njit()
def _onto_points(points, target, translation, gates_m, rounds_per_gate, motion):
    centre = mean(points)
    count = len(points)
    turn, shift = 0.0, translation.copy()
    nearest = nothing_known(count)
    for gate_m in gates_m:
        for _ in range(rounds_per_gate):
            cosine, sine = math.cos(turn), math.sin(turn)
            paired, a, b = 0, np.zeros(3), np.zeros(3)
            crossed, along = 0.0, 0.0
            for i in range(count):
                ax, ay, az = points[i, 0] - centre[0], points[i, 1] - centre[1], points[i, 2] - centre[2]
                x = cosine * ax - sine * ay + centre[0] + shift[0]
                y = sine * ax + cosine * ay + centre[1] + shift[1]
                z = az + centre[2] + shift[2]
                near, _ = follow(target, x, y, z, gate_m, i, nearest)
                if near < 0:
                    continue
                at = target.points[near]
                bx, by = at[0] - centre[0], at[1] - centre[1]
                paired += 1
                a[0], a[1], a[2] = a[0] + ax, a[1] + ay, a[2] + az
                b[0], b[1], b[2] = b[0] + bx, b[1] + by, b[2] + at[2] - centre[2]
                crossed += ax * by - ay * bx
                along += ax * bx + ay * by
            if paired < MIN_POINTS:
                break
            for k in range(3):
                a[k] /= paired
                b[k] /= paired
            last_turn, turn = turn, 0.0
            if paired >= MIN_TURNING_POINTS:
                crossed -= paired * (a[0] * b[1] - a[1] * b[0])
                along -= paired * (a[0] * b[0] + a[1] * b[1])
                turn = min(max(math.atan2(crossed, along), -MAX_TURN_RAD), MAX_TURN_RAD)
            cosine, sine = math.cos(turn), math.sin(turn)
            changed = abs(turn - last_turn)
            for k, turned in enumerate((cosine * a[0] - sine * a[1], sine * a[0] + cosine * a[1], a[2])):
                changed = max(changed, abs(b[k] - turned - shift[k]))
                shift[k] = b[k] - turned
            if changed < _SETTLED:
                break
    _about(centre, turn, shift, motion)


@njit()
def onto_planes(
    points, normals, target, target_normals, turn, shift, gates_m, up, along_ground, plane_scale_m,
    point_scale_m, point_weight, min_agreement,
):
    """Motion (4, 4) of points (N, 3) with normals (N, 3) onto a surface, from a turn and a shift (3,).

    Each round is one Gauss-Newton step of Σ ρ(n · off) + w Σ ρ(off) + h (up · shift)² over pairs no farther
    apart than the round's gate; n is the plane where normals agree, ρ of Geman and McClure, `up` (3,) the
    ground's normal, and h `along_ground` times the weight of all pairs.
    """
    centre = mean(points)
    shift = shift.copy()
    nearest = nothing_known(len(points))
    for gate_m in gates_m:
        matrix, right = np.zeros((4, 4)), np.zeros(4)
        total, count = _add_pairs(
            points, normals, target, target_normals, centre, turn, shift, gate_m, plane_scale_m,
            point_scale_m, point_weight, min_agreement, nearest, matrix, right)
        if count < MIN_POINTS:
            break
        held = along_ground * total
        rise = up[0] * shift[0] + up[1] * shift[1] + up[2] * shift[2]
        for a in range(3):
            right[1 + a] -= held * rise * up[a]
            for b in range(a + 1):
                matrix[1 + a, 1 + b] += held * up[a] * up[b]
        if count < MIN_TURNING_POINTS:
            matrix[1, 0] = matrix[2, 0] = matrix[3, 0] = right[0] = 0.0
            matrix[0, 0] = 1.0
        for a in range(4):
            matrix[a, a] += _REGULARISATION * max(total, 1.0)
        solve_positive4(matrix, right)
        turn = min(max(turn + right[0], -MAX_TURN_RAD), MAX_TURN_RAD)
        changed = abs(right[0])
        for k in range(3):
            shift[k] += right[1 + k]
            changed = max(changed, abs(right[1 + k]))
        if gate_m == gates_m[-1] and changed < _SETTLED:
            break
    motion = np.empty((4, 4))
    _about(centre, turn, shift, motion)
    return motion


@njit()
def _add_pairs(
    points, normals, target, target_normals, centre, turn, shift, gate_m, plane_scale_m, point_scale_m,
    point_weight, min_agreement, nearest, matrix, right,
):
    """Add the pairs' share to the lower triangle of the normal equations; returns weight and number."""
    cosine, sine = math.cos(turn), math.sin(turn)
    total, count = 0.0, 0
    for i in range(len(points)):
        dx, dy, dz = points[i, 0] - centre[0], points[i, 1] - centre[1], points[i, 2] - centre[2]
        tx, ty = cosine * dx - sine * dy, sine * dx + cosine * dy
        x, y, z = tx + centre[0] + shift[0], ty + centre[1] + shift[1], dz + centre[2] + shift[2]
        near, apart_sq = follow(target, x, y, z, gate_m, i, nearest)
        if near < 0:
            continue
        count += 1
        at = target.points[near]
        ox, oy, oz = at[0] - x, at[1] - y, at[2] - z
        ratio = apart_sq / (point_scale_m * point_scale_m)
        weight = point_weight / ((1.0 + ratio) * (1.0 + ratio))
        total += weight
        # The rows of the three axes: [-ty 1 0 0], [tx 0 1 0], [0 0 0 1].
        matrix[0, 0] += weight * (tx * tx + ty * ty)
        matrix[1, 0] -= weight * ty
        matrix[2, 0] += weight * tx
        for a in range(1, 4):
            matrix[a, a] += weight
        right[0] += weight * (tx * oy - ty * ox)
        right[1] += weight * ox
        right[2] += weight * oy
        right[3] += weight * oz

        plane = target_normals[target.rows[near]]
        nx, ny = cosine * normals[i, 0] - sine * normals[i, 1], sine * normals[i, 0] + cosine * normals[i, 1]
        if not agree(plane, nx, ny, normals[i, 2], min_agreement):
            continue
        off_plane = plane[0] * ox + plane[1] * oy + plane[2] * oz
        ratio = off_plane * off_plane / (plane_scale_m * plane_scale_m)
        weight = 1.0 / ((1.0 + ratio) * (1.0 + ratio))
        total += weight
        by_turn = plane[1] * tx - plane[0] * ty
        matrix[0, 0] += weight * by_turn * by_turn
        right[0] += weight * off_plane * by_turn
        for a in range(3):
            matrix[1 + a, 0] += weight * plane[a] * by_turn
            right[1 + a] += weight * off_plane * plane[a]
            for b in range(a + 1):
                matrix[1 + a, 1 + b] += weight * plane[a] * plane[b]
    return total, count


@njit(inline="always")
def follow(target, x, y, z, gate_m, i, nearest):
    """Nearest place to x, y, z within the gate, -1 without one, and its squared distance, for point i.

    While a point has moved by less than what sets the nearest apart from all others, none is searched for.
    """
    left_m = math.sqrt(trees.distance_sq(nearest.asked, i, x, y, z))
    apart_sq = np.inf
    if nearest.place[i] >= 0:
        apart_sq = trees.distance_sq(target.points, nearest.place[i], x, y, z)
    if min(math.sqrt(apart_sq), gate_m) >= nearest.clear_m[i] - left_m - _ROUNDING_M:
        apart_sq = _search(target, x, y, z, gate_m, i, nearest)
    return (nearest.place[i] if apart_sq < gate_m * gate_m else -1), apart_sq


@njit()
def _search(target, x, y, z, gate_m, i, nearest):
    """Squared distance to the nearest place, which is noted for point i."""
    # Beyond the gate as well: what is known to be empty there need not be searched again after every step.
    reach_m = _BEYOND_GATE * gate_m
    nearest.place[i], apart_sq, second_sq = trees.nearest_two(target, x, y, z, reach_m * reach_m)
    nearest.clear_m[i] = math.sqrt(second_sq)
    nearest.asked[i, 0], nearest.asked[i, 1], nearest.asked[i, 2] = x, y, z
    return apart_sq


@njit()
def mean(points):
    """The mean (3,) of points (N, 3)."""
    mean = np.zeros(3)
    for i in range(len(points)):
        for k in range(3):
            mean[k] += points[i, k]
    for k in range(3):
        mean[k] /= len(points)
    return mean


@njit()
def _about(centre, turn, shift, motion):
    """Fill `motion` (4, 4) with the turn about the vertical through `centre` and the shift that follows."""
    cosine, sine = math.cos(turn), math.sin(turn)
    for i in range(4):
        for j in range(4):
            motion[i, j] = 1.0 if i == j else 0.0
    motion[0, 0], motion[0, 1], motion[1, 0], motion[1, 1] = cosine, -sine, sine, cosine
    motion[0, 3] = centre[0] + shift[0] - (cosine * centre[0] - sine * centre[1])
    motion[1, 3] = centre[1] + shift[1] - (sine * centre[0] + cosine * centre[1])
    motion[2, 3] = shift[2]
