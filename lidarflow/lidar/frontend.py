"""From two prepared scans to the factor graph: who is a neighbour of whom, and what matches what."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from lidarflow import pose
from lidarflow.config import MatchingConfig
from lidarflow.kernels import graphs
from lidarflow.lidar.keypoints import Keypoints
from lidarflow.lidar.matching import Matches
from lidarflow.lidar.mesh import Mesh
from lidarflow.rows import without_gaps
from lidarflow.types import FlowProblem

# The start values (N, 4, 4) of points (N, 3).
StartValues = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True, slots=True, eq=False)
class Graph:
    """A FlowProblem and how its variables relate to the source scan.

    problem   FlowProblem
    variable  (N,) int32    variable whose motion a point of the source has, -1 = outside the graph
    rows      (M,) int64    row of the source that each variable sits at
    """

    problem: FlowProblem
    variable: np.ndarray
    rows: np.ndarray


def build(points: np.ndarray, mesh: Mesh, thinning_m: float) -> Graph:
    """Variables and smoothness edges of a source scan (Dewan et al. 2016, section III), starting at rest.

    Points (N, 3) without a mesh neighbour are left out.
    """
    variable, rows = _variables(points, mesh, thinning_m)
    edges = variable.take(mesh.edges)
    if thinning_m:
        edges = np.sort(edges[edges[:, 0] != edges[:, 1]], axis=1)
        edges = np.unique(edges, axis=0)
    problem = FlowProblem(
        points.take(rows, axis=0), np.broadcast_to(pose.identity(), (len(rows), 4, 4)), np.empty(0, np.int32),
        np.empty((0, 3)), edges, without_gaps(mesh.component[rows]))
    return Graph(problem, variable, rows)


def started(graph: Graph, start_at: StartValues) -> Graph:
    """The graph with start values."""
    return replace(graph, problem=replace(graph.problem, initial=start_at(graph.problem.points)))


def matches(
    graph: Graph, source: Keypoints, target: Keypoints, start_at: StartValues, dt_s: float,
    config: MatchingConfig,
) -> Matches:
    """The matches of keypoints that a variable stands for, each sought around where a start value puts it."""
    eligible = np.flatnonzero(graph.variable[source.row] >= 0)
    points = source.points.take(eligible, axis=0)
    return Matches(source, eligible, pose.apply(start_at(points), points), target, dt_s, config)


def matched(graph: Graph, points: np.ndarray, rows: np.ndarray, places: np.ndarray) -> Graph:
    """The graph with matches: rows (K,) of the source's points (N, 3), ascending, and their places (K, 3).

    A variable that stands for several points takes the first of their matches, shifted from that point to
    where the variable sits, as its start value turns.
    """
    variable, first = np.unique(graph.variable[rows], return_index=True)
    problem = graph.problem
    aside_m = problem.points[variable] - points[rows[first]]
    turned = np.einsum("nij,nj->ni", problem.initial[variable, :3, :3], aside_m)
    problem = replace(problem, match_index=variable, match_target=places[first] + turned)
    return replace(graph, problem=problem)


def focused(
    graph: Graph, object_id: np.ndarray, object_motions: np.ndarray, ego_motion: np.ndarray
) -> Graph:
    """The part of a graph that moving objects touch, every variable tied to its object or the world.

    object_id (N,), -1 = none; object_motions (G, 4, 4) and ego_motion (4, 4), target_from_source. Mesh
    components without a point on an object follow the ego-motion: ego-motion explains them.
    """
    return tied(graph, touched(graph, object_id), object_id, object_motions, ego_motion)


def touched(graph: Graph, object_id: np.ndarray) -> np.ndarray:
    """Which variables (M,) are in a component with a point on an object, those of points being (N,)."""
    return components_with(graph, owners(graph, object_id) >= 0)


def components_with(graph: Graph, marked: np.ndarray) -> np.ndarray:
    """Which variables (M,) are in a component with one of the `marked` (M,)."""
    component = graph.problem.component
    has_one = np.zeros(component.max(initial=-1) + 1, bool)
    has_one[component[marked]] = True
    return has_one[component]


def tied(
    graph: Graph, kept: np.ndarray, object_id: np.ndarray, object_motions: np.ndarray,
    ego_motion: np.ndarray,
) -> Graph:
    """The `kept` variables (M,) of a graph, whole components, each tied to its object or the world."""
    motions = np.concatenate([ego_motion[None], object_motions])
    group = (owners(graph, object_id)[kept] + 1).astype(np.int32)   # group 0 is the static world
    part = graph.problem.part(np.flatnonzero(kept), motions.take(group, axis=0))
    reduced = replace(part, group=group, group_motions=motions)
    position = np.full(len(kept) + 1, -1, np.int32)      # the last is that of points without a variable
    position[:-1][kept] = np.arange(len(reduced.points))
    return Graph(reduced, position.take(graph.variable), graph.rows[kept])


def owners(graph: Graph, object_id: np.ndarray) -> np.ndarray:
    """The object (M,) that a point of each variable is on, -1 = none, from that of the points (N,)."""
    owner = np.full(len(graph.problem.points), -1)
    on_object = np.flatnonzero((graph.variable >= 0) & (object_id >= 0))
    owner[graph.variable[on_object]] = object_id[on_object]
    return owner


def _variables(points: np.ndarray, mesh: Mesh, thinning_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Variable (N,) int32 of each point, -1 for points without edges, and the row (M,) each one sits at.

    With thinning, the points of one component in one voxel share a variable, at the lowest row.
    """
    rows = np.flatnonzero(graphs.touched(mesh.edges, len(points)))
    variable = np.full(len(points), -1, np.int32)
    if thinning_m == 0 or len(rows) == 0:
        variable[rows] = np.arange(len(rows), dtype=np.int32)
        return variable, rows
    voxel = np.floor(points[rows] / thinning_m).astype(np.int64)
    label = np.column_stack([mesh.component[rows], voxel])
    _, first, member = np.unique(label, axis=0, return_index=True, return_inverse=True)
    rank = np.argsort(np.argsort(first, kind="stable"), kind="stable")
    variable[rows] = rank[member.ravel()]
    return variable, rows[np.sort(first)]
