"""What many shifts agree on: the median of some, and the most common that lead from one cloud to another."""

import numpy as np

from lidarflow.kernels.compiled import njit


@njit()
def median(shifts):
    """Median (3,) of the shifts (K, 3) along each axis."""
    middle, half = np.empty(3), len(shifts) // 2
    for k in range(3):
        ordered = np.sort(shifts[:, k])
        middle[k] = ordered[half] if len(shifts) % 2 else (ordered[half - 1] + ordered[half]) / 2.0
    return middle


@njit()
def peaks(source, target, max_shift_m, max_rise_m, cell_m, count):
    """Mean shifts (≤ count, 3) of the cells along the ground that most shifts lead to, most votes first.

    Every shift from one of `source` (N, 3) to one of `target` (M, 3) votes that is no longer along the ground
    than `max_shift_m` and no higher than `max_rise_m`.
    """
    reach = int(np.ceil(max_shift_m / cell_m)) + 1
    votes = np.zeros((2 * reach + 1, 2 * reach + 1), np.int64)
    sums = np.zeros((2 * reach + 1, 2 * reach + 1, 3))
    for i in range(len(source)):
        for j in range(len(target)):
            dx, dy = target[j, 0] - source[i, 0], target[j, 1] - source[i, 1]
            dz = target[j, 2] - source[i, 2]
            if dx * dx + dy * dy > max_shift_m * max_shift_m or abs(dz) > max_rise_m:
                continue
            u, v = int(np.floor(dx / cell_m)) + reach, int(np.floor(dy / cell_m)) + reach
            votes[u, v] += 1
            sums[u, v, 0] += dx
            sums[u, v, 1] += dy
            sums[u, v, 2] += dz
    found = np.empty((count, 3))
    for peak in range(count):
        best = np.argmax(votes)
        u, v = best // votes.shape[1], best % votes.shape[1]
        if votes[u, v] == 0:
            return found[:peak].copy()
        for k in range(3):
            found[peak, k] = sums[u, v, k] / votes[u, v]
        votes[u, v] = 0
    return found
