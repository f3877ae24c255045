"""From two prepared scans to the factor graph: who is a neighbour of whom, and what matches what."""

from dataclasses import dataclass

import numpy as np

from lidarflow import pose
from lidarflow.config import Config
from lidarflow.lidar import matching
from lidarflow.lidar.features import Features
from lidarflow.lidar.mesh import Mesh
from lidarflow.types import FlowProblem, ScanPair


@dataclass(frozen=True, slots=True, eq=False)
class Graph:
    """A FlowProblem and how its variables relate to the source scan.

    problem   FlowProblem
    variable  (N,) int32    variable whose motion a point of the source has, -1 = outside the graph
    """

    problem: FlowProblem
    variable: np.ndarray


def build_problem(
    pair: ScanPair, source: Features, target: Features, mesh: Mesh, start: np.ndarray, config: Config
) -> Graph:
    """Variables, matches and smoothness edges of one pair (Dewan et al. 2016, section III).

    start (N, 4, 4) are the start values of the source's points. Points without a mesh neighbour are left
    out. Keypoints are matched inside a gate around where their start value puts them.
    """
    variable, rows = _variables(pair.source.points, mesh, config.graph.thinning_m)
    edges = variable[mesh.edges]
    edges = np.sort(edges[edges[:, 0] != edges[:, 1]], axis=1)
    edges = np.unique(edges, axis=0).astype(np.int32) if config.graph.thinning_m else edges.astype(np.int32)

    in_graph = np.isin(source.keypoint, rows)
    keypoint = source.keypoint[in_graph]
    target_points = pair.target.points[target.keypoint]
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
    return Graph(problem, variable)


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
