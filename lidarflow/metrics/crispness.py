"""Crispness: how well a cloud lies on another, for which no truth is needed."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from lidarflow import pose
from lidarflow.types import FlowResult, Scan


def crispness(points: np.ndarray, target: np.ndarray, sigma_m: float) -> float:
    """How well points (N, 3) lie on target (M, 3): mean of exp(−½ dᵀ(2Σ)⁻¹d), in [0, 1].

    d reaches from each point to the nearest target point and Σ = sigma_m² I (Dewan et al. 2016, eq. 15;
    scores of different sigma cannot be compared). NaN without points.
    """
    return _crispness(points, _tree(target), sigma_m)


@dataclass(frozen=True, slots=True)
class Alignment:
    """Crispness before any motion, after ego-motion, and after the points' own flow."""

    before: float
    by_ego: float
    after: float
    sigma_m: float


def alignment(source: Scan, target: Scan, result: FlowResult, sigma_m: float) -> Alignment:
    """Crispness of the points above ground whose motion is known."""
    rows = result.valid & ~result.is_ground
    points, tree = source.points[rows], _tree(target.points)
    return Alignment(
        before=_crispness(points, tree, sigma_m),
        by_ego=_crispness(pose.apply(result.ego_motion, points), tree, sigma_m),
        after=_crispness(points + result.flow[rows], tree, sigma_m),
        sigma_m=sigma_m,
    )


def _tree(points: np.ndarray) -> cKDTree:
    return cKDTree(points[np.isfinite(points).all(axis=1)])


def _crispness(points: np.ndarray, target: cKDTree, sigma_m: float) -> float:
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) == 0 or target.n == 0:
        return float("nan")
    distance_m, _ = target.query(points, workers=-1)
    return float(np.exp(-(distance_m**2) / (4.0 * sigma_m**2)).mean())
