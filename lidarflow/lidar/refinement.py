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
from lidarflow.kernels import neighbours, tree, triangles
from lidarflow.kernels.tree import Tree
from lidarflow.kernels.triangles import Triangles
from lidarflow.lidar.mesh import Mesh
from lidarflow.rows import lengths
from lidarflow.types import FlowProblem

_TOLERANCE = 1e-2  # a gain smaller than this share ends a solution


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """A scan's points above ground and the triangles between them.

    The nearest return is no measure of where a surface is: rings lie far apart and travel with the sensor,
    and what is pulled to the nearest of them is pulled along the surface. Triangles fill the gaps.

    triangles  Triangles
    lone       Tree        over the points that no triangle has
    """

    triangles: Triangles
    lone: Tree

    @classmethod
    def around(
        cls, places: np.ndarray, margin_m: float, points: np.ndarray, rows: np.ndarray, upright: Tree,
        mesh: Mesh,
    ) -> "Surface":
        """Of a scan's points (N, 3) and its mesh, what has a corner nearer than margin_m to places (M, 3).

        rows (U,) are those of the points that stand upright and that the tree is over.
        """
        near = np.zeros(len(points), bool)
        near[rows[neighbours.near_rows(upright, tree.build(places), margin_m)]] = True
        a, b, c = near.take(mesh.triangles.T)
        kept = mesh.triangles.compress(a | b | c, axis=0)
        near[kept] = False
        return cls(triangles.build(points.take(kept, axis=0)), tree.build(points.compress(near, axis=0)))

    def nearest(self, points: np.ndarray, reach_m: float) -> np.ndarray:
        """Nearest places (N, 3) on the surface to points (N, 3), metres; NaN where none is within reach."""
        return triangles.nearest(self.triangles, self.lone, points, reach_m)


def margin_m(config: RefineConfig, longest_m: float) -> float:
    """How far from where things begin limbs may ask for a surface whose edges are `longest_m` at most.

    Every round takes a point no farther than it reaches, and the next reaches as far again.
    """
    return config.rounds * config.reach_m + longest_m


def refined(
    problem: FlowProblem, motions: np.ndarray, surface: Surface, solve: Callable, settings: SolverConfig,
    config: RefineConfig,
) -> tuple[np.ndarray, np.ndarray]:
    """Motions (M, 4, 4) of the problem's variables on the surface, from `motions`, and what was solved (M,).

    solve(problem, settings) gives motions, what was solved, and more. A thing none of whose points has left
    its group has no limbs that move, and is done.
    """
    motions, solved = motions.copy(), np.zeros(len(motions), bool)
    rows = np.arange(len(problem.points))
    for _ in range(config.rounds):
        if len(rows) == 0:
            break
        here = motions[rows]
        part = problem if len(rows) == len(problem.points) else problem.part(rows, here)
        motions[rows], solved[rows], *_ = solve(rematched(part, here, surface, config.reach_m), settings)
        by_group = pose.apply(part.group_motions[part.group], part.points)
        apart_m = lengths(pose.apply(motions[rows], part.points) - by_group)
        limbs = np.unique(part.component[apart_m > config.tie_truncation])
        rows = rows[np.isin(part.component, limbs)]
    return motions, solved


def rematched(problem: FlowProblem, motions: np.ndarray, surface: Surface, reach_m: float) -> FlowProblem:
    """The problem at `motions` (M, 4, 4), every variable matched with the nearest place on the next scan.

    Places farther than `reach_m` say nothing.
    """
    moved = pose.apply(motions, problem.points)
    places = surface.nearest(moved, reach_m)
    near = np.flatnonzero(np.isfinite(places[:, 0])).astype(np.int32)
    return replace(problem, initial=motions, match_index=near, match_target=places[near])


def solver(config: SolverConfig, limits: RefineConfig) -> SolverConfig:
    """The solver's settings for matches with a surface, which lie nearer than those of descriptors.

    The surface is asked again after every solution, which therefore need not be exact. What is beyond the
    truncation at the start are limbs that have left their body: a step without it would pull them back.
    """
    return replace(
        config, plain_first=False, relative_tolerance=_TOLERANCE, data_weight=limits.data_weight,
        truncation_m=limits.reach_m, tie_weight=limits.tie_weight, tie_truncation=limits.tie_truncation)


def wanted(problem: FlowProblem, config: RefineConfig) -> np.ndarray:
    """Which variables (M,) of a graph may have limbs: components that are near and no larger than a person.

    What is larger is a wall, a hedge, or a car. What is far is seen by too few scan lines.
    """
    order = np.argsort(problem.component, kind="stable")
    first = np.flatnonzero(np.diff(problem.component[order], prepend=-1))
    if len(first) == 0 or config.rounds == 0:
        return np.zeros(len(order), bool)
    ordered = problem.points[order]
    size_m = np.maximum.reduceat(ordered, first) - np.minimum.reduceat(ordered, first)
    nearest_m = np.minimum.reduceat(lengths(ordered), first)
    small = (size_m <= config.max_size_m).all(axis=1) & (nearest_m <= config.max_range_m)
    return small[problem.component]
