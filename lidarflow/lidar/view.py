"""The two scans as the search for objects sees them.

All points are in the target's sensor frame after ego-motion: a static world would lie on the target as it
is, and an object's motion is what it does over ground.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lidarflow.config import ObjectsConfig
from lidarflow.kernels import neighbours, tree
from lidarflow.kernels.tree import Tree
from lidarflow.lidar.evidence import Evidence, gather, tolerance
from lidarflow.lidar.surface import CAP_M, Cloud, Counterparts, Misfit, Surface, counterparts, misfit_after
from lidarflow.rows import lengths

MatchFinder = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
_STANDS_OUT_M = 2.0 * CAP_M   # planes are looked for up to here


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A pair of scans in the target's sensor frame.

    source         Surface       non-ground points (N, 3) of the source, after ego-motion
    tolerance_m    (N,)          how far they may be from the target and still be explained
    evidence       Evidence      of these points against the whole target
    by_ego         Misfit        how far ego-motion leaves them from the target
    at_rest        Counterparts  their nearest of `upright`, within the reach of planes
    upright        Surface       the target's points that are not ground
    ground         Tree          and those that are
    source_ground  Tree          the source's ground, after ego-motion
    has_appeared   (U,) bool     upright points where the source has nothing after ego-motion
    newcomers      (A, 3)        these points
    appeared       Tree          over them
    matches        function      of rows of the source: those with a descriptor match (M,), and where it is
                                 (M, 3)
    """

    source: Surface
    tolerance_m: np.ndarray
    evidence: Evidence
    by_ego: Misfit
    at_rest: Counterparts
    upright: Surface
    ground: Tree
    source_ground: Tree
    has_appeared: np.ndarray
    newcomers: np.ndarray
    appeared: Tree
    matches: MatchFinder

    @property
    def points(self) -> np.ndarray:
        return self.source.points

    def after(self, rows: np.ndarray, over_ground: np.ndarray) -> Misfit:
        """How far the source's `rows` (K,) are from the target after the motion (4, 4)."""
        return misfit_after(self.source, rows, over_ground, self.upright, self.ground)


def no_matches(_rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """None of the rows has a match."""
    return np.empty(0, np.int64), np.empty((0, 3))


def look(source: Cloud, target: Cloud, config: ObjectsConfig) -> View:
    """The view of a pair without matches, all in the target's sensor frame after ego-motion."""
    points, upright = source.upright.points, target.upright
    tolerance_m = tolerance(lengths(points), config)
    farthest_m = float(tolerance_m.max(initial=_STANDS_OUT_M))
    at_rest = counterparts(points, source.upright.normals, upright, farthest_m)
    left_m = neighbours.nearest_m(target.ground, points, at_rest.distance_m, farthest_m)
    capped_m = np.minimum(left_m, CAP_M)
    on_plane = at_rest.within(_STANDS_OUT_M)
    plane_m = np.where(on_plane, np.minimum(np.abs(at_rest.offset_m), capped_m), capped_m)

    near_m = tolerance(lengths(upright.points), config)
    was_there = np.zeros(len(near_m), bool)
    met = np.flatnonzero(at_rest.row >= 0)
    was_there[at_rest.row[met[at_rest.distance_m[met] <= near_m[at_rest.row[met]]]]] = True
    for surroundings in (source.upright.tree, source.ground):
        gone = np.flatnonzero(~was_there)
        was_there[gone] = neighbours.any_within(surroundings, upright.points.take(gone, axis=0), near_m[gone])
    newcomers = upright.points.compress(~was_there, axis=0)
    everything = np.concatenate([upright.points, target.ground.points])
    return View(
        source.upright, tolerance_m, gather(points, left_m, tolerance_m, everything),
        Misfit(capped_m, plane_m), at_rest, upright, target.ground, source.ground, ~was_there, newcomers,
        tree.build(newcomers), no_matches)
