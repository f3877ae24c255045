"""What tells the rings of a spinning sensor apart: usable points, steps of azimuth, pitches by rank."""

import math

import numpy as np

from lidarflow.kernels.compiled import njit

_TURN = 2.0 * math.pi


@njit()
def usable(points, min_range_m):
    """Whether points (N, 3) are finite, farther away than `min_range_m` and not the one before again (N,).

    Files of two returns a beam write most points twice.
    """
    found = np.empty(len(points), np.bool_)
    before_x = before_y = before_z = np.nan
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        is_finite = math.isfinite(x) and math.isfinite(y) and math.isfinite(z)
        is_new = x != before_x or y != before_y or z != before_z
        found[i] = is_finite and is_new and math.sqrt(x * x + y * y + z * z) > min_range_m
        before_x, before_y, before_z = x, y, z
    return found


@njit()
def steps(azimuth):
    """Steps (N - 1,), within half a turn, from each azimuth (N,) to the next."""
    step = np.empty(len(azimuth) - 1)
    for i in range(len(step)):
        step[i] = _in_turn(azimuth[i + 1] - azimuth[i] + math.pi) - math.pi
    return step


@njit()
def cuts(azimuth, direction, ahead_rad, min_fall_rad):
    """Indices at which azimuths (N,) begin a new turn in `direction` (1 or -1): (K,) int64.

    Turns begin `ahead_rad` before the first azimuth; steps back across there by `min_fall_rad` and less do
    not count.
    """
    found, count, last = np.empty(len(azimuth), np.int64), 0, 0.0
    for i in range(len(azimuth)):
        turned = _in_turn(direction * (azimuth[i] - azimuth[0]) + ahead_rad)
        if i > 0 and turned - last < -min_fall_rad:
            found[count] = i
            count += 1
        last = turned
    return found[:count].copy()


@njit()
def at_ranks(values, bounds, ranks):
    """What sorting each run values[bounds[r]:bounds[r + 1]] would put at indices `ranks` (R, K): (R, K)."""
    found = np.empty(ranks.shape)
    for r in range(len(ranks)):
        within = ranks[r] - bounds[r]
        found[r] = np.partition(values[bounds[r]:bounds[r + 1]], within)[within]
    return found


@njit(inline="always")
def _in_turn(angle):
    """`angle`, at most a turn outside, brought to [0, 2π); much faster than a remainder."""
    if angle < 0.0:
        return angle + _TURN
    return angle - _TURN if angle >= _TURN else angle
