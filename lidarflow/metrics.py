"""Scores of a flow: against the truth where there is one, by crispness where there is none."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from lidarflow import pose
from lidarflow.types import FlowResult, Scan, Truth


def crispness(points: np.ndarray, target: np.ndarray, sigma_m: float) -> float:
    """How well points (N, 3) lie on target (M, 3): mean of exp(−½ dᵀ(2Σ)⁻¹d), in [0, 1].

    d reaches from each point to the nearest target point and Σ = sigma_m² I (Dewan et al. 2016, eq. 15;
    scores of different sigma cannot be compared). NaN without points.
    """
    return _crispness(points, _tree(target), sigma_m)


def _tree(points: np.ndarray) -> cKDTree:
    return cKDTree(points[np.isfinite(points).all(axis=1)])


def _crispness(points: np.ndarray, target: cKDTree, sigma_m: float) -> float:
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) == 0 or target.n == 0:
        return float("nan")
    distance_m, _ = target.query(points, workers=-1)
    return float(np.exp(-(distance_m**2) / (4.0 * sigma_m**2)).mean())


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


@dataclass(frozen=True, slots=True)
class ErrorSummary:
    """End-point error in metres over a set of points; NaN where the set is empty."""

    points: int
    mean: float
    median: float


def end_point_error(flow: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Distance (N,) in metres between estimated and true flow (N, 3)."""
    return np.linalg.norm(flow - truth, axis=1)


def summarise(error: np.ndarray) -> ErrorSummary:
    """Count, mean and median of errors (N,) in metres."""
    if len(error) == 0:
        return ErrorSummary(0, float("nan"), float("nan"))
    return ErrorSummary(len(error), float(error.mean()), float(np.median(error)))


def pose_errors(points: np.ndarray, motions: np.ndarray, true_motion: np.ndarray) -> tuple[float, float]:
    """The paper's t_e [m] and r_e [rad]: mean over points (N, 3) of the error of their motions (N, 4, 4).

    `true_motion` (4, 4) is what every one of the points did (Dewan et al. 2016, section V-A: a static
    scene, where it is the ego-motion). The translation is compared where the variable sits, at its point:
    at the sensor's origin, a turn of the point in place would count by its distance from the sensor.
    """
    if len(motions) == 0:
        return float("nan"), float("nan")
    truth = np.broadcast_to(true_motion, motions.shape)
    off_m = np.linalg.norm(pose.apply(motions, points) - pose.apply(truth, points), axis=1)
    return float(off_m.mean()), float(pose.rotation_distance(truth, motions).mean())


@dataclass(frozen=True, slots=True)
class Scores:
    """One pair against its truth; "graph" counts only points the graph solved, others had the ego-motion."""

    all: ErrorSummary
    static: ErrorSummary
    dynamic: ErrorSummary
    graph_static: ErrorSummary
    graph_dynamic: ErrorSummary
    t_e: float
    r_e_rad: float
    movers_found: float
    false_movers: float
    ego_error_m: float
    ego_error_rad: float


def score(points: np.ndarray, result: FlowResult, truth: Truth) -> Scores:
    """Errors of `result` for the source scan's points (N, 3), over finite rows the truth is valid for."""
    known = truth.valid & np.isfinite(result.flow).all(axis=1)
    moving, still = known & truth.is_dynamic, known & ~truth.is_dynamic
    graph = result.in_graph & result.valid
    error = np.full(len(known), np.nan)
    error[known] = end_point_error(result.flow[known], truth.flow[known])
    rows = still & graph
    t_e, r_e = pose_errors(points[rows], result.motions[rows], truth.ego_motion)
    ego = result.ego_motion[None], truth.ego_motion[None]
    return Scores(
        all=summarise(error[known]),
        static=summarise(error[still]),
        dynamic=summarise(error[moving]),
        graph_static=summarise(error[still & graph]),
        graph_dynamic=summarise(error[moving & graph]),
        t_e=t_e,
        r_e_rad=r_e,
        movers_found=_share(result.is_dynamic[moving]),
        false_movers=_share(result.is_dynamic[still]),
        ego_error_m=float(pose.translation_distance(*ego)[0]),
        ego_error_rad=float(pose.rotation_distance(*ego)[0]),
    )


def _share(mask: np.ndarray) -> float:
    return float(mask.mean()) if len(mask) else float("nan")


def static_truth(points: np.ndarray, ego_motion: np.ndarray) -> Truth:
    """Truth of a static scene from poses alone: every point (N, 3) moves with the sensor."""
    n = len(points)
    return Truth(
        flow=pose.apply(ego_motion, points) - points,
        ego_motion=ego_motion,
        valid=np.isfinite(points).all(axis=1),
        is_dynamic=np.zeros(n, bool),
        object_id=np.full(n, -1),
    )
