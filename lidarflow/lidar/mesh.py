"""The triangle mesh that says which points are neighbours, and its connected components."""

from dataclasses import dataclass

import numpy as np

from lidarflow.config import MeshConfig
from lidarflow.errors import DataError
from lidarflow.kernels import graphs, normals, tangent_stars
from lidarflow.kernels import mesh as kernel
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
        azimuth = np.arctan2(points[:, 1], points[:, 0])
        order = _by_ring(azimuth, np.flatnonzero(kept & (ring >= 0)), ring)
        method, triangles = "grid", _grid_triangles(points, azimuth, order, ring, config)
    edges = graphs.sides(triangles, len(points))
    if ring is not None:
        edges = _with_ring_edges(edges, points, order, ring, config)
    return Mesh(triangles, edges, graphs.components(edges, len(points)), method)


def _grid_triangles(
    points: np.ndarray, azimuth: np.ndarray, order: np.ndarray, ring: np.ndarray, config: MeshConfig
) -> np.ndarray:
    """Strips between neighbouring rings, then across whatever stands between the two ends of a surface.

    A branch in front of a wall breaks the wall's strips twice: along the ring, mended by strips that leave
    out the points no strip wanted, and across it, mended for the fragments by strips from every ring to the
    next but one or two. The wall breaks the strips of the branch likewise: where it is thin and slanting,
    an arm held away from the body, it lies beside the wall on the next ring; what no strip wanted gets
    strips by itself.
    """
    limits = _limits(config, config.max_edge_rings * _ring_spacing(points, ring))
    triangles = _strips(points, azimuth, order, ring, limits)
    meshed = np.zeros(len(points), bool)
    meshed[triangles.ravel()] = True
    triangles = np.concatenate([
        triangles, _strips(points, azimuth, order[meshed[order]], ring, limits),
        _strips(points, azimuth, order[~meshed[order]], ring, limits)])

    component = graphs.components(triangles, len(points))
    is_fragment = np.bincount(component)[component] < _FRAGMENT_POINTS
    across = [
        _strips(points, azimuth, order[ring[order] % step == phase], ring // step, limits)
        for step in (2, 3) for phase in range(step)
    ]
    across = np.concatenate(across)
    return np.concatenate([triangles, across[is_fragment[across].any(axis=1)]])


def _with_ring_edges(
    edges: np.ndarray, points: np.ndarray, order: np.ndarray, ring: np.ndarray, config: MeshConfig
) -> np.ndarray:
    """`edges` (E, 2) and those along rings to points without any: a level arm is seen by one ring only."""
    lone = np.ones(len(points), bool)
    lone[edges.ravel()] = False
    along = kernel.ring_edges(
        points, order, _bounds(ring[order]), lone, *_limits(config, max_edge_rad=0.0))
    edges = np.concatenate([edges, along])
    return edges[np.argsort(edges[:, 0] * np.int64(len(points)) + edges[:, 1], kind="stable")]


def _ring_spacing(points: np.ndarray, ring: np.ndarray) -> float:
    """Median angle in radians between a ring and the next."""
    member = np.flatnonzero(ring >= 0)
    member = member[np.argsort(ring[member], kind="stable")]
    pitch = np.arctan2(points[member, 2], np.hypot(points[member, 0], points[member, 1]))
    bounds = np.searchsorted(ring[member], np.arange(1, ring.max() + 1))
    middle = [np.median(one_ring) for one_ring in np.split(pitch, bounds) if len(one_ring)]
    return float(np.median(np.abs(np.diff(middle)))) if len(middle) > 1 else 0.0


def _strips(
    points: np.ndarray, azimuth: np.ndarray, order: np.ndarray, ring: np.ndarray, limits: tuple
) -> np.ndarray:
    return kernel.ring_strips(points, azimuth, order, _bounds(ring[order]), *limits)


def _by_ring(azimuth: np.ndarray, rows: np.ndarray, ring: np.ndarray) -> np.ndarray:
    """`rows` (P,) ring by ring with azimuth ascending."""
    # One key, so that a sort that knows runs finds those of the file.
    return rows[np.argsort(ring[rows] * 8.0 + azimuth[rows], kind="stable")]


def _bounds(ring: np.ndarray) -> np.ndarray:
    """Where each of R rings begins in ascending rings (P,), and the end: (R + 1,)."""
    return np.searchsorted(ring, np.arange(ring[-1] + 2 if len(ring) else 1))


def _tangent_triangles(
    points: np.ndarray, kept: np.ndarray, surface: np.ndarray, config: MeshConfig, normal_radius_m: float
) -> np.ndarray:
    rows = np.flatnonzero(kept)
    if len(rows) < 3:
        return np.empty((0, 3), np.int32)
    point_normals = normals.estimate(points[rows], surface, normal_radius_m)
    local = tangent_stars.triangles(
        points[rows], point_normals, *_limits(config, max_edge_rad=0.0), _MAX_SURFACE_ANGLE_RAD,
        _MIN_ANGLE_RAD, _MAX_ANGLE_RAD)
    return rows[local].astype(np.int32)


def _limits(config: MeshConfig, max_edge_rad: float) -> tuple[float, float, float, float]:
    """What the kernels call continuous; edges may be longer than max_edge_m where max_edge_rad says so."""
    return config.max_edge_m, max_edge_rad, config.max_depth_jump_m, np.radians(config.min_grazing_deg)
