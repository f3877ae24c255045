"""Levenberg-Marquardt on every component of a pose graph by itself, each worked on by one thread."""

from collections import namedtuple

import numba
import numpy as np

from lidarflow.kernels import multigrid, pose_graph, queue, twist_errors
from lidarflow.kernels.compiled import njit
from lidarflow.kernels.hierarchy import weigh

# Where an iteration gains less than relative_tolerance of the energy, or absolute_tolerance, it is the last,
# unless the kernel let go or took back a match or a tie: then the next one may gain more. Components of fewer
# than `small` variables may be tried twice, see `_try_again`. The others are those of multigrid.solve, with
# what is negligible as a share of the gain below which an iteration is the last.
Limits = namedtuple("Limits", (
    "max_iterations", "relative_tolerance", "absolute_tolerance", "step_tolerance", "negligible",
    "max_products", "small", "min_matches"))
_FIRST_DAMPING, _MOST_DAMPING, _DAMPING_FACTOR = 1e-5, 1e5, 10.0    # as in gtsam
_SURELY_LESS = 0.03    # a cycle foresees at least this share of what there is to gain
_CLEARLY_LOWER = 0.99  # below this share of an energy, another minimum is worth leaving gtsam's answer for
FIGURES = 5            # iterations, first energy, last energy, whether the limit was reached, products

# variables (M, 7), those on trial, and start values or what another try ended with; gradients (2, M, 6) of
# the smoothness and of all of the energy, and active (2, M) matches and ties: one for the variables, one for
# those on trial, in turns.
State = namedtuple("State", ("variables", "trials", "others", "smoothness", "gradients", "active"))


def state_at(variables: np.ndarray) -> State:
    """Room to optimise variables (M, 7) in."""
    count = len(variables)
    return State(variables, np.empty_like(variables), variables.copy(), np.empty((2, count, 6)),
                 np.empty((2, count, 6)), np.empty((2, count), np.uint8))


@njit(parallel=True)
def optimise_each(factors, hierarchy, room, edge_bounds, order, waiting, threads, limits, state):
    """Move the variables to the minimum: without, then with the truncated kernels.

    Each of so many threads takes the next component of `order` (C,) from the queue `waiting` when it has done
    one; who does which changes nothing. Returns figures (C, 2, FIGURES) of both steps.
    """
    figures = np.zeros((hierarchy.bounds.shape[1] - 1, 2, FIGURES))
    for _ in numba.prange(threads):
        block = twist_errors.room()
        task = queue.take(waiting)
        while task < len(order):
            c = order[task]
            edges = (edge_bounds[c], edge_bounds[c + 1])
            _optimise(factors, hierarchy, room, c, edges, limits, state, block, figures[c])
            task = queue.take(waiting)
    return figures


@njit(error_model="numpy")
def _optimise(factors, hierarchy, room, c, edges, limits, state, block, figures):
    """Both steps for component c; the second starts with the smoothness that the first ended with."""
    nodes = (hierarchy.bounds[0, c], hierarchy.bounds[0, c + 1])
    near, count = pose_graph.near_matches(factors, state.variables, nodes)
    smooth = pose_graph.smoothness(factors, state.variables, nodes, edges, block, state.smoothness[0])
    here = 0
    for robust in range(2):
        smooth, here = _step(factors, hierarchy, room, c, nodes, edges, limits, state, block,
                             robust == 1, smooth, here, figures[robust])
    if nodes[1] - nodes[0] < limits.small and limits.min_matches <= near < count:
        _try_again(factors, hierarchy, room, c, nodes, edges, limits, state, block, figures[1])


@njit(error_model="numpy")
def _try_again(factors, hierarchy, room, c, nodes, edges, limits, state, block, figures):
    """The second step for component c from the start value, kept if it ends clearly lower.

    Without truncation a few wrong matches lead a small component to another minimum, often a higher one. What
    would keep too few matches to count as solved is no better, however low.
    """
    first, last = nodes
    variables, others = state.variables, state.others
    for i in range(first, last):
        for k in range(variables.shape[1]):
            variables[i, k], others[i, k] = others[i, k], variables[i, k]
    again = np.zeros(FIGURES)
    smooth = pose_graph.smoothness(factors, variables, nodes, edges, block, state.smoothness[0])
    _step(factors, hierarchy, room, c, nodes, edges, limits, state, block, True, smooth, 0, again)
    figures[0] += again[0]
    figures[4] += again[4]
    near, _ = pose_graph.near_matches(factors, variables, nodes)
    if again[2] < _CLEARLY_LOWER * figures[2] and near >= limits.min_matches:
        figures[2:4] = again[2:4]
    else:
        variables[first:last] = others[first:last]


@njit(error_model="numpy")
def _energy(factors, variables, nodes, robust, smooth, state, block, where):
    """Energy whose smoothness is known, with its gradient."""
    first, last = nodes
    state.gradients[where, first:last] = state.smoothness[where, first:last]
    return smooth + pose_graph.evidence(
        factors, variables, nodes, robust, block, state.gradients[where], state.active[where])


@njit(error_model="numpy")
def _step(factors, hierarchy, room, c, nodes, edges, limits, state, block, robust, smooth, here, figures):
    """Optimise component c; returns the smoothness and where its gradient is, and fills `figures`."""
    first, last = nodes
    variables, trials, active = state.variables, state.trials, state.active
    energy = _energy(factors, variables, nodes, robust, smooth, state, block, here)
    figures[1] = energy
    damping = _FIRST_DAMPING
    moved = True
    while figures[0] < limits.max_iterations and damping <= _MOST_DAMPING:
        if moved:
            pose_graph.place_levers(factors, variables, nodes, hierarchy.lever)
            weigh(hierarchy, c)
        multigrid.hold(hierarchy, room, c, variables[:, 4:], active[here], factors.data_weight,
                       factors.tie_weight, damping)
        least = max(limits.relative_tolerance * energy, limits.absolute_tolerance)
        products = multigrid.solve(
            hierarchy, room, c, state.gradients[here], limits.step_tolerance, limits.negligible * least,
            _SURELY_LESS * least, limits.max_products)
        if products < 0:
            figures[0] += 1
            break
        figures[4] += products
        pose_graph.step(variables, nodes, room.step, trials)
        there = 1 - here
        trial_smooth = pose_graph.smoothness(factors, trials, nodes, edges, block, state.smoothness[there])
        found = _energy(factors, trials, nodes, robust, trial_smooth, state, block, there)
        gained = energy - found
        moved = gained >= 0.0
        if not moved:
            damping *= _DAMPING_FACTOR
            continue
        figures[0] += 1
        damping = max(damping / _DAMPING_FACTOR, _FIRST_DAMPING)
        variables[first:last] = trials[first:last]
        settled = np.array_equal(active[here, first:last], active[there, first:last])
        energy, smooth, here = found, trial_smooth, there
        if gained < least and settled:
            break
    figures[2] = energy
    figures[3] = figures[0] >= limits.max_iterations
    return smooth, here
