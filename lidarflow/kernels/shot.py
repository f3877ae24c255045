"""SHOT352 descriptors (Tombari, Salti, Di Stefano 2010): 32 volumes × 11 bins of normal cosine.

The layout of the 352 numbers is the one of the Point Cloud Library: volume = 4 · azimuth sector +
2 · (outer shell) + (above), eleven cosine bins each.

Neighbours are first all placed, then all counted: only the counting depends on the order, and loops without
branches run on several neighbours at once.
"""

import math
from typing import NamedTuple

import numba
import numpy as np

from lidarflow.kernels import grid, local_frame, queue
from lidarflow.kernels.compiled import njit

SIZE = 352
_BINS = 11
_VOLUMES = 32
_SECTORS = 8
_SHARES = 5      # bins that a neighbour is shared among: its own and one beside it in each direction
_CHUNK = 16      # keypoints that one thread takes at a time
_TINY = 1e-300


class Support(NamedTuple):
    """What descriptors see: points (S, 3) and normals (S, 3) of a surface, in the order of a grid."""

    points: np.ndarray
    normals: np.ndarray
    keys: np.ndarray
    lower: np.ndarray
    shape: np.ndarray
    radius_m: float


def support(surface: np.ndarray, normals: np.ndarray, radius_m: float) -> Support:
    """The points (S, 3) of a surface and its normals (S, 3), to be seen within `radius_m` of keypoints."""
    order, keys, lower, shape = grid.build(surface, radius_m)
    return Support(
        surface.take(order, axis=0), normals.take(order, axis=0), keys, lower, shape, radius_m)


def describe(keypoints: np.ndarray, seen: Support, min_neighbours: int) -> tuple[np.ndarray, np.ndarray]:
    """Descriptors (K, 352) float32 of unit norm and frames (K, 3, 3) with rows x, y, z.

    Rows of the keypoints (K, 3) without enough neighbours are NaN.
    """
    descriptors = np.empty((len(keypoints), SIZE), np.float32)
    return descriptors, describe_into(descriptors, np.arange(len(keypoints)), keypoints, seen, min_neighbours)


def describe_into(
    table: np.ndarray, rows: np.ndarray, keypoints: np.ndarray, seen: Support, min_neighbours: int
) -> np.ndarray:
    """As `describe`, with the descriptors at `rows` (K,) of a table (T, 352); returns the frames."""
    frames = np.full((len(keypoints), 3, 3), np.nan)
    _describe(keypoints, *seen, min_neighbours, table, rows, frames)
    return frames


@njit(parallel=True)
def _describe(keypoints, surface, normals, keys, lower, shape, radius_m, min_neighbours, table, rows, frames):
    waiting = queue.tasks()
    for _ in numba.prange(queue.PLACES):
        chunk = queue.take(waiting)
        while chunk < (len(keypoints) + _CHUNK - 1) // _CHUNK:
            start, end = chunk * _CHUNK, (chunk + 1) * _CHUNK
            _describe_some(
                keypoints[start:end], surface, normals, keys, lower, shape, radius_m, min_neighbours, table,
                rows[start:end], frames[start:end])
            chunk = queue.take(waiting)


@njit()
def _describe_some(
    keypoints, surface, normals, keys, lower, shape, radius_m, min_neighbours, table, rows, frames
):
    starts, ends = np.empty(9, np.int64), np.empty(9, np.int64)
    offsets, index, cosines = np.empty((4, 0)), np.empty(0, np.int64), np.empty(0)
    bins, shares = np.empty((_SHARES, 0), np.int64), np.empty((_SHARES, 0))
    for i in range(len(keypoints)):
        run_count = grid.runs(keypoints[i], keys, lower, shape, radius_m, starts, ends)
        room = grid.room(starts, ends, run_count) + 1
        if room > len(index):
            room *= 2
            offsets, index, cosines = np.empty((4, room)), np.empty(room, np.int64), np.empty(room)
            bins, shares = np.empty((_SHARES, room), np.int64), np.empty((_SHARES, room))
        count = _gather(keypoints[i], surface, starts, ends, run_count, radius_m, offsets, index)
        frame, descriptor = frames[i], table[rows[i]]
        descriptor[:] = np.nan
        if count < min_neighbours or not local_frame.fill(frame, offsets, count, radius_m):
            continue
        count = _incline(frame[2], normals, index, count, offsets, cosines)
        _share(frame, offsets, cosines, count, radius_m, bins, shares)
        _count(bins, shares, count, descriptor)


