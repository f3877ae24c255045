"""K-Means of the points of a depth image, and which of its clusters touch.

Sums run over chunks of a fixed size, whose partial sums are added in order: the number of threads changes
nothing.
"""

import numba
import numpy as np

_CHUNK = 2048


@numba.njit(cache=True, parallel=True)
def nearest(points, centres):
    """Index (N,) int32 of the centre (K, 3) nearest to each point (N, 3); −1 where z is 0."""
    label = np.empty(len(points), np.int32)
    for chunk in numba.prange((len(points) + _CHUNK - 1) // _CHUNK):
        for i in range(chunk * _CHUNK, min((chunk + 1) * _CHUNK, len(points))):
            label[i] = _nearest(points[i, 0], points[i, 1], points[i, 2], centres)
    return label


@numba.njit(cache=True, inline="always")
def _nearest(x, y, z, centres):
    best, best_sq = -1, np.float32(np.inf)
    if z > 0.0:
        for k in range(len(centres)):
            dx, dy, dz = x - centres[k, 0], y - centres[k, 1], z - centres[k, 2]
            distance_sq = dx * dx + dy * dy + dz * dz
            if distance_sq < best_sq:
                best, best_sq = k, distance_sq
    return best


@numba.njit(cache=True, parallel=True)
def _sums(points, centres):
    chunks = (len(points) + _CHUNK - 1) // _CHUNK
    partial = np.zeros((chunks, len(centres), 4))
    for chunk in numba.prange(chunks):
        for i in range(chunk * _CHUNK, min((chunk + 1) * _CHUNK, len(points))):
            k = _nearest(points[i, 0], points[i, 1], points[i, 2], centres)
            if k >= 0:
                for axis in range(3):
                    partial[chunk, k, axis] += points[i, axis]
                partial[chunk, k, 3] += 1.0
    total = np.zeros((len(centres), 4))
    for chunk in range(chunks):
        total += partial[chunk]
    return total


@numba.njit(cache=True)
def centres(points, seeds, max_rounds, tolerance_m):
    """Centres (K, 3) float32 of the clusters of points (N, 3) float32, z > 0, grown from seeds (K, 3).

    Lloyd's rounds, until no coordinate of a centre moves by more than `tolerance_m`. A centre that no
    point is nearest to stays.
    """
    found = seeds.copy()
    for _ in range(max_rounds):
        total = _sums(points, found)
        largest_step = 0.0
        for k in range(len(found)):
            if total[k, 3] > 0.0:
                for axis in range(3):
                    centre = np.float32(total[k, axis] / total[k, 3])
                    largest_step = max(largest_step, abs(centre - found[k, axis]))
                    found[k, axis] = centre
        if largest_step <= tolerance_m:
            break
    return found


@numba.njit(cache=True)
def touching(label, points, count, reach_m):
    """Matrix (K, K) bool: clusters of `label` (H, W) with neighbouring pixels within `reach_m` in space.

    Points (H, W, 3) in metres, K = `count`. Every cluster touches itself.
    """
    touch = np.zeros((count, count), np.bool_)
    for k in range(count):
        touch[k, k] = True
    reach_sq = reach_m * reach_m
    rows, columns = label.shape
    for v in range(rows):
        for u in range(columns):
            here = label[v, u]
            if here < 0:
                continue
            for other_v, other_u in ((v, u + 1), (v + 1, u)):
                if other_v == rows or other_u == columns:
                    continue
                other = label[other_v, other_u]
                if other < 0 or other == here or touch[here, other]:
                    continue
                distance_sq = 0.0
                for axis in range(3):
                    distance_sq += (points[v, u, axis] - points[other_v, other_u, axis]) ** 2
                if distance_sq < reach_sq:
                    touch[here, other] = touch[other, here] = True
    return touch
