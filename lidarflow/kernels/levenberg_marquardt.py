"""Levenberg-Marquardt on every component of a pose graph by itself, each worked on by one thread."""

from collections import namedtuple

import numba
import numpy as np

from lidarflow.kernels import multigrid, pose_graph, queue, twist_errors
from lidarflow.kernels.compiled import njit
from lidarflow.kernels.hierarchy import build, weigh

# Without `plain_first` only the second step is made, from the start values.
# Where an iteration gains less than relative_tolerance of the energy, or absolute_tolerance, it is the last,
# unless the kernel let go or took back a match or a tie: then the next one may gain more. Components of fewer
# than `small` variables may be tried twice, see `_try_again`. The equations are set up anew where a lever has
# moved farther than `same_place` since; energy and gradient are exact, whatever these are. The others are
# those of multigrid.solve, with what is negligible as a share of the gain below which one is the last.
Limits = namedtuple("Limits", (
    "plain_first", "max_iterations", "relative_tolerance", "absolute_tolerance", "step_tolerance",
    "negligible", "max_products", "small", "min_matches", "same_place"))
_FIRST_DAMPING, _MOST_DAMPING, _DAMPING_FACTOR = 1e-5, 1e5, 10.0    # as in gtsam
_SURELY_LESS = 0.03    # a cycle foresees at least this share of what there is to gain
_CLEARLY_LOWER = 0.99  # below this share of an energy, another minimum is worth leaving gtsam's answer for
FIGURES = 5            # iterations, first energy, last energy, whether the limit was reached, products

# variables (M, 7), those on trial, and start values or what another try ended with; gradients (2, M, 6) of
# the smoothness and of all of the energy, and active (2, M) matches and ties: one for the variables, one for
# those on trial, in turns; and a block of pairs for twist_errors.
State = namedtuple("State", (
    "variables", "trials", "others", "smoothness", "gradients", "active", "block"))


@njit()
def state_at(variables):
    """Room to optimise variables (M, 7) in."""
    count = len(variables)
    return State(variables, np.empty_like(variables), variables.copy(), np.empty((2, count, 6)),
                 np.empty((2, count, 6)), np.empty((2, count), np.uint8), twist_errors.room())


@njit(parallel=True)
def optimise_each(graph, weights, parts, order, waiting, threads, limits, motions):
    """Move the variables of all parts to the minimum: without (if wanted), then with the truncated kernels.

    motions (N, 4, 4) are those of the graph to start from, and become what is found. Each of so many threads
    takes the next part of `order` (C,) from the queue `waiting` when it has done one; who does which changes
    nothing. Returns figures (C, 2, FIGURES) of both steps, and how many matches (C,) each part keeps within
    the truncation; with fewer than limits.min_matches it has no unique solution, and keeps its motions.
    """
    figures, kept = np.zeros((len(order), 2, FIGURES)), np.zeros(len(order), np.int64)
    for _ in numba.prange(threads):
        task = queue.take(waiting)
        while task < len(order):
            c = order[task]
            kept[c] = _optimise(graph, weights, parts, c, limits, motions, figures[c])
            task = queue.take(waiting)
    return figures, kept


@njit(error_model="numpy")
def _optimise(graph, weights, parts, c, limits, motions, figures):
    """The steps for part c; the second starts with the smoothness that the first ended with.

    Returns how many matches it keeps.
    """
    rows = parts.rows[parts.bounds[c]:parts.bounds[c + 1]]
    edges = pose_graph.edges_between(
        parts.edges[parts.edge_bounds[c]:parts.edge_bounds[c + 1]], parts.place, len(rows))
    factors = pose_graph.factors_of(graph, weights, rows, edges)
    variables = pose_graph.variables_of(motions, rows, factors.points)
    # Twists are about the origin of the target's frame: each part gets one of its own, near to it.
    origin = variables[0, 4:].copy()
    pose_graph.recentre(variables, factors, origin)
    hierarchy, state = build(edges, len(rows), weights.smoothness), state_at(variables)
    room = multigrid.room_for(hierarchy)

    near, count = pose_graph.near_matches(factors, variables)
    smooth = pose_graph.smoothness(factors, variables, state.block, state.smoothness[0])
    here = 0
    for robust in range(0 if limits.plain_first else 1, 2):
        smooth, here = _step(
            factors, hierarchy, room, limits, state, robust == 1, smooth, here, figures[robust])
    if limits.plain_first and len(rows) < limits.small and limits.min_matches <= near < count:
        _try_again(factors, hierarchy, room, limits, state, figures[1])
    near, _ = pose_graph.near_matches(factors, variables)
    if near >= limits.min_matches:
        variables[:, 4:] += origin
        pose_graph.motions_of(variables, factors.points, rows, motions)
    return near


