"""k-d tree over points, for queries inside other kernels.

Nodes are halves of halves down to small leaves, each with the box around its points; the children of node i
are 2 i + 1 and 2 i + 2. Points lie in the order of the leaves, so that a node is one run of them. While one
node is searched no more of them wait than the tree has levels, which is always less than stack.SIZE.
"""

from typing import NamedTuple

import numpy as np

from lidarflow.kernels import stack
from lidarflow.kernels.compiled import njit

_LEAF = 12       # points of a leaf, about
_FEW = 12        # so few are put in order one by one
_ROW, _HALF = np.uint64(0xFFFFFFFF), np.uint64(32)
CHUNK = 512      # queries that one thread takes at a time; it takes longer to start than fewer


class Tree(NamedTuple):
    """A k-d tree.

    points  (N, 3) float64      in the order of the leaves
    rows    (N,) int64          where each of them was before
    starts  (M,) int64          first point of each node, level by level
    ends    (M,) int64          and the one after its last
    boxes   (M, 2, 3) float64   lower and upper corner of the box around a node's points
    """

    points: np.ndarray
    rows: np.ndarray
    starts: np.ndarray
    ends: np.ndarray
    boxes: np.ndarray


NOTHING = Tree(
    np.empty((0, 3)), np.empty(0, np.int64), np.zeros(1, np.int64), np.zeros(1, np.int64),
    np.full((1, 2, 3), [[np.inf], [-np.inf]]))


def build(points: np.ndarray) -> Tree:
    """The tree over finite points (N, 3), which may be none."""
    return Tree(*_grown(np.ascontiguousarray(points, float)))


def moved(tree: Tree, points: np.ndarray) -> Tree:
    """The tree of the same rows once they have moved together to `points` (N, 3); boxes are made anew."""
    placed, boxes = _moved(tree, np.ascontiguousarray(points))
    return tree._replace(points=placed, boxes=boxes)


@njit()
def _grown(points):
    return grown(points)[:]


@njit()
def grown(points):
    """As `build`, for other kernels."""
    count, nodes = len(points), 1
    while count > _LEAF * (nodes + 1) // 2:
        nodes = 2 * nodes + 1
    starts, ends, boxes = np.zeros(nodes, np.int64), np.zeros(nodes, np.int64), np.empty((nodes, 2, 3))
    ends[0] = count
    # Rows stand in the low half of what is put in order; coordinates that decide stand before them.
    ordered = np.empty(count, np.uint64)
    for i in range(count):
        ordered[i] = np.uint64(i)
    # One half is done before the other, while its points are at hand.
    waiting = stack.integers()
    waiting[0], depth = 0, 1
    while depth > 0:
        depth -= 1
        node = waiting[depth]
        start, end = starts[node], ends[node]
        _fill_box(boxes[node], points, ordered, start, end)
        if node >= nodes // 2:
            continue
        middle = (start + end) // 2
        axis = 0
        for k in range(1, 3):
            if boxes[node, 1, k] - boxes[node, 0, k] > boxes[node, 1, axis] - boxes[node, 0, axis]:
                axis = k
        _mark(ordered, points, axis, boxes[node, 0, axis], boxes[node, 1, axis], start, end)
        _part(ordered, start, end, middle)
        starts[2 * node + 1], ends[2 * node + 1] = start, middle
        starts[2 * node + 2], ends[2 * node + 2] = middle, end
        waiting[depth], waiting[depth + 1] = 2 * node + 2, 2 * node + 1
        depth += 2
    placed, rows = np.empty((count, 3)), np.empty(count, np.int64)
    for i in range(count):
        row = np.int64(ordered[i] & _ROW)
        rows[i] = row
        placed[i, 0], placed[i, 1], placed[i, 2] = points[row, 0], points[row, 1], points[row, 2]
    return Tree(placed, rows, starts, ends, boxes)


