"""The triangle mesh that says which points are neighbours, and its connected components."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from lidarflow.config import MeshConfig
from lidarflow.errors import DataError
from lidarflow.kernels import mesh as kernel
from lidarflow.kernels import normals
from lidarflow.lidar import rings

# Marton et al. 2009 ask for angles of 10 to 120 degrees; scan lines lie farther apart than points along
# them, so slim triangles are the rule here and the lower limit is relaxed.
_MIN_ANGLE_RAD = np.radians(2.0)
_MAX_ANGLE_RAD = np.radians(120.0)
_MAX_SURFACE_ANGLE_RAD = np.radians(45.0)
_FRAGMENT_POINTS = 20   # smaller components are mended by strips that skip a ring


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """Triangles over a cloud, as a graph.

    triangles  (T, 3) int32
    edges      (E, 2) int32   unique, i < j: sides of triangles, and what a single ring sees of thin things
    component  (N,) int32     connected component of each point, 0 .. C-1; lone points are their own
    method     str            "grid" or "tangent": how the triangles were found
    """

    triangles: np.ndarray
    edges: np.ndarray
    component: np.ndarray
    method: str


def build(
    points: np.ndarray, kept: np.ndarray, surface: np.ndarray, config: MeshConfig, normal_radius_m: float
) -> Mesh:
    """Mesh of the `kept` rows of a whole scan.

    points (N, 3) metres in the sensor frame and file order; kept (N,) bool; surface (S, 3), the thinned
    points that normals are fitted to where normals are needed. Spinning sensors are meshed along their scan
    grid (rings × azimuth), every other cloud by local triangulation in tangent planes (after Marton et al.
    2009). Raises DataError when the grid is asked for and the cloud has none.
    """
    ring = None if config.method == "tangent" else rings.recover(points)
    if ring is None and config.method == "grid":
        raise DataError("mesh.method = grid, but the rings of a spinning sensor cannot be told apart in this "
                        "cloud; use auto or tangent")
    if ring is None:
        method = "tangent"
        triangles = _tangent_triangles(points, kept, surface, config, normal_radius_m)
    else:
        method, triangles = "grid", _grid_triangles(points, kept, ring, config)
    edges = unique_edges(triangles)
    if ring is not None:
        edges = _with_ring_edges(edges, points, kept, ring, config)
    return Mesh(triangles, edges, components(edges, len(points)), method)


def _grid_triangles(
    points: np.ndarray, kept: np.ndarray, ring: np.ndarray, config: MeshConfig
) -> np.ndarray:
    """Strips between neighbouring rings, then across whatever stands between the two ends of a surface.

    A branch in front of a wall breaks the wall's strips twice: along the ring, mended by strips that leave
    out the points no strip wanted, and across it, mended for the fragments by strips from every ring to the
    next but one or two. The wall breaks the strips of the branch likewise: where it is thin and slanting,
    an arm held away from the body, it lies beside the wall on the next ring; what no strip wanted gets
    strips by itself.
    """
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    rows = np.flatnonzero(kept & (ring >= 0))
    limits = _limits(config, config.max_edge_rings * _ring_spacing(points, ring))
    triangles = _strips(points, azimuth, rows, ring, limits)
    meshed = np.zeros(len(points), bool)
    meshed[triangles.ravel()] = True
    triangles = np.concatenate([
        triangles, _strips(points, azimuth, rows[meshed[rows]], ring, limits),
        _strips(points, azimuth, rows[~meshed[rows]], ring, limits)])

    component = components(unique_edges(triangles), len(points))
    is_fragment = np.bincount(component)[component] < _FRAGMENT_POINTS
    across = [
        _strips(points, azimuth, rows[ring[rows] % step == phase], ring // step, limits)
        for step in (2, 3) for phase in range(step)
    ]
    across = np.concatenate(across)
    return np.concatenate([triangles, across[is_fragment[across].any(axis=1)]])


def _with_ring_edges(
    edges: np.ndarray, points: np.ndarray, kept: np.ndarray, ring: np.ndarray, config: MeshConfig
) -> np.ndarray:
    """`edges` (E, 2) and those along rings to points without any: a level arm is seen by one ring only."""
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    rows = np.flatnonzero(kept & (ring >= 0))
    order, bounds = _by_ring(azimuth, rows, ring)
    lone = np.ones(len(points), bool)
    lone[edges.ravel()] = False
    along = kernel.ring_edges(points, order, bounds, lone, *_limits(config, max_edge_rad=0.0))
    return np.unique(np.concatenate([edges, along]), axis=0)


def _ring_spacing(points: np.ndarray, ring: np.ndarray) -> float:
    """Median angle in radians between a ring and the next."""
    member = np.flatnonzero(ring >= 0)
    member = member[np.argsort(ring[member], kind="stable")]
    pitch = np.arctan2(points[member, 2], np.hypot(points[member, 0], points[member, 1]))
    bounds = np.searchsorted(ring[member], np.arange(1, ring.max() + 1))
    middle = [np.median(one_ring) for one_ring in np.split(pitch, bounds) if len(one_ring)]
    return float(np.median(np.abs(np.diff(middle)))) if len(middle) > 1 else 0.0


def _strips(
    points: np.ndarray, azimuth: np.ndarray, rows: np.ndarray, ring: np.ndarray, limits: tuple
) -> np.ndarray:
    return kernel.ring_strips(points, azimuth, *_by_ring(azimuth, rows, ring), *limits)


def _by_ring(azimuth: np.ndarray, rows: np.ndarray, ring: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`rows` (P,) ring by ring with azimuth ascending, and where each ring begins in them (R + 1,)."""
    order = rows[np.lexsort((azimuth[rows], ring[rows]))]
    return order, np.searchsorted(ring[order], np.arange(ring.max() + 2))


def _tangent_triangles(
    points: np.ndarray, kept: np.ndarray, surface: np.ndarray, config: MeshConfig, normal_radius_m: float
) -> np.ndarray:
    rows = np.flatnonzero(kept)
    if len(rows) < 3:
        return np.empty((0, 3), np.int32)
    point_normals = normals.estimate(points[rows], surface, normal_radius_m)
    local = kernel.tangent_stars(
        points[rows], point_normals, *_limits(config, max_edge_rad=0.0), _MAX_SURFACE_ANGLE_RAD,
        _MIN_ANGLE_RAD, _MAX_ANGLE_RAD)
    return rows[local].astype(np.int32)


def _limits(config: MeshConfig, max_edge_rad: float) -> tuple[float, float, float, float]:
    """What the kernels call continuous; edges may be longer than max_edge_m where max_edge_rad says so."""
    return config.max_edge_m, max_edge_rad, config.max_depth_jump_m, np.radians(config.min_grazing_deg)


def unique_edges(triangles: np.ndarray) -> np.ndarray:
    """Edges (E, 2) int32, i < j, sorted and unique, of triangles (T, 3)."""
    sides = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [0, 2]]])
    sides = np.sort(sides, axis=1).astype(np.int64)
    n = np.int64(sides.max()) + 1 if len(sides) else np.int64(1)
    keys = np.unique(sides[:, 0] * n + sides[:, 1])
    return np.stack([keys // n, keys % n], axis=1).astype(np.int32)


def components(edges: np.ndarray, count: int) -> np.ndarray:
    """Component (count,) int32 of each of `count` points joined by edges (E, 2)."""
    graph = coo_array((np.ones(len(edges), np.int8), (edges[:, 0], edges[:, 1])), shape=(count, count))
    return connected_components(graph, directed=False)[1].astype(np.int32)
