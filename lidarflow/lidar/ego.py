"""Ego-motion: the rigid motion of the static world between two scans."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np

from lidarflow import pose
from lidarflow.config import Config, EgoConfig
from lidarflow.errors import DataError
from lidarflow.lidar import wide_search
from lidarflow.lidar.registration import (
    Planes,
    overlap,
    reproducible,
    robust_point_to_plane,
)
from lidarflow.types import Scan

# Coarse to fine: how far apart corresponding surfaces may be, in voxels. With voxels of 0.2 m the first stage
# reaches 4 m, the motion of a 10 Hz sensor at 40 m/s, and the last 0.15 m.
_STAGES_VOXELS = (20.0, 7.5, 3.0, 1.5, 0.75)
_COARSE_VOXELS = 5.0         # the first stage works on a cloud thinned this much more
_GUESS_OFF_M = 0.6           # a guess is nearer than this: a sensor at 10 Hz gains 0.1 m at 10 m/s²
_SURPRISE_M = 0.3            # a guess farther off than this, or turned more, is looked at twice
_SURPRISE_RAD = 0.03
_SAME_M = 0.02               # registrations that end nearer to one another agree
_SAME_RAD = 0.002
_ABOUT_RIGHT = 0.9           # of the source within a coarse voxel: 0.94 or more at 10 Hz, at most 0.76 if off
_SURELY_MEETS = 0.2          # within the last reach: scans of two places were brought together by up to 0.17
_CLEARLY_MORE = 0.04         # of the source within the fourth reach: 0.06 to 0.22 when rest led nowhere
_USUAL_OVERLAP = 0.5         # within the last reach: 0.6 to 0.9 of dense scans that lie right, less if not
_MIN_OVERLAP = 0.3           # of the source within the third stage's reach of the target, at the end


@dataclass(frozen=True, slots=True, eq=False)
class Thinned:
    """A scan for registration.

    points   (M, 3)   means per voxel, metres, sensor frame
    planes   Planes   of these
    voxel_m  float
    name     str      what messages call it
    """

    points: np.ndarray
    planes: Planes
    voxel_m: float
    name: str = ""

    @classmethod
    def of(cls, points: np.ndarray, config: Config, name: str = "") -> "Thinned":
        """Of the points (N, 3) in range, thinned to the wanted voxel, to a smaller one in a small place.

        Raises DataError, which says whose points they are (`name`), where too few are left.
        """
        return cls(*Planes.in_range(points, config.preparation, config.ego.voxel_m, name), name)

    @classmethod
    def of_scan(cls, scan: Scan, config: Config) -> "Thinned":
        """As `of`, called as the scan is."""
        return cls.of(scan.points, config, scan.name)


def find(source: Thinned, target: Thinned, guess: np.ndarray | None, config: EgoConfig) -> np.ndarray:
    """target_from_source (4, 4), as the settings want it.

    It is the registration that begins at the guess. Without one, or where it turns out to be far off, or
    little of the source to meet the target, one begins at rest and wide, and where little meets then either,
    and the two do not agree, one all around; that by which more meets is taken. Raises DataError when
    the clouds have too little in common.
    """
    if guess is not None and config.method == "kiss_icp" and not config.refine:
        return reproducible(guess)
    best = None
    if guess is not None:
        best = _found(source, target, lambda: register(source, target, guess, _GUESS_OFF_M))
        if best.share >= _USUAL_OVERLAP and not _is_far_off(guess, best.motion):
            return reproducible(best.motion)
    coarse = cache(lambda: _coarse(source, target))
    from_rest = _found(source, target, lambda: register(source, target, wide_search.from_rest(coarse())))
    is_settled = best is not None and _agree(best, from_rest)
    best = from_rest if best is None else best.or_better(from_rest)
    if best.share < _USUAL_OVERLAP and not is_settled and not _is_about_right(source, target, best):
        best = _or_all_around(source, target, coarse, best)
    if best.refusal:
        raise best.refusal
    return reproducible(best.motion)


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    """What a registration found: the motion (4, 4) and the share of the source that meets the target by it.

    Where it was refused, the identity, nothing, and why.
    """

    motion: np.ndarray
    share: float
    refusal: DataError | None = None

    def or_better(self, other: "_Found") -> "_Found":
        """The other one where it was not refused and more meets by it."""
        is_better = other.refusal is None and (self.refusal or other.share > self.share)
        return other if is_better else self


def _found(source: Thinned, target: Thinned, registration: Callable[[], np.ndarray]) -> _Found:
    try:
        motion = registration()
    except DataError as error:
        return _Found(pose.identity(), 0.0, error)
    return _Found(motion, _overlap(source, target, motion))


def _agree(one: _Found, other: _Found) -> bool:
    """Whether two registrations that began apart came to the same place."""
    return bool(
        not one.refusal and not other.refusal
        and pose.translation_distance(one.motion, other.motion) < _SAME_M
        and pose.rotation_distance(one.motion, other.motion) < _SAME_RAD)


def _is_about_right(source: Thinned, target: Thinned, found: _Found) -> bool:
    """Whether nearly all of the source comes near to the target: sparse scans need not meet more closely."""
    return found.refusal is None and _overlap(
        source, target, found.motion, _COARSE_VOXELS) >= _ABOUT_RIGHT


def _or_all_around(
    source: Thinned, target: Thinned, coarse: Callable[[], wide_search.Coarse], best: _Found
) -> _Found:
    """What is found from the best of many starts, if clearly more meets by it than by the best so far."""
    found = _found(source, target, lambda: register(source, target, wide_search.from_all_around(coarse())))
    if found.share < _SURELY_MEETS:
        return best
    # Wider than the last reach: rings travel with the sensor, and meet by whatever is nearly rest.
    by_found, by_best = (
        _overlap(source, target, one.motion, _STAGES_VOXELS[3]) for one in (found, best))
    return found if best.refusal or by_found > by_best + _CLEARLY_MORE else best


def register(
    source: Thinned, target: Thinned, start: np.ndarray | None = None, start_off_m: float = np.inf
) -> np.ndarray:
    """target_from_source (4, 4) of two clouds, by robust point-to-plane ICP.

    `start` is a first guess; without one the search begins wide, at the identity. A guess known to be less
    than `start_off_m` off is not searched for wider than that. Raises DataError when the clouds have too
    little in common.
    """
    if start is None:
        start = wide_search.from_rest(_coarse(source, target))
    reaches_m = [reach_voxels * target.voxel_m for reach_voxels in _STAGES_VOXELS[1:]]
    reaches_m = [reach_m for reach_m in reaches_m if reach_m <= start_off_m] or reaches_m[-1:]
    # In the order of a tree, points that follow one another meet planes that do.
    target_from_source = robust_point_to_plane(
        source.planes.tree.points, target.planes, reaches_m, start)
    _require_overlap(source, target, target_from_source)
    return target_from_source


def _coarse(source: Thinned, target: Thinned) -> wide_search.Coarse:
    voxel_m = target.voxel_m
    return wide_search.Coarse.of(
        source.points, target.points, _COARSE_VOXELS * voxel_m, _STAGES_VOXELS[0] * voxel_m,
        (source.name, target.name))


def _require_overlap(source: Thinned, target: Thinned, target_from_source: np.ndarray) -> None:
    """Raise DataError unless the motion is rigid and brings the clouds together."""
    reach_m = _STAGES_VOXELS[2] * target.voxel_m
    is_rigid = pose.is_rigid(target_from_source, tolerance=1e-4)
    found = overlap(source.points, target.planes.tree, reach_m, target_from_source) if is_rigid else 0.0
    if found < _MIN_OVERLAP:
        raise DataError(
            f"ego-motion: {found:.0%} of {source.name or 'the first scan'} comes within {reach_m:.2g} m of "
            f"{target.name or 'the second'}, at least {_MIN_OVERLAP:.0%} should; are these consecutive scans "
            "of one sensor?")


def _overlap(
    source: Thinned, target: Thinned, target_from_source: np.ndarray, reach_voxels: float = _STAGES_VOXELS[-1]
) -> float:
    """Share of the source that comes within a reach of the target, that of the last stage."""
    return overlap(source.points, target.planes.tree, reach_voxels * target.voxel_m, target_from_source)


def _is_far_off(guess: np.ndarray, found: np.ndarray) -> bool:
    return bool(
        pose.translation_distance(guess, found) > _SURPRISE_M
        or pose.rotation_distance(guess, found) > _SURPRISE_RAD)
