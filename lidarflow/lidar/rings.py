"""Which laser of a spinning sensor each point came from, recovered from file order or from pitch."""

import numpy as np

_MIN_RINGS, _MAX_RINGS = 8, 256
_MIN_POINTS_PER_RING = 50
# Lasers sit apart from each other, so one ring's pitch, seen from the common origin, varies with range: by
# 1.5 of 26 degrees on an HDL-64E.
_MAX_RING_PITCH_SHARE = 0.1
_MAX_SHARE_IN_WIDE_RINGS = 0.1   # of the points
_MAX_STEP_RAD = np.radians(10.0)


def recover(points: np.ndarray) -> np.ndarray | None:
    """Ring index (N,) int32, 0 = highest laser and -1 = none, of points (N, 3) in file order.

    None when the cloud is not one revolution of a spinning multi-beam sensor. Rows that are not finite, or
    lie on the sensor, get -1.
    """
    usable = np.isfinite(points).all(axis=1)
    usable[usable] = np.linalg.norm(points[usable], axis=1) > 0.1
    if usable.sum() < _MIN_RINGS * _MIN_POINTS_PER_RING:
        return None
    x, y, z = points[usable].T
    azimuth, pitch = np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))
    found = _from_file_order(azimuth, pitch)
    if found is None:
        found = _from_pitch(pitch)
    if found is None:
        return None
    ring = np.full(len(points), -1, np.int32)
    ring[usable] = found
    return ring


def _from_file_order(azimuth: np.ndarray, pitch: np.ndarray) -> np.ndarray | None:
    """Rings of a file that stores one laser's revolution after another (KITTI, row-major images)."""
    step = (np.diff(azimuth) + np.pi) % (2 * np.pi) - np.pi
    direction = np.sign(np.median(step))
    if direction == 0 or (np.abs(step) < _MAX_STEP_RAD).mean() < 0.9:
        return None
    # Half a step before the first point, so that a ring that starts beside it starts behind the cut.
    turned = (direction * (azimuth - azimuth[0]) + 0.5 * np.median(np.abs(step))) % (2 * np.pi)
    starts = np.flatnonzero(np.diff(turned) < -_MAX_STEP_RAD) + 1   # a high ring may see one house, no cut
    ring = np.zeros(len(azimuth), np.int64)
    ring[starts] = 1
    ring = np.cumsum(ring)
    counts = np.bincount(ring)
    # The cut is crossed more than once where azimuth jitters there: short pieces belong to their neighbour.
    ring = (np.cumsum(counts >= _MIN_POINTS_PER_RING) - 1).clip(0)[ring]
    return _checked(ring, pitch)


def _from_pitch(pitch: np.ndarray) -> np.ndarray | None:
    """Rings of a cloud whose pitch takes few values (nominal beam angles, any file order)."""
    order = np.argsort(pitch, kind="stable")
    gaps = np.diff(pitch[order])
    ring = np.empty(len(pitch), np.int64)
    ring[order] = np.concatenate([[0], np.cumsum(gaps > np.radians(0.08))])
    counts = np.bincount(ring)
    large = counts >= _MIN_POINTS_PER_RING
    if counts[large].sum() < 0.95 * len(pitch):
        return None
    renumbered = np.cumsum(large) - 1
    ring = np.where(large[ring], renumbered[ring], -1)
    if not (ring >= 0).any():
        return None
    return _checked(ring, pitch)


def _checked(ring: np.ndarray, pitch: np.ndarray) -> np.ndarray | None:
    """`ring` renumbered from the highest laser down, or None if rings are not cones of equal pitch."""
    count = ring.max() + 1
    if not _MIN_RINGS <= count <= _MAX_RINGS:
        return None
    member = ring >= 0
    order = np.lexsort((pitch, np.where(member, ring, count)))[: member.sum()]
    bounds = np.searchsorted(ring[order], np.arange(count + 1))
    low, middle, high = (pitch[order][_rank(bounds, share)] for share in (0.1, 0.5, 0.9))
    is_wide = high - low > _MAX_RING_PITCH_SHARE * np.ptp(middle)
    if np.diff(bounds)[is_wide].sum() > _MAX_SHARE_IN_WIDE_RINGS * len(order):
        return None
    rank = np.empty(count, np.int32)
    rank[np.argsort(-middle, kind="stable")] = np.arange(count, dtype=np.int32)
    return np.where(member, rank[ring], -1).astype(np.int32)


def _rank(bounds: np.ndarray, share: float) -> np.ndarray:
    """Index of the entry at `share` of each sorted segment [bounds[r], bounds[r+1])."""
    return (bounds[:-1] + share * (bounds[1:] - bounds[:-1] - 1)).astype(np.int64)
