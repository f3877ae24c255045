"""Undirected graphs as edge lists: unique edges of triangles, connected components."""

import numpy as np

from lidarflow.kernels.compiled import njit
from lidarflow.kernels.union_find import join, labels


def sides(triangles: np.ndarray, count: int) -> np.ndarray:
    """Edges (E, 2) int32, i < j, sorted and unique, of triangles (T, 3) over `count` points."""
    return _sides(np.ascontiguousarray(triangles), count)


def components(joined: np.ndarray, count: int) -> np.ndarray:
    """Component (count,) int32 of points in edges (E, 2) or triangles (E, 3), numbered by first points."""
    return _components(np.ascontiguousarray(joined), count)


@njit()
def _sides(triangles, count):
    first = np.zeros(count + 1, np.int64)    # of the edges of each lower end, later: where the next one goes
    for t in range(len(triangles)):
        for k in range(3):
            first[min(triangles[t, k], triangles[t, (k + 1) % 3]) + 1] += 1
    for i in range(count):
        first[i + 1] += first[i]
    upper, place = np.empty(3 * len(triangles), np.int32), first[:-1].copy()
    for t in range(len(triangles)):
        for k in range(3):
            a, b = triangles[t, k], triangles[t, (k + 1) % 3]
            i, j = min(a, b), max(a, b)
            upper[place[i]] = j
            place[i] += 1
    edges, found = np.empty((len(upper), 2), np.int32), 0
    for i in range(count):
        own = upper[first[i]: first[i + 1]]
        _sort(own)
        for k in range(len(own)):
            if k == 0 or own[k] != own[k - 1]:
                edges[found, 0], edges[found, 1] = i, own[k]
                found += 1
    return edges[:found].copy()


@njit()
def _sort(few):
    """Sort a handful of numbers in place, by insertion."""
    for k in range(1, len(few)):
        number, at = few[k], k
        while at > 0 and few[at - 1] > number:
            few[at] = few[at - 1]
            at -= 1
        few[at] = number


@njit()
def _components(joined, count):
    parent = np.arange(count)
    for e in range(len(joined)):
        for k in range(1, joined.shape[1]):
            join(parent, joined[e, 0], joined[e, k])
    return labels(parent).astype(np.int32)
