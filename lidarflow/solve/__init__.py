"""Solvers of the pointwise factor graph: one problem, one energy, one form of answer."""

import numpy as np

from lidarflow.config import SolverConfig
from lidarflow.types import FlowProblem, SolveStats


def solve(
    problem: FlowProblem, config: SolverConfig, min_matches: int
) -> tuple[np.ndarray, np.ndarray, SolveStats]:
    """Motions (M, 4, 4) of all variables, whether each was solved (M,), and what the solver did.

    By the solver that the settings name; what is not called is not loaded. Raises SolveError.
    """
    if config.method == "gtsam":
        from lidarflow.solve import gtsam_lm as solver
    else:
        from lidarflow.solve import fast as solver
    return solver.solve(problem, config, min_matches)
