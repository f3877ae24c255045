"""Energy of a FlowProblem by direct evaluation, free of any solver, and how far apart two answers are."""

import numpy as np

from lidarflow import pose, robust
from lidarflow.config import SolverConfig


def moved_apart_m(a: np.ndarray, b: np.ndarray, points: np.ndarray) -> float:
    """Largest distance in metres between where two sets of motions put the points."""
    return float(np.linalg.norm(pose.apply(a, points) - pose.apply(b, points), axis=1).max())


def smoothness_residuals(problem, motions, config: SolverConfig) -> np.ndarray:
    """Eq. 10 (E, 6) by direct evaluation, at the point j of every edge or at the sensor."""
    i, j = problem.edges.T
    twist = pose.log(pose.inverse(motions[i]) @ motions[j])
    if config.smoothness_frame == "point":
        seen = np.linalg.inv(pose.adjoint(pose.from_translation(problem.points[j])))
        twist = np.einsum("nij,nj->ni", seen, twist)
    return twist


def match_distances_sq(problem, motions) -> np.ndarray:
    index = problem.match_index
    return ((pose.apply(motions[index], problem.points[index]) - problem.match_target) ** 2).sum(axis=1)


def energy(problem, motions, config: SolverConfig) -> float:
    """Eq. 4 with the kernel of eq. 13, by direct evaluation."""
    loss, _ = robust.truncated(match_distances_sq(problem, motions), config.truncation_m)
    smooth = (smoothness_residuals(problem, motions, config) ** 2).sum()
    return 0.5 * (config.data_weight * loss.sum() + config.smoothness_weight * smooth)