@njit()
def _fill_box(box, points, ordered, start, end):
    """Make `box` (2, 3) that around the points whose rows are ordered from `start` to `end`."""
    ax, ay, az = np.inf, np.inf, np.inf
    bx, by, bz = -np.inf, -np.inf, -np.inf
    for i in range(start, end):
        row = np.int64(ordered[i] & _ROW)
        x, y, z = points[row, 0], points[row, 1], points[row, 2]
        ax, ay, az, bx, by, bz = min(ax, x), min(ay, y), min(az, z), max(bx, x), max(by, y), max(bz, z)
    box[0, 0], box[0, 1], box[0, 2], box[1, 0], box[1, 1], box[1, 2] = ax, ay, az, bx, by, bz


@njit()
def _mark(ordered, points, axis, low, high, start, end):
    """Put before each row from `start` to `end` where its point lies along an axis, in 2³² steps.

    Points of one step are in the order of their rows, so that no two are equal.
    """
    scale = 4294967295.0 / (high - low) if high > low else 0.0
    for i in range(start, end):
        row = ordered[i] & _ROW
        step = np.uint64((points[np.int64(row), axis] - low) * scale)
        ordered[i] = (step << _HALF) | row


@njit()
def _part(ordered, start, end, middle):
    """Reorder start..end so that nothing before `middle` is greater than anything after it.

    Hoare's selection (1961), with Lomuto's way of parting: what is written does not depend on a comparison,
    so that none is guessed wrong.
    """
    while end - start > _FEW:
        quarter = (end - start) // 4
        pivot = _median(ordered[start + quarter], ordered[(start + end) // 2], ordered[end - 1 - quarter])
        below = start
        for i in range(start, end):
            own = ordered[i]
            ordered[i] = ordered[below]
            ordered[below] = own
            below += 1 if own < pivot else 0
        if below > middle:
            end = below
        else:
            start = below
    for i in range(start + 1, end):
        own, at = ordered[i], i
        while at > start and ordered[at - 1] > own:
            ordered[at] = ordered[at - 1]
            at -= 1
        ordered[at] = own


@njit()
def _no_boxes(count):
    boxes = np.empty((count, 2, 3))
    for node in range(count):
        for k in range(3):
            boxes[node, 0, k], boxes[node, 1, k] = np.inf, -np.inf
    return boxes


@njit()
def _moved(tree, points):
    nodes = len(tree.ends)
    placed = np.empty_like(points)
    boxes = _no_boxes(nodes)
    for node in range(nodes - 1, -1, -1):
        if node >= nodes // 2:
            for i in range(tree.starts[node], tree.ends[node]):
                for k in range(3):
                    placed[i, k] = points[tree.rows[i], k]
                    boxes[node, 0, k] = min(boxes[node, 0, k], placed[i, k])
                    boxes[node, 1, k] = max(boxes[node, 1, k], placed[i, k])
        else:
            for k in range(3):
                boxes[node, 0, k] = min(boxes[2 * node + 1, 0, k], boxes[2 * node + 2, 0, k])
                boxes[node, 1, k] = max(boxes[2 * node + 1, 1, k], boxes[2 * node + 2, 1, k])
    return placed, boxes


@njit(inline="always")
def _median(a, b, c):
    return max(min(a, b), min(max(a, b), c))


@njit(inline="always")
def box_distance_sq(boxes, i, x, y, z):
    """Squared distance of x, y, z from box i, 0 inside it."""
    dx = max(max(boxes[i, 0, 0] - x, x - boxes[i, 1, 0]), 0.0)
    dy = max(max(boxes[i, 0, 1] - y, y - boxes[i, 1, 1]), 0.0)
    dz = max(max(boxes[i, 0, 2] - z, z - boxes[i, 1, 2]), 0.0)
    return dx * dx + dy * dy + dz * dz


@njit(inline="always")
def distance_sq(points, i, x, y, z):
    """Squared distance of x, y, z from point i."""
    dx, dy, dz = points[i, 0] - x, points[i, 1] - y, points[i, 2] - z
    return dx * dx + dy * dy + dz * dz


@njit()
def descend(tree, x, y, z, bound_sq, waiting, waiting_sq, depth):
    """Take the last of the waiting nodes and go down from it to its nearest leaf.

    The other children on the way wait, where they are nearer than the root of `bound_sq`. Returns the leaf,
    its squared distance and how many wait now; a node that is no leaf is as far as the bound.
    """
    depth -= 1
    node, node_sq = waiting[depth], waiting_sq[depth]
    leaves = len(tree.ends) // 2
    while node < leaves and node_sq < bound_sq:
        left, right = 2 * node + 1, 2 * node + 2
        left_sq, right_sq = (
            box_distance_sq(tree.boxes, left, x, y, z), box_distance_sq(tree.boxes, right, x, y, z))
        if left_sq > right_sq:
            left, right, left_sq, right_sq = right, left, right_sq, left_sq
        if right_sq < bound_sq:
            waiting[depth], waiting_sq[depth] = right, right_sq
            depth += 1
        node, node_sq = left, left_sq
    return node, node_sq, depth


@njit()
def nearest(tree, x, y, z, best_sq, best):
    """Place in the tree of the point nearest to x, y, z, and its squared distance.

    `best` and `best_sq` where nothing is nearer than the root of `best_sq`.
    """
    waiting, waiting_sq = stack.integers(), stack.reals()
    waiting[0], waiting_sq[0], depth = 0, box_distance_sq(tree.boxes, 0, x, y, z), 1
    while depth > 0:
        node, node_sq, depth = descend(tree, x, y, z, best_sq, waiting, waiting_sq, depth)
        if node_sq >= best_sq:
            continue
        for i in range(tree.starts[node], tree.ends[node]):
            apart_sq = distance_sq(tree.points, i, x, y, z)
            if apart_sq < best_sq:
                best, best_sq = i, apart_sq
    return best, best_sq


@njit()
def nearest_two(tree, x, y, z, reach_sq):
    """Place of the point nearest to x, y, z, its squared distance, and that of the second; none has place -1.

    Distances are `reach_sq` where nothing is nearer.
    """
    best, best_sq, second_sq = -1, reach_sq, reach_sq
    waiting, waiting_sq = stack.integers(), stack.reals()
    waiting[0], waiting_sq[0], depth = 0, box_distance_sq(tree.boxes, 0, x, y, z), 1
    while depth > 0:
        node, node_sq, depth = descend(tree, x, y, z, second_sq, waiting, waiting_sq, depth)
        if node_sq >= second_sq:
            continue
        for i in range(tree.starts[node], tree.ends[node]):
            apart_sq = distance_sq(tree.points, i, x, y, z)
            if apart_sq < best_sq:
                best, best_sq, second_sq = i, apart_sq, best_sq
            elif apart_sq < second_sq:
                second_sq = apart_sq
    return best, best_sq, second_sq


@njit()
def within(tree, x, y, z, radius_sq):
    """Place in the tree of some point whose squared distance from x, y, z is at most `radius_sq`, or -1."""
    leaves = len(tree.ends) // 2
    waiting = stack.integers()
    waiting[0], depth = 0, 1
    while depth > 0:
        depth -= 1
        node = waiting[depth]
        if box_distance_sq(tree.boxes, node, x, y, z) > radius_sq:
            continue
        while node < leaves:
            left, right = 2 * node + 1, 2 * node + 2
            left_sq, right_sq = (
                box_distance_sq(tree.boxes, left, x, y, z), box_distance_sq(tree.boxes, right, x, y, z))
            if left_sq > right_sq:
                left, right, left_sq, right_sq = right, left, right_sq, left_sq
            if right_sq <= radius_sq:
                waiting[depth] = right
                depth += 1
            node = left
        for i in range(tree.starts[node], tree.ends[node]):
            if distance_sq(tree.points, i, x, y, z) <= radius_sq:
                return i
    return -1


@njit()
def all_within(tree, x, y, z, radius_sq, found):
    """Fill `found` with the places at most the root of `radius_sq` from x, y, z; returns how many."""
    leaves, count = len(tree.ends) // 2, 0
    waiting = stack.integers()
    waiting[0], depth = 0, 1
    while depth > 0:
        depth -= 1
        node = waiting[depth]
        if box_distance_sq(tree.boxes, node, x, y, z) > radius_sq:
            continue
        if node < leaves:
            waiting[depth], waiting[depth + 1] = 2 * node + 1, 2 * node + 2
            depth += 2
            continue
        for i in range(tree.starts[node], tree.ends[node]):
            if distance_sq(tree.points, i, x, y, z) <= radius_sq:
                found[count] = i
                count += 1
    return count
