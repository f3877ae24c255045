"""The pointwise factor graph solved by Levenberg-Marquardt, its normal equations by multigrid.

Energy, steps and stopping rule are those of gtsam_lm.py; small components, which have several minima, are
tried without the first step as well. A variable is moved by a twist in the target's frame, so that the error
between neighbours, Log(τ_i⁻¹ τ_j), changes by K (ξ_j − ξ_i), and a motion that all neighbours share costs
nothing. K is the inverse left Jacobian of the error, which is near the identity, times the adjoint of τ_i⁻¹.
The normal equations leave the first out; energy and gradient are exact, so the minimum is. What K leaves of
the normal equations adds up like inertia (kernels/inertia.py).
"""

import numba
import numpy as np

from lidarflow.config import SolverConfig
from lidarflow.kernels import hierarchy, levenberg_marquardt, multigrid, pose_graph, queue
from lidarflow.solve import common
from lidarflow.types import FlowProblem, SolveStats

_STEP_TOLERANCE = 0.03    # conjugate gradients stop where less than this is left to add to their gain
_NEGLIGIBLE = 0.03        # or less than this share of the gain below which an iteration is the last
_MAX_PRODUCTS = 50
_SMALL = 200              # components of fewer variables often have several minima, and are tried twice


def solve(
    problem: FlowProblem, config: SolverConfig, min_matches: int
) -> tuple[np.ndarray, np.ndarray, SolveStats]:
    """Motions (M, 4, 4) of all variables, whether each was solved (M,), and what the solver did.

    As gtsam_lm.solve. Raises SolveError for a problem with numbers that are not finite.
    """
    common.require_finite(problem)
    tried = common.matches_per_component(problem) >= max(min_matches, 1)
    found = problem.initial.copy()
    figures = np.zeros((0, 2, levenberg_marquardt.FIGURES))
    if tried.any():
        figures = _optimise(problem, tried, config, max(min_matches, 1), found)
    steps = [[common.Step(int(f[0]), f[1], f[2], common.AT_LIMIT if f[3] else common.CONVERGED) for f in rows]
             for rows in (figures[:, 0].tolist(), figures[:, 1].tolist())]
    return common.concluded("fast", problem, found, tried, *steps, config, min_matches)


def _optimise(
    problem: FlowProblem, tried: np.ndarray, config: SolverConfig, min_matches: int, motions: np.ndarray
) -> np.ndarray:
    """Write the motions of the components `tried` (C,); returns figures (C', 2, FIGURES) of their steps."""
    label = np.where(tried, np.cumsum(tried) - 1, -1)[problem.component]
    rows = np.flatnonzero(label >= 0)
    rows = rows[np.argsort(label[rows], kind="stable")]
    place = np.full(len(label), -1, np.int32)
    place[rows] = np.arange(len(rows), dtype=np.int32)
    counts = np.bincount(label[rows], minlength=tried.sum())
    bounds = np.concatenate([[0], np.cumsum(counts)])

    edges = pose_graph.edges_between(problem.edges, place, len(rows))
    edge_bounds = np.searchsorted(edges[:, 0], bounds)
    points = problem.points[rows]
    factors = factors_of(problem, rows, place, points, edges, config)
    levels = hierarchy.build(edges, bounds, config.smoothness_weight)
    variables = pose_graph.variables_of(problem.initial, rows, points)
    # Twists are about the origin of the target's frame: each component gets one of its own, near to it.
    origin = np.repeat(variables[bounds[:-1], 4:], counts, axis=0)
    for positions in (variables[:, 4:], factors.targets, factors.ties[:, 4:]):
        positions -= origin
    largest_first = np.argsort(-counts, kind="stable")
    limits = levenberg_marquardt.Limits(
        config.max_iterations, config.relative_tolerance, common.ABSOLUTE_TOLERANCE, _STEP_TOLERANCE,
        _NEGLIGIBLE, _MAX_PRODUCTS, _SMALL, min_matches)
    figures = levenberg_marquardt.optimise_each(
        factors, levels, multigrid.room_for(levels), edge_bounds, largest_first, queue.tasks(),
        numba.get_num_threads(), limits, levenberg_marquardt.state_at(variables))
    variables[:, 4:] += origin
    pose_graph.motions_of(variables, points, rows, motions)
    return figures


def factors_of(
    problem: FlowProblem, rows: np.ndarray, place: np.ndarray, points: np.ndarray, edges: np.ndarray,
    config: SolverConfig,
) -> pose_graph.Factors:
    """Factors of the variables `rows` (M',) of a problem, at `points` (M', 3), in that order.

    place (M,) is where each variable of the problem is in it, or -1; edges (E', 2) are between places.
    """
    matched, targets = np.zeros(len(rows), bool), np.zeros((len(rows), 3))
    index = place[problem.match_index]
    matched[index[index >= 0]] = True
    targets[index[index >= 0]] = problem.match_target[index >= 0]
    group = problem.group[rows] if len(problem.group) else np.full(len(rows), -1, np.int32)
    ties = pose_graph.variables_of(problem.group_motions, group, points)
    return pose_graph.Factors(
        points, edges, matched, targets, group >= 0, ties, config.smoothness_frame == "point",
        config.data_weight, config.smoothness_weight, config.tie_weight, config.truncation_m**2,
        config.tie_truncation**2)

