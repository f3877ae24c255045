"""Which parts of a graph are refined, and when: what moves with the world while objects are looked for.

Components of a graph are independent, so that the answer is as if all were refined at the end.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from lidarflow import pose
from lidarflow.config import Config
from lidarflow.kernels.tree import Tree
from lidarflow.lidar import frontend, refinement
from lidarflow.lidar.frontend import Graph
from lidarflow.lidar.mesh import Mesh


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """Some of a graph's variables, their motions (M, 4, 4), and whether matches say so (M,)."""

    graph: Graph
    motions: np.ndarray
    solved: np.ndarray

    @property
    def source_rows(self) -> np.ndarray:
        """The rows (P,) of the source scan that a variable of the part stands for."""
        return np.flatnonzero(self.graph.variable >= 0)


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """What it takes to refine a part of a pair.

    graph   Graph        of the source
    wanted  (M,) bool    its variables in components that may have limbs
    points  (N, 3)       of the target, metres
    rows    (U,) int64   of them that stand upright
    tree    Tree         over these
    mesh    Mesh         of the target
    solve   function     of a problem and settings: motions, what was solved, and more
    config  Config
    """

    graph: Graph
    wanted: np.ndarray
    points: np.ndarray
    rows: np.ndarray
    tree: Tree
    mesh: Mesh
    solve: Callable
    config: Config

    def refined(self, part: Graph, motions: np.ndarray) -> Part:
        """A part of the graph once its `motions` (M, 4, 4) have been drawn to the target."""
        solved = np.zeros(len(motions), bool)
        if len(motions):
            surface = refinement.Surface.around(
                pose.apply(motions, part.problem.points),
                refinement.margin_m(self.config.refine, self.config.mesh.max_edge_m), self.points, self.rows,
                self.tree, self.mesh)
            settings = refinement.solver(self.config.solver, self.config.refine)
            motions, solved = refinement.refined(
                part.problem, motions, surface, self.solve, settings, self.config.refine)
        return Part(part, motions, solved)


def of_world(scene: Scene, ego_motion: np.ndarray) -> Part:
    """All that may have limbs, as if it moved with the world."""
    nobody = np.full(len(scene.graph.variable), -1)
    part = frontend.tied(scene.graph, scene.wanted, nobody, np.empty((0, 4, 4)), ego_motion)
    return scene.refined(part, part.problem.initial)


def apart_from(world: Part, graph: Graph, touched: np.ndarray) -> Part:
    """What of the world's part is in no component of the whole `graph` that is `touched` (M,)."""
    kept = np.append(~touched, False)[graph.variable]
    variable = np.where(kept, world.graph.variable, -1)
    return Part(replace(world.graph, variable=variable), world.motions, world.solved)


def of_objects(
    scene: Scene, touched: np.ndarray, solved: Part, owner: np.ndarray, object_motions: np.ndarray,
    is_rigid: np.ndarray, ego_motion: np.ndarray,
) -> Part:
    """The `touched` (M,) components that may have limbs, from what was solved for them, else their group.

    owner (N,) is the object of each point, -1 = the world; no component with a point on one that `is_rigid`
    (G,) has limbs.
    """
    on_rigid = np.append(is_rigid, False)[frontend.owners(scene.graph, owner)]
    kept = scene.wanted & touched & ~frontend.components_with(scene.graph, on_rigid)
    part = frontend.tied(scene.graph, kept, owner, object_motions, ego_motion)
    motions, variable = part.problem.initial.copy(), solved.graph.variable[part.rows]
    motions[variable >= 0] = solved.motions[variable[variable >= 0]]
    return scene.refined(part, motions)
