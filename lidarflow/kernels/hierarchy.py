"""A hierarchy of ever coarser meshes, whose vertices are aggregates of points that move as one.

Rigid motions of an aggregate cost no smoothness, and twists are all about the origin, so a coarse twist is
that of all its points as it is, and the coarse equations are sums of the fine ones (Galerkin). But a coarse
mesh gives way only where aggregates meet, and is too stiff (Braess 1995): its edges count less. What holds a
node where it is counts in full, so that rigid motions are right on every level.

All levels are in one list of nodes, level after level.
"""

from collections import namedtuple

import numpy as np

from lidarflow.kernels.compiled import FUSED, njit
from lidarflow.kernels.inertia import SIZE, add_at

_SOFTENING = 0.5    # share of the sum of edges that counts for the coarser one

# bounds (L + 1,): first node of every level, and the end. Neighbours of node i with higher numbers are
# up[up_start[i]:up_start[i + 1]], the edges to them up_edge[…], which just counts; those with lower numbers
# are down[…], and down_edge[…]. parent (N,) is the coarser node, edge_parent (E,) the coarser edge, -1 =
# none. stiffness is the weight of an edge. lever (M, 3) is where an edge to a point from an earlier one sees
# twists. `weigh` fills the rest: inertias (E', 10) of the edges beyond the first level, incident (N, 10) sums
# over the edges of a node.
Hierarchy = namedtuple("Hierarchy", (
    "bounds", "up_start", "up", "up_edge", "down_start", "down", "down_edge", "parent", "edge_parent",
    "stiffness", "lever", "inertias", "incident"))


@njit()
def build(edges, count, stiffness):
    """Hierarchy of a mesh of `count` points with edges (E, 2), i < j, sorted."""
    up_start, up = _rows(edges, count)
    levels = []
    while True:
        down_start, down, down_edge = _reversed(up_start, up)
        parent, aggregates = _aggregates(up_start, up, down_start, down)
        coarse_start, coarse_up, edge_parent = _coarse_edges(
            up_start, up, down_start, down, down_edge, parent, aggregates)
        levels.append((up_start, up, down_start, down, down_edge, parent, edge_parent))
        if aggregates == 0:
            return _flat(levels, stiffness)
        up_start, up = coarse_start, coarse_up


@njit()
def _flat(levels, stiffness):
    """One list of nodes of all levels."""
    bounds, ends = np.zeros(len(levels) + 1, np.int64), np.zeros(len(levels) + 1, np.int64)
    for level in range(len(levels)):
        bounds[level + 1] = bounds[level] + len(levels[level][5])
        ends[level + 1] = ends[level] + len(levels[level][1])
    nodes, edges = bounds[-1], ends[-1]
    up_start, down_start = np.empty(nodes + 1, np.int64), np.empty(nodes + 1, np.int64)
    up, down, down_edge = np.empty(edges, np.int32), np.empty(edges, np.int32), np.empty(edges, np.int32)
    parent, edge_parent = np.empty(nodes, np.int32), np.empty(edges, np.int32)
    for level in range(len(levels)):
        node, edge, coarser, coarser_edge = bounds[level], ends[level], bounds[level + 1], ends[level + 1]
        ups_start, ups, downs_start, downs, down_edges, parents, edge_parents = levels[level]
        for i in range(len(parents)):
            up_start[node + i], down_start[node + i] = edge + ups_start[i], edge + downs_start[i]
            parent[node + i] = coarser + parents[i] if parents[i] >= 0 else -1
        for e in range(len(ups)):
            up[edge + e], down[edge + e] = node + ups[e], node + downs[e]
            down_edge[edge + e] = edge + down_edges[e]
            edge_parent[edge + e] = coarser_edge + edge_parents[e] if edge_parents[e] >= 0 else -1
    up_start[nodes] = down_start[nodes] = edges
    return Hierarchy(
        bounds, up_start, up, np.arange(edges).astype(np.int32), down_start, down, down_edge, parent,
        edge_parent, stiffness, np.full((bounds[1], 3), np.inf), np.empty((edges - ends[1], SIZE)),
        np.empty((nodes, SIZE)))


@njit(**FUSED)
def weigh(hierarchy):
    """Fill the inertias of the edges, and what they sum up to at the nodes, from `lever`."""
    bounds, up_start, up = hierarchy.bounds, hierarchy.up_start, hierarchy.up
    inertias, incident, edge_parent = hierarchy.inertias, hierarchy.incident, hierarchy.edge_parent
    lever, stiffness, points_edges = hierarchy.lever, hierarchy.stiffness, len(up) - len(inertias)
    softened = _SOFTENING * stiffness
    incident[:] = 0.0
    inertias[:] = 0.0
    for i in range(bounds[1]):
        for e in range(up_start[i], up_start[i + 1]):
            add_at(incident, i, lever, up[e], stiffness, stiffness)
            add_at(incident, up[e], lever, up[e], stiffness, stiffness)
            if edge_parent[e] >= 0:
                add_at(inertias, edge_parent[e] - points_edges, lever, up[e], softened, softened)
    for i in range(bounds[1], bounds[-1]):
        for e in range(up_start[i], up_start[i + 1]):
            for k in range(SIZE):
                share = inertias[e - points_edges, k]
                incident[i, k] += share
                incident[up[e], k] += share
                if edge_parent[e] >= 0:
                    inertias[edge_parent[e] - points_edges, k] += _SOFTENING * share


