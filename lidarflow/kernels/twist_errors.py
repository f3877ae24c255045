"""Errors between pairs of poses, a block of pairs at a time.

A block is a flat array of rows of WIDTH numbers, a row for each number that is given of a pair or found.
Loops along rows have neither branches nor unknown distances between what they read and what they write, so
that the compiler makes vector instructions of them.
"""

import numpy as np

from lidarflow.kernels.compiled import FUSED, njit
from lidarflow.kernels.rotations import (
    SERIES_BELOW,
    between,
    cross,
    inverse_jacobian,
    logarithm,
    logarithm_series,
    turned,
)

WIDTH = 32    # pairs in a block
# First rows of what is given: both poses (quaternion, position), the offset between them in the first one's
# axes, and the place −p that their twist is seen from.
_FIRST, _SECOND, _OFFSET, _LEVER = 0, 7, 14, 17
# Of what lies between: rotation from the first to the second (quaternion, then `logarithm`), displacement.
_TURN, _SHIFT = 20, 25
# Of what is found: squared norm of the error, and the gradient of half of it.
_SQUARE, _WRENCH = 28, 29
_ROWS = 35


@njit()
def room():
    """A block with zeros in all its rows."""
    return np.zeros(_ROWS * WIDTH)


@njit(**FUSED)
def put_poses(block, k, first, i, second, j):
    """Let the k-th pair be the rows i and j of poses (M, 7) and (N, 7)."""
    for row in range(7):
        block[(_FIRST + row) * WIDTH + k] = first[i, row]
        block[(_SECOND + row) * WIDTH + k] = second[j, row]


@njit(**FUSED)
def put_points(block, k, points, i, j, at_point):
    """Let the k-th pair sit at the i-th and j-th point; its twist is seen at the latter, or at the origin."""
    for row in range(3):
        block[(_OFFSET + row) * WIDTH + k] = points[j, row] - points[i, row]
        block[(_LEVER + row) * WIDTH + k] = 0.0 if at_point else points[j, row]


@njit(**FUSED)
def put_together(block):
    """Let the poses of all pairs sit at the same point, where their twist is seen."""
    block[_OFFSET * WIDTH:(_LEVER + 3) * WIDTH] = 0.0


@njit(**FUSED)
def square(block, k):
    """Squared norm of the k-th pair's error."""
    return block[_SQUARE * WIDTH + k]


@njit(**FUSED)
def wrench(block, k, weight):
    """The k-th pair's gradient, for a twist of the first pose about the origin.

    For a twist of the second pose it is the opposite: a common twist changes nothing.
    """
    tx, ty, tz = _three(block, _WRENCH, k)
    fx, fy, fz = _three(block, _WRENCH + 3, k)
    return weight * tx, weight * ty, weight * tz, weight * fx, weight * fy, weight * fz


@njit(**FUSED)
def evaluate(block):
    """Fill in the errors of all pairs: the twist from the first pose to the second, less the offset."""
    if _relate(block) == 0:
        _take_logarithms(block)
    else:
        _take_large_logarithms(block)
    _differentiate(block)


@njit(**FUSED)
def _three(block, row, k):
    return block[row * WIDTH + k], block[(row + 1) * WIDTH + k], block[(row + 2) * WIDTH + k]


@njit(**FUSED)
def _put_three(block, row, k, x, y, z):
    block[row * WIDTH + k], block[(row + 1) * WIDTH + k], block[(row + 2) * WIDTH + k] = x, y, z


@njit(**FUSED)
def _relate(block):
    """Rotations and displacements between the poses; returns how many rotations are too large for series."""
    large = 0
    for k in range(WIDTH):
        ax, ay, az = _three(block, _FIRST, k)
        aw = block[(_FIRST + 3) * WIDTH + k]
        bx, by, bz = _three(block, _SECOND, k)
        qx, qy, qz, qw = between(ax, ay, az, aw, bx, by, bz, block[(_SECOND + 3) * WIDTH + k])
        large += qx * qx + qy * qy + qz * qz >= SERIES_BELOW
        _put_three(block, _TURN, k, qx, qy, qz)
        block[(_TURN + 3) * WIDTH + k] = qw
        ux, uy, uz = _three(block, _FIRST + 4, k)
        vx, vy, vz = _three(block, _SECOND + 4, k)
        sx, sy, sz = turned(-ax, -ay, -az, aw, vx - ux, vy - uy, vz - uz)
        _put_three(block, _SHIFT, k, sx, sy, sz)
    return large


