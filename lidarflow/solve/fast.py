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
from lidarflow.kernels import levenberg_marquardt, parts, pose_graph, queue
from lidarflow.solve import common
from lidarflow.types import FlowProblem, SolveStats

_STEP_TOLERANCE = 0.03    # conjugate gradients stop where less than this is left to add to their gain
_NEGLIGIBLE = 0.03        # or less than this share of the gain below which an iteration is the last
_MAX_PRODUCTS = 50
_SAME_PLACE_M = 0.05      # the equations are set up anew where something has moved farther
_SMALL = 200              # components of fewer variables often have several minima, and are tried twice


def solve(
    problem: FlowProblem, config: SolverConfig, min_matches: int
) -> tuple[np.ndarray, np.ndarray, SolveStats]:
    """Motions (M, 4, 4) of all variables, whether each was solved (M,), and what the solver did.

    As gtsam_lm.solve. Raises SolveError for a problem with numbers that are not finite.
    """
    common.require_finite(problem)
    min_matches = max(min_matches, 1)
    tried = common.matches_per_component(problem) >= min_matches
    motions, kept = np.array(problem.initial, np.float64), np.zeros(len(tried), np.int64)
    figures, kept[tried] = _optimise(problem, tried, config, min_matches, motions)
    steps = [[common.Step(int(f[0]), f[1], f[2], common.AT_LIMIT if f[3] else common.CONVERGED) for f in rows]
             for rows in (figures[:, 0].tolist() if config.plain_first else [], figures[:, 1].tolist())]
    solved, stats = common.concluded("fast", problem, kept >= min_matches, kept, *steps)
    return motions, solved, stats


def _optimise(
    problem: FlowProblem, tried: np.ndarray, config: SolverConfig, min_matches: int, motions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Write the motions of those components `tried` (C,) that have a unique solution.

    Returns figures (C', 2, FIGURES) of the steps of all that are tried, and how many matches (C',) they keep.
    """
    components = parts.split(problem.component, problem.edges, tried)
    largest_first = np.argsort(-np.diff(components.bounds), kind="stable")
    limits = levenberg_marquardt.Limits(
        config.plain_first, config.max_iterations, config.relative_tolerance, common.ABSOLUTE_TOLERANCE,
        _STEP_TOLERANCE, _NEGLIGIBLE, _MAX_PRODUCTS, _SMALL, min_matches, _SAME_PLACE_M)
    return levenberg_marquardt.optimise_each(
        graph_of(problem), weights_of(config), components, largest_first, queue.tasks(),
        numba.get_num_threads(), limits, motions)


def graph_of(problem: FlowProblem) -> pose_graph.Graph:
    """What kernels see of a problem: arrays of one kind, so that these are compiled once."""
    match = np.full(len(problem.points), -1, np.int32)
    match[problem.match_index] = np.arange(len(problem.match_index))
    group = problem.group if len(problem.group) else np.full(len(problem.points), -1)
    return pose_graph.Graph(
        _plain(problem.points), match, _plain(problem.match_target), _plain(group, np.int32),
        _plain(problem.group_motions))


def weights_of(config: SolverConfig) -> pose_graph.Weights:
    """What kernels see of the settings."""
    return pose_graph.Weights(
        config.smoothness_frame == "point", config.data_weight, config.smoothness_weight, config.tie_weight,
        config.truncation_m**2, config.tie_truncation**2)


def _plain(array: np.ndarray, kind: type = np.float64) -> np.ndarray:
    return np.require(array, kind, ("C", "W"))
