"""What one scan brings to any pair it is part of: masks, surface, keypoints, descriptors."""

from dataclasses import dataclass

import numpy as np

from lidarflow.config import Config
from lidarflow.kernels import grid, shot, tree
from lidarflow.lidar import ground, preparation
from lidarflow.lidar.surface import Cloud, Surface
from lidarflow.types import Scan


@dataclass(frozen=True, slots=True, eq=False)
class Masks:
    """Which points of a scan take part.

    usable  (N,) bool   finite, within the range limits, no reflection from under the road
    ground  (N,) bool   the ground among them
    """

    usable: np.ndarray
    ground: np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class Features:
    """A prepared scan.

    usable       (N,) bool          as in Masks
    ground       (N,) bool
    cloud        Cloud              these points: what stands upright, rows ascending, and the ground
    keypoint     (K,) int64         rows of the scan
    descriptors  (K, 352) float32   SHOT of each keypoint, unit norm
    """

    usable: np.ndarray
    ground: np.ndarray
    cloud: Cloud
    keypoint: np.ndarray
    descriptors: np.ndarray

    @property
    def surface(self) -> np.ndarray:
        """Thinned non-ground points (S, 3), metres."""
        return self.cloud.upright.points[self.cloud.upright.thinned]


def masks(scan: Scan, config: Config) -> Masks:
    """The points of `scan` that take part, and the ground among them."""
    usable = preparation.usable(scan.points, config.preparation)
    found = ground.detect(scan.points, usable, config.ground)
    return Masks(usable & ~found.reflection, found.mask)


def extract(scan: Scan, config: Config) -> Features:
    """Prepare `scan`: mask, ground, thinned surface, keypoints on a voxel grid and their descriptors."""
    seen = masks(scan, config)
    rows = np.flatnonzero(seen.usable & ~seen.ground)
    upright = Surface.of(scan.points[rows], config.shot.surface_voxel_m, config.normals.radius_m)
    ground_tree = tree.build(scan.points[seen.usable & seen.ground])
    keypoint = rows[grid.first_per_voxel(upright.points, config.matching.keypoint_voxel_m)]
    descriptors, _ = shot.describe(
        scan.points[keypoint], upright.points[upright.thinned], upright.normals[upright.thinned],
        config.shot.radius_m, config.shot.min_neighbours)
    described = np.isfinite(descriptors[:, 0])
    return Features(
        seen.usable, seen.ground, Cloud(upright, ground_tree), keypoint[described], descriptors[described])
