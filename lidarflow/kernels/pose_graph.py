"""The pointwise factor graph: its exact energy and gradient, and steps of its variables.

A variable is a row x, y, z, w of the rotation's quaternion, then the moved point. A step of it is a twist
(6,), rotation first, about the origin of the target's frame: it turns the rotation, and shifts the point by
what it does there. A gradient is a wrench (6,): torque about the origin, then force.
"""

from collections import namedtuple

import numba
import numpy as np

from lidarflow.kernels import twist_errors
from lidarflow.kernels.compiled import njit
from lidarflow.kernels.rotations import cross, from_matrix, stepped, to_matrix, turned

# points (M, 3); edges (E, 2) i < j, sorted by component; matched (M,) bool, targets (M, 3); tied (M,) bool,
# ties (M, 7) rows as of variables; at_point: eq. 10 seen at the point. Then the weights, and the squares
# that matches and ties are truncated at.
Factors = namedtuple("Factors", (
    "points", "edges", "matched", "targets", "tied", "ties", "at_point", "data_weight", "smoothness_weight",
    "tie_weight", "truncation_sq", "tie_truncation_sq"))


@njit(parallel=True)
def variables_of(motions, rows, points):
    """Variables (M, 7) of the motions in `rows` (M,) of (N, 4, 4), at points (M, 3); zeros for row -1."""
    variables = np.zeros((len(points), 7))
    for i in numba.prange(len(points)):
        if rows[i] >= 0:
            motion = motions[rows[i]]
            x, y, z, w = from_matrix(motion)
            variables[i, 0], variables[i, 1], variables[i, 2], variables[i, 3] = x, y, z, w
            for k in range(3):
                variables[i, 4 + k] = (motion[k, 0] * points[i, 0] + motion[k, 1] * points[i, 1]
                                       + motion[k, 2] * points[i, 2] + motion[k, 3])
    return variables


@njit(parallel=True)
def motions_of(variables, points, rows, motions):
    """Write the motions of variables (M, 7) at points (M, 3) to `rows` (M,) of `motions` (N, 4, 4)."""
    for i in numba.prange(len(points)):
        motion = motions[rows[i]]
        to_matrix(variables[i, 0], variables[i, 1], variables[i, 2], variables[i, 3], motion)
        for k in range(3):
            motion[k, 3] = variables[i, 4 + k] - (
                motion[k, 0] * points[i, 0] + motion[k, 1] * points[i, 1] + motion[k, 2] * points[i, 2])


@njit()
def edges_between(edges, place, count):
    """The edges (E, 2) between what has a place (M,), not -1, as sorted pairs of `count` places."""
    first = np.zeros(count + 1, np.int64)
    for e in range(len(edges)):
        if place[edges[e, 0]] >= 0:
            first[place[edges[e, 0]] + 1] += 1
    first = np.cumsum(first)
    end, found = first[:-1].copy(), np.empty((first[-1], 2), place.dtype)
    for e in range(len(edges)):
        i, j = place[edges[e, 0]], place[edges[e, 1]]
        if i < 0:
            continue
        slot = end[i]
        while slot > first[i] and found[slot - 1, 1] > j:
            found[slot, 0], found[slot, 1] = i, found[slot - 1, 1]
            slot -= 1
        found[slot, 0], found[slot, 1] = i, j
        end[i] += 1
    return found


@njit(error_model="numpy")
def smoothness(factors, variables, nodes, edges, block, wrenches):
    """Energy of the edges from edges[0] to edges[1] (eq. 10), which are all those of the variables
    from nodes[0] to nodes[1], whose gradient is written to `wrenches` (M, 6)."""
    pairs, weight = factors.edges, factors.smoothness_weight
    wrenches[nodes[0]:nodes[1]] = 0.0
    total = 0.0
    for start in range(edges[0], edges[1], twist_errors.WIDTH):
        count = min(twist_errors.WIDTH, edges[1] - start)
        for k in range(count):
            i, j = pairs[start + k, 0], pairs[start + k, 1]
            twist_errors.put_poses(block, k, variables, i, variables, j)
            twist_errors.put_points(block, k, factors.points, i, j, factors.at_point)
        twist_errors.evaluate(block)
        for k in range(count):
            total += twist_errors.square(block, k)
            twist_errors.add_wrench(block, k, weight, wrenches, pairs[start + k, 0])
            twist_errors.add_wrench(block, k, -weight, wrenches, pairs[start + k, 1])
    return 0.5 * weight * total


