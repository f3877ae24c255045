"""From two prepared scans to the factor graph: who is a neighbour of whom, and what matches what."""

from dataclasses import dataclass, replace

import numpy as np

from lidarflow import pose
from lidarflow.config import Config
from lidarflow.lidar import matching
from lidarflow.lidar.features import Keypoints
from lidarflow.lidar.mesh import Mesh
from lidarflow.types import FlowProblem, ScanPair


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


def build_problem(
    pair: ScanPair, source: Keypoints, target: Keypoints, mesh: Mesh, start: np.ndarray, config: Config,
    sought: np.ndarray,
) -> Graph:
    """Variables, matches and smoothness edges of one pair (Dewan et al. 2016, section III).

    start (N, 4, 4) are the start values of the source's points. Points without a mesh neighbour are left
    out. Keypoints are matched inside a gate around where their start value puts them, if they are `sought`
    (N,); the start values of others than these do not matter.
    """
    variable, rows = _variables(pair.source.points, mesh, config.graph.thinning_m)
    edges = variable[mesh.edges]
    edges = np.sort(edges[edges[:, 0] != edges[:, 1]], axis=1)
    edges = np.unique(edges, axis=0).astype(np.int32) if config.graph.thinning_m else edges.astype(np.int32)

    sits_here = np.zeros(len(variable), bool)
    sits_here[rows] = True
    in_graph = (sits_here & sought)[source.row]
    keypoint = source.row[in_graph]
    target_points = pair.target.points[target.row]
    query, found = matching.match(
        pose.apply(start[keypoint], pair.source.points[keypoint]), source.descriptors[in_graph],
        target_points, target.descriptors, pair.dt_s, config.matching)
    _, component = np.unique(mesh.component[rows], return_inverse=True)
    problem = FlowProblem(
        points=pair.source.points[rows],
        initial=start[rows],
        match_index=variable[keypoint[query]],
        match_target=target_points[found],
        edges=edges,
        component=component.astype(np.int32),
    )
    return Graph(problem, variable, rows)


def focused(
    graph: Graph, object_id: np.ndarray, object_motions: np.ndarray, ego_motion: np.ndarray
) -> Graph:
    """The part of a graph that moving objects touch, every variable tied to its object or the world.

    object_id (N,), -1 = none; object_motions (G, 4, 4) and ego_motion (4, 4), target_from_source. Mesh
    components without a point on an object follow the ego-motion: ego-motion explains them.
    """
    component = graph.problem.component
    touched = np.isin(component, component[owners(graph, object_id) >= 0])
    return tied(graph, touched, object_id, object_motions, ego_motion)


def tied(
    graph: Graph, kept: np.ndarray, object_id: np.ndarray, object_motions: np.ndarray,
    ego_motion: np.ndarray,
) -> Graph:
    """The `kept` variables (M,) of a graph, whole components, each tied to its object or the world."""
    motions = np.concatenate([ego_motion[None], object_motions])
    group = (owners(graph, object_id)[kept] + 1).astype(np.int32)   # group 0 is the static world
    part = graph.problem.part(np.flatnonzero(kept))
    reduced = replace(part, initial=motions[group], group=group, group_motions=motions)
    position = np.where(kept, np.cumsum(kept) - 1, -1).astype(np.int32)
    rows = np.flatnonzero(graph.variable >= 0)
    variable = np.full(len(graph.variable), -1, np.int32)
    variable[rows] = position[graph.variable[rows]]
    return Graph(reduced, variable, graph.rows[kept])


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
    meshed = np.zeros(len(points), bool)
    meshed[mesh.edges.ravel()] = True
    rows = np.flatnonzero(meshed)
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
