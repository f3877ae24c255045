"""Images of intensity and depth: smaller ones, and their gradients; surfaces are never mixed.

Depth is 0 where there is none. Layers of a packed image (H, W, 6): intensity, depth, the intensity's
gradients along u and v, the depth's gradients along u and v.
"""

import math

import numba
import numpy as np

from lidarflow.kernels.compiled import njit
from lidarflow.kernels.sorting import sort

_INTENSITY_GRAIN = 1e-6   # keep the mean of two slopes defined where both are 0
_DEPTH_GRAIN_M = 0.005


@njit(parallel=True)
def resize(intensity, depth, width, height, max_jump_m):
    """Area mean of intensity and a surface's mean depth, both (height, width), of larger images (H, W).

    A pixel's depth is the area mean of the readings under it that lie within `max_jump_m` of their median.
    """
    rows, columns = depth.shape
    scale_v, scale_u = rows / height, columns / width
    small_intensity = np.empty((height, width), np.float32)
    small_depth = np.zeros((height, width), np.float32)
    most = (math.ceil(scale_v) + 1) * (math.ceil(scale_u) + 1)
    for v in numba.prange(height):
        readings, in_order = np.empty(most, np.float32), np.empty(most, np.float32)
        shares = np.empty(most)
        top, bottom = v * scale_v, (v + 1) * scale_v
        for u in range(width):
            left, right = u * scale_u, (u + 1) * scale_u
            total, area, count = 0.0, 0.0, 0
            for j in range(int(top), min(math.ceil(bottom - 1e-9), rows)):
                share_v = min(bottom, j + 1.0) - max(top, float(j))
                for i in range(int(left), min(math.ceil(right - 1e-9), columns)):
                    share = share_v * (min(right, i + 1.0) - max(left, float(i)))
                    total += share * intensity[j, i]
                    area += share
                    if depth[j, i] > 0.0:
                        readings[count], shares[count] = depth[j, i], share
                        count += 1
            small_intensity[v, u] = total / area
            small_depth[v, u] = _surface_depth(readings, shares, count, max_jump_m, in_order)
    return small_intensity, small_depth


@njit()
def _surface_depth(readings, shares, count, max_jump_m, in_order):
    """Mean, weighted by `shares`, of the first `count` readings near their lower median; 0 without any.

    `in_order` is room for as many.
    """
    if count == 0:
        return 0.0
    in_order[:count] = readings[:count]
    sort(in_order[:count])
    middle = in_order[(count - 1) // 2]
    total = weight = 0.0
    for k in range(count):
        if abs(readings[k] - middle) < max_jump_m:
            total += shares[k] * readings[k]
            weight += shares[k]
    return total / weight


@njit(parallel=True)
def halve(intensity, depth, max_jump_m):
    """The next level (H // 2, W // 2) of a pyramid: a 4x4 binomial window over one surface.

    The surface is that of the lower median of the four pixels in the middle; readings count less the
    farther they are from it in depth, and not at all from `max_jump_m` on.
    """
    rows, columns = depth.shape
    height, width = rows // 2, columns // 2
    small_intensity = np.empty((height, width), np.float32)
    small_depth = np.zeros((height, width), np.float32)
    for v in numba.prange(height):
        middles = np.empty(4, np.float32)
        for u in range(width):
            count = 0
            for k in range(4):
                reading = depth[2 * v + k // 2, 2 * u + k % 2]
                if reading > 0.0:
                    middles[count] = reading
                    count += 1
            sort(middles[:count])
            middle = middles[(count - 1) // 2] if count else 0.0
            plain = plain_weight = near = near_depth = near_weight = 0.0
            for j in range(max(2 * v - 1, 0), min(2 * v + 3, rows)):
                share_v = 2.0 if j == 2 * v or j == 2 * v + 1 else 1.0
                for i in range(max(2 * u - 1, 0), min(2 * u + 3, columns)):
                    share = 2.0 * share_v if i == 2 * u or i == 2 * u + 1 else share_v
                    plain += share * intensity[j, i]
                    plain_weight += share
                    off = abs(depth[j, i] - middle)
                    if count and depth[j, i] > 0.0 and off < max_jump_m:
                        weight = share * (max_jump_m - off)
                        near += weight * intensity[j, i]
                        near_depth += weight * depth[j, i]
                        near_weight += weight
            if count:
                small_intensity[v, u] = near / near_weight
                small_depth[v, u] = near_depth / near_weight
            else:
                small_intensity[v, u] = plain / plain_weight
    return small_intensity, small_depth


@njit(parallel=True)
def pack(intensity, depth):
    """Packed image (H, W, 6) float32 of an intensity and a depth image (H, W), gradients per pixel.

    A gradient is the mean of the slopes to either side, each weighted by the other's size: along an edge
    it stays on the flatter side. Depth has a slope only to pixels that have depth.
    """
    rows, columns = depth.shape
    packed = np.zeros((rows, columns, 6), np.float32)
    for v in numba.prange(rows):
        for u in range(columns):
            here, z = intensity[v, u], depth[v, u]
            packed[v, u, 0], packed[v, u, 1] = here, z
            left, right, up, down = u > 0, u < columns - 1, v > 0, v < rows - 1
            packed[v, u, 2] = _slope(
                left, here - intensity[v, u - left], right, intensity[v, u + right] - here, _INTENSITY_GRAIN)
            packed[v, u, 3] = _slope(
                up, here - intensity[v - up, u], down, intensity[v + down, u] - here, _INTENSITY_GRAIN)
            if z > 0.0:
                z_left, z_right = depth[v, u - left], depth[v, u + right]
                z_up, z_down = depth[v - up, u], depth[v + down, u]
                packed[v, u, 4] = _slope(
                    left and z_left > 0.0, z - z_left, right and z_right > 0.0, z_right - z, _DEPTH_GRAIN_M)
                packed[v, u, 5] = _slope(
                    up and z_up > 0.0, z - z_up, down and z_down > 0.0, z_down - z, _DEPTH_GRAIN_M)
    return packed


@njit(inline="always")
def _slope(has_before, before, has_after, after, grain):
    if has_before and has_after:
        size_before, size_after = abs(before) + grain, abs(after) + grain
        return (size_after * before + size_before * after) / (size_before + size_after)
    if has_before:
        return before
    return after if has_after else 0.0 * after