@njit(**FUSED)
def _take_logarithms(block):
    for k in range(WIDTH):
        x, y, z = _three(block, _TURN, k)
        x, y, z, c, slope = logarithm_series(x, y, z)
        _put_three(block, _TURN, k, x, y, z)
        block[(_TURN + 3) * WIDTH + k], block[(_TURN + 4) * WIDTH + k] = c, slope


@njit(**FUSED)
def _take_large_logarithms(block):
    for k in range(WIDTH):
        x, y, z = _three(block, _TURN, k)
        x, y, z, c, slope = logarithm(x, y, z, block[(_TURN + 3) * WIDTH + k])
        _put_three(block, _TURN, k, x, y, z)
        block[(_TURN + 3) * WIDTH + k], block[(_TURN + 4) * WIDTH + k] = c, slope


@njit(**FUSED)
def _differentiate(block):
    """Squared norms, and the gradient of half of them."""
    for k in range(WIDTH):
        ox, oy, oz = _three(block, _TURN, k)
        c, slope = block[(_TURN + 3) * WIDTH + k], block[(_TURN + 4) * WIDTH + k]
        sx, sy, sz = _three(block, _SHIFT, k)
        dx, dy, dz = _three(block, _OFFSET, k)
        px, py, pz = _three(block, _LEVER, k)
        tx, ty, tz = sx - dx, sy - dy, sz - dz
        yx, yy, yz = inverse_jacobian(ox, oy, oz, c, 1.0, tx, ty, tz)
        lx, ly, lz = cross(px, py, pz, ox, oy, oz)
        yx, yy, yz = yx + lx, yy + ly, yz + lz
        turn = ox * ox + oy * oy + oz * oz
        block[_SQUARE * WIDTH + k] = turn + yx * yx + yy * yy + yz * yz

        # By ω, through J⁻¹(ω) t as well, then by t; both in the axes that the first pose leads to.
        ot = ox * tx + oy * ty + oz * tz
        yo = yx * ox + yy * oy + yz * oz
        yt = yx * tx + yy * ty + yz * tz
        along = 1.0 - 2.0 * c * yt + 2.0 * slope * (yo * ot - yt * turn)
        mx, my, mz = cross(yx, yy, yz, px + 0.5 * tx, py + 0.5 * ty, pz + 0.5 * tz)
        gx = along * ox + mx + c * (yx * ot + tx * yo)
        gy = along * oy + my + c * (yy * ot + ty * yo)
        gz = along * oz + mz + c * (yz * ot + tz * yo)
        fx, fy, fz = inverse_jacobian(ox, oy, oz, c, -1.0, yx, yy, yz)
        gx, gy, gz = inverse_jacobian(ox, oy, oz, c, -1.0, gx, gy, gz)

        # Force and torque at the first pose; the torque about the origin is larger by its lever.
        mx, my, mz = cross(fx, fy, fz, sx, sy, sz)
        ax, ay, az = _three(block, _FIRST, k)
        aw = block[(_FIRST + 3) * WIDTH + k]
        fx, fy, fz = turned(ax, ay, az, aw, -fx, -fy, -fz)
        mx, my, mz = turned(ax, ay, az, aw, mx - gx, my - gy, mz - gz)
        x, y, z = _three(block, _FIRST + 4, k)
        lx, ly, lz = cross(x, y, z, fx, fy, fz)
        _put_three(block, _WRENCH, k, mx + lx, my + ly, mz + lz)
        _put_three(block, _WRENCH + 3, k, fx, fy, fz)
