"""Nearest places on triangles, by a tree of boxes around them."""

from typing import NamedTuple

import numba
import numpy as np

from lidarflow.kernels import queue, stack
from lidarflow.kernels import tree as trees
from lidarflow.kernels.compiled import njit
from lidarflow.kernels.tree import Tree


class Triangles(NamedTuple):
    """Triangles in the order of the leaves of a tree.

    corners  (T, 3, 3) float64   the three corners of each
    boxes    (T, 2, 3) float64   lower and upper corner of the box around each
    tree     Tree                over the means of the corners, but its boxes are around whole triangles
    """

    corners: np.ndarray
    boxes: np.ndarray
    tree: Tree


def build(corners: np.ndarray) -> Triangles:
    """Triangles, given by their corners (T, 3, 3); there may be none."""
    tree = trees.build((corners[:, 0] + corners[:, 1] + corners[:, 2]) / 3.0)
    placed, boxes, around = _arranged(np.ascontiguousarray(corners, float), tree)
    return Triangles(placed, boxes, tree._replace(boxes=around))


def nearest(triangles: Triangles, lone: Tree, points: np.ndarray, reach_m: float) -> np.ndarray:
    """The place (N, 3) on triangles, or of lone points, that is nearest to each of points (N, 3).

    NaN where none is nearer than `reach_m`.
    """
    places = np.full((len(points), 3), np.nan)
    _nearest_in_chunks(*triangles, lone, np.ascontiguousarray(points), float(reach_m), places)
    return places


@njit()
def _arranged(corners, tree):
    placed, boxes = np.empty_like(corners), np.empty((len(corners), 2, 3))
    for i in range(len(corners)):
        own = corners[tree.rows[i]]
        for k in range(3):
            placed[i, 0, k], placed[i, 1, k], placed[i, 2, k] = own[0, k], own[1, k], own[2, k]
            boxes[i, 0, k] = min(own[0, k], min(own[1, k], own[2, k]))
            boxes[i, 1, k] = max(own[0, k], max(own[1, k], own[2, k]))
    around = np.empty_like(tree.boxes)
    for node in range(len(around) - 1, -1, -1):
        leaf = node >= len(around) // 2
        inside, first, end = around, 2 * node + 1, 2 * node + 3
        if leaf:
            inside, first, end = boxes, tree.starts[node], tree.ends[node]
        for k in range(3):
            around[node, 0, k], around[node, 1, k] = np.inf, -np.inf
            for i in range(first, end):
                around[node, 0, k] = min(around[node, 0, k], inside[i, 0, k])
                around[node, 1, k] = max(around[node, 1, k], inside[i, 1, k])
    return placed, boxes, around


@njit(parallel=True)
def _nearest_in_chunks(corners, boxes, tree, lone, points, reach_m, places):
    waiting = queue.tasks()
    for _ in numba.prange(queue.PLACES):
        chunk = queue.take(waiting)
        while chunk < (len(points) + trees.CHUNK - 1) // trees.CHUNK:
            start, end = chunk * trees.CHUNK, (chunk + 1) * trees.CHUNK
            _nearest(corners, boxes, tree, lone, points[start:end], reach_m, places[start:end])
            chunk = queue.take(waiting)


@njit(error_model="numpy")
def _nearest(corners, boxes, tree, lone, points, reach_m, places):
    best = -1
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        # What is nearest to one point is near to the next.
        best_sq, best = _nearest_triangle(corners, boxes, tree, x, y, z, reach_m * reach_m, best)
        place, _ = trees.nearest(lone, x, y, z, best_sq, -1)
        if place >= 0:
            for k in range(3):
                places[i, k] = lone.points[place, k]
        elif best >= 0:
            places[i, 0], places[i, 1], places[i, 2] = _closest(corners, best, x, y, z)


@njit(error_model="numpy")
def _nearest_triangle(corners, boxes, tree, x, y, z, best_sq, guess):
    """Squared distance to the nearest triangle, and its number; `best_sq` and -1 if none is nearer."""
    best = -1
    if guess >= 0:
        guess_sq = _apart_sq(corners, guess, x, y, z)
        if guess_sq < best_sq:
            best_sq, best = guess_sq, guess
    waiting, waiting_sq = stack.integers(), stack.reals()
    waiting[0], waiting_sq[0], depth = 0, trees.box_distance_sq(tree.boxes, 0, x, y, z), 1
    while depth > 0:
        node, node_sq, depth = trees.descend(tree, x, y, z, best_sq, waiting, waiting_sq, depth)
        if node_sq >= best_sq:
            continue
        for i in range(tree.starts[node], tree.ends[node]):
            if trees.box_distance_sq(boxes, i, x, y, z) < best_sq:
                apart_sq = _apart_sq(corners, i, x, y, z)
                if apart_sq < best_sq:
                    best, best_sq = i, apart_sq
    return best_sq, best


@njit(inline="always")
def _apart_sq(corners, i, x, y, z):
    px, py, pz = _closest(corners, i, x, y, z)
    return (px - x) ** 2 + (py - y) ** 2 + (pz - z) ** 2


@njit(inline="always")
def _closest(corners, i, x, y, z):
    """The place on triangle i nearest to x, y, z: on a corner, on a side, or within (Ericson 2005, 5.1.5).

    Corners may coincide.
    """
    ax, ay, az = corners[i, 0, 0], corners[i, 0, 1], corners[i, 0, 2]
    bx, by, bz = corners[i, 1, 0] - ax, corners[i, 1, 1] - ay, corners[i, 1, 2] - az    # from a to b
    cx, cy, cz = corners[i, 2, 0] - ax, corners[i, 2, 1] - ay, corners[i, 2, 2] - az    # from a to c
    px, py, pz = x - ax, y - ay, z - az
    b_p, c_p = bx * px + by * py + bz * pz, cx * px + cy * py + cz * pz
    b_b, b_c, c_c = bx * bx + by * by + bz * bz, bx * cx + by * cy + bz * cz, cx * cx + cy * cy + cz * cz
    b_q, c_q = b_p - b_b, c_p - b_c      # as b_p and c_p, seen from b,
    b_r, c_r = b_p - b_c, c_p - c_c      # and from c
    by_c, by_b, by_a = b_p * c_q - b_q * c_p, b_r * c_p - b_p * c_r, b_q * c_r - b_r * c_q
    if b_p <= 0.0 and c_p <= 0.0:
        v, w = 0.0, 0.0
    elif b_q >= 0.0 and c_q <= b_q:
        v, w = 1.0, 0.0
    elif c_r >= 0.0 and b_r <= c_r:
        v, w = 0.0, 1.0
    elif by_c <= 0.0 and b_p >= 0.0 and b_q <= 0.0 and b_b > 0.0:
        v, w = b_p / (b_p - b_q), 0.0
    elif by_b <= 0.0 and c_p >= 0.0 and c_r <= 0.0:
        v, w = 0.0, c_p / (c_p - c_r)
    elif by_a <= 0.0 and c_q - b_q >= 0.0 and b_r - c_r >= 0.0:
        w = (c_q - b_q) / ((c_q - b_q) + (b_r - c_r))
        v = 1.0 - w
    else:
        total = by_a + by_b + by_c
        v, w = by_b / total, by_c / total
    return ax + v * bx + w * cx, ay + v * by + w * cy, az + v * bz + w * cz
