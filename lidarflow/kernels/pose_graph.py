"""The pointwise factor graph: its exact energy and gradient, and steps of its variables.

A variable is a row x, y, z, w of the rotation's quaternion, then the moved point. A step of it is a twist
(6,), rotation first, about the origin of the target's frame: the twist turns the rotation, and shifts the
point by what it does at the point's `place`. Places are where the points were when last linearised. A
gradient is a wrench (6,): torque about the origin, then force.
"""

from collections import namedtuple

import numba
import numpy as np

from lidarflow.kernels.compiled import njit
from lidarflow.kernels.rotations import (
    between,
    cross,
    from_matrix,
    inverse_jacobian,
    logarithm,
    stepped,
    to_matrix,
    turned,
)

# points (M, 3); edges (E, 2) i < j, sorted by component; matched (M,) bool, targets (M, 3); tied (M,) bool,
# ties (M, 7) rows as of variables; at_point: eq. 10 seen at the point. Then the weights, and the squares
# that matches and ties are truncated at.
Factors = namedtuple("Factors", (
    "points", "edges", "matched", "targets", "tied", "ties", "at_point", "data_weight", "smoothness_weight",
    "tie_weight", "truncation_sq", "tie_truncation_sq"))


@njit(parallel=True)
def variables_of(motions, points):
    """Variables (M, 7) of motions (M, 4, 4) at points (M, 3)."""
    variables = np.empty((len(points), 7))
    for i in numba.prange(len(points)):
        x, y, z, w = from_matrix(motions[i])
        variables[i, 0], variables[i, 1], variables[i, 2], variables[i, 3] = x, y, z, w
        for k in range(3):
            variables[i, 4 + k] = (motions[i, k, 0] * points[i, 0] + motions[i, k, 1] * points[i, 1]
                                   + motions[i, k, 2] * points[i, 2] + motions[i, k, 3])
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


@njit(error_model="numpy")
def _twist_error(first, i, second, j, dx, dy, dz, px, py, pz):
    """Squared norm of the twist from the pose i to the pose j, less an offset d in i's axes, seen from −p.

    Then the gradient of half of it: force at i, torque at i, in the axes that i leads to. Those at j are in
    balance with them.
    """
    ax, ay, az, aw = first[i, 0], first[i, 1], first[i, 2], first[i, 3]
    qx, qy, qz, qw = between(ax, ay, az, aw, second[j, 0], second[j, 1], second[j, 2], second[j, 3])
    ox, oy, oz, c, slope = logarithm(qx, qy, qz, qw)
    sx, sy, sz = turned(
        -ax, -ay, -az, aw, second[j, 4] - first[i, 4], second[j, 5] - first[i, 5], second[j, 6] - first[i, 6])
    tx, ty, tz = sx - dx, sy - dy, sz - dz
    yx, yy, yz = inverse_jacobian(ox, oy, oz, c, 1.0, tx, ty, tz)
    lx, ly, lz = cross(px, py, pz, ox, oy, oz)
    yx, yy, yz = yx + lx, yy + ly, yz + lz
    square = ox * ox + oy * oy + oz * oz + yx * yx + yy * yy + yz * yz

    # By ω, through J⁻¹(ω) t as well, then by t.
    ot = ox * tx + oy * ty + oz * tz
    yo = yx * ox + yy * oy + yz * oz
    yt = yx * tx + yy * ty + yz * tz
    along = 1.0 - 2.0 * c * yt + 2.0 * slope * (yo * ot - yt * (ox * ox + oy * oy + oz * oz))
    mx, my, mz = cross(yx, yy, yz, px + 0.5 * tx, py + 0.5 * ty, pz + 0.5 * tz)
    gx = along * ox + mx + c * (yx * ot + tx * yo)
    gy = along * oy + my + c * (yy * ot + ty * yo)
    gz = along * oz + mz + c * (yz * ot + tz * yo)
    fx, fy, fz = inverse_jacobian(ox, oy, oz, c, -1.0, yx, yy, yz)
    gx, gy, gz = inverse_jacobian(ox, oy, oz, c, -1.0, gx, gy, gz)
    mx, my, mz = cross(fx, fy, fz, sx, sy, sz)
    fx, fy, fz = turned(ax, ay, az, aw, -fx, -fy, -fz)
    mx, my, mz = turned(ax, ay, az, aw, mx - gx, my - gy, mz - gz)
    return square, fx, fy, fz, mx, my, mz


@njit(error_model="numpy")
def _add(wrenches, i, places, weight, fx, fy, fz, tx, ty, tz):
    """Add a force and a torque at a variable's place, times a weight, to its wrench about the origin."""
    mx, my, mz = cross(places[i, 0], places[i, 1], places[i, 2], fx, fy, fz)
    wrenches[i, 0] += weight * (tx + mx)
    wrenches[i, 1] += weight * (ty + my)
    wrenches[i, 2] += weight * (tz + mz)
    wrenches[i, 3] += weight * fx
    wrenches[i, 4] += weight * fy
    wrenches[i, 5] += weight * fz


