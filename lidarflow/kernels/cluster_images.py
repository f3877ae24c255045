"""Images seen through clusters: residuals of each, soft membership, and blended motion.

Packed images are those of images.py; `camera` (4,) is fx, fy, cx, cy; a motion is (3, 4), all float32.
"""

import math

import numba
import numpy as np

from lidarflow.kernels.alignment import NEAREST_M, look_up, moved

_NEGLIGIBLE = 6.0   # exp(−6) = 0.0025: weights below it are 0


@numba.njit(cache=True, parallel=True, error_model="numpy")
def residuals(source, target, camera, motion, label, count, max_jump_m, max_depth_m, max_intensity,
              occlusion_m, max_edge_m):
    """Sums (K, 4) over the pixels of each cluster: |r_I|, |r_Z|, their weight, and the number of pixels.

    Residuals of the warp by one motion, cut off at `max_intensity` and `max_depth_m`. Weights sink from 1 to
    0 where something nearer hides the pixel, −r_Z from `occlusion_m` to twice that, and are 0 at edges,
    where depth differs from its four neighbours by more than `max_edge_m` in sum.
    """
    rows, columns = label.shape
    partial = np.zeros((rows, count, 4))
    for v in numba.prange(rows):
        seen = np.empty(6, np.float32)
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
            x, y, z = moved(depth, v, u, camera, motion)
            there_u, there_v = camera[0] * x / z + camera[2], camera[1] * y / z + camera[3]
            if z <= NEAREST_M or not look_up(target, there_u, there_v, max_jump_m, seen):
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


@numba.njit(cache=True, inline="always", error_model="numpy")
def _blending(x, y, z, own, centres, touch, per_m2, weights):
    """Fill `weights` (K,), of sum 1, for a point of cluster `own`: exp(−per_m2 |d_own² − d_k²|) or 0."""
    own_sq = ((x - centres[own, 0]) ** 2 + (y - centres[own, 1]) ** 2 + (z - centres[own, 2]) ** 2)
    total = np.float32(0.0)
    for k in range(len(centres)):
        weights[k] = 0.0
        if touch[own, k]:
            other_sq = ((x - centres[k, 0]) ** 2 + (y - centres[k, 1]) ** 2 + (z - centres[k, 2]) ** 2)
            exponent = per_m2 * abs(own_sq - other_sq)
            if exponent < _NEGLIGIBLE:
                weights[k] = math.exp(-exponent)
                total += weights[k]
    for k in range(len(centres)):
        weights[k] /= total


@numba.njit(cache=True, parallel=True)
def members(points, label, centres, touch, per_m2, min_weight, wanted):
    """Pixels of each wanted cluster (K,) bool: numbers v W + u in ascending order, and where each set starts.

    A pixel is a member where its blending weight exceeds `min_weight`. Set k is
    pixels[starts[k] : starts[k + 1]]; it is empty for clusters that are not wanted.
    """
    rows, columns = label.shape
    count = len(centres)
    near = np.zeros(count, np.int64)   # how many wanted clusters a cluster's pixels may belong to
    for own in range(count):
        for k in range(count):
            near[own] += wanted[k] and touch[own, k]
    per_row = np.zeros((rows, count), np.int64)
    belongs = np.zeros((rows, columns, count), np.bool_)
    for v in numba.prange(rows):
        weights = np.empty(count, np.float32)
        for u in range(columns):
            own = label[v, u]
            if own < 0 or near[own] == 0:
                continue
            _blending(points[v, u, 0], points[v, u, 1], points[v, u, 2], own, centres, touch, per_m2, weights)
            for k in range(count):
                if wanted[k] and weights[k] > min_weight:
                    belongs[v, u, k] = True
                    per_row[v, k] += 1
    starts = np.zeros(count + 1, np.int64)
    first = np.zeros((rows, count), np.int64)
    for k in range(count):
        starts[k + 1] = starts[k]
        for v in range(rows):
            first[v, k] = starts[k + 1]
            starts[k + 1] += per_row[v, k]
    pixels = np.empty(starts[count], np.int32)
    for v in numba.prange(rows):
        for u in range(columns):
            own = label[v, u]
            if own < 0 or near[own] == 0:
                continue
            for k in range(count):
                if belongs[v, u, k]:
                    pixels[first[v, k]] = v * columns + u
                    first[v, k] += 1
    return pixels, starts


@numba.njit(cache=True, parallel=True)
def blended_flow(points, label, centres, touch, per_m2, motions):
    """Flow (H, W, 3) float32 of points (H, W, 3) by the blended motions (K, 3, 4) of touching clusters."""
    rows, columns = label.shape
    flow = np.zeros((rows, columns, 3), np.float32)
    for v in numba.prange(rows):
        weights = np.empty(len(centres), np.float32)
        for u in range(columns):
            own = label[v, u]
            if own < 0:
                continue
            x, y, z = points[v, u, 0], points[v, u, 1], points[v, u, 2]
            _blending(x, y, z, own, centres, touch, per_m2, weights)
            for k in range(len(centres)):
                if weights[k] > 0.0:
                    for axis in range(3):
                        there = (motions[k, axis, 0] * x + motions[k, axis, 1] * y + motions[k, axis, 2] * z
                                 + motions[k, axis, 3])
                        flow[v, u, axis] += weights[k] * (there - points[v, u, axis])
    return flow
