"""Single linkage of points, by union and find."""

import math

import numpy as np

from lidarflow.kernels import tree as trees
from lidarflow.kernels.cells import numbered
from lidarflow.kernels.compiled import njit
from lidarflow.kernels.union_find import join, labels

_CELLS_PER_LINK = 3


def components(points: np.ndarray, link_m: float) -> np.ndarray:
    """Label (N,) of each point (N, 3): points that steps of at most about `link_m` lead between share one.

    Points are first gathered in cells of a third of that distance, whose means are then linked. Labels count
    from 0 in the order of the components' lowest cells.
    """
    return joined(np.ascontiguousarray(points), float(link_m))


@njit()
def joined(points, link_m):
    """As `components`, for other kernels."""
    member, means, place = _cells(points, link_m / _CELLS_PER_LINK)
    label = _linked(means, trees.grown(means), link_m)
    of_point = np.empty(len(points), np.int64)
    for i in range(len(points)):
        of_point[i] = label[place[member[i]]]
    return of_point


@njit()
def _cells(points, cell_m):
    """Cell (N,) of each point, means (V, 3) of cells from the lowest on, and the place (V,) of each there."""
    member, counts = numbered(points, cell_m)
    count = len(counts)
    sums, cells = np.zeros((count, 3)), np.empty((count, 3), np.int64)
    for i in range(len(points)):
        for k in range(3):
            sums[member[i], k] += points[i, k]
            cells[member[i], k] = math.floor(points[i, k] / cell_m)
    keys = np.zeros(count, np.int64)
    for k in range(3):
        lowest, highest = _least_and_most(cells[:, k])
        for cell in range(count):
            keys[cell] = keys[cell] * (highest - lowest + 1) + cells[cell, k] - lowest
    means, place = np.empty((count, 3)), np.empty(count, np.int64)
    order = np.argsort(keys)
    for rank in range(count):
        for k in range(3):
            means[rank, k] = sums[order[rank], k] / counts[order[rank]]
        place[order[rank]] = rank
    return member, means, place


@njit()
def _least_and_most(values):
    least = most = 0
    for i in range(len(values)):
        least, most = (values[i], values[i]) if i == 0 else (min(least, values[i]), max(most, values[i]))
    return least, most


@njit()
def _linked(points, tree, link_m):
    """Labels (N,) of the components, in the order of their first points."""
    parent = np.arange(len(points))
    found = np.empty(len(points), np.int64)
    for i in range(len(points)):
        count = trees.all_within(tree, points[i, 0], points[i, 1], points[i, 2], link_m * link_m, found)
        for k in range(count):
            join(parent, i, tree.rows[found[k]])
    return labels(parent)
