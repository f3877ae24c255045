"""Normal equations of a pose graph, solved by conjugate gradients with a multigrid cycle before them.

Unknown are twists, known are wrenches; see inertia.py and hierarchy.py. On the first level, an edge resists
the twist between two points where the later one is, so that its share of a product is what the earlier
point's twist is there (`seen`): sums over neighbours are plain sums.
"""

from collections import namedtuple

import numpy as np

from lidarflow.kernels import inertia
from lidarflow.kernels.compiled import FUSED, njit
from lidarflow.kernels.rotations import cross

_NOTHING = 1e-300    # less is not worth a step, whatever is asked for

# held (N, 10): inertia that holds each node where it is (matches, ties, damping); inverse (N, 10) of the sum
# of that and of its edges; loads (N, 6) and twists (N, 6) of a cycle; seen (M, 6) of twists; before (M, 6):
# the sum of earlier neighbours' twists that a point was last solved with; then vectors of the conjugate
# gradients, all (M, 6).
Room = namedtuple("Room", (
    "held", "inverse", "loads", "twists", "seen", "before", "direction", "product", "step"))


@njit()
def room_for(hierarchy):
    """Arrays that the solver works in."""
    nodes, points = len(hierarchy.parent), len(hierarchy.lever)
    return Room(
        np.empty((nodes, inertia.SIZE)), np.empty((nodes, inertia.SIZE)), np.empty((nodes, 6)),
        np.empty((nodes, 6)), np.empty((points, 6)), np.empty((points, 6)), np.empty((points, 6)),
        np.empty((points, 6)), np.empty((points, 6)))


@njit(**FUSED)
def hold(hierarchy, room, places, active, data_weight, tie_weight, damping):
    """Fill `held` and `inverse`, from the matches and ties that are `active` (M,)."""
    bounds, parent, incident = hierarchy.bounds, hierarchy.parent, hierarchy.incident
    held, inverse = room.held, room.inverse
    held[:] = 0.0
    for i in range(bounds[1]):
        rotational = damping + tie_weight * (active[i] >> 1)
        inertia.add_at(held, i, places, i, rotational + data_weight * (active[i] & 1), rotational)
    for i in range(bounds[-1]):
        inertia.invert(incident, held, inverse, i)
        if i < bounds[-2]:
            for k in range(inertia.SIZE):
                held[parent[i], k] += held[i, k]


@njit(**FUSED)
def _see(lever, i, ox, oy, oz, vx, vy, vz):
    """What a unit inertia at a point's lever makes of a twist: a wrench about the origin."""
    x, y, z = lever[i, 0], lever[i, 1], lever[i, 2]
    ux, uy, uz = cross(ox, oy, oz, x, y, z)
    ux, uy, uz = ux + vx, uy + vy, uz + vz
    tx, ty, tz = cross(x, y, z, ux, uy, uz)
    return ox + tx, oy + ty, oz + tz, ux, uy, uz


@njit(**FUSED)
def _sum(neighbours, start, end, rows):
    """Sum of the rows (6,) of some neighbours."""
    a = b = c = d = e = f = 0.0
    for k in range(start, end):
        j = neighbours[k]
        a += rows[j, 0]
        b += rows[j, 1]
        c += rows[j, 2]
        d += rows[j, 3]
        e += rows[j, 4]
        f += rows[j, 5]
    return a, b, c, d, e, f


@njit(**FUSED)
def _set(rows, i, a, b, c, d, e, f):
    rows[i, 0], rows[i, 1], rows[i, 2], rows[i, 3], rows[i, 4], rows[i, 5] = a, b, c, d, e, f


@njit(**FUSED)
def _loaded(loads, i, s, a, b, c, d, e, f):
    """The load of a node and what its neighbours add, times s."""
    return (loads[i, 0] + s * a, loads[i, 1] + s * b, loads[i, 2] + s * c,
            loads[i, 3] + s * d, loads[i, 4] + s * e, loads[i, 5] + s * f)


# The arrays are taken out of their tuples in each of the sweeps: inner calls with them would copy it all.

@njit(**FUSED)
def _points_down(hierarchy, room):
    """A Gauss-Seidel sweep from rest over points, in order; what is left becomes the next level's load."""
    up_start, up, down_start, down = hierarchy.up_start, hierarchy.up, hierarchy.down_start, hierarchy.down
    lever, parent, s = hierarchy.lever, hierarchy.parent, hierarchy.stiffness
    inverse, loads, twists, seen = room.inverse, room.loads, room.twists, room.seen
    for i in range(len(lever)):
        a, b, c, d, e, f = _sum(down, down_start[i], down_start[i + 1], twists)
        a, b, c, d, e, f = _see(lever, i, a, b, c, d, e, f)
        a, b, c, d, e, f = _loaded(loads, i, s, a, b, c, d, e, f)
        a, b, c, d, e, f = inertia.twist(inverse, i, a, b, c, d, e, f)
        _set(twists, i, a, b, c, d, e, f)
        a, b, c, d, e, f = _see(lever, i, a, b, c, d, e, f)
        _set(seen, i, a, b, c, d, e, f)
    for i in range(len(lever)):
        # Where point i was solved, the later ones were at rest: their pull is what is left.
        a, b, c, d, e, f = _sum(up, up_start[i], up_start[i + 1], seen)
        if parent[i] >= 0:
            inertia.add_to(loads, parent[i], s * a, s * b, s * c, s * d, s * e, s * f)


