"""The pointwise factor graph: its exact energy and gradient, and steps of its variables.

A variable is a row x, y, z, w of the rotation's quaternion, then the moved point. A step of it is a twist
(6,), rotation first, about the origin of the target's frame: it turns the rotation, and shifts the point by
what it does there. A gradient is a wrench (6,): torque about the origin, then force.
"""

from collections import namedtuple

import numpy as np

from lidarflow.kernels import inertia, twist_errors
from lidarflow.kernels.compiled import FUSED, njit
from lidarflow.kernels.rotations import cross, from_matrix, stepped, to_matrix, turned

# A whole problem: points (N, 3); match (N,) is which of the targets (K, 3) a variable has, group (N,) which
# of the motions (G, 4, 4) it is tied to, -1 = none.
Graph = namedtuple("Graph", ("points", "match", "targets", "group", "group_motions"))
# at_point: eq. 10 seen at the point. Then what terms count, and the squares that they are truncated at.
Weights = namedtuple("Weights", (
    "at_point", "data", "smoothness", "tie", "truncation_sq", "tie_truncation_sq"))
# A part of it: points (M, 3); edges (E, 2) i < j, sorted; matched (M,) bool, targets (M, 3); tied (M,) bool,
# ties (M, 7) rows as of variables.
Factors = namedtuple("Factors", ("points", "edges", "matched", "targets", "tied", "ties", "weights"))


@njit()
def factors_of(graph, weights, rows, edges):
    """Factors of the variables `rows` (M,) of a graph, with edges (E, 2) between their places among these."""
    points, targets = np.empty((len(rows), 3)), np.zeros((len(rows), 3))
    matched, tied = np.zeros(len(rows), np.bool_), np.zeros(len(rows), np.bool_)
    for i in range(len(rows)):
        match = graph.match[rows[i]]
        matched[i], tied[i] = match >= 0, graph.group[rows[i]] >= 0
        for k in range(3):
            points[i, k] = graph.points[rows[i], k]
            if match >= 0:
                targets[i, k] = graph.targets[match, k]
    ties = variables_of(graph.group_motions, graph.group[rows], points)
    return Factors(points, edges, matched, targets, tied, ties, weights)


@njit()
def variables_of(motions, rows, points):
    """Variables (M, 7) of the motions in `rows` (M,) of (N, 4, 4), at points (M, 3); zeros for row -1."""
    variables = np.zeros((len(points), 7))
    for i in range(len(points)):
        if rows[i] >= 0:
            motion = motions[rows[i]]
            x, y, z, w = from_matrix(motion)
            variables[i, 0], variables[i, 1], variables[i, 2], variables[i, 3] = x, y, z, w
            for k in range(3):
                variables[i, 4 + k] = (motion[k, 0] * points[i, 0] + motion[k, 1] * points[i, 1]
                                       + motion[k, 2] * points[i, 2] + motion[k, 3])
    return variables


@njit()
def motions_of(variables, points, rows, motions):
    """Write the motions of variables (M, 7) at points (M, 3) to `rows` (M,) of `motions` (N, 4, 4)."""
    for i in range(len(points)):
        motion = motions[rows[i]]
        to_matrix(variables[i, 0], variables[i, 1], variables[i, 2], variables[i, 3], motion)
        for k in range(3):
            motion[k, 3] = variables[i, 4 + k] - (
                motion[k, 0] * points[i, 0] + motion[k, 1] * points[i, 1] + motion[k, 2] * points[i, 2])


@njit()
def recentre(variables, factors, origin):
    """Take a new origin (3,) from the positions of variables, targets and ties."""
    for i in range(len(variables)):
        for k in range(3):
            variables[i, 4 + k] -= origin[k]
            factors.targets[i, k] -= origin[k]
            factors.ties[i, 4 + k] -= origin[k]


@njit()
def edges_between(edges, place, count):
    """Edges (E, 2) as sorted pairs of the `count` places (N,) of what they join."""
    first = np.zeros(count + 1, np.int64)
    for e in range(len(edges)):
        first[place[edges[e, 0]] + 1] += 1
    first = np.cumsum(first)
    end, found = first[:-1].copy(), np.empty((first[-1], 2), place.dtype)
    for e in range(len(edges)):
        i, j = place[edges[e, 0]], place[edges[e, 1]]
        slot = end[i]
        while slot > first[i] and found[slot - 1, 1] > j:
            found[slot, 0], found[slot, 1] = i, found[slot - 1, 1]
            slot -= 1
        found[slot, 0], found[slot, 1] = i, j
        end[i] += 1
    return found


