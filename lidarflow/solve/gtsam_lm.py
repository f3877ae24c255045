"""The pointwise factor graph solved by Levenberg-Marquardt in gtsam; the only importer of gtsam.

Every variable sits at its own point, X_i = τ_i · Trans(p_i), so that gtsam's native factors are all that is
needed: a translation prior for a match, a between factor for two mesh neighbours.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import gtsam
import numpy as np

from lidarflow import pose
from lidarflow.config import SolverConfig
from lidarflow.solve import common
from lidarflow.solve.common import Step
from lidarflow.types import FlowProblem, SolveStats

_EYE = gtsam.Rot3()


def solve(
    problem: FlowProblem, config: SolverConfig, min_matches: int
) -> tuple[np.ndarray, np.ndarray, SolveStats]:
    """Motions (M, 4, 4) of all variables, whether each was solved (M,), and what the solver did.

    Components are independent problems (Dewan et al. 2016, section IV). Each is optimised first without (if
    config.plain_first), then with the truncated kernel (eq. 13). A component with fewer than `min_matches`
    matches, or whose matches the kernel lets go until fewer are left, has no unique solution and keeps its
    start value. Raises SolveError for a problem with numbers that are not finite.
    """
    common.require_finite(problem)
    found = problem.initial.copy()
    min_matches = max(min_matches, 1)
    tried = common.matches_per_component(problem) >= min_matches
    plain: list[Step] = []
    robust = []
    for part in _components(problem):
        if not tried[problem.component[part.rows[0]]]:
            continue
        found[part.rows], (*first, last) = _solve_component(part, config)
        plain += first
        robust.append(last)
    index = problem.match_index
    off_m = pose.apply(found[index], problem.points[index]) - problem.match_target
    kept = common.matches_per_component(problem, (off_m**2).sum(axis=1) <= config.truncation_m**2)
    solved, stats = common.concluded(
        "gtsam", problem, tried & (kept >= min_matches), kept, plain, robust)
    return np.where(solved[:, None, None], found, problem.initial), solved, stats


@dataclass(frozen=True, slots=True, eq=False)
class _Component:
    """The part of a FlowProblem that belongs to one mesh component, indices but `rows` within it.

    rows  (M,)         its variables in the problem
    tied  (T,)         the variables that have a group, and
    tie   (T, 4, 4)    the motions of their groups
    """

    rows: np.ndarray
    points: np.ndarray
    initial: np.ndarray
    match_index: np.ndarray
    match_target: np.ndarray
    edges: np.ndarray
    tied: np.ndarray
    tie: np.ndarray


def _components(problem: FlowProblem) -> Iterator[_Component]:
    """The components of a problem that have matches, in ascending order."""
    count = int(problem.component.max()) + 1 if len(problem.component) else 0
    local = np.empty(len(problem.points), np.int64)
    rows_of = _grouped(problem.component, count)
    matches_of = _grouped(problem.component[problem.match_index], count)
    edges_of = _grouped(problem.component[problem.edges[:, 0]], count)
    group = problem.group if len(problem.group) else np.full(len(problem.points), -1)
    for rows, matches, edges in zip(rows_of, matches_of, edges_of, strict=True):
        if len(matches) == 0:
            continue
        local[rows] = np.arange(len(rows))
        tied = np.flatnonzero(group[rows] >= 0)
        yield _Component(
            rows, problem.points[rows], problem.initial[rows], local[problem.match_index[matches]],
            problem.match_target[matches], local[problem.edges[edges]], tied,
            problem.group_motions[group[rows[tied]]])


def _grouped(label: np.ndarray, count: int) -> list[np.ndarray]:
    """Row numbers of each label 0 .. count-1, ascending."""
    order = np.argsort(label, kind="stable")
    return np.split(order, np.searchsorted(label[order], np.arange(1, count))) if count else []


def _solve_component(part: _Component, config: SolverConfig) -> tuple[np.ndarray, list[Step]]:
    """Motions (M, 4, 4) of a component, and the steps that led there, the truncated one last."""
    smoothness = _smoothness_factors(part, config)
    values = _values(part.initial, part.points)
    steps = []
    noises = [(_robust_data_noise(config), _robust_tie_noise(config))]
    if config.plain_first:
        noises.insert(0, (_data_noise(config), _tie_noise(config)))
    for data_noise, tie_noise in noises:
        graph = gtsam.NonlinearFactorGraph(smoothness)
        graph.push_back(_data_factors(part, data_noise))
        graph.push_back(_tie_factors(part, tie_noise))
        values, step = _optimise(graph, values, config)
        steps.append(step)
    return _motions(values, part.points), steps


def _values(motions: np.ndarray, points: np.ndarray) -> gtsam.Values:
    """The variables X_i = τ_i · Trans(p_i) of motions (M, 4, 4) at points (M, 3)."""
    values = gtsam.Values()
    for i, (motion, moved) in enumerate(zip(motions, pose.apply(motions, points), strict=True)):
        values.insert(i, gtsam.Pose3(gtsam.Rot3(motion[:3, :3]), moved))
    return values


def _motions(values: gtsam.Values, points: np.ndarray) -> np.ndarray:
    """Motions (M, 4, 4) of the variables at points (M, 3): τ_i = X_i · Trans(−p_i)."""
    at_point = gtsam.utilities.extractPose3(values)   # rows: rotation (9, row-major), translation (3)
    rotation, moved = at_point[:, :9].reshape(-1, 3, 3), at_point[:, 9:]
    return pose.from_rotation_translation(rotation, moved - np.einsum("nij,nj->ni", rotation, points))


def _data_factors(part: _Component, noise) -> gtsam.NonlinearFactorGraph:
    """The data term of every match: τ_i p_i − p'_i, the variable's own translation off its match."""
    graph = gtsam.NonlinearFactorGraph()
    for i, target in zip(part.match_index.tolist(), part.match_target, strict=True):
        graph.add(gtsam.PoseTranslationPrior3D(i, target, noise))
    return graph


def _tie_factors(part: _Component, noise) -> gtsam.NonlinearFactorGraph:
    """The tie of a variable to its group's motion G: the twist from G to τ_i, seen at the point."""
    graph = gtsam.NonlinearFactorGraph()
    moved = pose.apply(part.tie, part.points[part.tied])
    for i, motion, place in zip(part.tied.tolist(), part.tie, moved, strict=True):
        graph.add(gtsam.PriorFactorPose3(i, gtsam.Pose3(gtsam.Rot3(motion[:3, :3]), place), noise))
    return graph