@njit()
def _gather(keypoint, surface, starts, ends, run_count, radius_m, offsets, index):
    """How many neighbours, the keypoint left out; fills offsets (4, ·) x y z distance and surface rows."""
    px, py, pz = keypoint[0], keypoint[1], keypoint[2]
    count = 0
    for run in range(run_count):
        for j in range(starts[run], ends[run]):
            x, y, z = surface[j, 0] - px, surface[j, 1] - py, surface[j, 2] - pz
            distance_sq = x * x + y * y + z * z
            # Written anyway, and overwritten by the next where it is no neighbour.
            offsets[0, count], offsets[1, count], offsets[2, count] = x, y, z
            offsets[3, count], index[count] = distance_sq, j
            count += 1 if 0.0 < distance_sq <= radius_m * radius_m else 0
    for k in range(count):
        offsets[3, k] = math.sqrt(offsets[3, k])
    return count


@njit()
def _incline(axis, normals, index, count, offsets, cosines):
    """How many neighbours have a normal; moves them to the front and fills the cosines (·,) with `axis`."""
    kept = 0
    for k in range(count):
        normal = normals[index[k]]
        cosine = axis[0] * normal[0] + axis[1] * normal[1] + axis[2] * normal[2]
        cosines[kept] = cosine
        for a in range(4):
            offsets[a, kept] = offsets[a, k]
        kept += 1 if cosine == cosine else 0
    return kept


@njit(inline="always")
def angle(y, x):
    """atan2(y, x) to 1e-7 radians, in a fraction of its time (Abramowitz and Stegun 1964, 4.4.49)."""
    low, high = min(abs(x), abs(y)), max(abs(x), abs(y))
    ratio = low / max(high, _TINY)
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
    found = 0.5 * math.pi - found if abs(y) > abs(x) else found
    found = math.pi - found if x < 0.0 else found
    return -found if y < 0.0 else found


@njit()
def _share(frame, offsets, cosines, count, radius_m, bins, shares):
    """Fill the bins (5, ·) of each neighbour and its shares (5, ·) in them.

    It has its own bin and, linearly, the next one in cosine, shell, elevation and azimuth.
    """
    x0, x1, x2 = frame[0, 0], frame[0, 1], frame[0, 2]
    y0, y1, y2 = frame[1, 0], frame[1, 1], frame[1, 2]
    z0, z1, z2 = frame[2, 0], frame[2, 1], frame[2, 2]
    for k in range(count):
        dx, dy, dz, distance = offsets[0, k], offsets[1, k], offsets[2, k], offsets[3, k]
        x, y, z = dx * x0 + dy * x1 + dz * x2, dx * y0 + dy * y1 + dz * y2, dx * z0 + dy * z1 + dz * z2

        place = (1.0 + min(1.0, max(-1.0, cosines[k]))) * 0.5 * (_BINS - 1)
        bin_ = math.floor(place + 0.5)
        beside_bin = place - bin_

        turns = (angle(y, x) + math.pi) * (_SECTORS / (2.0 * math.pi))
        sector = min(math.floor(turns), _SECTORS - 1)
        beside_sector = turns - sector - 0.5

        outer = 1 if distance > 0.5 * radius_m else 0
        beside_shell = 2.0 * distance / radius_m - 0.5 - outer

        above = 1 if z > 0.0 else 0
        inclination = angle(math.sqrt(x * x + y * y), z) / (0.5 * math.pi)
        beside_inclination = inclination - 1.5 + above

        # The innermost, outermost, lowest and highest volumes have no neighbour on the far side.
        shell_share = abs(beside_shell) if (outer == 1) == (beside_shell < 0.0) else 0.0
        inclination_share = abs(beside_inclination) if (above == 1) == (beside_inclination > 0.0) else 0.0
        step = 1 if beside_sector > 0.0 else _SECTORS - 1
        next_sector = (sector + step) & (_SECTORS - 1)

        own = (4 * sector + 2 * outer + above) * _BINS + bin_
        bins[0, k] = own
        bins[1, k] = own + (1 if beside_bin > 0.0 else 0) - (1 if beside_bin < 0.0 else 0)
        bins[2, k] = own + (2 - 4 * outer) * _BINS
        bins[3, k] = own + (1 - 2 * above) * _BINS
        bins[4, k] = own + 4 * (next_sector - sector) * _BINS
        shares[0, k] = (1.0 - abs(beside_bin)) + (1.0 - abs(beside_shell)) \
            + (1.0 - abs(beside_inclination)) + (1.0 - abs(beside_sector))
        shares[1, k] = abs(beside_bin)
        shares[2, k], shares[3, k], shares[4, k] = shell_share, inclination_share, abs(beside_sector)


@njit()
def _count(bins, shares, count, descriptor):
    """Fill a descriptor (352,) with the sums of the shares in each bin, made unit length; NaN for none."""
    descriptor[:] = 0.0
    for k in range(count):
        for share in range(_SHARES):
            descriptor[bins[share, k]] += shares[share, k]
    squares = np.zeros(_VOLUMES, np.float32)
    for bin_ in range(_BINS):
        for volume in range(_VOLUMES):
            squares[volume] += descriptor[bin_ * _VOLUMES + volume] ** 2
    norm = math.sqrt(squares.sum())
    for k in range(SIZE):
        descriptor[k] = descriptor[k] / norm if norm > 0.0 else np.nan
