"""Best and second-best descriptors among the candidates inside a gate."""

import numba
import numpy as np

from lidarflow.kernels import grid
from lidarflow.kernels.compiled import njit


def best_in_gate(
    centres: np.ndarray, descriptors: np.ndarray, candidates: np.ndarray,
    candidate_descriptors: np.ndarray, gate_m: float, rival_radius_m: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """For every query, the most similar candidate within the gate and its best rival elsewhere.

    centres (Q, 3) of the gates, descriptors (Q, D) float32 of unit norm, candidates (C, 3) and their
    descriptors (C, D). Returns best (Q,) int64, -1 for an empty gate, and squared descriptor distances
    (Q,) of the best and of the best candidate farther than `rival_radius_m` from it (inf without one).
    """
    order, keys, lower, shape = grid.build(candidates, gate_m)
    # Queries of one place share their candidates, which stay at hand when they come one after the other.
    by_place, *_ = grid.build(centres, gate_m)
    best, best_sq, rival_sq = _best_in_gate(
        centres, descriptors, by_place, candidates[order], candidate_descriptors[order], keys, lower, shape,
        gate_m, rival_radius_m)
    found = best >= 0
    best[found] = order[best[found]]
    return best, best_sq, rival_sq


@njit(fastmath=True)
def _dot(a, b):
    total = np.float32(0.0)
    for k in range(len(a)):
        total += a[k] * b[k]
    return total


@njit(parallel=True)
def _best_in_gate(
    centres, descriptors, by_place, candidates, candidate_descriptors, keys, lower, shape, gate_m,
    rival_radius_m
):
    n = len(centres)
    best = np.full(n, -1, np.int64)
    best_sq, rival_sq = np.full(n, np.inf), np.full(n, np.inf)
    for visit in numba.prange(n):
        i = by_place[visit]
        starts, ends = np.empty(9, np.int64), np.empty(9, np.int64)
        run_count = grid.runs(centres[i], keys, lower, shape, gate_m, starts, ends)
        room = grid.room(starts, ends, run_count)
        index, distance_sq = np.empty(room, np.int64), np.empty(room)
        count = 0
        for run in range(run_count):
            for j in range(starts[run], ends[run]):
                if _distance_sq(centres[i], candidates[j]) > gate_m * gate_m:
                    continue
                index[count] = j
                distance_sq[count] = max(0.0, 2.0 - 2.0 * _dot(descriptors[i], candidate_descriptors[j]))
                if distance_sq[count] < best_sq[i]:
                    best_sq[i], best[i] = distance_sq[count], j
                count += 1
        for k in range(count):
            if distance_sq[k] < rival_sq[i]:
                apart_sq = _distance_sq(candidates[index[k]], candidates[best[i]])
                if apart_sq > rival_radius_m * rival_radius_m:
                    rival_sq[i] = distance_sq[k]
    return best, best_sq, rival_sq


@njit()
def _distance_sq(a, b):
    return (a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2
