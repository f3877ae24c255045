"""Undirected graphs as edge lists: unique edges of triangles, connected components, who has edges."""

import numpy as np

from lidarflow.kernels.compiled import njit
from lidarflow.kernels.sorting import sort
from lidarflow.kernels.union_find import join, labels


def sides(triangles: np.ndarray, more: np.ndarray, count: int) -> np.ndarray:
    """Edges (E, 2) int32, i < j, sorted and unique, of triangles (T, 3) over `count` points.

    `more` (K, 2) are edges besides.
    """
    return _sides(np.ascontiguousarray(triangles), np.ascontiguousarray(more), count)


def components(joined: np.ndarray, count: int) -> np.ndarray:
    """Component (count,) int32 of points in edges (E, 2) or triangles (E, 3), numbered by first points."""
    return _components(np.ascontiguousarray(joined), count)


def touched(joined: np.ndarray, count: int) -> np.ndarray:
    """Whether each of `count` points is in one of the edges (E, 2) or triangles (E, 3): (count,) bool."""
    return _touched(np.ascontiguousarray(joined), count)


@njit()
def _sides(triangles, more, count):
    # Edges of each lower end: how many, then where they end, and where they begin once they are there.
    first = np.zeros(count + 1, np.int32)
    for t in range(len(triangles)):
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        if not _is_told(triangles, t):
            first[min(a, b)] += 1
        first[min(b, c)] += 1
        first[min(a, c)] += 1
    for e in range(len(more)):
        first[min(more[e, 0], more[e, 1])] += 1
    for i in range(count):
        first[i + 1] += first[i]
    upper = np.empty(first[count], np.int32)
    for t in range(len(triangles)):
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        if not _is_told(triangles, t):
            _put(upper, first, a, b)
        _put(upper, first, b, c)
        _put(upper, first, a, c)
    for e in range(len(more)):
        _put(upper, first, more[e, 0], more[e, 1])
    edges, found = np.empty((len(upper), 2), np.int32), 0
    for i in range(count):
        own = upper[first[i]: first[i + 1]]
        sort(own)
        for k in range(len(own)):
            if k == 0 or own[k] != own[k - 1]:
                edges[found, 0], edges[found, 1] = i, own[k]
                found += 1
    return edges[:found].copy()


@njit(inline="always")
def _is_told(triangles, t):
    """Whether the first side of a triangle is one of the triangle before, as it is along a strip."""
    if t == 0:
        return False
    a, b = triangles[t, 0], triangles[t, 1]
    a_before, b_before, c_before = triangles[t - 1, 0], triangles[t - 1, 1], triangles[t - 1, 2]
    return (a == c_before and b == b_before) or (b == c_before and a == a_before)


@njit(inline="always")
def _put(upper, first, a, b):
    """Put the higher of two points before the others of the lower one."""
    i = min(a, b)
    first[i] -= 1
    upper[first[i]] = max(a, b)


@njit()
def _components(joined, count):
    parent = np.arange(count)
    for e in range(len(joined)):
        for k in range(1, joined.shape[1]):
            join(parent, joined[e, 0], joined[e, k])
    return labels(parent).astype(np.int32)


@njit()
def _touched(joined, count):
    found = np.zeros(count, np.bool_)
    for e in range(len(joined)):
        for k in range(joined.shape[1]):
            found[joined[e, k]] = True
    return found
