"""K-Means of the points of a depth image, and which of its clusters touch.

Sums run over chunks of a fixed size, whose partial sums are added in order: the number of threads changes
nothing.
"""

import numba
import numpy as np

from lidarflow.kernels import queue
from lidarflow.kernels.compiled import njit

_CHUNK = 1024


@njit(parallel=True)
def nearest(points, centres):
    """Index (N,) int32 of the centre (K, 3) nearest to each point (N, 3); −1 where z is 0. All float32."""
    label = np.empty(len(points), np.int32)
    waiting = queue.tasks()
    for _ in numba.prange(queue.PLACES):
        chunk = queue.take(waiting)
        while chunk < (len(points) + _CHUNK - 1) // _CHUNK:
            start, end = chunk * _CHUNK, min((chunk + 1) * _CHUNK, len(points))
            _label_chunk(points[start:end], centres, label[start:end])
            chunk = queue.take(waiting)
    return label


@njit()
def _label_chunk(points, centres, label):
    """As `nearest`, for so few points that everything stays in the nearest cache."""
    count = len(points)
    x, y, z = np.empty(count, np.float32), np.empty(count, np.float32), np.empty(count, np.float32)
    smallest_sq = np.full(count, np.inf, np.float32)
    for i in range(count):
        x[i], y[i], z[i] = points[i, 0], points[i, 1], points[i, 2]
        label[i] = -1
    for k in range(len(centres)):
        cx, cy, cz = centres[k, 0], centres[k, 1], centres[k, 2]
        for i in range(count):   # without branches, so that it uses vector registers
            distance_sq = (x[i] - cx) * (x[i] - cx) + (y[i] - cy) * (y[i] - cy) + (z[i] - cz) * (z[i] - cz)
            closer = distance_sq < smallest_sq[i]
            smallest_sq[i] = distance_sq if closer else smallest_sq[i]
            label[i] = k if closer else label[i]
    for i in range(count):
        if z[i] <= 0.0:
            label[i] = -1


@njit(parallel=True)
def _sums(points, centres):
    """Sums (K, 4) of the coordinates of the points nearest to each centre, and their number."""
    chunks = (len(points) + _CHUNK - 1) // _CHUNK
    partial = np.zeros((chunks, len(centres), 4))
    waiting = queue.tasks()
    for _ in numba.prange(queue.PLACES):
        chunk = queue.take(waiting)
        while chunk < chunks:
            start, end = chunk * _CHUNK, min((chunk + 1) * _CHUNK, len(points))
            label = np.empty(end - start, np.int32)
            _label_chunk(points[start:end], centres, label)
            for i in range(end - start):
                k = label[i]
                if k >= 0:
                    for axis in range(3):
                        partial[chunk, k, axis] += points[start + i, axis]
                    partial[chunk, k, 3] += 1.0
            chunk = queue.take(waiting)
    total = np.zeros((len(centres), 4))
    for chunk in range(chunks):
        total += partial[chunk]
    return total


@njit()
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


@njit()
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
