"""Ego-motion: the rigid motion of the static world between two scans."""

import contextlib
from dataclasses import dataclass

import numpy as np

from lidarflow import pose
from lidarflow.config import Config, EgoConfig
from lidarflow.errors import DataError
from lidarflow.lidar.registration import (
    Planes,
    overlap,
    reproducible,
    robust_point_to_plane,
    thinned,
)
from lidarflow.types import Scan

# Coarse to fine: how far apart corresponding surfaces may be, in voxels. With voxels of 0.2 m the first stage
# reaches 4 m, the motion of a 10 Hz sensor at 40 m/s, and the last 0.15 m.
_STAGES_VOXELS = (20.0, 7.5, 3.0, 1.5, 0.75)
_COARSE_VOXELS = 5.0         # the first stage works on a cloud thinned this much more
_GUESS_OFF_M = 0.6           # a guess is nearer than this: a sensor at 10 Hz gains 0.1 m at 10 m/s²
_SURPRISE_M = 0.3            # a guess farther off than this, or turned more, is looked at twice
_SURPRISE_RAD = 0.03
_USUAL_OVERLAP = 0.5         # within the last reach: 0.6 to 0.9 of dense scans that lie right, less if not
_MIN_OVERLAP = 0.3           # of the source within the third stage's reach of the target, at the end


@dataclass(frozen=True, slots=True, eq=False)
class Thinned:
    """A scan for registration: points (M, 3), means per voxel in metres, their planes, what it is called."""

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

    It is the registration that begins at the guess, or wide without one. Where the guess turns out to be far
    off, or little of the source to meet the target, a wide one is tried too, and the better taken. Raises
    DataError when the clouds have too little in common.
    """
    if guess is None:
        return reproducible(register(source, target))
    if config.method == "kiss_icp" and not config.refine:
        return reproducible(guess)
    found, share = None, 0.0
    with contextlib.suppress(DataError):
        found = register(source, target, guess, _GUESS_OFF_M)
        share = _overlap(source, target, found)
        if share >= _USUAL_OVERLAP and not _is_far_off(guess, found):
            return reproducible(found)
    try:
        wide = register(source, target)
    except DataError:
        if found is None:
            raise
        return reproducible(found)
    return reproducible(wide if found is None or _overlap(source, target, wide) > share else found)


def register(
    source: Thinned, target: Thinned, start: np.ndarray | None = None, start_off_m: float = np.inf
) -> np.ndarray:
    """target_from_source (4, 4) of two clouds, by robust point-to-plane ICP.

    `start` is a first guess; without one the search begins wide, at the identity. A guess known to be less
    than `start_off_m` off is not searched for wider than that. Raises DataError when the clouds have too
    little in common.
    """
    voxel_m, target_from_source = target.voxel_m, start
    if start is None:
        coarse_m = _COARSE_VOXELS * voxel_m
        target_from_source = robust_point_to_plane(
            thinned(source.points, coarse_m, source.name),
            Planes.of(thinned(target.points, coarse_m, target.name), coarse_m),
            [_STAGES_VOXELS[0] * voxel_m], np.eye(4))
    reaches_m = [reach_voxels * voxel_m for reach_voxels in _STAGES_VOXELS[1:]]
    reaches_m = [reach_m for reach_m in reaches_m if reach_m <= start_off_m] or reaches_m[-1:]
    # In the order of a tree, points that follow one another meet planes that do.
    target_from_source = robust_point_to_plane(
        source.planes.tree.points, target.planes, reaches_m, target_from_source)
    _require_overlap(source, target, target_from_source)
    return target_from_source


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


def _overlap(source: Thinned, target: Thinned, target_from_source: np.ndarray) -> float:
    """Share of the source that comes within the last stage's reach of the target."""
    return overlap(
        source.points, target.planes.tree, _STAGES_VOXELS[-1] * target.voxel_m, target_from_source)


def _is_far_off(guess: np.ndarray, found: np.ndarray) -> bool:
    return bool(
        pose.translation_distance(guess, found) > _SURPRISE_M
        or pose.rotation_distance(guess, found) > _SURPRISE_RAD)