@njit(**FUSED)
def _points_up(hierarchy, room):
    """Add the coarser level's twists to those of points, then a Gauss-Seidel sweep in reversed order."""
    up_start, up, down_start, down = hierarchy.up_start, hierarchy.up, hierarchy.down_start, hierarchy.down
    lever, parent, s = hierarchy.lever, hierarchy.parent, hierarchy.stiffness
    inverse, loads, twists, seen, before = room.inverse, room.loads, room.twists, room.seen, room.before
    for i in range(len(lever)):
        for k in range(6):
            twists[i, k] += twists[parent[i], k]
    for i in range(len(lever) - 1, -1, -1):
        a, b, c, d, e, f = _sum(down, down_start[i], down_start[i + 1], twists)
        _set(before, i, a, b, c, d, e, f)
        a, b, c, d, e, f = _see(lever, i, a, b, c, d, e, f)
        g, h, k, m, n, o = _sum(up, up_start[i], up_start[i + 1], seen)
        a, b, c, d, e, f = _loaded(loads, i, s, a + g, b + h, c + k, d + m, e + n, f + o)
        a, b, c, d, e, f = inertia.twist(inverse, i, a, b, c, d, e, f)
        _set(twists, i, a, b, c, d, e, f)
        a, b, c, d, e, f = _see(lever, i, a, b, c, d, e, f)
        _set(seen, i, a, b, c, d, e, f)


@njit(**FUSED)
def _pull(inertias, twists, edges, first_edge, neighbours, start, end):
    """What the twists of some neighbours of a coarse node add to its load."""
    a = b = c = d = e = f = 0.0
    for slot in range(start, end):
        j = neighbours[slot]
        g, h, k, m, n, o = inertia.wrench(
            inertias, edges[slot] - first_edge, twists[j, 0], twists[j, 1], twists[j, 2], twists[j, 3],
            twists[j, 4], twists[j, 5])
        a, b, c, d, e, f = a + g, b + h, c + k, d + m, e + n, f + o
    return a, b, c, d, e, f


@njit(**FUSED)
def _nodes_down(hierarchy, room, first, last):
    """As `_points_down`, for the nodes of a coarser level."""
    up_start, up, up_edge = hierarchy.up_start, hierarchy.up, hierarchy.up_edge
    down_start, down, down_edge = hierarchy.down_start, hierarchy.down, hierarchy.down_edge
    parent, inertias = hierarchy.parent, hierarchy.inertias
    first_edge = len(up) - len(inertias)
    inverse, loads, twists = room.inverse, room.loads, room.twists
    for i in range(first, last):
        a, b, c, d, e, f = _pull(
            inertias, twists, down_edge, first_edge, down, down_start[i], down_start[i + 1])
        a, b, c, d, e, f = _loaded(loads, i, 1.0, a, b, c, d, e, f)
        a, b, c, d, e, f = inertia.twist(inverse, i, a, b, c, d, e, f)
        _set(twists, i, a, b, c, d, e, f)
    for i in range(first, last):
        if parent[i] >= 0:
            a, b, c, d, e, f = _pull(inertias, twists, up_edge, first_edge, up, up_start[i], up_start[i + 1])
            inertia.add_to(loads, parent[i], a, b, c, d, e, f)


@njit(**FUSED)
def _nodes_up(hierarchy, room, first, last):
    """As `_points_up`, for the nodes of a coarser level."""
    up_start, up, up_edge = hierarchy.up_start, hierarchy.up, hierarchy.up_edge
    down_start, down, down_edge = hierarchy.down_start, hierarchy.down, hierarchy.down_edge
    parent, inertias = hierarchy.parent, hierarchy.inertias
    first_edge = len(up) - len(inertias)
    inverse, loads, twists = room.inverse, room.loads, room.twists
    for i in range(first, last):
        for k in range(6):
            twists[i, k] += twists[parent[i], k]
    for i in range(last - 1, first - 1, -1):
        a, b, c, d, e, f = _pull(
            inertias, twists, down_edge, first_edge, down, down_start[i], down_start[i + 1])
        g, h, k, m, n, o = _pull(inertias, twists, up_edge, first_edge, up, up_start[i], up_start[i + 1])
        a, b, c, d, e, f = _loaded(loads, i, 1.0, a + g, b + h, c + k, d + m, e + n, f + o)
        a, b, c, d, e, f = inertia.twist(inverse, i, a, b, c, d, e, f)
        _set(twists, i, a, b, c, d, e, f)


