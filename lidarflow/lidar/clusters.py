"""Groups of points that are close together."""

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

_CELLS_PER_LINK = 3


def linked(points: np.ndarray, link_m: float) -> np.ndarray:
    """Label (N,) of each point (N, 3); points nearer than about `link_m` share a label.

    Points are first gathered in cells of a third of that distance, whose means are then linked.
    """
    if len(points) == 0:
        return np.empty(0, np.int64)
    cells = np.floor(points * (_CELLS_PER_LINK / link_m)).astype(np.int64)
    _, member = np.unique(cells, axis=0, return_inverse=True)
    member = member.ravel()
    counts = np.bincount(member)
    means = np.stack([np.bincount(member, points[:, axis]) for axis in range(3)], axis=1) / counts[:, None]
    pairs = cKDTree(means).query_pairs(link_m, output_type="ndarray")
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(counts), len(counts)))
    return connected_components(graph, directed=False)[1][member]
