"""Which laser of a spinning sensor each point came from, recovered from file order or from pitch."""

from dataclasses import dataclass

import numpy as np

from lidarflow.kernels import rings as kernel
from lidarflow.rows import median

_MIN_RINGS, _MAX_RINGS = 8, 256
_MIN_POINTS_PER_RING = 50
_MIN_RANGE_M = 0.1
# Lasers sit apart from each other, so one ring's pitch, seen from the common origin, varies with range: by
# 1.5 of 26 degrees on an HDL-64E.
_MAX_RING_PITCH_SHARE = 0.1
_MAX_SHARE_IN_WIDE_RINGS = 0.1   # of the points
_MAX_STEP_RAD = np.radians(10.0)   # from a point to the next of its ring; larger ones are gaps, or the cut
_MIN_SHARE_OF_STEPS = 0.9          # that are no larger, in a file of one revolution after another
_SAME_PITCH_RAD = np.radians(0.08)  # nominal beams lie farther apart than this
_MIN_SHARE_IN_RINGS = 0.95         # of the points, where pitch alone tells rings


@dataclass(frozen=True, slots=True, eq=False)
class Rings:
    """The lasers of a spinning sensor that N points came from.

    index        (N,) int32     0 = highest laser, -1 = none
    azimuth      (N,) float64   of all points
    spacing_rad  float          median angle between a ring and the next
    """

    index: np.ndarray
    azimuth: np.ndarray
    spacing_rad: float


def recover(points: np.ndarray) -> Rings | None:
    """The rings of points (N, 3) in file order.

    None when the cloud is not one revolution of a spinning multi-beam sensor. Rows that are not finite, or
    lie on the sensor, have no laser.
    """
    rows = np.flatnonzero(kernel.usable(points, _MIN_RANGE_M))
    if len(rows) < _MIN_RINGS * _MIN_POINTS_PER_RING:
        return None
    x, y, z = points.T
    azimuth, pitch = np.arctan2(y, x), np.arctan2(z, np.sqrt(x * x + y * y))[rows]
    found = _from_file_order(azimuth[rows], pitch)
    if found is None:
        found = _from_pitch(pitch)
    if found is None:
        return None
    index = np.full(len(points), -1, np.int32)
    index[rows], spacing_rad = found
    return Rings(index, azimuth, spacing_rad)


def _from_file_order(azimuth: np.ndarray, pitch: np.ndarray) -> tuple[np.ndarray, float] | None:
    """Lasers (P,) and spacing of a file of one revolution after another (KITTI, row-major images)."""
    step = kernel.steps(azimuth)
    direction, step_size = np.sign(median(step)), np.abs(step)
    if direction == 0 or np.count_nonzero(step_size < _MAX_STEP_RAD) / len(step) < _MIN_SHARE_OF_STEPS:
        return None
    # Half a step before the first point, so that a ring that starts beside it starts behind the cut. A high
    # ring may see one house, and no cut.
    starts = kernel.cuts(azimuth, direction, 0.5 * median(step_size), _MAX_STEP_RAD)
    # The cut is crossed more than once where azimuth jitters there: short pieces belong to their neighbour.
    starts = np.concatenate([[0], starts])
    starts = starts[np.diff(starts, append=len(azimuth)) >= _MIN_POINTS_PER_RING]
    bounds = np.concatenate([[0], starts[1:], [len(azimuth)]])
    lasers = _lasers(pitch, bounds)
    if lasers is None:
        return None
    return np.repeat(lasers[0], np.diff(bounds)), lasers[1]


def _from_pitch(pitch: np.ndarray) -> tuple[np.ndarray, float] | None:
    """Lasers (P,), or -1, and spacing where pitch takes few values (nominal beam angles, any file order)."""
    order = np.argsort(pitch, kind="stable")
    ascending = pitch[order]
    starts = np.flatnonzero(np.diff(ascending) > _SAME_PITCH_RAD) + 1
    counts = np.diff(np.concatenate([[0], starts, [len(pitch)]]))
    is_large = counts >= _MIN_POINTS_PER_RING
    if counts[is_large].sum() < _MIN_SHARE_IN_RINGS * len(pitch):
        return None
    lasers = _lasers(
        ascending[np.repeat(is_large, counts)], np.concatenate([[0], np.cumsum(counts[is_large])]))
    if lasers is None:
        return None
    laser_of_piece = np.full(len(counts), -1, np.int32)
    laser_of_piece[is_large], spacing_rad = lasers
    laser = np.empty(len(pitch), np.int32)
    laser[order] = np.repeat(laser_of_piece, counts)
    return laser, spacing_rad


def _lasers(pitch: np.ndarray, bounds: np.ndarray) -> tuple[np.ndarray, float] | None:
    """Laser (R,) int32 of each ring, counted from the highest, and their spacing in radians.

    Ring r has pitch[bounds[r]:bounds[r + 1]]. None if rings are not cones of equal pitch.
    """
    counts = np.diff(bounds)
    if not _MIN_RINGS <= len(counts) <= _MAX_RINGS:
        return None
    # Of two numbers in the middle, rings are ordered by the first; their mean is the median.
    ranks = np.column_stack([
        _rank(bounds, 0.1), _rank(bounds, 0.5), bounds[:-1] + counts // 2, _rank(bounds, 0.9)])
    low, middle, next_to_middle, high = kernel.at_ranks(pitch, bounds, ranks).T
    is_wide = high - low > _MAX_RING_PITCH_SHARE * np.ptp(middle)
    if counts[is_wide].sum() > _MAX_SHARE_IN_WIDE_RINGS * len(pitch):
        return None
    from_highest = np.argsort(-middle, kind="stable")
    laser = np.empty(len(counts), np.int32)
    laser[from_highest] = np.arange(len(counts), dtype=np.int32)
    of_ring = (0.5 * (middle + next_to_middle))[from_highest]
    return laser, median(np.abs(np.diff(of_ring)))


def _rank(bounds: np.ndarray, share: float) -> np.ndarray:
    """Index of the entry at `share` of each sorted segment [bounds[r], bounds[r+1])."""
    return (bounds[:-1] + share * (bounds[1:] - bounds[:-1] - 1)).astype(np.int64)
