"""Ego-motion: the rigid motion of the static world between two scans, or along a sequence."""

import numpy as np

from lidarflow import pose
from lidarflow.config import Config, EgoConfig
from lidarflow.errors import DataError
from lidarflow.lidar import preparation
from lidarflow.lidar.registration import (
    Planes,
    overlap,
    reproducible,
    robust_point_to_plane,
    thinned,
    voxel_for,
)

# Coarse to fine: how far apart corresponding surfaces may be, in voxels. With voxels of 0.2 m the first stage
# reaches 4 m, the motion of a 10 Hz sensor at 40 m/s, and the last 0.15 m.
_STAGES_VOXELS = (20.0, 7.5, 3.0, 1.5, 0.75)
_COARSE_VOXELS = 5.0         # the first stage works on a cloud thinned this much more
_GUESS_OFF_M = 0.6           # KISS-ICP is nearer than this
_MIN_OVERLAP = 0.3           # of the source within the third stage's reach of the target, at the end


def find(source: np.ndarray, target: np.ndarray, guess: np.ndarray | None, config: EgoConfig) -> np.ndarray:
    """target_from_source (4, 4) of usable points (N, 3) and (M, 3), as the settings want it.

    It is the guess of `Odometry`, refined unless told otherwise, or found by registration alone. Raises
    DataError when the clouds have too little in common.
    """
    found = guess
    if guess is None or config.refine:
        found = register(source, target, guess, config, np.inf if guess is None else _GUESS_OFF_M)
    return reproducible(found)


def register(
    source: np.ndarray, target: np.ndarray, start: np.ndarray | None, config: EgoConfig,
    start_off_m: float = np.inf,
) -> np.ndarray:
    """target_from_source (4, 4) of two clouds (N, 3) and (M, 3) in metres, by robust point-to-plane ICP.

    `start` is a first guess; without one the search begins wide, at the identity. A guess known to be less
    than `start_off_m` off is not searched for wider than that. Raises DataError when the clouds have too
    little in common.
    """
    voxel_m = voxel_for(source, config.voxel_m)
    fine = thinned(source, voxel_m), Planes.of(thinned(target, voxel_m), voxel_m)
    target_from_source = start
    if start is None:
        coarse_m = _COARSE_VOXELS * voxel_m
        coarse = thinned(source, coarse_m), Planes.of(thinned(target, coarse_m), coarse_m)
        target_from_source = robust_point_to_plane(
            *coarse, [_STAGES_VOXELS[0] * voxel_m], np.eye(4))
    reaches_m = [reach_voxels * voxel_m for reach_voxels in _STAGES_VOXELS[1:]]
    reaches_m = [reach_m for reach_m in reaches_m if reach_m <= start_off_m] or reaches_m[-1:]
    target_from_source = robust_point_to_plane(*fine, reaches_m, target_from_source)
    _require_overlap(*fine, _STAGES_VOXELS[2] * voxel_m, target_from_source)
    return target_from_source


def _require_overlap(
    source: np.ndarray, target: Planes, reach_m: float, target_from_source: np.ndarray
) -> None:
    """Raise DataError unless the motion is rigid and brings the clouds together."""
    is_rigid = pose.is_rigid(target_from_source, tolerance=1e-4)
    found = overlap(source, target.tree, reach_m, target_from_source) if is_rigid else 0.0
    if found < _MIN_OVERLAP:
        raise DataError(
            f"ego-motion: {found:.0%} of the first scan comes within {reach_m:.2g} m of the second, at "
            f"least {_MIN_OVERLAP:.0%} should; are these consecutive scans of one sensor?")


class Odometry:
    """First guesses of the ego-motion along a sequence, by KISS-ICP (Vizzo et al. 2023).

    With the setting ego.method = "registration" there are none.
    """

    def __init__(self, config: Config):
        self._limits = config.preparation
        self._odometry = None if config.ego.method == "registration" else _kiss_icp(self._limits)
        self._world_from_previous: np.ndarray | None = None

    def step(self, points: np.ndarray) -> np.ndarray | None:
        """current_from_previous (4, 4) for the next scan's points (N, 3); None for the first."""
        if self._odometry is None:
            return None
        usable = preparation.usable(points, self._limits)
        self._odometry.register_frame(points[usable], np.empty(0))
        world_from_current = np.array(self._odometry.last_pose)
        previous, self._world_from_previous = self._world_from_previous, world_from_current
        return None if previous is None else pose.inverse(world_from_current) @ previous


def _kiss_icp(limits):
    from kiss_icp.config import KISSConfig
    from kiss_icp.kiss_icp import KissICP

    config = KISSConfig()
    config.data.min_range, config.data.max_range = limits.min_range_m, limits.max_range_m
    config.data.deskew = False   # flow is between the points as they were measured
    config.mapping.voxel_size = limits.max_range_m / 100.0
    return KissICP(config)
