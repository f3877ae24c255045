"""SHOT352 descriptors (Tombari, Salti, Di Stefano 2010): 32 volumes × 11 bins of normal cosine.

The layout of the 352 numbers is the one of the Point Cloud Library: volume = 4 · azimuth sector +
2 · (outer shell) + (above), eleven cosine bins each.
"""

import math

import numba
import numpy as np

from lidarflow.kernels import grid
from lidarflow.kernels.compiled import njit
from lidarflow.kernels.linalg import symmetric_eigen3

SIZE = 352
_BINS = 11
_SECTORS = 8
_MIN_FRAME_NEIGHBOURS = 5


def describe(
    keypoints: np.ndarray, surface: np.ndarray, normals: np.ndarray, radius_m: float, min_neighbours: int
) -> tuple[np.ndarray, np.ndarray]:
    """Descriptors (K, 352) float32 of unit norm and frames (K, 3, 3) with rows x, y, z.

    keypoints (K, 3), surface (S, 3), normals (S, 3) of the surface; rows without enough neighbours are NaN.
    """
    order, keys, lower, shape = grid.build(surface, radius_m)
    return _describe(keypoints, surface[order], normals[order], keys, lower, shape, radius_m, min_neighbours)


@njit(parallel=True, fastmath={"contract", "arcp", "reassoc"})
def _describe(keypoints, surface, normals, keys, lower, shape, radius_m, min_neighbours):
    n = len(keypoints)
    descriptors = np.full((n, SIZE), np.nan, np.float32)
    frames = np.full((n, 3, 3), np.nan)
    for i in numba.prange(n):
        starts, ends = np.empty(9, np.int64), np.empty(9, np.int64)
        run_count = grid.runs(keypoints[i], keys, lower, shape, radius_m, starts, ends)
        room = 0
        for run in range(run_count):
            room += ends[run] - starts[run]
        offsets, index = np.empty((room, 4)), np.empty(room, np.int64)
        count = _gather(keypoints[i], surface, starts, ends, run_count, radius_m, offsets, index)
        if count < min_neighbours or not _local_frame(offsets, count, radius_m, frames[i]):
            continue
        histogram = np.zeros(SIZE, np.float32)
        for k in range(count):
            cosine = 0.0
            for a in range(3):
                cosine += frames[i, 2, a] * normals[index[k], a]
            if cosine == cosine:
                _vote(histogram, frames[i], offsets[k], cosine, radius_m)
        norm_sq = 0.0
        for k in range(SIZE):
            norm_sq += histogram[k] * histogram[k]
        if norm_sq > 0.0:
            descriptors[i] = histogram / math.sqrt(norm_sq)
    return descriptors, frames


@njit()
def _gather(keypoint, surface, starts, ends, run_count, radius_m, offsets, index):
    """How many neighbours, the keypoint left out; fills offsets (·, 4) x y z distance and surface rows."""
    count = 0
    for run in range(run_count):
        for j in range(starts[run], ends[run]):
            x, y, z = surface[j, 0] - keypoint[0], surface[j, 1] - keypoint[1], surface[j, 2] - keypoint[2]
            distance_sq = x * x + y * y + z * z
            if 0.0 < distance_sq <= radius_m * radius_m:
                offsets[count, 0], offsets[count, 1], offsets[count, 2] = x, y, z
                offsets[count, 3] = math.sqrt(distance_sq)
                index[count] = j
                count += 1
    return count


@njit()
def _local_frame(offsets, count, radius_m, frame):
    """Fill `frame` (rows x, y, z) from the covariance weighted by radius − distance; False if degenerate."""
    if count < _MIN_FRAME_NEIGHBOURS:
        return False
    xx = xy = xz = yy = yz = zz = total = 0.0
    for k in range(count):
        x, y, z = offsets[k, 0], offsets[k, 1], offsets[k, 2]
        weight = radius_m - offsets[k, 3]
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
    ahead = 0
    total = 0.0
    for k in range(count):
        along = offsets[k, 0] * axis[0] + offsets[k, 1] * axis[1] + offsets[k, 2] * axis[2]
        total += along
        if along >= 0.0:
            ahead += 1
    if 2 * ahead < count or (2 * ahead == count and total < 0.0):
        for a in range(3):
            axis[a] = -axis[a]


@njit(inline="always")
def angle(y, x):
    """atan2(y, x) to 1e-7 radians, in a quarter of its time (Abramowitz and Stegun 1964, 4.4.49)."""
    low, high = min(abs(x), abs(y)), max(abs(x), abs(y))
    if high == 0.0:
        return 0.0
    ratio = low / high
    s = ratio * ratio
    series = 0.0028662257
    series = series * s - 0.0161657367
    series = series * s + 0.0429096138
    series = series * s - 0.0752896400
    series = series * s + 0.1065626393
    series = series * s - 0.1420889944
    series = series * s + 0.1999355085
    series = series * s - 0.3333314528
    found = ratio * (series * s + 1.0)
    if abs(y) > abs(x):
        found = 0.5 * math.pi - found
    if x < 0.0:
        found = math.pi - found
    return -found if y < 0.0 else found


@njit()
def _vote(histogram, frame, offset, cosine, radius_m):
    """Add one neighbour to its bin and, linearly, to the next bin in cosine, shell, elevation and azimuth."""
    distance = offset[3]
    x = offset[0] * frame[0, 0] + offset[1] * frame[0, 1] + offset[2] * frame[0, 2]
    y = offset[0] * frame[1, 0] + offset[1] * frame[1, 1] + offset[2] * frame[1, 2]
    z = offset[0] * frame[2, 0] + offset[1] * frame[2, 1] + offset[2] * frame[2, 2]

    place = (1.0 + min(1.0, max(-1.0, cosine))) * 0.5 * (_BINS - 1)
    bin_ = math.floor(place + 0.5)
    beside_bin = place - bin_

    turns = (angle(y, x) + math.pi) * (_SECTORS / (2.0 * math.pi))
    sector = min(int(turns), _SECTORS - 1)
    beside_sector = turns - sector - 0.5

    outer = 1 if distance > 0.5 * radius_m else 0
    beside_shell = 2.0 * distance / radius_m - (1.5 if outer else 0.5)

    above = 1 if z > 0.0 else 0
    inclination = angle(math.sqrt(x * x + y * y), z) / (0.5 * math.pi)
    beside_inclination = inclination - (0.5 if above else 1.5)

    volume = 4 * sector + 2 * outer + above
    weight = 1.0 - abs(beside_bin)
    if beside_bin > 0.0:
        histogram[volume * _BINS + bin_ + 1] += beside_bin
    elif beside_bin < 0.0:
        histogram[volume * _BINS + bin_ - 1] -= beside_bin

    # The innermost, outermost, lowest and highest volumes have no neighbour on the far side.
    weight += 1.0 - abs(beside_shell)
    if (outer == 1) == (beside_shell < 0.0):
        histogram[(volume + (-2 if outer else 2)) * _BINS + bin_] += abs(beside_shell)
    weight += 1.0 - abs(beside_inclination)
    if (above == 1) == (beside_inclination > 0.0):
        histogram[(volume + (-1 if above else 1)) * _BINS + bin_] += abs(beside_inclination)

    weight += 1.0 - abs(beside_sector)
    step = 1 if beside_sector > 0.0 else _SECTORS - 1
    next_sector = (sector + step) % _SECTORS
    histogram[(4 * next_sector + 2 * outer + above) * _BINS + bin_] += abs(beside_sector)
    histogram[volume * _BINS + bin_] += weight
