"""Images seen through clusters: residuals of each, soft membership, and blended motion.

Packed images, points, cameras and motions are those of alignment.py.
"""

import math

import numba
import numpy as np

from lidarflow.kernels.alignment import look_up
from lidarflow.kernels.compiled import njit
from lidarflow.kernels.linalg import moved

_NEGLIGIBLE = 6.0   # exp(−6) = 0.0025: weights below it are 0


@njit(parallel=True, error_model="numpy")
def residuals(points, source, target, camera, motion, label, count, max_jump_m, max_depth_m, max_intensity,
              occlusion_m, max_edge_m):
    """Sums (K, 4) over the pixels of each cluster: |r_I|, |r_Z|, their weight, and the number of pixels.

    Residuals of the warp by one motion, cut off at `max_intensity` and `max_depth_m`. Weights sink from 1 to
    0 where something nearer hides the pixel, −r_Z from `occlusion_m` to twice that, and are 0 at edges,
    where depth differs from its four neighbours by more than `max_edge_m` in sum.
    """
    rows, columns = label.shape
    partial = np.zeros((rows, count, 4))
    for v in numba.prange(rows):
        seen = np.empty(2, np.float32)
        for u in range(columns):
            k = label[v, u]
            if k < 0:
                continue
            partial[v, k, 3] += 1.0
            if v == 0 or u == 0 or v == rows - 1 or u == columns - 1:
                continue
            depth = source[v, u, 1]
            edge = (abs(source[v - 1, u, 1] - depth) + abs(source[v + 1, u, 1] - depth)
                    + abs(source[v, u - 1, 1] - depth) + abs(source[v, u + 1, 1] - depth))
            if edge > max_edge_m:
                continue
            x, y, z = moved(points[v, u], motion)
            if not look_up(target, camera, x, y, z, max_jump_m, 2, seen):
                continue
            hidden_m = z - seen[1]
            weight = min(max(2.0 - hidden_m / occlusion_m, 0.0), 1.0)
            partial[v, k, 0] += weight * min(abs(seen[0] - source[v, u, 0]), max_intensity)
            partial[v, k, 1] += weight * min(abs(hidden_m), max_depth_m)
            partial[v, k, 2] += weight
    total = np.zeros((count, 4))
    for v in range(rows):
        total += partial[v]
    return total


@njit(parallel=True, error_model="numpy")
def misfits(points, source, target, camera, pixels, starts, motions, tried, max_jump_m, photometric_weight,
            max_intensity, max_depth_m):
    """Mean α |r_I| + |r_Z| (K, K) of set k's pixels after motion j, where tried[k, j]; infinite elsewhere.

    Sets of pixels are those of `members`, motions (K, 3, 4). Residuals are cut off at `max_intensity` and
    `max_depth_m`, which is also what a pixel counts that is not seen again.
    """
    count = len(motions)
    points, source = points.reshape(-1, 3), source.reshape(-1, 6)
    mean = np.full((count, count), np.inf)
    for job in numba.prange(count * count):
        k, j = job // count, job % count
        size = starts[k + 1] - starts[k]
        if not tried[k, j] or size == 0:
            continue
        seen = np.empty(2, np.float32)
        total = 0.0
        for pixel in pixels[starts[k]:starts[k + 1]]:
            x, y, z = moved(points[pixel], motions[j])
            if look_up(target, camera, x, y, z, max_jump_m, 2, seen):
                total += (photometric_weight * min(abs(seen[0] - source[pixel, 0]), max_intensity)
                          + min(abs(seen[1] - z), max_depth_m))
            else:
                total += photometric_weight * max_intensity + max_depth_m
        mean[k, j] = total / size
    return mean


@njit()
def _neighbours(touch):
    """Clusters that touch each cluster, itself included: (K, K) int32 from the left, and how many (K,)."""
    count = len(touch)
    near, number = np.zeros((count, count), np.int32), np.zeros(count, np.int64)
    for own in range(count):
        for k in range(count):
            if touch[own, k]:
                near[own, number[own]] = k
                number[own] += 1
    return near, number


