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


def near_rows(points: np.ndarray, body: np.ndarray, radius_m: float) -> np.ndarray:
    """Ascending rows of points (N, 3) within `radius_m` of any of the points of `body` (K, 3)."""
    low, high = body.min(axis=0) - radius_m, body.max(axis=0) + radius_m
    rows = np.flatnonzero(((points >= low) & (points <= high)).all(axis=1))
    distance_m, _ = cKDTree(body).query(points[rows], distance_upper_bound=radius_m)
    return rows[np.isfinite(distance_m)]