@njit()
def _rows(edges, count):
    """Start (count + 1,) of every node in the list of neighbours with higher numbers, and that list."""
    start, up = np.zeros(count + 1, np.int64), np.empty(len(edges), np.int32)
    for e in range(len(edges)):
        start[edges[e, 0] + 1] += 1
        up[e] = edges[e, 1]
    return np.cumsum(start), up


@njit()
def _reversed(up_start, up):
    """For every node the neighbours with lower numbers, and the edges to them."""
    count = len(up_start) - 1
    start = np.zeros(count + 1, np.int64)
    for e in range(len(up)):
        start[up[e] + 1] += 1
    start = np.cumsum(start)
    filled = start[:-1].copy()
    down, edge = np.empty(len(up), up.dtype), np.empty(len(up), np.int32)
    for i in range(count):
        for e in range(up_start[i], up_start[i + 1]):
            slot = filled[up[e]]
            down[slot], edge[slot] = i, e
            filled[up[e]] += 1
    return start, down, edge


@njit()
def _aggregates(up_start, up, down_start, down):
    """Aggregate (N,) of every node, a node with all its neighbours where these are free, then what is left.

    That is the first phase of Vanek, Mandel and Brezina 1996; what is left joins its first neighbour's. A
    mesh without edges has no coarser level: -1. Also returns how many aggregates there are.
    """
    nodes = len(up_start) - 1
    parent = np.full(nodes, -1, np.int32)
    count = 0
    if len(up) == 0:
        return parent, count
    for i in range(nodes):
        free = parent[i] < 0
        for e in range(up_start[i], up_start[i + 1]):
            free = free and parent[up[e]] < 0
        for e in range(down_start[i], down_start[i + 1]):
            free = free and parent[down[e]] < 0
        if not free:
            continue
        parent[i] = count
        for e in range(up_start[i], up_start[i + 1]):
            parent[up[e]] = count
        for e in range(down_start[i], down_start[i + 1]):
            parent[down[e]] = count
        count += 1
    for i in range(nodes):
        if parent[i] < 0:
            # An aggregate of the first phase: what joined in this one is told by its sign.
            for e in range(down_start[i], down_start[i + 1]):
                if parent[i] == -1 and parent[down[e]] >= 0:
                    parent[i] = -2 - parent[down[e]]
            for e in range(up_start[i], up_start[i + 1]):
                if parent[i] == -1 and parent[up[e]] >= 0:
                    parent[i] = -2 - parent[up[e]]
    for i in range(nodes):
        if parent[i] < -1:
            parent[i] = -2 - parent[i]
    return parent, count


@njit()
def _members(parent, count):
    """Start (A + 1,) of every aggregate in the list of their members, and that list."""
    start = np.zeros(count + 1, np.int64)
    for i in range(len(parent)):
        if parent[i] >= 0:
            start[parent[i] + 1] += 1
    start = np.cumsum(start)
    filled, member = start[:-1].copy(), np.empty(start[-1], np.int32)
    for i in range(len(parent)):
        if parent[i] >= 0:
            member[filled[parent[i]]] = i
            filled[parent[i]] += 1
    return start, member


@njit()
def _coarse_edges(up_start, up, down_start, down, down_edge, parent, count):
    """Edges between aggregates as `up_start` and `up`, and which of them (E,) each edge is in, or -1."""
    member_start, member = _members(parent, count)
    start = np.zeros(count + 1, np.int64)
    neighbour, edge_parent = np.empty(len(up), np.int32), np.full(len(up), -1, np.int32)
    slot_of = np.full(count, -1, np.int64)
    slots = 0
    for a in range(count):
        for k in range(member_start[a], member_start[a + 1]):
            i = member[k]
            ups = up_start[i + 1] - up_start[i]
            for n in range(ups + down_start[i + 1] - down_start[i]):
                if n < ups:
                    edge = up_start[i] + n
                    b = parent[up[edge]]
                else:
                    edge = down_edge[down_start[i] + n - ups]
                    b = parent[down[down_start[i] + n - ups]]
                if b <= a:
                    continue
                if slot_of[b] < start[a]:
                    slot_of[b], neighbour[slots] = slots, b
                    slots += 1
                edge_parent[edge] = slot_of[b]
        start[a + 1] = slots
    return start, neighbour[:slots].copy(), edge_parent
