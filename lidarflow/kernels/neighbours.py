"""Nearest neighbours and neighbourhoods of many points at once, in a k-d tree."""

import math

import numba
import numpy as np

from lidarflow.kernels import queue, stack
from lidarflow.kernels.compiled import njit
from lidarflow.kernels.tree import (
    CHUNK,
    Tree,
    box_distance_sq,
    distance_sq,
    nearest,
    within,
)


def query(tree: Tree, points: np.ndarray, reach_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Distance (N,) from each of points (N, 3) to the nearest of the tree, and its row (N,).

    Infinite and -1 where nothing is nearer than `reach_m`.
    """
    distance_m, row = np.full(len(points), np.inf), np.full(len(points), -1)
    kernel = _query_in_chunks if len(points) > CHUNK else _query
    kernel(tree, np.ascontiguousarray(points), float(reach_m), distance_m, row)
    return distance_m, row


def nearest_m(tree: Tree, points: np.ndarray, known_m: np.ndarray, reach_m: float) -> np.ndarray:
    """Distance (N,) from each of points (N, 3) to the nearest of the tree, or `known_m` (N,) if that is less.

    What is not nearer than `reach_m` is as far as known.
    """
    return _nearest_m(tree, np.ascontiguousarray(points), known_m, float(reach_m))


def near_rows(tree: Tree, body: Tree, radius_m: float) -> np.ndarray:
    """Ascending rows of the tree's points that are nearer than `radius_m` to any point of a body."""
    return np.sort(rows_near(tree, body, float(radius_m)))


def counts_around(
    tree: Tree, marks: np.ndarray, points: np.ndarray, radius_m: float
) -> np.ndarray:
    """How many (K, F) of the tree's points with each of F marks lie within `radius_m` of points (K, 3).

    marks (N, F) bool are aligned with the rows the tree was built from.
    """
    counts = np.zeros((len(points), marks.shape[1]), np.int64)
    before = _before(tree, marks)
    kernel = _counts_in_chunks if len(points) > CHUNK else _counts_around
    kernel(tree, before, np.ascontiguousarray(points), float(radius_m), counts)
    return counts


def number_around(tree: Tree, points: np.ndarray, radius_m: float) -> np.ndarray:
    """How many (K,) of the tree's points lie within `radius_m` of each of points (K, 3)."""
    counts = np.zeros((len(points), 1), np.int64)
    each = np.arange(len(tree.rows) + 1)[:, None]   # every point counts, whatever it is
    _counts_around(tree, each, np.ascontiguousarray(points), float(radius_m), counts)
    return counts[:, 0]


def any_within(tree: Tree, points: np.ndarray, reach_m: np.ndarray) -> np.ndarray:
    """Whether (N,) the tree has a point as near to each of points (N, 3) as its `reach_m` (N,)."""
    return _any_within(tree, np.ascontiguousarray(points), reach_m)


@njit(parallel=True)
def _query_in_chunks(tree, points, reach_m, distance_m, row):
    waiting = queue.tasks()
    for _ in numba.prange(queue.PLACES):
        chunk = queue.take(waiting)
        while chunk < (len(points) + CHUNK - 1) // CHUNK:
            start, end = chunk * CHUNK, (chunk + 1) * CHUNK
            _query(tree, points[start:end], reach_m, distance_m[start:end], row[start:end])
            chunk = queue.take(waiting)


@njit()
def _query(tree, points, reach_m, distance_m, row):
    for i in range(len(points)):
        place, apart_sq = nearest(tree, points[i, 0], points[i, 1], points[i, 2], reach_m * reach_m, -1)
        if place >= 0:
            distance_m[i], row[i] = math.sqrt(apart_sq), tree.rows[place]


@njit(parallel=True)
def _nearest_m(tree, points, known_m, reach_m):
    distance_m = known_m.copy()
    for i in numba.prange(len(points)):
        bound_m = min(known_m[i], reach_m)
        place, apart_sq = nearest(tree, points[i, 0], points[i, 1], points[i, 2], bound_m * bound_m, -1)
        if place >= 0:
            distance_m[i] = math.sqrt(apart_sq)
    return distance_m


@njit(parallel=True)
def _any_within(tree, points, reach_m):
    found = np.zeros(len(points), np.bool_)
    for i in numba.prange(len(points)):
        found[i] = within(tree, points[i, 0], points[i, 1], points[i, 2], reach_m[i] * reach_m[i]) >= 0
    return found


@njit()
def rows_near(tree, body, radius_m):
    """As `near_rows`, in the order of the tree, for other kernels."""
    found, count = np.empty(len(tree.rows), np.int64), 0
    leaves, radius_sq = len(tree.ends) // 2, radius_m * radius_m
    waiting = stack.integers()
    waiting[0], depth = 0, 1
    witness = 0   # what was near to the last point is probably near to this one
    while depth > 0:
        depth -= 1
        node = waiting[depth]
        if not _boxes_are_near(tree, node, body, radius_sq):
            continue
        if _farthest_sq(tree, node, body.points, witness) < radius_sq:
            for i in range(tree.starts[node], tree.ends[node]):
                found[count] = tree.rows[i]
                count += 1
        elif node < leaves:
            waiting[depth], waiting[depth + 1] = 2 * node + 1, 2 * node + 2
            depth += 2
        else:
            for i in range(tree.starts[node], tree.ends[node]):
                x, y, z = tree.points[i, 0], tree.points[i, 1], tree.points[i, 2]
                if distance_sq(body.points, witness, x, y, z) >= radius_sq:
                    place, _ = nearest(body, x, y, z, radius_sq, -1)
                    if place < 0:
                        continue
                    witness = place
                found[count] = tree.rows[i]
                count += 1
    return found[:count].copy()


@njit(inline="always")
def _boxes_are_near(tree, node, body, radius_sq):
    """Whether a node's box is nearer than the root of `radius_sq` to the box around the whole body."""
    apart_sq = 0.0
    for k in range(3):
        below = body.boxes[0, 0, k] - tree.boxes[node, 1, k]
        above = tree.boxes[node, 0, k] - body.boxes[0, 1, k]
        gap = max(max(below, above), 0.0)
        apart_sq += gap * gap
    return apart_sq < radius_sq


@njit(inline="always")
def _farthest_sq(tree, node, points, i):
    """Squared distance from point i to the farthest corner of a node's box."""
    apart_sq = 0.0
    for k in range(3):
        gap = max(points[i, k] - tree.boxes[node, 0, k], tree.boxes[node, 1, k] - points[i, k])
        apart_sq += gap * gap
    return apart_sq


@njit()
def _before(tree, marks):
    """How many (N + 1, F) points in front of each place have each mark."""
    before = np.zeros((len(marks) + 1, marks.shape[1]), np.int64)
    for i in range(len(marks)):
        for mark in range(marks.shape[1]):
            before[i + 1, mark] = before[i, mark] + marks[tree.rows[i], mark]
    return before


@njit(parallel=True)
def _counts_in_chunks(tree, before, points, radius_m, counts):
    waiting = queue.tasks()
    for _ in numba.prange(queue.PLACES):
        chunk = queue.take(waiting)
        while chunk < (len(points) + CHUNK - 1) // CHUNK:
            start, end = chunk * CHUNK, (chunk + 1) * CHUNK
            _counts_around(tree, before, points[start:end], radius_m, counts[start:end])
            chunk = queue.take(waiting)


@njit()
def _counts_around(tree, before, points, radius_m, counts):
    """Add the counts of marks (K, F) to `counts`; a node in reach as a whole is two look-ups in `before`."""
    leaves, radius_sq = len(tree.ends) // 2, radius_m * radius_m
    waiting = stack.integers()
    for k in range(len(points)):
        x, y, z = points[k, 0], points[k, 1], points[k, 2]
        waiting[0], depth = 0, 1
        while depth > 0:
            depth -= 1
            node = waiting[depth]
            if box_distance_sq(tree.boxes, node, x, y, z) > radius_sq:
                continue
            start, end = tree.starts[node], tree.ends[node]
            if _farthest_sq(tree, node, points, k) <= radius_sq:
                for mark in range(counts.shape[1]):
                    counts[k, mark] += before[end, mark] - before[start, mark]
            elif node < leaves:
                waiting[depth], waiting[depth + 1] = 2 * node + 1, 2 * node + 2
                depth += 2
            else:
                for i in range(start, end):
                    if distance_sq(tree.points, i, x, y, z) <= radius_sq:
                        for mark in range(counts.shape[1]):
                            counts[k, mark] += before[i + 1, mark] - before[i, mark]