@njit(error_model="numpy")
def _add_balance(wrenches, j, places, weight, first, i, second, fx, fy, fz, tx, ty, tz):
    """Add at pose j what is in balance with a force and a torque at pose i."""
    mx, my, mz = cross(
        first[i, 4] - second[j, 4], first[i, 5] - second[j, 5], first[i, 6] - second[j, 6], fx, fy, fz)
    _add(wrenches, j, places, -weight, fx, fy, fz, tx + mx, ty + my, tz + mz)


@njit(error_model="numpy")
def smoothness(factors, variables, places, nodes, edges, wrenches):
    """Energy of the edges from edges[0] to edges[1] (eq. 10), which are all those of the variables
    from nodes[0] to nodes[1], whose gradient is written to `wrenches` (M, 6)."""
    points, pairs, weight, at_point = (
        factors.points, factors.edges, factors.smoothness_weight, factors.at_point)
    wrenches[nodes[0]:nodes[1]] = 0.0
    total = 0.0
    px = py = pz = 0.0
    for e in range(edges[0], edges[1]):
        i, j = pairs[e, 0], pairs[e, 1]
        x, y, z = points[j, 0], points[j, 1], points[j, 2]
        if not at_point:
            px, py, pz = x, y, z
        square, fx, fy, fz, tx, ty, tz = _twist_error(
            variables, i, variables, j, x - points[i, 0], y - points[i, 1], z - points[i, 2], px, py, pz)
        total += square
        _add(wrenches, i, places, weight, fx, fy, fz, tx, ty, tz)
        _add_balance(wrenches, j, places, weight, variables, i, variables, fx, fy, fz, tx, ty, tz)
    return 0.5 * weight * total


@njit(error_model="numpy")
def evidence(factors, variables, places, nodes, robust, wrenches, active):
    """Energy of the matches and ties of the variables from nodes[0] to nodes[1]; adds its gradient.

    Fills `active` (M,): 1 for a match that counts, 2 for a tie. With `robust` those beyond the truncation
    do not.
    """
    matched, targets, tied, ties = factors.matched, factors.targets, factors.tied, factors.ties
    total = 0.0
    for i in range(nodes[0], nodes[1]):
        active[i] = 0
        if matched[i]:
            rx, ry, rz = (variables[i, 4] - targets[i, 0], variables[i, 5] - targets[i, 1],
                          variables[i, 6] - targets[i, 2])
            square = rx * rx + ry * ry + rz * rz
            if robust and square > factors.truncation_sq:
                square = factors.truncation_sq
            else:
                active[i] += 1
                _add(wrenches, i, places, factors.data_weight, rx, ry, rz, 0.0, 0.0, 0.0)
            total += factors.data_weight * square
        if tied[i]:
            square, fx, fy, fz, tx, ty, tz = _twist_error(ties, i, variables, i, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
            if robust and square > factors.tie_truncation_sq:
                square = factors.tie_truncation_sq
            else:
                active[i] += 2
                _add_balance(
                    wrenches, i, places, factors.tie_weight, ties, i, variables, fx, fy, fz, tx, ty, tz)
            total += factors.tie_weight * square
    return 0.5 * total


@njit(error_model="numpy")
def step(variables, places, nodes, twists, moved):
    """Write the variables nodes[0] .. nodes[1], each moved by its twist of `twists` (M, 6), to `moved`."""
    for i in range(nodes[0], nodes[1]):
        ox, oy, oz = twists[i, 0], twists[i, 1], twists[i, 2]
        ux, uy, uz = cross(ox, oy, oz, places[i, 0], places[i, 1], places[i, 2])
        moved[i, 0], moved[i, 1], moved[i, 2], moved[i, 3] = stepped(
            variables[i, 0], variables[i, 1], variables[i, 2], variables[i, 3], ox, oy, oz)
        moved[i, 4] = variables[i, 4] + ux + twists[i, 3]
        moved[i, 5] = variables[i, 5] + uy + twists[i, 4]
        moved[i, 6] = variables[i, 6] + uz + twists[i, 5]


@njit(error_model="numpy")
def place(factors, variables, nodes, places, levers):
    """Put the places of variables where their points are.

    `levers` (M, 3) are where the twist between neighbours is seen: at the point, or at what the sensor's
    origin becomes when it moves with the point.
    """
    points, at_point = factors.points, factors.at_point
    for i in range(nodes[0], nodes[1]):
        x = y = z = 0.0
        if not at_point:
            x, y, z = turned(variables[i, 0], variables[i, 1], variables[i, 2], variables[i, 3],
                             points[i, 0], points[i, 1], points[i, 2])
        places[i, 0], places[i, 1], places[i, 2] = variables[i, 4], variables[i, 5], variables[i, 6]
        levers[i, 0], levers[i, 1], levers[i, 2] = (
            variables[i, 4] - x, variables[i, 5] - y, variables[i, 6] - z)


@njit(error_model="numpy")
def displace(places, variables, nodes, wrenches):
    """Make wrenches about the origin of forces at `places` those of the same forces where the points are."""
    for i in range(nodes[0], nodes[1]):
        mx, my, mz = cross(
            variables[i, 4] - places[i, 0], variables[i, 5] - places[i, 1], variables[i, 6] - places[i, 2],
            wrenches[i, 3], wrenches[i, 4], wrenches[i, 5])
        wrenches[i, 0] += mx
        wrenches[i, 1] += my
        wrenches[i, 2] += mz