@njit(error_model="numpy")
def _try_again(factors, hierarchy, room, limits, state, figures):
    """The second step from the start value, kept if it ends clearly lower.

    Without truncation a few wrong matches lead a small component to another minimum, often a higher one. What
    would keep too few matches to count as solved is no better, however low.
    """
    variables, others = state.variables, state.others
    for i in range(len(variables)):
        for k in range(variables.shape[1]):
            variables[i, k], others[i, k] = others[i, k], variables[i, k]
    again = np.zeros(FIGURES)
    smooth = pose_graph.smoothness(factors, variables, state.block, state.smoothness[0])
    _step(factors, hierarchy, room, limits, state, True, smooth, 0, again)
    figures[0] += again[0]
    figures[4] += again[4]
    near, _ = pose_graph.near_matches(factors, variables)
    if again[2] < _CLEARLY_LOWER * figures[2] and near >= limits.min_matches:
        figures[2:4] = again[2:4]
    else:
        variables[:] = others


@njit(error_model="numpy")
def _energy(factors, variables, robust, smooth, state, where):
    """Energy whose smoothness is known, with its gradient."""
    state.gradients[where] = state.smoothness[where]
    return smooth + pose_graph.evidence(
        factors, variables, robust, state.block, state.gradients[where], state.active[where])


@njit(error_model="numpy")
def _step(factors, hierarchy, room, limits, state, robust, smooth, here, figures):
    """Optimise; returns the smoothness and where its gradient is, and fills `figures`."""
    variables, trials, active = state.variables, state.trials, state.active
    energy = _energy(factors, variables, robust, smooth, state, here)
    figures[1] = energy
    damping = _FIRST_DAMPING
    held = False
    while figures[0] < limits.max_iterations and damping <= _MOST_DAMPING:
        if pose_graph.place_levers(factors, variables, limits.same_place, hierarchy.lever):
            weigh(hierarchy)
            held = False
        if not held:
            multigrid.hold(hierarchy, room, variables[:, 4:], active[here], factors.weights.data,
                           factors.weights.tie, damping)
            held = True
        least = max(limits.relative_tolerance * energy, limits.absolute_tolerance)
        products = multigrid.solve(
            hierarchy, room, state.gradients[here], limits.step_tolerance, limits.negligible * least,
            _SURELY_LESS * least, limits.max_products)
        if products < 0:
            figures[0] += 1
            break
        figures[4] += products
        pose_graph.step(variables, room.step, trials)
        there = 1 - here
        trial_smooth = pose_graph.smoothness(factors, trials, state.block, state.smoothness[there])
        found = _energy(factors, trials, robust, trial_smooth, state, there)
        gained = energy - found
        if not gained >= 0.0:
            damping *= _DAMPING_FACTOR
            held = False
            continue
        figures[0] += 1
        held = damping == _FIRST_DAMPING
        damping = max(damping / _DAMPING_FACTOR, _FIRST_DAMPING)
        variables[:] = trials
        settled = np.array_equal(active[here], active[there])
        held = held and settled
        energy, smooth, here = found, trial_smooth, there
        if gained < least and settled:
            break
    figures[2] = energy
    figures[3] = figures[0] >= limits.max_iterations
    return smooth, here