def _tie_noise(config: SolverConfig):
    return gtsam.noiseModel.Isotropic.Precision(6, config.tie_weight)


def _robust_tie_noise(config: SolverConfig):
    """Truncated: a point that its matches and neighbours pull away farther than this is let go."""
    kernel = gtsam.noiseModel.mEstimator.TruncatedLeastSquares(
        config.tie_truncation * np.sqrt(config.tie_weight))
    return gtsam.noiseModel.Robust.Create(kernel, _tie_noise(config))


def _data_noise(config: SolverConfig):
    return gtsam.noiseModel.Isotropic.Precision(3, config.data_weight)


def _robust_data_noise(config: SolverConfig):
    """Eq. 13 on the distance in metres: gtsam applies the kernel to the whitened residual."""
    c = config.truncation_m * np.sqrt(config.data_weight)
    kernel = gtsam.noiseModel.mEstimator.TruncatedLeastSquares(c)
    return gtsam.noiseModel.Robust.Create(kernel, _data_noise(config))


def _smoothness_factors(part: _Component, config: SolverConfig) -> gtsam.NonlinearFactorGraph:
    """Eq. 10 for every mesh edge: the twist between neighbours, seen at the point or at the sensor."""
    graph = gtsam.NonlinearFactorGraph()
    at_point = gtsam.noiseModel.Isotropic.Precision(6, config.smoothness_weight)
    seen_at_point = config.smoothness_frame == "point"
    for i, j in part.edges.tolist():
        noise = at_point if seen_at_point else _sensor_frame_noise(part.points[j], config)
        offset = gtsam.Pose3(_EYE, part.points[j] - part.points[i])
        graph.add(gtsam.BetweenFactorPose3(i, j, offset, noise))
    return graph


def _sensor_frame_noise(point: np.ndarray, config: SolverConfig):
    """The factor's error is Ad(Trans(p_j))⁻¹ ξ; information AᵀA with A = Ad(Trans(p_j)) gives back ‖ξ‖²."""
    adjoint = pose.adjoint(pose.from_translation(point))
    return gtsam.noiseModel.Gaussian.Information(config.smoothness_weight * adjoint.T @ adjoint)


def _optimise(graph, values, config: SolverConfig) -> tuple[gtsam.Values, Step]:
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(config.max_iterations)
    parameters.setRelativeErrorTol(config.relative_tolerance)
    parameters.setAbsoluteErrorTol(common.ABSOLUTE_TOLERANCE)
    initial_error = graph.error(values)
    optimiser = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters)
    values = optimiser.optimize()
    iterations = optimiser.iterations()
    stopped = common.AT_LIMIT if iterations >= config.max_iterations else common.CONVERGED
    return values, Step(iterations, initial_error, optimiser.error(), stopped)
