"""Where a registration of two scans begins when nothing is known and beginning at rest has led nowhere."""

import numpy as np

from lidarflow import pose
from lidarflow.lidar.registration import Planes, overlap, robust_point_to_plane, thinned
from lidarflow.rows import every_few

# A sensor at 2 Hz comes so far in a street, or turns so far in a hand; one at 10 Hz does neither.
_RINGS_M = (4.0, 8.0, 12.0)
_DIRECTIONS = 8
_TURNS_RAD = (-1.0, -0.5, 0.5, 1.0)
_SAMPLE = 1500               # points of the source; where they meet nothing, more do not either


def best_start(source: np.ndarray, target: np.ndarray, voxel_m: float, reach_m: float) -> np.ndarray:
    """Of many motions, target_from_source (4, 4), the one by which most of the source meets the target.

    Points (N, 3) and (M, 3), metres, thinned to `voxel_m`, are registered from shifts and turns all around,
    surfaces `reach_m` apart. Raises DataError where too few points are left.
    """
    points, planes = thinned(source, voxel_m), Planes.of(thinned(target, voxel_m), voxel_m)
    points = points[every_few(len(points), _SAMPLE)]
    ends = [robust_point_to_plane(points, planes, [reach_m], start) for start in _starts()]
    shares = [overlap(points, planes.tree, voxel_m, motion) for motion in ends]
    return ends[int(np.argmax(shares))]


def _starts() -> list[np.ndarray]:
    """Motions (4, 4) to begin at: along the ground in all directions, or turned about the vertical."""
    angles = np.arange(_DIRECTIONS) * (2.0 * np.pi / _DIRECTIONS)
    around = np.stack([np.cos(angles), np.sin(angles), np.zeros(_DIRECTIONS)], axis=1)
    shifts = np.concatenate([ring_m * around for ring_m in _RINGS_M])
    return [*pose.from_translation(shifts), *map(pose.from_yaw, _TURNS_RAD)]
