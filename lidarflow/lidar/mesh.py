"""The triangle mesh that says which points are neighbours, and its connected components."""

from dataclasses import dataclass

import numpy as np

from lidarflow.config import MeshConfig
from lidarflow.errors import DataError
from lidarflow.kernels import graphs, normals, tangent_stars
from lidarflow.kernels import mesh as kernel
from lidarflow.kernels.grid import first_per_voxel
from lidarflow.lidar import rings

# Marton et al. 2009 ask for angles of 10 to 120 degrees; scan lines lie farther apart than points along
# them, so slim triangles are the rule here and the lower limit is relaxed.
_MIN_ANGLE_RAD = np.radians(2.0)
_MAX_ANGLE_RAD = np.radians(120.0)
_MAX_SURFACE_ANGLE_RAD = np.radians(45.0)
_FRAGMENT_POINTS = 20   # smaller components are mended by strips that skip a ring
_SAME_PLACE_M = 1e-3    # of points this near to one another a local triangulation takes one


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
    found = None if config.method == "tangent" else rings.recover(points)
    if found is None and config.method == "grid":
        raise DataError("mesh.method = grid, but the rings of a spinning sensor cannot be told apart in this "
                        "cloud; use auto or tangent")
    along = np.empty((0, 2), np.int32)
    if found is None:
        method = "tangent"
        triangles = _tangent_triangles(points, kept, surface, config, normal_radius_m)
    else:
        grid = _scan_grid(points, kept, found)
        method, triangles = "grid", _grid_triangles(grid, len(points), found.spacing_rad, config)
        along = _ring_edges(grid, graphs.touched(triangles, len(points)), config)
    edges = graphs.sides(triangles, along, len(points))
    return Mesh(triangles, edges, graphs.components(edges, len(points)), method)


def _scan_grid(points: np.ndarray, kept: np.ndarray, found: rings.Rings) -> kernel.ScanGrid:
    """The kept points (N,) that have a ring, along the rings."""
    rows = np.flatnonzero(kept & (found.index >= 0))
    ring = found.index[rows]
    # One key, so that a sort that knows runs finds those of the file.
    order = np.argsort(ring * 8.0 + found.azimuth[rows], kind="stable")
    bounds = np.concatenate([[0], np.cumsum(np.bincount(ring))])
    return kernel.scan_grid(points, found.azimuth, rows[order], bounds)


def _grid_triangles(grid: kernel.ScanGrid, count: int, spacing_rad: float, config: MeshConfig) -> np.ndarray:
    """Strips between neighbouring rings, then across whatever stands between the two ends of a surface.

    A branch in front of a wall breaks the wall's strips twice: along the ring, mended by strips that leave
    out the points no strip wanted, and across it, mended for the fragments by strips from every ring to the
    next but one or two. The wall breaks the strips of the branch likewise: where it is thin and slanting,
    an arm held away from the body, it lies beside the wall on the next ring; what no strip wanted gets
    strips by itself. The scan has `count` points.
    """
    limits = _limits(config, config.max_edge_rings * spacing_rad)
    triangles = _all_strips(grid, limits)
    is_meshed = graphs.touched(triangles, count)[grid.row]
    triangles = np.concatenate([
        triangles, _all_strips(kernel.part(grid, is_meshed), limits),
        _all_strips(kernel.part(grid, ~is_meshed), limits)])

    component = graphs.components(triangles, count)
    in_fragment = np.bincount(component)[component[grid.row]] < _FRAGMENT_POINTS
    across = [kernel.ring_strips(grid, step, in_fragment, *limits) for step in (2, 3)]
    return np.concatenate([triangles, *across])


def _all_strips(grid: kernel.ScanGrid, limits: tuple) -> np.ndarray:
    return kernel.ring_strips(grid, 1, np.ones(len(grid.row), bool), *limits)


def _ring_edges(grid: kernel.ScanGrid, on_triangle: np.ndarray, config: MeshConfig) -> np.ndarray:
    """Edges (E, 2) along rings to points not `on_triangle` (N,): a level arm is seen by one ring only."""
    return kernel.ring_edges(grid, ~on_triangle[grid.row], *_limits(config, max_edge_rad=0.0))


def _tangent_triangles(
    points: np.ndarray, kept: np.ndarray, surface: np.ndarray, config: MeshConfig, normal_radius_m: float
) -> np.ndarray:
    rows = np.flatnonzero(kept)
    rows = rows[first_per_voxel(points[rows], _SAME_PLACE_M)]
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
