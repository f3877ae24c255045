"""How far points move when a twist is off by what its covariance says."""

import math

import numpy as np

from lidarflow.kernels.compiled import njit


@njit()
def information(at, normals, centre, weights):
    """What planes tell of the twist (rotation first) about `centre` (3,) of a cloud that lies on them (6, 6).

    A plane at x (K, 3) with the normal n (K, 3) and its weight (K,) adds w JᵀJ, J = [(x − centre) × n, n].
    """
    total, row = np.zeros((6, 6)), np.empty(6)
    for i in range(len(at)):
        x, y, z = at[i, 0] - centre[0], at[i, 1] - centre[1], at[i, 2] - centre[2]
        row[3], row[4], row[5] = normals[i, 0], normals[i, 1], normals[i, 2]
        row[0], row[1], row[2] = y * row[5] - z * row[4], z * row[3] - x * row[5], x * row[4] - y * row[3]
        for a in range(6):
            for b in range(a + 1):
                total[a, b] += weights[i] * row[a] * row[b]
    for a in range(6):
        for b in range(a):
            total[b, a] = total[a, b]
    return total


@njit()
def of_twist(covariance, points, centre, own_m, own_rad):
    """Standard deviation (N,) in metres, over all axes, of points (N, 3) that a twist moves about `centre`.

    covariance (6, 6) is the twist's, rotation first, at centre (3,). Each point errs by `own_m` more, and by
    the angle `own_rad` as seen from the origin. A point at x from the centre moves by ω × x + t: this is the
    root of the trace of J C Jᵀ with J = [−hat(x), I].
    """
    deviation_m = np.empty(len(points))
    xx, yy, zz = covariance[0, 0], covariance[1, 1], covariance[2, 2]
    xy, xz, yz = covariance[0, 1], covariance[0, 2], covariance[1, 2]
    ax = covariance[2, 4] - covariance[1, 5]
    ay = covariance[0, 5] - covariance[2, 3]
    az = covariance[1, 3] - covariance[0, 4]
    shifts_sq = covariance[3, 3] + covariance[4, 4] + covariance[5, 5]
    for i in range(len(points)):
        u, v, w = points[i, 0], points[i, 1], points[i, 2]
        x, y, z = u - centre[0], v - centre[1], w - centre[2]
        by_turn_sq = ((yy + zz) * x * x + (xx + zz) * y * y + (xx + yy) * z * z
                      - 2.0 * (xy * x * y + xz * x * z + yz * y * z))
        by_both_sq = 2.0 * (ax * x + ay * y + az * z)
        own_sq = own_m * own_m + own_rad * own_rad * (u * u + v * v + w * w)
        deviation_m[i] = math.sqrt(shifts_sq + by_both_sq + by_turn_sq + own_sq)
    return deviation_m
