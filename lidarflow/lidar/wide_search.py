"""Where a registration of two scans begins when nothing is known: at rest, or from all around."""

from dataclasses import dataclass

import numpy as np

from lidarflow import pose
from lidarflow.lidar.registration import Planes, overlap, robust_point_to_plane, thinned
from lidarflow.rows import every_few

# A sensor at 2 Hz comes so far in a street, or turns so far in a hand; one at 10 Hz does neither.
_RINGS_M = (4.0, 8.0, 12.0)
_DIRECTIONS = 8
_TURNS_RAD = (-1.0, -0.5, 0.5, 1.0)
_SAMPLE = 1500               # points of the source; where they meet nothing, more do not either


@dataclass(frozen=True, slots=True, eq=False)
class Coarse:
    """Two scans thinned so far that all of one may be looked for in all of the other.

    source   (N, 3)   metres, source frame
    target   Planes   target frame
    voxel_m  float    that both are thinned to
    reach_m  float    how far apart corresponding surfaces may be
    """

    source: np.ndarray
    target: Planes
    voxel_m: float
    reach_m: float

    @classmethod
    def of(
        cls, source: np.ndarray, target: np.ndarray, voxel_m: float, reach_m: float, names: tuple[str, str]
    ) -> "Coarse":
        """Of points (N, 3) and (M, 3); DataError, which says whose (`names`), where too few are left."""
        points = thinned(source, voxel_m, names[0])
        return cls(points, Planes.of(thinned(target, voxel_m, names[1]), voxel_m), voxel_m, reach_m)


def from_rest(scans: Coarse) -> np.ndarray:
    """target_from_source (4, 4) as it is found from the identity."""
    return robust_point_to_plane(scans.source, scans.target, [scans.reach_m], np.eye(4))


def from_all_around(scans: Coarse) -> np.ndarray:
    """Of what is found from many shifts and turns, target_from_source (4, 4), that by which most meets."""
    points = scans.source[every_few(len(scans.source), _SAMPLE)]
    ends = [robust_point_to_plane(points, scans.target, [scans.reach_m], start) for start in _starts()]
    shares = [overlap(points, scans.target.tree, scans.voxel_m, motion) for motion in ends]
    return ends[int(np.argmax(shares))]


def _starts() -> list[np.ndarray]:
    """Motions (4, 4) to begin at: along the ground in all directions, or turned about the vertical."""
    angles = np.arange(_DIRECTIONS) * (2.0 * np.pi / _DIRECTIONS)
    around = np.stack([np.cos(angles), np.sin(angles), np.zeros(_DIRECTIONS)], axis=1)
    shifts = np.concatenate([ring_m * around for ring_m in _RINGS_M])
    return [*pose.from_translation(shifts), *map(pose.from_yaw, _TURNS_RAD)]
