"""The variables and edges of a graph, component after component."""

from collections import namedtuple

import numpy as np

from lidarflow.kernels.compiled import njit

# rows (M',) of the variables, those of the c-th part from bounds[c] to bounds[c + 1], in order; place (M,)
# is where a variable is in its part. edges (E', 2) between variables, those of a part from edge_bounds[c].
Parts = namedtuple("Parts", ("bounds", "rows", "place", "edge_bounds", "edges"))


def split(component: np.ndarray, edges: np.ndarray, wanted: np.ndarray) -> Parts:
    """Those components of variables (M,) that are `wanted` (C,), in order, with the edges (E, 2) within."""
    return Parts(*_split(component, edges, wanted))


@njit()
def _split(component, edges, wanted):
    part = np.full(len(wanted), -1, np.int32)
    count = 0
    for c in range(len(wanted)):
        if wanted[c]:
            part[c] = count
            count += 1
    bounds, edge_bounds = np.zeros(count + 1, np.int64), np.zeros(count + 1, np.int64)
    for i in range(len(component)):
        c = part[component[i]]
        if c >= 0:
            bounds[c + 1] += 1
    for e in range(len(edges)):
        c = part[component[edges[e, 0]]]
        if c >= 0:
            edge_bounds[c + 1] += 1
    bounds, edge_bounds = np.cumsum(bounds), np.cumsum(edge_bounds)
    rows, place = np.empty(bounds[-1], np.int32), np.full(len(component), -1, np.int32)
    between = np.empty((edge_bounds[-1], 2), np.int32)
    filled, edges_filled = bounds.copy(), edge_bounds.copy()
    for i in range(len(component)):
        c = part[component[i]]
        if c >= 0:
            rows[filled[c]], place[i] = i, filled[c] - bounds[c]
            filled[c] += 1
    for e in range(len(edges)):
        c = part[component[edges[e, 0]]]
        if c >= 0:
            between[edges_filled[c], 0], between[edges_filled[c], 1] = edges[e, 0], edges[e, 1]
            edges_filled[c] += 1
    return bounds, rows, place, edge_bounds, between
