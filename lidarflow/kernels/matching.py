"""Best and second-best descriptors among the candidates inside a gate."""

from typing import NamedTuple

import numba
import numpy as np

from lidarflow.kernels import grid, queue
from lidarflow.kernels.compiled import njit

_PLACES = 4     # of queries that are looked at together, along each side of a gate


class Described(NamedTuple):
    """Points (K, 3), metres, and the row (K,) of a table (T, D) float32 that has each one's descriptor."""

    points: np.ndarray
    row: np.ndarray
    table: np.ndarray

    @classmethod
    def whole(cls, points: np.ndarray, table: np.ndarray) -> "Described":
        """Points (K, 3) with descriptors (K, D) in the same order."""
        return cls(points, np.arange(len(points)), table)

    def part(self, kept: np.ndarray) -> "Described":
        """Some of them (P,)."""
        return Described(self.points[kept], self.row[kept], self.table)


def best_in_gate(
    queries: Described, candidates: Described, gate_m: float, rival_radius_m: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """For every query, the most similar candidate within the gate around it and its best rival elsewhere.

    Returns best (Q,) int64, -1 for an empty gate, and squared descriptor distances (Q,) of the best and of
    the best candidate farther than `rival_radius_m` from it (inf without one).
    """
    order, keys, lower, shape = grid.build(candidates.points, gate_m)
    # Two queries of one place share their candidates: what is read for one serves the other.
    by_place, *_ = grid.build(queries.points, gate_m / _PLACES)
    best, best_sq, rival_sq = _best_in_gate(
        queries, by_place, candidates.part(order), keys, lower, shape, gate_m, rival_radius_m)
    found = best >= 0
    best[found] = order[best[found]]
    return best, best_sq, rival_sq


@njit(fastmath=True)
def _products(a, b, c, d):
    """Inner products of a with c and d, and of b with c and d; each number is read half as often."""
    a_c, a_d, b_c, b_d = np.float32(0.0), np.float32(0.0), np.float32(0.0), np.float32(0.0)
    for k in range(len(a)):
        of_a, of_b, of_c, of_d = a[k], b[k], c[k], d[k]
        a_c += of_a * of_c
        a_d += of_a * of_d
        b_c += of_b * of_c
        b_d += of_b * of_d
    return a_c, a_d, b_c, b_d


@njit(parallel=True)
def _best_in_gate(queries, by_place, candidates, keys, lower, shape, gate_m, rival_radius_m):
    n, centres = len(queries.points), queries.points
    best = np.full(n, -1, np.int64)
    best_sq, rival_sq = np.full(n, np.inf), np.full(n, np.inf)
    waiting = queue.tasks()
    for _ in numba.prange(queue.PLACES):
        couple = queue.take(waiting)
        while couple < (n + 1) // 2:
            a, b = by_place[2 * couple], by_place[min(2 * couple + 1, n - 1)]
            near, inside = _near_either(centres[a], centres[b], candidates.points, keys, lower, shape, gate_m)
            products = np.empty((2, len(near)), np.float32)
            for k in range(0, len(near), 2):
                last = min(k + 1, len(near) - 1)
                products[0, k], products[0, last], products[1, k], products[1, last] = _products(
                    queries.table[queries.row[a]], queries.table[queries.row[b]],
                    candidates.table[candidates.row[near[k]]], candidates.table[candidates.row[near[last]]])
            for slot in range(2):
                i = b if slot else a
                best[i], best_sq[i], rival_sq[i] = _best_and_rival(
                    candidates.points, near, inside[slot], products[slot], rival_radius_m)
            couple = queue.take(waiting)
    return best, best_sq, rival_sq


@njit()
def _near_either(a, b, candidates, keys, lower, shape, gate_m):
    """The candidates (n,) within the gate around a or around b, (3,) each, and which are in whose (2, n)."""
    starts, ends = np.empty(18, np.int64), np.empty(18, np.int64)
    cell_a, cell_b = grid.cell_of(a, lower, gate_m), grid.cell_of(b, lower, gate_m)
    of_a = count = grid.runs_around(cell_a, keys, shape, starts, ends)
    if cell_b != cell_a:
        count += grid.runs_around(cell_b, keys, shape, starts[of_a:], ends[of_a:])
    room = grid.room(starts, ends, count)
    near, inside, found = np.empty(room, np.int64), np.empty((2, room), np.bool_), 0
    gate_sq = gate_m * gate_m
    for run in range(count):
        for j in range(starts[run], ends[run]):
            near_a = _distance_sq(a, candidates[j]) <= gate_sq
            near_b = _distance_sq(b, candidates[j]) <= gate_sq
            by_b = run >= of_a or cell_a == cell_b  # these runs are those of b
            if (near_a and run < of_a) or (near_b and by_b and not near_a):
                near[found], inside[0, found], inside[1, found] = j, near_a, near_b
                found += 1
    return near[:found], inside[:, :found]


@njit()
def _best_and_rival(candidates, near, inside, products, rival_radius_m):
    """The best of the candidates `inside`, -1 for none, and the squared distances of it and of its rival."""
    best, best_sq, rival_sq = -1, np.inf, np.inf
    distance_sq = np.full(len(near), np.inf)
    for k in range(len(near)):
        if inside[k]:
            distance_sq[k] = max(0.0, 2.0 - 2.0 * products[k])
            if distance_sq[k] < best_sq:
                best_sq, best = distance_sq[k], near[k]
    for k in range(len(near)):
        if distance_sq[k] < rival_sq and (
                _distance_sq(candidates[near[k]], candidates[best]) > rival_radius_m * rival_radius_m):
            rival_sq = distance_sq[k]
    return best, best_sq, rival_sq


@njit(inline="always")
def _distance_sq(a, b):
    return (a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2
