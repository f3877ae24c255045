"""Levenberg-Marquardt on every component of a pose graph by itself, each worked on by one thread."""

from collections import namedtuple

import numba
import numpy as np

from lidarflow.kernels import multigrid, pose_graph
from lidarflow.kernels.compiled import njit
from lidarflow.kernels.hierarchy import weigh

# Where an iteration gains less than relative_tolerance of the energy, or absolute_tolerance, it is the last.
# The others are those of multigrid.solve.
Limits = namedtuple("Limits", (
    "max_iterations", "relative_tolerance", "absolute_tolerance", "step_tolerance", "max_products",
    "correction"))
_FIRST_DAMPING, _MOST_DAMPING, _DAMPING_FACTOR = 1e-5, 1e5, 10.0    # as in gtsam
_SURELY_LESS = 0.03    # a cycle foresees at least this share of what there is to gain
FIGURES = 5            # iterations, first energy, last energy, whether the limit was reached, products

# variables (M, 7) and those on trial; places (M, 3); gradients (2, M, 6) of the smoothness and of all of the
# energy, and active (2, M) matches and ties: one for the variables, one for those on trial, in turns.
State = namedtuple("State", ("variables", "trials", "places", "smoothness", "gradients", "active"))


def state_at(variables: np.ndarray) -> State:
    """Room to optimise variables (M, 7) in."""
    count = len(variables)
    return State(variables, np.empty_like(variables), np.empty((count, 3)), np.empty((2, count, 6)),
                 np.empty((2, count, 6)), np.empty((2, count), np.uint8))


@njit(parallel=True)
def optimise_each(factors, hierarchy, room, edge_bounds, shares, share_bounds, limits, state):
    """Move the variables to the minimum: without, then with the truncated kernels.

    Thread t does the components shares[share_bounds[t]:share_bounds[t + 1]], by themselves. Returns figures
    (C, 2, FIGURES) of both steps.
    """
    figures = np.zeros((hierarchy.bounds.shape[1] - 1, 2, FIGURES))
    for t in numba.prange(len(share_bounds) - 1):
        for k in range(share_bounds[t], share_bounds[t + 1]):
            c = shares[k]
            edges = (edge_bounds[c], edge_bounds[c + 1])
            _optimise(factors, hierarchy, room, c, edges, limits, state, figures[c])
    return figures


@njit(error_model="numpy")
def _optimise(factors, hierarchy, room, c, edges, limits, state, figures):
    """Both steps for component c; the second starts with the smoothness that the first ended with."""
    nodes = (hierarchy.bounds[0, c], hierarchy.bounds[0, c + 1])
    state.places[nodes[0]:nodes[1]] = state.variables[nodes[0]:nodes[1], 4:]
    smooth = pose_graph.smoothness(
        factors, state.variables, state.places, nodes, edges, state.smoothness[0])
    here = 0
    for robust in range(2):
        smooth, here = _step(factors, hierarchy, room, c, nodes, edges, limits, state, robust == 1,
                             smooth, here, figures[robust])


@njit(error_model="numpy")
def _linearise(factors, hierarchy, c, nodes, state, here):
    """Normal equations where the variables are now."""
    pose_graph.displace(state.places, state.variables, nodes, state.smoothness[here])
    pose_graph.displace(state.places, state.variables, nodes, state.gradients[here])
    pose_graph.place(factors, state.variables, nodes, state.places, hierarchy.lever)
    weigh(hierarchy, c)


@njit(error_model="numpy")
def _energy(factors, variables, nodes, robust, smooth, state, where):
    """Energy whose smoothness is known, with its gradient."""
    first, last = nodes
    state.gradients[where, first:last] = state.smoothness[where, first:last]
    return smooth + pose_graph.evidence(
        factors, variables, state.places, nodes, robust, state.gradients[where], state.active[where])


@njit(error_model="numpy")
def _step(factors, hierarchy, room, c, nodes, edges, limits, state, robust, smooth, here, figures):
    """Optimise component c; returns the smoothness and where its gradient is, and fills `figures`."""
    first, last = nodes
    variables, trials, active = state.variables, state.trials, state.active
    energy = _energy(factors, variables, nodes, robust, smooth, state, here)
    _linearise(factors, hierarchy, c, nodes, state, here)
    figures[1] = energy
    damping = _FIRST_DAMPING
    while figures[0] < limits.max_iterations and damping <= _MOST_DAMPING:
        multigrid.hold(
            hierarchy, room, c, state.places, active[here], factors.data_weight, factors.tie_weight, damping)
        least = max(limits.relative_tolerance * energy, limits.absolute_tolerance)
        products = multigrid.solve(
            hierarchy, room, c, state.gradients[here], limits.step_tolerance, _SURELY_LESS * least,
            limits.max_products, limits.correction)
        figures[4] += products
        if products == 0:
            figures[0] += 1
            break
        pose_graph.step(variables, state.places, nodes, room.step, trials)
        there = 1 - here
        trial_smooth = pose_graph.smoothness(
            factors, trials, state.places, nodes, edges, state.smoothness[there])
        found = _energy(factors, trials, nodes, robust, trial_smooth, state, there)
        gained = energy - found
        if not gained >= 0.0:
            damping *= _DAMPING_FACTOR
            continue
        figures[0] += 1
        damping = max(damping / _DAMPING_FACTOR, _FIRST_DAMPING)
        variables[first:last] = trials[first:last]
        energy, smooth, here = found, trial_smooth, there
        if gained < least:
            break
        _linearise(factors, hierarchy, c, nodes, state, here)
    figures[2] = energy
    figures[3] = figures[0] >= limits.max_iterations
    return smooth, here
