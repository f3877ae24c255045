"""Correspondences between keypoints of two scans, by SHOT descriptors inside a gate."""

import numpy as np

from lidarflow.config import MatchingConfig
from lidarflow.kernels import matching as kernel


def match(
    predicted: np.ndarray, descriptors: np.ndarray, candidates: np.ndarray,
    candidate_descriptors: np.ndarray, dt_s: float, config: MatchingConfig,
) -> tuple[np.ndarray, np.ndarray]:
    """Rows (K,) of the queries and rows (K,) of the candidates that are each other's match.

    predicted (Q, 3) is where the start value puts each query keypoint, in the frame of the candidates
    (C, 3); the gate around it is the largest plausible speed times dt_s. A match survives when its rival
    elsewhere in the gate is clearly worse (ratio test) and matching back from it ends near the query
    (mutual best, within the keypoints' spacing).
    """
    gate_m = config.max_speed_m_per_s * dt_s
    best, best_sq, rival_sq = kernel.best_in_gate(
        predicted, descriptors, candidates, candidate_descriptors, gate_m, config.rival_radius_m)
    clear = (best >= 0) & (best_sq <= config.max_ratio**2 * rival_sq)
    query = np.flatnonzero(clear)
    target = best[query]

    unique, inverse = np.unique(target, return_inverse=True)
    back, _, _ = kernel.best_in_gate(
        candidates[unique], candidate_descriptors[unique], predicted, descriptors, gate_m,
        config.rival_radius_m)
    returned = back[inverse]
    error_m = np.linalg.norm(predicted[returned] - predicted[query], axis=1)
    mutual = (returned >= 0) & (error_m <= config.mutual_radius_m)
    return query[mutual], target[mutual]
