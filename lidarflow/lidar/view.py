"""The two scans as the search for objects sees them.

All points are in the target's sensor frame after ego-motion: a static world would lie on the target as it
is, and an object's motion is what it does over ground.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from lidarflow import pose
from lidarflow.config import ObjectsConfig
from lidarflow.lidar.evidence import Evidence, gather, tolerance
from lidarflow.lidar.surface import CAP_M, Misfit, Surface, misfit, nearest


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A pair of scans in the target's sensor frame.

    source         Surface     non-ground points (N, 3) of the source, after ego-motion
    evidence       Evidence    of these points against the whole target
    source_tree    cKDTree     over these points
    by_ego         Misfit      how far ego-motion leaves them from the target
    target         cKDTree     all of the target's usable points
    upright        Surface     those of them that are not ground
    upright_tree   cKDTree     over the points of `upright`
    ground         cKDTree     those of them that are
    source_ground  cKDTree     the source's ground, after ego-motion
    has_appeared   (U,) bool   upright points where the source has nothing after ego-motion
    match_rows     (K,) int64  source points with a descriptor match
    match_shift    (K, 3)      from such a point to its match
    """

    source: Surface
    source_tree: cKDTree
    evidence: Evidence
    by_ego: Misfit
    target: cKDTree
    upright: Surface
    upright_tree: cKDTree
    ground: cKDTree
    source_ground: cKDTree
    has_appeared: np.ndarray
    match_rows: np.ndarray
    match_shift: np.ndarray

    @property
    def points(self) -> np.ndarray:
        return self.source.points

    def after(self, rows: np.ndarray, over_ground: np.ndarray) -> Misfit:
        """How far the source's `rows` (K,) are from the target after the motion (4, 4)."""
        moved = pose.apply(over_ground, self.points[rows])
        turned = pose.turn(over_ground, self.source.normals[rows])
        return _to_target(moved, turned, self.upright, self.upright_tree, capped_distance(self.target, moved))


def look(
    points: np.ndarray, target_points: np.ndarray, target_ground: np.ndarray, source_points: np.ndarray,
    source_ground: np.ndarray, matched: tuple[np.ndarray, np.ndarray], normal_radius_m: float,
    config: ObjectsConfig,
) -> View:
    """The view of a pair, all in the target's sensor frame after ego-motion, metres.

    points (N, 3) the source's non-ground points; target_points (M, 3) and which of them are ground (M,);
    source_points (S, 3) all of the source and which of them are ground (S,); matched: rows (K,) of `points`
    and their matches (K, 3).
    """
    source = Surface.of(points, normal_radius_m)
    upright = Surface.of(target_points[~target_ground], normal_radius_m)
    upright_tree = cKDTree(upright.points)
    from_source_m, _ = cKDTree(source_points).query(upright.points, workers=-1)
    has_appeared = from_source_m > tolerance(np.linalg.norm(upright.points, axis=1), config)
    evidence = gather(points, target_points, config)
    by_ego = _to_target(
        points, source.normals, upright, upright_tree, np.minimum(evidence.left_m, CAP_M))
    rows, places = matched
    return View(source, cKDTree(points), evidence, by_ego, cKDTree(target_points), upright, upright_tree,
                cKDTree(target_points[target_ground]), cKDTree(source_points[source_ground]), has_appeared,
                rows, places - points[rows])


def _to_target(
    points: np.ndarray, normals: np.ndarray, upright: Surface, upright_tree: cKDTree, distance_m: np.ndarray
) -> Misfit:
    """Misfit whose distances reach all of the target, ground included, and whose planes are never farther."""
    plane_m = misfit(points, normals, upright, upright_tree).plane_m
    return Misfit(distance_m, np.minimum(plane_m, distance_m))


def capped_distance(tree: cKDTree, points: np.ndarray) -> np.ndarray:
    """Distance (N,) of points (N, 3) to the nearest point of `tree`, at most CAP_M."""
    return np.minimum(nearest(tree, points, CAP_M)[0], CAP_M)
