"""What one scan brings to any pair it is part of: masks, surface, keypoints."""

from concurrent.futures import Future
from dataclasses import dataclass

import numpy as np

from lidarflow.aside import Aside, done
from lidarflow.config import Config
from lidarflow.kernels import tree
from lidarflow.lidar import ego, ground, preparation
from lidarflow.lidar.keypoints import Keypoints
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

    @property
    def standing(self) -> np.ndarray:
        """The usable points (N,) bool above ground."""
        return self.usable & ~self.ground


@dataclass(frozen=True, slots=True, eq=False)
class Features(Masks):
    """A prepared scan; what takes long may still be under way, and is waited for when it is asked for.

    cloud      Cloud           these points: what stands upright, rows ascending, and the ground
    keypoints  Keypoints
    thinned    ego.Thinned     for registration
    """

    begun_thinned: "Future[ego.Thinned]"
    begun_cloud: "Future[Cloud]"
    begun_keypoints: "Future[Keypoints]"

    @property
    def thinned(self) -> ego.Thinned:
        return self.begun_thinned.result()

    @property
    def cloud(self) -> Cloud:
        return self.begun_cloud.result()

    @property
    def keypoints(self) -> Keypoints:
        return self.begun_keypoints.result()

    @property
    def surface(self) -> np.ndarray:
        """Thinned non-ground points (S, 3), metres."""
        return self.cloud.upright.points.take(self.cloud.upright.thinned, axis=0)


def masks(scan: Scan, config: Config) -> Masks:
    """The points of `scan` that take part, and the ground among them."""
    usable = preparation.usable(scan.points, config.preparation)
    found = ground.detect(scan.points, usable, config.ground)
    return Masks(usable & ~found.reflection, found.mask)


def extract(scan: Scan, config: Config, beside: Aside | None = None) -> Features:
    """Prepare `scan`: mask, ground, thinned surfaces, keypoints on a voxel grid.

    All but the masks is done `beside` the caller where there is such a thing.
    """
    begin = beside.begin if beside else done
    thinned = begin(ego.Thinned.of_scan, scan, config)
    seen = masks(scan, config)
    cloud = begin(_cloud, scan.points, seen, config)
    return Features(seen.usable, seen.ground, thinned, cloud, begin(_keypoints, seen, cloud, config))


def _cloud(points: np.ndarray, seen: Masks, config: Config) -> Cloud:
    upright = points.compress(seen.standing, axis=0)
    return Cloud(
        Surface.of(upright, config.shot.surface_voxel_m, config.normals.radius_m),
        tree.build(points.compress(seen.usable & seen.ground, axis=0)))


def _keypoints(seen: Masks, cloud: "Future[Cloud]", config: Config) -> Keypoints:
    found = Keypoints.of(np.flatnonzero(seen.standing), cloud.result().upright, config)
    if not config.objects.enabled:
        found.described()     # all will be asked for
    return found
