"""Points that can be told apart, and their descriptors, each made when it is first asked for."""

from functools import cached_property

import numpy as np

from lidarflow.config import Config
from lidarflow.kernels import grid, shot, tree
from lidarflow.kernels.matching import Described
from lidarflow.kernels.tree import Tree
from lidarflow.lidar.surface import Surface


class Keypoints:
    """Points of a scan on a voxel grid, which SHOT tells apart.

    row     (K,) int64   of the scan, ascending
    points  (K, 3)       metres
    """

    def __init__(self, row: np.ndarray, points: np.ndarray, seen: shot.Support, min_neighbours: int):
        self.row, self.points = row, points
        self._seen, self._min_neighbours = seen, min_neighbours
        self._descriptors = np.empty((len(row), shot.SIZE), np.float32)
        self._is_made = np.zeros(len(row), bool)

    @classmethod
    def of(cls, rows: np.ndarray, surface: Surface, config: Config) -> "Keypoints":
        """Those of a surface whose points are `rows` (N,) of a scan."""
        chosen = grid.first_per_voxel(surface.points, config.matching.keypoint_voxel_m)
        seen = shot.support(
            surface.points.take(surface.thinned, axis=0), surface.normals.take(surface.thinned, axis=0),
            config.shot.radius_m)
        return cls(rows[chosen], surface.points.take(chosen, axis=0), seen, config.shot.min_neighbours)

    @cached_property
    def tree(self) -> Tree:
        """Over their points."""
        return tree.build(self.points)

    def described(self, chosen: np.ndarray | None = None) -> Described:
        """Those of the `chosen` (C,), or of all, that have a descriptor; others have too few neighbours."""
        chosen = np.arange(len(self.row)) if chosen is None else chosen
        new = chosen[~self._is_made[chosen]]
        if len(new):
            shot.describe_into(self._descriptors, new, self.points[new], self._seen, self._min_neighbours)
            self._is_made[new] = True
        kept = chosen[np.isfinite(self._descriptors[chosen, 0])]
        return Described(self.points[kept], kept, self._descriptors)