@njit(inline="always", error_model="numpy")
def _blending(point, own, centres, near, per_m2, weights):
    """Fill `weights`, of sum 1, of the clusters `near` that a point of cluster `own` may move with.

    They are exp(−per_m2 |d_own² − d²|) with d the distances to the centres.
    """
    own_sq = _distance_sq(point, centres[own])
    total = np.float32(0.0)
    for i in range(len(near)):
        exponent = per_m2 * abs(own_sq - _distance_sq(point, centres[near[i]]))
        weights[i] = math.exp(-exponent) if exponent < _NEGLIGIBLE else np.float32(0.0)
        total += weights[i]
    for i in range(len(near)):
        weights[i] /= total


@njit(inline="always")
def _distance_sq(a, b):
    x, y, z = a[0] - b[0], a[1] - b[1], a[2] - b[2]
    return x * x + y * y + z * z


@njit()
def members(points, label, centres, touch, per_m2, min_weight, wanted):
    """Pixels of each wanted cluster (K,) bool: numbers v W + u in ascending order, and where each set starts.

    A pixel is a member where its blending weight exceeds `min_weight`. Set k is
    pixels[starts[k] : starts[k + 1]]; it is empty for clusters that are not wanted.
    """
    count = len(centres)
    points, label = points.reshape(-1, 3), label.ravel()
    near, number = _neighbours(touch)
    useful = np.zeros(count, np.bool_)
    for own in range(count):
        for k in near[own, :number[own]]:
            useful[own] |= wanted[k]
    belongs = np.zeros((len(label), number.max()), np.bool_)
    starts = np.zeros(count + 1, np.int64)
    weights = np.empty(count, np.float32)
    for pixel in range(len(label)):
        own = label[pixel]
        if own < 0 or not useful[own]:
            continue
        _blending(points[pixel], own, centres, near[own, :number[own]], per_m2, weights)
        for i in range(number[own]):
            if wanted[near[own, i]] and weights[i] > min_weight:
                belongs[pixel, i] = True
                starts[near[own, i] + 1] += 1
    for k in range(count):
        starts[k + 1] += starts[k]
    pixels, following = np.empty(starts[count], np.int64), starts.copy()
    for pixel in range(len(label)):
        own = label[pixel]
        if own < 0 or not useful[own]:
            continue
        for i in range(number[own]):
            if belongs[pixel, i]:
                pixels[following[near[own, i]]] = pixel
                following[near[own, i]] += 1
    return pixels, starts


@njit(parallel=True)
def blended_flow(points, label, centres, touch, per_m2, motions):
    """Flow (H, W, 3) float32 of points (H, W, 3) by the blended motions (K, 3, 4) of touching clusters."""
    rows, columns = label.shape
    near, number = _neighbours(touch)
    together = np.ones(len(touch), np.bool_)   # clusters that move as all that they touch: nothing to blend
    for own in range(len(touch)):
        for k in near[own, :number[own]]:
            together[own] &= (motions[k] == motions[own]).all()
    flow = np.zeros((rows, columns, 3), np.float32)
    for v in numba.prange(rows):
        weights = np.empty(len(centres), np.float32)
        for u in range(columns):
            own = label[v, u]
            if own < 0:
                continue
            point = points[v, u]
            if together[own]:
                _add_flow(point, motions[own], np.float32(1.0), flow[v, u])
                continue
            around = near[own, :number[own]]
            _blending(point, own, centres, around, per_m2, weights)
            for i in range(len(around)):
                _add_flow(point, motions[around[i]], weights[i], flow[v, u])
    return flow


@njit(inline="always")
def _add_flow(point, motion, weight, flow):
    x, y, z = moved(point, motion)
    flow[0] += weight * (x - point[0])
    flow[1] += weight * (y - point[1])
    flow[2] += weight * (z - point[2])
