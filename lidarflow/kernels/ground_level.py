"""How high the ground is around places: the median of its nearest points, seen from above."""

import math
from typing import NamedTuple

import numba
import numpy as np

from lidarflow.kernels import grid
from lidarflow.kernels import tree as trees
from lidarflow.kernels.compiled import njit

_CHUNK = 512     # places that one thread takes at a time


class Flat(NamedTuple):
    """Ground points seen from above.

    tree     Tree     over the points, every z zero
    heights  (G,)     z of the points in its order
    lowest   (M,)     of each node's heights
    highest  (M,)
    """

    tree: trees.Tree
    heights: np.ndarray
    lowest: np.ndarray
    highest: np.ndarray


def flat(ground: np.ndarray) -> Flat:
    """Ground points (G, 3) seen from above."""
    seen = ground.copy()
    seen[:, 2] = 0.0
    tree = trees.build(seen)
    heights = np.ascontiguousarray(ground[tree.rows, 2])
    return Flat(tree, heights, *_ranges(tree, heights))


def around(
    ground: Flat, places: np.ndarray, neighbours: int, reach_m: float, height_m: float = np.inf
) -> np.ndarray:
    """Median height (K,) of the `neighbours` nearest to each of places (K, 3), whose own z does not count.

    NaN where fewer are nearer than `reach_m`, and where all that are lie more than `height_m` lower, or all
    higher, than the place.
    """
    return _around(*ground, np.ascontiguousarray(places), neighbours, float(reach_m), float(height_m))


def low_per_cell(
    points: np.ndarray, cell_m: float, share: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """How high it is at `share` of the way up each cell (C,), 0 being its lowest point.

    Also returns how many points each has (C,) and the cell (N,) of each of points (N, 3).
    """
    seen = points.copy()
    seen[:, 2] = 0.0
    cell, counts = grid.voxels(seen, cell_m)
    return _at_share(np.ascontiguousarray(points[:, 2]), cell, counts, share), counts, cell


@njit()
def _at_share(heights, cell, counts, share):
    """The height (C,) at `share` of the way up each cell."""
    ends = np.cumsum(counts)
    filled = ends - counts
    sorted_heights, found = np.empty(len(heights)), np.empty(len(counts))
    for i in range(len(heights)):
        sorted_heights[filled[cell[i]]] = heights[i]
        filled[cell[i]] += 1
    for c in range(len(counts)):
        own = sorted_heights[ends[c] - counts[c]:ends[c]]
        own.sort()
        found[c] = own[int(share * (counts[c] - 1))]
    return found


@njit()
def _ranges(tree, heights):
    """Lowest and highest (M,) of the heights (G,) under each node."""
    nodes = len(tree.ends)
    lowest, highest = np.full(nodes, np.inf), np.full(nodes, -np.inf)
    for node in range(nodes - 1, -1, -1):
        if node >= nodes // 2:
            for i in range(tree.starts[node], tree.ends[node]):
                lowest[node], highest[node] = min(lowest[node], heights[i]), max(highest[node], heights[i])
        else:
            left, right = 2 * node + 1, 2 * node + 2
            lowest[node], highest[node] = min(lowest[left], lowest[right]), max(highest[left], highest[right])
    return lowest, highest


@njit(parallel=True)
def _around(tree, heights, lowest, highest, places, neighbours, reach_m, height_m):
    levels = np.full(len(places), np.nan)
    for chunk in numba.prange((len(places) + _CHUNK - 1) // _CHUNK):
        near, near_sq = np.empty(neighbours, np.int64), np.empty(neighbours)
        own = np.empty(neighbours)
        for i in range(chunk * _CHUNK, min((chunk + 1) * _CHUNK, len(places))):
            x, y, z = places[i, 0], places[i, 1], places[i, 2]
            low, high = z - height_m, z + height_m
            if not _reaches(tree, heights, lowest, highest, x, y, reach_m * reach_m, low, high):
                continue
            _nearest(tree, x, y, reach_m * reach_m, near, near_sq)
            if near[-1] < 0:
                continue
            for k in range(neighbours):
                own[k] = heights[near[k]]
            own.sort()
            levels[i] = 0.5 * (own[(neighbours - 1) // 2] + own[neighbours // 2])
    return levels


@njit()
def _reaches(tree, heights, lowest, highest, x, y, reach_sq, low, high):
    """Whether something near x, y is at least `low`, and something at most `high`."""
    leaves = len(tree.ends) // 2
    waiting = np.empty(trees.DEPTH, np.int64)
    waiting[0], depth = 0, 1
    above, below = False, False
    while depth > 0:
        depth -= 1
        node = waiting[depth]
        adds = (not above and highest[node] >= low) or (not below and lowest[node] <= high)
        if not adds or trees.box_distance_sq(tree.boxes, node, x, y, 0.0) >= reach_sq:
            continue
        if node < leaves:
            waiting[depth], waiting[depth + 1] = 2 * node + 1, 2 * node + 2
            depth += 2
            continue
        for i in range(tree.starts[node], tree.ends[node]):
            if trees.distance_sq(tree.points, i, x, y, 0.0) < reach_sq:
                above = above or heights[i] >= low
                below = below or heights[i] <= high
        if above and below:
            return True
    return False


@njit()
def _nearest(tree, x, y, reach_sq, near, near_sq):
    """Fill places and squared distances of the nearest, ascending; the places of missing ones are -1."""
    near[:], near_sq[:] = -1, reach_sq
    waiting, waiting_sq = np.empty(trees.DEPTH, np.int64), np.empty(trees.DEPTH)
    waiting[0], waiting_sq[0], depth = 0, trees.box_distance_sq(tree.boxes, 0, x, y, 0.0), 1
    while depth > 0:
        node, node_sq, depth = trees.descend(tree, x, y, 0.0, near_sq[-1], waiting, waiting_sq, depth)
        if node_sq >= near_sq[-1]:
            continue
        for i in range(tree.starts[node], tree.ends[node]):
            apart_sq = trees.distance_sq(tree.points, i, x, y, 0.0)
            if apart_sq >= near_sq[-1] or math.isnan(apart_sq):
                continue
            k = len(near) - 1
            while k > 0 and near_sq[k - 1] > apart_sq:
                near[k], near_sq[k] = near[k - 1], near_sq[k - 1]
                k -= 1
            near[k], near_sq[k] = i, apart_sq
