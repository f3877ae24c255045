"""Which directions a scan looked in."""

import math

import numpy as np

from lidarflow.kernels.compiled import njit


@njit()
def looked_at(directions, others, max_angle_rad, least):
    """Whether (N,) at least so many of `others` (M, 3) are around each of the unit `directions` (N, 3).

    All are seen from the origin; angles are taken as chords. The unit cube is cut into cells
    as long as one; those of a cell are chained.
    """
    size = math.ceil(2.0 / max_angle_rad) + 3
    head, following = np.full((size, size, size), -1, np.int32), np.full(len(others), -1, np.int32)
    unit = np.empty((len(others), 3))
    for i in range(len(others)):
        range_m = math.sqrt(others[i, 0] ** 2 + others[i, 1] ** 2 + others[i, 2] ** 2)
        for k in range(3):
            unit[i, k] = others[i, k] / max(range_m, 1e-6)
        u, v, w = _cell(unit[i], max_angle_rad)
        following[i], head[u, v, w] = head[u, v, w], i
    looked = np.zeros(len(directions), np.bool_)
    for i in range(len(directions)):
        looked[i] = _at_least(directions[i], unit, head, following, max_angle_rad, least)
    return looked


@njit(inline="always")
def _cell(direction, cell):
    """Its three indices, from 1 on, so that all neighbours of a cell exist."""
    return (int((direction[0] + 1.0) / cell) + 1, int((direction[1] + 1.0) / cell) + 1,
            int((direction[2] + 1.0) / cell) + 1)


@njit()
def _at_least(direction, unit, head, following, max_angle_rad, least):
    u, v, w = _cell(direction, max_angle_rad)
    count, size = 0, len(head)
    for a in range(u - 1, min(u + 2, size)):
        for b in range(v - 1, min(v + 2, size)):
            for c in range(w - 1, min(w + 2, size)):
                i = head[a, b, c]
                while i >= 0:
                    dx, dy = unit[i, 0] - direction[0], unit[i, 1] - direction[1]
                    dz = unit[i, 2] - direction[2]
                    count += dx * dx + dy * dy + dz * dz < max_angle_rad * max_angle_rad
                    if count >= least:
                        return True
                    i = following[i]
    return False