@njit(error_model="numpy")
def evidence(factors, variables, nodes, robust, block, wrenches, active):
    """Energy of the matches and ties of the variables from nodes[0] to nodes[1]; adds its gradient.

    Fills `active` (M,): 1 for a match that counts, 2 for a tie. With `robust` those beyond the truncation
    do not.
    """
    active[nodes[0]:nodes[1]] = 0
    return (_matches(factors, variables, nodes, robust, wrenches, active)
            + _ties(factors, variables, nodes, robust, block, wrenches, active))


@njit(error_model="numpy")
def _matches(factors, variables, nodes, robust, wrenches, active):
    matched, targets, weight, most = (
        factors.matched, factors.targets, factors.data_weight, factors.truncation_sq)
    total = 0.0
    for i in range(nodes[0], nodes[1]):
        if not matched[i]:
            continue
        x, y, z = variables[i, 4], variables[i, 5], variables[i, 6]
        fx, fy, fz = x - targets[i, 0], y - targets[i, 1], z - targets[i, 2]
        square = fx * fx + fy * fy + fz * fz
        if robust and square > most:
            total += most
            continue
        total += square
        active[i] += 1
        tx, ty, tz = cross(x, y, z, fx, fy, fz)
        wrenches[i, 0] += weight * tx
        wrenches[i, 1] += weight * ty
        wrenches[i, 2] += weight * tz
        wrenches[i, 3] += weight * fx
        wrenches[i, 4] += weight * fy
        wrenches[i, 5] += weight * fz
    return 0.5 * weight * total


@njit(error_model="numpy")
def near_matches(factors, variables, nodes):
    """How many matches of the variables from nodes[0] to nodes[1] are within the truncation, and how many
    there are."""
    matched, targets = factors.matched, factors.targets
    near = count = 0
    for i in range(nodes[0], nodes[1]):
        x, y = variables[i, 4] - targets[i, 0], variables[i, 5] - targets[i, 1]
        z = variables[i, 6] - targets[i, 2]
        count += matched[i]
        near += matched[i] and x * x + y * y + z * z <= factors.truncation_sq
    return near, count


@njit(error_model="numpy")
def _ties(factors, variables, nodes, robust, block, wrenches, active):
    tied, ties, weight, most = factors.tied, factors.ties, factors.tie_weight, factors.tie_truncation_sq
    total = 0.0
    twist_errors.put_together(block)
    for start in range(nodes[0], nodes[1], twist_errors.WIDTH):
        count = min(twist_errors.WIDTH, nodes[1] - start)
        some = False
        for k in range(count):
            twist_errors.put_poses(block, k, ties, start + k, variables, start + k)
            some = some or tied[start + k]
        if not some:
            continue
        twist_errors.evaluate(block)
        for k in range(count):
            if not tied[start + k]:
                continue
            square = twist_errors.square(block, k)
            if robust and square > most:
                total += most
                continue
            total += square
            active[start + k] += 2
            twist_errors.add_wrench(block, k, -weight, wrenches, start + k)
    return 0.5 * weight * total


@njit(error_model="numpy")
def step(variables, nodes, twists, moved):
    """Write the variables nodes[0] .. nodes[1], each moved by its twist of `twists` (M, 6), to `moved`."""
    for i in range(nodes[0], nodes[1]):
        ox, oy, oz = twists[i, 0], twists[i, 1], twists[i, 2]
        ux, uy, uz = cross(ox, oy, oz, variables[i, 4], variables[i, 5], variables[i, 6])
        moved[i, 0], moved[i, 1], moved[i, 2], moved[i, 3] = stepped(
            variables[i, 0], variables[i, 1], variables[i, 2], variables[i, 3], ox, oy, oz)
        moved[i, 4] = variables[i, 4] + ux + twists[i, 3]
        moved[i, 5] = variables[i, 5] + uy + twists[i, 4]
        moved[i, 6] = variables[i, 6] + uz + twists[i, 5]


@njit(error_model="numpy")
def place_levers(factors, variables, nodes, levers):
    """Put `levers` (M, 3) where the twist between a variable and an earlier neighbour is seen.

    That is at the point, or at what the sensor's origin becomes when it moves with the point.
    """
    points, at_point = factors.points, factors.at_point
    for i in range(nodes[0], nodes[1]):
        x = y = z = 0.0
        if not at_point:
            x, y, z = turned(variables[i, 0], variables[i, 1], variables[i, 2], variables[i, 3],
                             points[i, 0], points[i, 1], points[i, 2])
        levers[i, 0], levers[i, 1], levers[i, 2] = (
            variables[i, 4] - x, variables[i, 5] - y, variables[i, 6] - z)
