"""Repeatable frames at keypoints (Tombari, Salti, Di Stefano 2010), from the offsets of their neighbours."""

import numpy as np

from lidarflow.kernels.compiled import njit
from lidarflow.kernels.linalg import symmetric_eigen3

MIN_NEIGHBOURS = 5


@njit()
def fill(frame, offsets, count, radius_m):
    """Fill a frame (3, 3), rows x, y, z, from the covariance weighted by radius − distance.

    Returns whether there is one: too few neighbours have none.
    offsets (4, ·) are x, y, z and distance of `count` neighbours within the radius, in metres.
    """
    if count < MIN_NEIGHBOURS:
        return False
    xx = xy = xz = yy = yz = zz = total = 0.0
    for k in range(count):
        x, y, z = offsets[0, k], offsets[1, k], offsets[2, k]
        weight = radius_m - offsets[3, k]
        total += weight
        xx += weight * x * x
        xy += weight * x * y
        xz += weight * x * z
        yy += weight * y * y
        yz += weight * y * z
        zz += weight * z * z
    if total <= 0.0:
        return False
    values, vectors = np.empty(3), np.empty((3, 3))
    symmetric_eigen3(xx / total, xy / total, xz / total, yy / total, yz / total, zz / total, values, vectors)
    for row, column in ((0, 2), (2, 0)):
        for a in range(3):
            frame[row, a] = vectors[a, column]
        _point_to_the_majority(offsets, count, frame[row])
    frame[1, 0] = frame[2, 1] * frame[0, 2] - frame[2, 2] * frame[0, 1]
    frame[1, 1] = frame[2, 2] * frame[0, 0] - frame[2, 0] * frame[0, 2]
    frame[1, 2] = frame[2, 0] * frame[0, 1] - frame[2, 1] * frame[0, 0]
    return True


@njit()
def _point_to_the_majority(offsets, count, axis):
    """Flip `axis` (3,) in place when most neighbours lie on its negative side (sign disambiguation)."""
    x, y, z = axis[0], axis[1], axis[2]
    ahead = 0
    for k in range(count):
        ahead += 1 if offsets[0, k] * x + offsets[1, k] * y + offsets[2, k] * z >= 0.0 else 0
    side = 2.0 * ahead - count
    if side == 0.0:
        for k in range(count):
            side += offsets[0, k] * x + offsets[1, k] * y + offsets[2, k] * z
    if side < 0.0:
        axis[0], axis[1], axis[2] = -x, -y, -z
