"""How high the ground is around places: the median of its nearest points, seen from above."""

import math

import numba
import numpy as np

from lidarflow.kernels import tree as trees
from lidarflow.kernels.compiled import njit

_CHUNK = 512     # places that one thread takes at a time


def flat_tree(ground: np.ndarray) -> tuple[trees.Tree, np.ndarray]:
    """A tree over ground points (G, 3) seen from above, and their heights (G,) in its order."""
    flat = ground.copy()
    flat[:, 2] = 0.0
    grown = trees.build(flat)
    return grown, np.ascontiguousarray(ground[grown.rows, 2])


def around(
    tree: trees.Tree, heights: np.ndarray, places: np.ndarray, neighbours: int, reach_m: float
) -> np.ndarray:
    """Median height (K,) of the `neighbours` nearest to each of places (K, 3), whose own z does not count.

    `tree` and `heights` are of `flat_tree`. NaN where fewer are nearer than `reach_m`.
    """
    return _around(tree, heights, np.ascontiguousarray(places), neighbours, float(reach_m))


@njit(parallel=True)
def _around(tree, heights, places, neighbours, reach_m):
    levels = np.full(len(places), np.nan)
    for chunk in numba.prange((len(places) + _CHUNK - 1) // _CHUNK):
        near, near_sq = np.empty(neighbours, np.int64), np.empty(neighbours)
        own = np.empty(neighbours)
        for i in range(chunk * _CHUNK, min((chunk + 1) * _CHUNK, len(places))):
            _nearest(tree, places[i, 0], places[i, 1], reach_m * reach_m, near, near_sq)
            if near[-1] < 0:
                continue
            for k in range(neighbours):
                own[k] = heights[near[k]]
            own.sort()
            levels[i] = 0.5 * (own[(neighbours - 1) // 2] + own[neighbours // 2])
    return levels


@njit()
def _nearest(tree, x, y, reach_sq, near, near_sq):
    """Fill places and squared distances of the nearest, ascending; the places of missing ones are -1."""
    near[:], near_sq[:] = -1, reach_sq
    leaves = len(tree.ends) // 2
    waiting = np.empty(trees.DEPTH, np.int64)
    waiting[0], depth = 0, 1
    while depth > 0:
        depth -= 1
        node = waiting[depth]
        if trees.box_distance_sq(tree, node, x, y, 0.0) >= near_sq[-1]:
            continue
        while node < leaves:
            left, right = 2 * node + 1, 2 * node + 2
            if trees.box_distance_sq(tree, left, x, y, 0.0) > trees.box_distance_sq(tree, right, x, y, 0.0):
                left, right = right, left
            waiting[depth] = right
            depth += 1
            node = left
        for i in range(tree.starts[node], tree.ends[node]):
            apart_sq = trees.distance_sq(tree.points, i, x, y, 0.0)
            if apart_sq >= near_sq[-1] or math.isnan(apart_sq):
                continue
            k = len(near) - 1
            while k > 0 and near_sq[k - 1] > apart_sq:
                near[k], near_sq[k] = near[k - 1], near_sq[k - 1]
                k -= 1
            near[k], near_sq[k] = i, apart_sq