@njit(**FUSED)
def cycle(hierarchy, room):
    """One V-cycle: about the `twists` that the `loads` of the first level make."""
    bounds = hierarchy.bounds
    levels = len(bounds) - 1
    room.loads[bounds[1]:] = 0.0
    _points_down(hierarchy, room)
    for level in range(1, levels):
        _nodes_down(hierarchy, room, bounds[level], bounds[level + 1])
    for level in range(levels - 2, 0, -1):
        _nodes_up(hierarchy, room, bounds[level], bounds[level + 1])
    if levels > 1:
        _points_up(hierarchy, room)


@njit(**FUSED)
def _turn(hierarchy, room, share):
    """The next direction, the cycle's twists and a share of the last one, and its product with the equations.

    A cycle leaves unbalanced what earlier neighbours have moved since a point was last solved: its product is
    the loads without that. Returns the direction times its product.
    """
    down_start, down, lever, s = hierarchy.down_start, hierarchy.down, hierarchy.lever, hierarchy.stiffness
    loads, twists, before = room.loads, room.twists, room.before
    direction, product = room.direction, room.product
    total = 0.0
    for i in range(len(lever)):
        a, b, c, d, e, f = loads[i, 0], loads[i, 1], loads[i, 2], loads[i, 3], loads[i, 4], loads[i, 5]
        if down_start[i] < down_start[i + 1]:
            g, h, k, m, n, o = _sum(down, down_start[i], down_start[i + 1], twists)
            g, h, k = g - before[i, 0], h - before[i, 1], k - before[i, 2]
            m, n, o = m - before[i, 3], n - before[i, 4], o - before[i, 5]
            g, h, k, m, n, o = _see(lever, i, g, h, k, m, n, o)
            a, b, c, d, e, f = a - s * g, b - s * h, c - s * k, d - s * m, e - s * n, f - s * o
        g, h, k = twists[i, 0], twists[i, 1], twists[i, 2]
        m, n, o = twists[i, 3], twists[i, 4], twists[i, 5]
        if share != 0.0:
            a, b, c = a + share * product[i, 0], b + share * product[i, 1], c + share * product[i, 2]
            d, e, f = d + share * product[i, 3], e + share * product[i, 4], f + share * product[i, 5]
            g, h, k = g + share * direction[i, 0], h + share * direction[i, 1], k + share * direction[i, 2]
            m, n, o = m + share * direction[i, 3], n + share * direction[i, 4], o + share * direction[i, 5]
        _set(product, i, a, b, c, d, e, f)
        _set(direction, i, g, h, k, m, n, o)
        total += a * g + b * h + c * k + d * m + e * n + f * o
    return total


@njit(**FUSED)
def _dot(a, b, count):
    total = 0.0
    for i in range(count):
        total += (a[i, 0] * b[i, 0] + a[i, 1] * b[i, 1] + a[i, 2] * b[i, 2]
                  + a[i, 3] * b[i, 3] + a[i, 4] * b[i, 4] + a[i, 5] * b[i, 5])
    return total


@njit(**FUSED)
def _add_all(rows, scale, others, count):
    for i in range(count):
        for k in range(6):
            rows[i, k] += scale * others[i, k]


@njit(**FUSED)
def solve(hierarchy, room, gradient, tolerance, little, enough, most):
    """Fill `step` (M, 6) with the twists that minimise the quadratic model of the energy.

    Conjugate gradients, until a cycle foresees less than `tolerance` of what all iterations have gained, or
    `little`, or `most` iterations. That last cycle's twists are part of the step as they are. It is not made
    where the first one's were of the best length within `tolerance`: what strong ties and matches hold is
    about solved by one cycle. Where less than `enough` seems to be there to gain from the start, no step is
    made. Returns how many iterations were made, each with a cycle and a product, or -1 for no step.
    """
    loads, step, direction, product = room.loads, room.step, room.direction, room.product
    for i in range(len(step)):
        for k in range(6):
            loads[i, k] = -gradient[i, k]
            step[i, k] = 0.0
    gain, last_square = 0.0, 1.0
    for iteration in range(most):
        cycle(hierarchy, room)
        square = _dot(loads, room.twists, len(step))
        if iteration == 0 and not 0.5 * square >= max(enough, _NOTHING):
            return -1
        if 0.5 * square <= max(tolerance * gain, little):
            _add_all(step, 1.0, room.twists, len(step))
            return iteration
        length = square / _turn(hierarchy, room, square / last_square if iteration else 0.0)
        _add_all(step, length, direction, len(step))
        _add_all(loads, -length, product, len(step))
        if iteration == 0 and abs(length - 1.0) <= tolerance:
            return 1
        last_square = square
        gain += 0.5 * length * square
    return most
