"""A cloud with normals, and how far other points are from its surface."""

from dataclasses import dataclass

import numpy as np

from lidarflow import pose
from lidarflow.kernels import grid, normals, tree
from lidarflow.kernels import misfit as kernel
from lidarflow.kernels.tree import Tree

CAP_M = 0.3             # a point farther off than this is simply not explained
MIN_AGREEMENT = 0.7     # |cosine| between the normals of a point and of its counterpart


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """A cloud as a surface.

    points    (N, 3)      metres
    normals   (N, 3)      unit length, NaN where the neighbourhood is no surface
    thinned   (S,) int64  rows that represent it evenly
    tree      Tree        over its points
    """

    points: np.ndarray
    normals: np.ndarray
    thinned: np.ndarray
    tree: Tree

    @classmethod
    def of(cls, points: np.ndarray, voxel_m: float, radius_m: float) -> "Surface":
        """The surface of points (N, 3), normals fitted within `radius_m` to those thinned to `voxel_m`.

        A voxel of 0 thins nothing.
        """
        thinned = grid.first_per_voxel(points, voxel_m) if voxel_m else np.arange(len(points))
        return cls(
            points, normals.estimate(points, points.take(thinned, axis=0), radius_m), thinned,
            tree.build(points))

    def moved(self, motion: np.ndarray) -> "Surface":
        """The same surface after a motion (4, 4)."""
        points = pose.apply(motion, self.points)
        return Surface(points, pose.turn(motion, self.normals), self.thinned, tree.moved(self.tree, points))


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """The points of a scan that take part: what stands upright, and a tree over the ground (G, 3)."""

    upright: Surface
    ground: Tree

    def moved(self, motion: np.ndarray) -> "Cloud":
        """The same cloud after a motion (4, 4)."""
        ground = np.empty_like(self.ground.points)
        ground[self.ground.rows] = pose.apply(motion, self.ground.points)
        return Cloud(self.upright.moved(motion), tree.moved(self.ground, ground))


@dataclass(frozen=True, slots=True, eq=False)
class Misfit:
    """How far points are from a surface.

    distance_m  (N,)      to its nearest point, at most CAP_M
    plane_m     (N,)      to the plane of that point where the normals agree, else as distance_m; never more
    """

    distance_m: np.ndarray
    plane_m: np.ndarray

    def __getitem__(self, rows: np.ndarray) -> "Misfit":
        return Misfit(self.distance_m[rows], self.plane_m[rows])


@dataclass(frozen=True, slots=True, eq=False)
class Counterparts:
    """The nearest of a surface to some points.

    row         (N,) int64    of the surface, -1 where none is within reach
    distance_m  (N,)          to it, infinite where there is none
    agrees      (N,) bool     its normal is like the point's
    offset_m    (N,)          how far along that normal its plane lies from the point; NaN unless they agree
    """

    row: np.ndarray
    distance_m: np.ndarray
    agrees: np.ndarray
    offset_m: np.ndarray

    def __getitem__(self, rows: np.ndarray) -> "Counterparts":
        return Counterparts(self.row[rows], self.distance_m[rows], self.agrees[rows], self.offset_m[rows])

    def within(self, reach_m: float) -> np.ndarray:
        """Mask (N,) of the points whose counterpart is nearer than `reach_m` and agrees."""
        return self.agrees & (self.distance_m < reach_m)


def counterparts(
    points: np.ndarray, point_normals: np.ndarray, surface: Surface, reach_m: float
) -> Counterparts:
    """The nearest of a surface within `reach_m` of points (N, 3) with normals (N, 3)."""
    return Counterparts(
        *kernel.counterparts(points, point_normals, surface.tree, surface.normals, reach_m, MIN_AGREEMENT))


def misfit_after(
    cloud: Surface, rows: np.ndarray, motion: np.ndarray, surface: Surface, beside: Tree = tree.NOTHING
) -> Misfit:
    """How far the `rows` (K,) of a cloud are from a surface after `motion` (4, 4).

    Distances also reach what lies `beside`, and planes are never farther.
    """
    distance_m, plane_m = np.empty(len(rows)), np.empty(len(rows))
    kernel.after(cloud.points, cloud.normals, rows, motion, surface.tree, surface.normals, beside, CAP_M,
                 MIN_AGREEMENT, distance_m, plane_m)
    return Misfit(distance_m, plane_m)
