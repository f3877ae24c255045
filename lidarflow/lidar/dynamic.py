"""Which points move by themselves: smoothed residual motion that ego-motion cannot explain away."""

import numpy as np
from scipy.sparse import coo_array
from scipy.spatial import cKDTree

from lidarflow import pose
from lidarflow.config import DynamicConfig

_FAR_M = 1.0   # distances to the next scan count at most this much


def detect(
    points: np.ndarray, residual_flow: np.ndarray, candidates: np.ndarray, edges: np.ndarray,
    ego_motion: np.ndarray, target_points: np.ndarray, dt_s: float, config: DynamicConfig,
) -> np.ndarray:
    """Mask (N,) of the points that move over ground.

    points (N, 3), metres, source frame; residual_flow (N, 3), metres, in the target's axes; candidates (N,)
    bool, the solved points of the graph; edges (E, 2) of the mesh; ego_motion (4, 4), target_from_source;
    target_points (M, 3), the next scan in range, ground included, target frame. A point moves when its
    residual flow, averaged over the mesh, is fast enough, and when the points around it are farther from the
    next scan after ego-motion alone than after their own flow.
    """
    moving = np.zeros(len(points), bool)
    rows = np.flatnonzero(candidates)
    if len(rows) == 0 or len(target_points) == 0:
        return moving
    smooth = _Smoother(rows, edges, len(points), config.smoothing_rounds)
    speed = np.linalg.norm(smooth(residual_flow[rows]), axis=1) / dt_s

    tree = cKDTree(target_points)
    by_ego = pose.apply(ego_motion, points[rows])
    left_by_ego, _ = tree.query(by_ego, distance_upper_bound=_FAR_M, workers=-1)
    left_by_flow, _ = tree.query(by_ego + residual_flow[rows], distance_upper_bound=_FAR_M, workers=-1)
    gain_m = smooth(np.minimum(left_by_ego, _FAR_M) - np.minimum(left_by_flow, _FAR_M))
    moving[rows] = (speed >= config.min_speed_m_per_s) & (gain_m >= config.min_gain_m)
    return moving


class _Smoother:
    """Averaging with the mesh neighbours, a number of times."""

    def __init__(self, rows: np.ndarray, edges: np.ndarray, count: int, rounds: int):
        local = np.full(count, -1)
        local[rows] = np.arange(len(rows))
        i, j = local[edges].T
        inside = (i >= 0) & (j >= 0)
        i, j = i[inside], j[inside]
        self_loop = np.arange(len(rows))
        ends = np.concatenate([i, j, self_loop]), np.concatenate([j, i, self_loop])
        self._sum = coo_array((np.ones(len(ends[0])), ends), shape=(len(rows), len(rows))).tocsr()
        self._share = 1.0 / np.asarray(self._sum.sum(axis=1)).ravel()
        self._rounds = rounds

    def __call__(self, values: np.ndarray) -> np.ndarray:
        share = self._share if values.ndim == 1 else self._share[:, None]
        for _ in range(self._rounds):
            values = (self._sum @ values) * share
        return values
