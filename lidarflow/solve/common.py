"""What every solver shares: which components count as solved, and what is told about them."""

from collections import Counter
from dataclasses import dataclass

import numpy as np

from lidarflow.errors import SolveError
from lidarflow.types import FlowProblem, SolveStats

ABSOLUTE_TOLERANCE = 1e-9   # an iteration that gains less energy than this is the last one
CONVERGED, AT_LIMIT = "converged", "max_iterations"


@dataclass(frozen=True, slots=True)
class Step:
    """What one optimisation of one component did."""

    iterations: int
    initial_error: float
    final_error: float
    stopped: str


def require_finite(problem: FlowProblem) -> None:
    """Raise SolveError for a problem with numbers that are not finite."""
    for name in ("points", "initial", "match_target", "group_motions"):
        finite = np.isfinite(getattr(problem, name))
        if not finite.all():
            raise SolveError(
                f"FlowProblem.{name}: expected finite numbers, found {int((~finite).sum())} that are not; "
                "leave out what has none")


def matches_per_component(problem: FlowProblem, kept: np.ndarray | None = None) -> np.ndarray:
    """Number (C,) of the matches, or of the `kept` (K,) ones, in every component."""
    count = int(problem.component.max(initial=-1)) + 1
    index = problem.match_index if kept is None else problem.match_index[kept]
    return np.bincount(problem.component[index], minlength=count)


def concluded(
    solver: str, problem: FlowProblem, accepted: np.ndarray, kept: np.ndarray, plain: list[Step],
    robust: list[Step],
) -> tuple[np.ndarray, SolveStats]:
    """Which variables are solved (M,), and what the solver did, of the components `accepted` (C,).

    kept (C,) is how many matches each of them keeps within the truncation.
    """
    solved = accepted[problem.component]
    present = np.bincount(problem.component, minlength=len(accepted)) > 0
    stats = SolveStats(
        solver=solver,
        variables=len(problem.points),
        matches=len(problem.match_index),
        edges=len(problem.edges),
        components=int(present.sum()),
        solved_components=int((present & accepted).sum()),
        plain_iterations=sum(s.iterations for s in plain),
        robust_iterations=sum(s.iterations for s in robust),
        plain_initial_error=sum(s.initial_error for s in plain),
        plain_final_error=sum(s.final_error for s in plain),
        robust_initial_error=sum(s.initial_error for s in robust),
        robust_final_error=sum(s.final_error for s in robust),
        inliers=int(kept[accepted].sum()),
        stopped=dict(sorted(Counter(s.stopped for s in plain + robust).items())),
    )
    return solved, stats