@njit(**FUSED)
def smoothness(factors, variables, block, wrenches):
    """Energy of the edges (eq. 10), whose gradient is written to `wrenches` (M, 6)."""
    pairs, at_point, weight = factors.edges, factors.weights.at_point, factors.weights.smoothness
    wrenches[:] = 0.0
    total = 0.0
    for start in range(0, len(pairs), twist_errors.WIDTH):
        count = min(twist_errors.WIDTH, len(pairs) - start)
        for k in range(count):
            i, j = pairs[start + k, 0], pairs[start + k, 1]
            twist_errors.put_poses(block, k, variables, i, variables, j)
            twist_errors.put_points(block, k, factors.points, i, j, at_point)
        twist_errors.evaluate(block)
        for k in range(count):
            total += twist_errors.square(block, k)
            tx, ty, tz, fx, fy, fz = twist_errors.wrench(block, k, weight)
            inertia.add_to(wrenches, pairs[start + k, 0], tx, ty, tz, fx, fy, fz)
            inertia.add_to(wrenches, pairs[start + k, 1], -tx, -ty, -tz, -fx, -fy, -fz)
    return 0.5 * weight * total


@njit(**FUSED)
def evidence(factors, variables, robust, block, wrenches, active):
    """Energy of the matches and ties; adds its gradient to `wrenches` (M, 6).

    Fills `active` (M,): 1 for a match that counts, 2 for a tie. With `robust` those beyond the truncation
    do not.
    """
    active[:] = 0
    return (_matches(factors, variables, robust, wrenches, active)
            + _ties(factors, variables, robust, block, wrenches, active))


@njit(**FUSED)
def _matches(factors, variables, robust, wrenches, active):
    matched, targets, weight, most = (
        factors.matched, factors.targets, factors.weights.data, factors.weights.truncation_sq)
    total = 0.0
    for i in range(len(variables)):
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
        fx, fy, fz = weight * fx, weight * fy, weight * fz
        tx, ty, tz = cross(x, y, z, fx, fy, fz)
        inertia.add_to(wrenches, i, tx, ty, tz, fx, fy, fz)
    return 0.5 * weight * total


@njit(**FUSED)
def near_matches(factors, variables):
    """How many matches of the variables are within the truncation, and how many there are."""
    matched, targets, most = factors.matched, factors.targets, factors.weights.truncation_sq
    near = count = 0
    for i in range(len(variables)):
        x, y = variables[i, 4] - targets[i, 0], variables[i, 5] - targets[i, 1]
        z = variables[i, 6] - targets[i, 2]
        count += matched[i]
        near += matched[i] and x * x + y * y + z * z <= most
    return near, count


@njit(**FUSED)
def _ties(factors, variables, robust, block, wrenches, active):
    tied, ties, weight, most = (
        factors.tied, factors.ties, factors.weights.tie, factors.weights.tie_truncation_sq)
    total = 0.0
    twist_errors.put_together(block)
    for start in range(0, len(tied), twist_errors.WIDTH):
        count = min(twist_errors.WIDTH, len(tied) - start)
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
            inertia.add_to(wrenches, start + k, *twist_errors.wrench(block, k, -weight))
    return 0.5 * weight * total


@njit(**FUSED)
def step(variables, twists, moved):
    """Write the variables, each moved by its twist of `twists` (M, 6), to `moved`."""
    for i in range(len(variables)):
        ox, oy, oz = twists[i, 0], twists[i, 1], twists[i, 2]
        ux, uy, uz = cross(ox, oy, oz, variables[i, 4], variables[i, 5], variables[i, 6])
        moved[i, 0], moved[i, 1], moved[i, 2], moved[i, 3] = stepped(
            variables[i, 0], variables[i, 1], variables[i, 2], variables[i, 3], ox, oy, oz)
        moved[i, 4] = variables[i, 4] + ux + twists[i, 3]
        moved[i, 5] = variables[i, 5] + uy + twists[i, 4]
        moved[i, 6] = variables[i, 6] + uz + twists[i, 5]


@njit(**FUSED)
def place_levers(factors, variables, most, levers):
    """Put `levers` (M, 3) where the twist between a variable and an earlier neighbour is seen.

    That is at the point, or at what the sensor's origin becomes when it moves with the point. Where all are
    within `most` of there, they stay as they are. Returns whether they do not.
    """
    for i in range(len(variables)):
        x, y, z = _lever(factors, variables, i)
        x, y, z = x - levers[i, 0], y - levers[i, 1], z - levers[i, 2]
        if not x * x + y * y + z * z <= most * most:
            for j in range(len(variables)):
                levers[j, 0], levers[j, 1], levers[j, 2] = _lever(factors, variables, j)
            return True
    return False


@njit(**FUSED)
def _lever(factors, variables, i):
    if factors.weights.at_point:
        return variables[i, 4], variables[i, 5], variables[i, 6]
    x, y, z = turned(variables[i, 0], variables[i, 1], variables[i, 2], variables[i, 3],
                     factors.points[i, 0], factors.points[i, 1], factors.points[i, 2])
    return variables[i, 4] - x, variables[i, 5] - y, variables[i, 6] - z
