"""Quadratic forms of twists that add up like the inertia of rigid bodies.

Whatever resists a twist at a place q, with m against its displacement there and a matrix S against its
rotation, is ten numbers about the origin: the mass m, the first moment h = m q, and the upper triangle of
J = S + m (|q|² I − q qᵀ). It makes a twist (ω, v) a wrench (J ω + h × v, m v + ω × h): a symmetric 6x6 block
of the normal equations. Blocks of the points that move as one are their sum.
"""

from lidarflow.kernels.compiled import FUSED, njit
from lidarflow.kernels.rotations import cross

SIZE = 10


@njit(**FUSED)
def add_at(inertias, i, places, j, mass, rotational):
    """Add to the i-th inertia a mass at the j-th place, and what resists rotation in any direction."""
    x, y, z = places[j, 0], places[j, 1], places[j, 2]
    inertias[i, 0] += mass
    inertias[i, 1] += mass * x
    inertias[i, 2] += mass * y
    inertias[i, 3] += mass * z
    inertias[i, 4] += rotational + mass * (y * y + z * z)
    inertias[i, 5] -= mass * x * y
    inertias[i, 6] -= mass * x * z
    inertias[i, 7] += rotational + mass * (x * x + z * z)
    inertias[i, 8] -= mass * y * z
    inertias[i, 9] += rotational + mass * (x * x + y * y)


@njit(**FUSED)
def wrench(inertias, i, ox, oy, oz, vx, vy, vz):
    """Torque and force that the i-th inertia makes of a twist."""
    m, hx, hy, hz = inertias[i, 0], inertias[i, 1], inertias[i, 2], inertias[i, 3]
    tx, ty, tz = cross(hx, hy, hz, vx, vy, vz)
    fx, fy, fz = cross(ox, oy, oz, hx, hy, hz)
    return (inertias[i, 4] * ox + inertias[i, 5] * oy + inertias[i, 6] * oz + tx,
            inertias[i, 5] * ox + inertias[i, 7] * oy + inertias[i, 8] * oz + ty,
            inertias[i, 6] * ox + inertias[i, 8] * oy + inertias[i, 9] * oz + tz,
            m * vx + fx, m * vy + fy, m * vz + fz)


@njit(**FUSED)
def invert(first, second, inverses, i):
    """Write what `twist` needs to undo the sum of the i-th of two kinds of inertias to the i-th inverse.

    These are 1/m, the centre, and the upper triangle of the inverse of the inertia about the centre.
    """
    m = first[i, 0] + second[i, 0]
    by_m = 1.0 / m
    x, y = by_m * (first[i, 1] + second[i, 1]), by_m * (first[i, 2] + second[i, 2])
    z = by_m * (first[i, 3] + second[i, 3])
    a = first[i, 4] + second[i, 4] - m * (y * y + z * z)
    b = first[i, 5] + second[i, 5] + m * x * y
    c = first[i, 6] + second[i, 6] + m * x * z
    d = first[i, 7] + second[i, 7] - m * (x * x + z * z)
    e = first[i, 8] + second[i, 8] + m * y * z
    f = first[i, 9] + second[i, 9] - m * (x * x + y * y)
    aa, bb, cc = d * f - e * e, c * e - b * f, b * e - c * d
    scale = 1.0 / (a * aa + b * bb + c * cc)
    inverses[i, 0], inverses[i, 1], inverses[i, 2], inverses[i, 3] = by_m, x, y, z
    inverses[i, 4], inverses[i, 5], inverses[i, 6] = scale * aa, scale * bb, scale * cc
    inverses[i, 7], inverses[i, 8] = scale * (a * f - c * c), scale * (b * c - a * e)
    inverses[i, 9] = scale * (a * d - b * b)


@njit(**FUSED)
def twist(inverses, i, tx, ty, tz, fx, fy, fz):
    """The twist that the i-th inverse makes of a torque and a force."""
    by_m, x, y, z = inverses[i, 0], inverses[i, 1], inverses[i, 2], inverses[i, 3]
    mx, my, mz = cross(x, y, z, fx, fy, fz)
    tx, ty, tz = tx - mx, ty - my, tz - mz
    ox = inverses[i, 4] * tx + inverses[i, 5] * ty + inverses[i, 6] * tz
    oy = inverses[i, 5] * tx + inverses[i, 7] * ty + inverses[i, 8] * tz
    oz = inverses[i, 6] * tx + inverses[i, 8] * ty + inverses[i, 9] * tz
    vx, vy, vz = cross(x, y, z, ox, oy, oz)
    return ox, oy, oz, vx + by_m * fx, vy + by_m * fy, vz + by_m * fz


@njit(**FUSED)
def add_to(rows, i, a, b, c, d, e, f):
    """Add six numbers to the i-th of some twists or wrenches (N, 6)."""
    rows[i, 0] += a
    rows[i, 1] += b
    rows[i, 2] += c
    rows[i, 3] += d
    rows[i, 4] += e
    rows[i, 5] += f
