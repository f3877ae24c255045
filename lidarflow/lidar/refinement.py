"""The last step: what is near and no larger than a person is drawn to the next scan's surface, limb by limb.

A limb is thinner than descriptors see and than scan lines are apart; what it did shows only in where the next
scan's surface is. The same energy serves, its matches now the nearest places on that surface, found again at
every round's motions, as in ICP.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from lidarflow import pose
from lidarflow.config import RefineConfig, SolverConfig
from lidarflow.kernels import neighbours
from lidarflow.kernels.tree import Tree
from lidarflow.lidar.mesh import Mesh
from lidarflow.open3d_import import open3d
from lidarflow.types import FlowProblem

_TOLERANCE = 1e-2  # a gain smaller than this share ends a solution
_MARGIN_M = 3.0   # around the things that are refined: what they may reach within a pair


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """A scan's points above ground and the triangles between them.

    The nearest return is no measure of where a surface is: rings lie far apart and travel with the sensor,
    and what is pulled to the nearest of them is pulled along the surface. Triangles fill the gaps.

    upright    Tree                        of the points, for those without a triangle
    triangles  RaycastingScene or None     None without triangles
    """

    upright: Tree
    triangles: object

    @classmethod
    def around(cls, places: np.ndarray, points: np.ndarray, upright: Tree, mesh: Mesh) -> "Surface":
        """Of a scan's points (N, 3), metres, those that stand upright, and its mesh around places (M, 3)."""
        with np.errstate(invalid="ignore"):
            inside = (points >= places.min(axis=0) - _MARGIN_M) & (points <= places.max(axis=0) + _MARGIN_M)
        near = inside.all(axis=1)
        triangles = mesh.triangles[near[mesh.triangles].all(axis=1)]
        scene = None
        if len(triangles):
            o3d = open3d()
            scene = o3d.t.geometry.RaycastingScene()
            vertices = np.where(near[:, None], points, 0.0)   # no triangle uses the others
            scene.add_triangles(o3d.core.Tensor(vertices.astype(np.float32)),
                                o3d.core.Tensor(triangles.astype(np.uint32)))
        return cls(upright, scene)

    def nearest(self, points: np.ndarray) -> np.ndarray:
        """Nearest places (N, 3) on the surface to points (N, 3), metres; NaN where there is none."""
        places, off_m = neighbours.nearest_points(self.upright, points)
        if self.triangles is None:
            return places
        query = open3d().core.Tensor(points.astype(np.float32))
        on_triangles = self.triangles.compute_closest_points(query)["points"].numpy().astype(np.float64)
        nearer = np.linalg.norm(on_triangles - points, axis=1) < off_m
        return np.where(nearer[:, None], on_triangles, places)


def refined(
    problem: FlowProblem, motions: np.ndarray, surface: Surface, solve: Callable, settings: SolverConfig,
    config: RefineConfig,
) -> np.ndarray:
    """Motions (M, 4, 4) of the problem's variables on the surface, from `motions` (M, 4, 4).

    solve(problem, settings) gives motions, what was solved, and more. A thing none of whose points has left
    its group has no limbs that move, and is done.
    """
    motions = motions.copy()
    rows = np.arange(len(problem.points))
    for _ in range(config.rounds):
        if len(rows) == 0:
            break
        part = problem.part(rows)
        motions[rows], *_ = solve(rematched(part, motions[rows], surface, config.reach_m), settings)
        by_group = pose.apply(part.group_motions[part.group], part.points)
        apart_m = np.linalg.norm(pose.apply(motions[rows], part.points) - by_group, axis=1)
        limbs = np.unique(part.component[apart_m > config.tie_truncation])
        rows = rows[np.isin(part.component, limbs)]
    return motions


def rematched(problem: FlowProblem, motions: np.ndarray, surface: Surface, reach_m: float) -> FlowProblem:
    """The problem at `motions` (M, 4, 4), every variable matched with the nearest place on the next scan.

    Places farther than `reach_m` say nothing.
    """
    moved = pose.apply(motions, problem.points)
    places = surface.nearest(moved)
    near = np.flatnonzero(np.linalg.norm(places - moved, axis=1) <= reach_m).astype(np.int32)
    return replace(problem, initial=motions, match_index=near, match_target=places[near])


def solver(config: SolverConfig, limits: RefineConfig) -> SolverConfig:
    """The solver's settings for matches with a surface, which lie nearer than those of descriptors.

    The surface is asked again after every solution, which therefore need not be exact.
    """
    return replace(
        config, relative_tolerance=_TOLERANCE, data_weight=limits.data_weight, truncation_m=limits.reach_m,
        tie_weight=limits.tie_weight, tie_truncation=limits.tie_truncation)


def wanted(problem: FlowProblem, is_rigid: np.ndarray, config: RefineConfig) -> np.ndarray:
    """Which variables (M,) of a graph are refined: components that are near and no larger than a person.

    What is larger is a wall, a hedge, or a car; so is a fragment with a variable on such a rigid object,
    `is_rigid` (M,). What is far is seen by too few scan lines.
    """
    order = np.argsort(problem.component, kind="stable")
    first = np.flatnonzero(np.diff(problem.component[order], prepend=-1))
    if len(first) == 0 or config.rounds == 0:
        return np.zeros(len(order), bool)
    ordered = problem.points[order]
    size_m = np.maximum.reduceat(ordered, first) - np.minimum.reduceat(ordered, first)
    nearest_m = np.minimum.reduceat(np.linalg.norm(ordered, axis=1), first)
    small = (size_m <= config.max_size_m).all(axis=1) & (nearest_m <= config.max_range_m)
    return (small & ~np.logical_or.reduceat(is_rigid[order], first))[problem.component]
