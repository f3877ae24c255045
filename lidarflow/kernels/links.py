"""Single linkage of points, by union and find."""

import numba
import numpy as np

from lidarflow.kernels import grid
from lidarflow.kernels import tree as trees

_CELLS_PER_LINK = 3


def components(points: np.ndarray, link_m: float) -> np.ndarray:
    """Label (N,) of each point (N, 3): points that steps of at most about `link_m` lead between share one.

    Points are first gathered in cells of a third of that distance, whose means are then linked. Labels count
    from 0 in the order of the components' lowest cells.
    """
    if len(points) == 0:
        return np.empty(0, np.int64)
    cell_m = link_m / _CELLS_PER_LINK
    member, counts = grid.voxels(points, cell_m)
    means, first = _means(np.ascontiguousarray(points), member, counts)
    cells = np.floor(points[first] / cell_m).astype(np.int64)
    order = np.lexsort(cells.T[::-1])
    return _linked(means[order], trees.build(means[order]), float(link_m))[np.argsort(order)][member]


@numba.njit(cache=True)
def _means(points, member, counts):
    """Mean (V, 3) of each cell, and the first point (V,) in it."""
    means, first = np.zeros((len(counts), 3)), np.full(len(counts), -1)
    for i in range(len(points)):
        means[member[i]] += points[i]
        if first[member[i]] < 0:
            first[member[i]] = i
    for cell in range(len(counts)):
        means[cell] /= counts[cell]
    return means, first


@numba.njit(cache=True)
def _linked(points, tree, link_m):
    """Labels (N,) of the components, in the order of their first points."""
    parent = np.arange(len(points))
    found = np.empty(len(points), np.int64)
    for i in range(len(points)):
        count = trees.all_within(tree, points[i, 0], points[i, 1], points[i, 2], link_m * link_m, found)
        for k in range(count):
            a, b = _root(parent, i), _root(parent, tree.rows[found[k]])
            parent[max(a, b)] = min(a, b)
    label, count = np.empty(len(points), np.int64), 0
    for i in range(len(points)):
        root = _root(parent, i)
        if root == i:
            label[i] = count
            count += 1
        else:
            label[i] = label[root]
    return label


@numba.njit(cache=True)
def _root(parent, i):
    """The lowest member known of i's component; the way there is halved for the next time."""
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i
