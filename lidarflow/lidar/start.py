"""Start values: the motions of the previous pair, carried over to where their points are now."""

import numpy as np

from lidarflow import pose
from lidarflow.kernels import neighbours, tree
from lidarflow.rows import are_finite
from lidarflow.types import FlowResult

_MAX_CARRY_M = 1.0


def carried(
    points: np.ndarray, previous_points: np.ndarray, previous: FlowResult, took_s: float,
    ego_motion: np.ndarray, dt_s: float,
) -> np.ndarray:
    """Start motions (N, 4, 4), over `dt_s`, of `points` (N, 3), metres in the current source frame.

    Each point goes on with the motion, which took `took_s`, of the nearest previous point after its flow
    (Dewan et al. 2016, section IV); without a solved one within a metre, with the ego-motion.
    """
    start = np.tile(ego_motion, (len(points), 1, 1))
    known = np.flatnonzero(previous.valid & previous.in_graph)
    here = np.flatnonzero(are_finite(points))
    if len(known) == 0 or len(here) == 0:
        return start
    arrived = previous_points[known] + previous.flow[known]
    distance_m, nearest = neighbours.query(tree.build(arrived), points[here], _MAX_CARRY_M)
    close = np.isfinite(distance_m)
    start[here[close]] = pose.lasting(previous.motions[known[nearest[close]]], took_s, dt_s)
    return start
