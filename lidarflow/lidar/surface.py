"""A cloud with normals, and how far other points are from its surface."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from lidarflow.kernels import grid, normals

CAP_M = 0.3             # a point farther off than this is simply not explained
_MIN_AGREEMENT = 0.7    # |cosine| between the normals of a point and of its counterpart
_VOXEL_M = 0.12
_MANY_POINTS = 5000


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """A cloud as a surface.

    points    (N, 3)      metres
    normals   (N, 3)      unit length, NaN where the neighbourhood is no surface
    thinned   (S,) int64  rows that represent it evenly
    """

    points: np.ndarray
    normals: np.ndarray
    thinned: np.ndarray

    @classmethod
    def of(cls, points: np.ndarray, radius_m: float) -> "Surface":
        """The surface of points (N, 3), normals fitted within `radius_m`."""
        thinned = grid.first_per_voxel(points, _VOXEL_M)
        return cls(points, normals.estimate(points, points[thinned], radius_m), thinned)


@dataclass(frozen=True, slots=True, eq=False)
class Misfit:
    """How far points are from a surface.

    distance_m  (N,)      to its nearest point, at most CAP_M
    plane_m     (N,)      to the plane of that point where the normals agree, else as distance_m
    """

    distance_m: np.ndarray
    plane_m: np.ndarray


def nearest(tree: cKDTree, points: np.ndarray, reach_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Distance (N,) of each point (N, 3) to its nearest in `tree`, infinite beyond `reach_m`, and its row."""
    # Threads take longer to start than a few points to look up.
    workers = -1 if len(points) > _MANY_POINTS else 1
    return tree.query(points, distance_upper_bound=reach_m, workers=workers)


def counterparts(
    points: np.ndarray, point_normals: np.ndarray, surface: Surface, tree: cKDTree, reach_m: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Nearest rows (N,) of a surface whose points `tree` holds, distances (N,), and where normals agree (N,).

    Distances are infinite, and rows 0, where nothing lies within `reach_m`.
    """
    distance_m, row = nearest(tree, points, reach_m)
    agrees = np.isfinite(distance_m)
    row = np.where(agrees, row, 0)
    cosine = (surface.normals[row[agrees]] * point_normals[agrees]).sum(axis=1)
    with np.errstate(invalid="ignore"):
        agrees[agrees] = np.abs(cosine) > _MIN_AGREEMENT
    return row, distance_m, agrees


def plane_offsets(points: np.ndarray, surface: Surface, row: np.ndarray) -> np.ndarray:
    """How far (N,) along its normal, in metres, the plane at `row` (N,) lies from each point (N, 3)."""
    return (surface.normals[row] * (surface.points[row] - points)).sum(axis=1)


def misfit(points: np.ndarray, point_normals: np.ndarray, surface: Surface, tree: cKDTree) -> Misfit:
    """How far points (N, 3) with normals (N, 3) are from a surface."""
    row, distance_m, agrees = counterparts(points, point_normals, surface, tree, 2.0 * CAP_M)
    distance_m = np.minimum(distance_m, CAP_M)
    plane_m = distance_m.copy()
    plane_m[agrees] = np.abs(plane_offsets(points[agrees], surface, row[agrees]))
    return Misfit(distance_m, np.minimum(plane_m, CAP_M))
