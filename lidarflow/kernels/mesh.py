"""Triangles and edges between neighbouring points of scan rings."""

import math
from typing import NamedTuple

import numpy as np

from lidarflow.kernels.compiled import njit

_UNKNOWN, _NO, _YES = -1, 0, 1


class ScanGrid(NamedTuple):
    """Points of a scan ring by ring with azimuth ascending.

    row      (P,) int32       where each is in the scan
    points   (P, 3) float64   metres, sensor frame
    range_m  (P,) float64     how far away they are
    azimuth  (P,) float64     -π to π
    bounds   (R + 1,) int64   where each ring begins, and the end
    """

    row: np.ndarray
    points: np.ndarray
    range_m: np.ndarray
    azimuth: np.ndarray
    bounds: np.ndarray


def ring_strips(
    grid: ScanGrid, step: int, wanted: np.ndarray,
    max_edge_m: float, max_edge_rad: float, max_depth_jump_m: float, min_grazing_rad: float,
) -> np.ndarray:
    """Triangles (T, 3) int32, rows of the scan, of strips between rings where the surface is continuous.

    Strips join each ring with that `step` further on: those from rings 0, step, 2 step … first, then those
    from rings 1, 1 + step …. Triangles without a `wanted` (P,) corner are left out.
    """
    limits = (max_edge_m, max_edge_rad, max_depth_jump_m, math.sin(min_grazing_rad))
    return _ring_strips(grid, step, wanted, limits)


def ring_edges(
    grid: ScanGrid, wanted: np.ndarray,
    max_edge_m: float, max_edge_rad: float, max_depth_jump_m: float, min_grazing_rad: float,
) -> np.ndarray:
    """Edges (E, 2) int32 between neighbours on a ring where the surface is continuous.

    They are rows i < j of the scan; edges without a `wanted` (P,) end are left out.
    """
    limits = (max_edge_m, max_edge_rad, max_depth_jump_m, math.sin(min_grazing_rad))
    return _ring_edges(grid, wanted, limits)


def scan_grid(points: np.ndarray, azimuth: np.ndarray, order: np.ndarray, bounds: np.ndarray) -> ScanGrid:
    """The ScanGrid of some of the points (N, 3): `order` (P,) lists them, `bounds` (R + 1,) are its rings."""
    return ScanGrid(*_scan_grid(points, azimuth, order, bounds))


def part(grid: ScanGrid, kept: np.ndarray) -> ScanGrid:
    """The ScanGrid of the `kept` (P,) points alone; rings may be empty there."""
    return ScanGrid(*_part(grid, kept))


@njit()
def _scan_grid(points, azimuth, order, bounds):
    count = len(order)
    row, placed = np.empty(count, np.int32), np.empty((count, 3))
    range_m, placed_azimuth = np.empty(count), np.empty(count)
    for k in range(count):
        i = order[k]
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        row[k], range_m[k], placed_azimuth[k] = i, math.sqrt(x * x + y * y + z * z), azimuth[i]
        placed[k, 0], placed[k, 1], placed[k, 2] = x, y, z
    return row, placed, range_m, placed_azimuth, bounds


@njit()
def _part(grid, kept):
    bounds = np.zeros(len(grid.bounds), np.int64)
    for ring in range(len(bounds) - 1):
        bounds[ring + 1] = bounds[ring] + kept[grid.bounds[ring]: grid.bounds[ring + 1]].sum()
    count = bounds[-1]
    row, points = np.empty(count, np.int32), np.empty((count, 3))
    range_m, azimuth = np.empty(count), np.empty(count)
    at = 0
    for k in range(len(kept)):
        if kept[k]:
            row[at], range_m[at], azimuth[at] = grid.row[k], grid.range_m[k], grid.azimuth[k]
            for axis in range(3):
                points[at, axis] = grid.points[k, axis]
            at += 1
    return row, points, range_m, azimuth, bounds


@njit(inline="always")
def continuous_at(edge_sq, range_a, range_b, limits):
    """Whether a segment of squared length `edge_sq` can lie on one surface, as seen from the origin.

    Its ends are `range_a` and `range_b` away.
    """
    max_edge_m, max_edge_rad, max_depth_jump_m, min_sine = limits
    longest = max(max_edge_m, max_edge_rad * min(range_a, range_b))
    jump = abs(range_a - range_b)
    if edge_sq > longest * longest or jump > max_depth_jump_m:
        return False
    # Sine of the angle between the edge and the line of sight, from the edge's share along it.
    return edge_sq - jump * jump >= min_sine * min_sine * edge_sq


@njit(inline="always")
def _continuous(grid, a, b, limits):
    edge_sq = ((grid.points[a, 0] - grid.points[b, 0]) ** 2 + (grid.points[a, 1] - grid.points[b, 1]) ** 2
               + (grid.points[a, 2] - grid.points[b, 2]) ** 2)
    return continuous_at(edge_sq, grid.range_m[a], grid.range_m[b], limits)


@njit()
def _ring_strips(grid, step, wanted, limits):
    triangles, count = np.empty((2 * len(grid.row), 3), np.int32), 0
    rings = len(grid.bounds) - 1
    for first in range(step):
        for ring in range(first, rings - step, step):
            count = _strip(grid, ring, ring + step, wanted, limits, triangles, count)
    return triangles[:count].copy()


@njit()
def _strip(grid, upper, lower, wanted, limits, triangles, count):
    """Write the triangles between two rings behind the `count` that are there; returns how many there are."""
    bounds, azimuth = grid.bounds, grid.azimuth
    i, i_end, j, j_end = bounds[upper], bounds[upper + 1], bounds[lower], bounds[lower + 1]
    if i == i_end or j == j_end:
        return count
    a, b, ab = i, j, _UNKNOWN      # the last points, and whether the surface is continuous between them
    a_next, a_next_azimuth = _next_on_ring(azimuth, bounds[upper], i, i_end)
    b_next, b_next_azimuth = _next_on_ring(azimuth, bounds[lower], j, j_end)
    while a_next >= 0 or b_next >= 0:
        is_upper = a_next_azimuth <= b_next_azimuth
        c, beside, across = (a_next, a, b) if is_upper else (b_next, b, a)
        if wanted[a] or wanted[b] or wanted[c]:
            if ab == _UNKNOWN:
                ab = _YES if _continuous(grid, a, b, limits) else _NO
            next_ab = _YES if _continuous(grid, across, c, limits) else _NO
            if ab == _YES and next_ab == _YES and _continuous(grid, beside, c, limits):
                triangles[count, 0], triangles[count, 1] = grid.row[a], grid.row[b]
                triangles[count, 2] = grid.row[c]
                count += 1
            ab = next_ab
        else:
            ab = _UNKNOWN
        if is_upper:
            i, a = i + 1, c
            a_next, a_next_azimuth = _next_on_ring(azimuth, bounds[upper], i, i_end)
        else:
            j, b = j + 1, c
            b_next, b_next_azimuth = _next_on_ring(azimuth, bounds[lower], j, j_end)
    return count


@njit()
def _ring_edges(grid, wanted, limits):
    edges, count = np.empty((len(grid.row), 2), np.int32), 0
    for ring in range(len(grid.bounds) - 1):
        for k in range(grid.bounds[ring], grid.bounds[ring + 1] - 1):
            if (wanted[k] or wanted[k + 1]) and _continuous(grid, k, k + 1, limits):
                a, b = grid.row[k], grid.row[k + 1]
                edges[count, 0], edges[count, 1] = min(a, b), max(a, b)
                count += 1
    return edges[:count].copy()


@njit(inline="always")
def _next_on_ring(azimuth, start, here, end):
    """What comes after index `here` of a ring and its azimuth; past the last the first one, a turn on.

    -1 and infinity at the end, which a ring with no point in the half turn across ±π has at its last point.
    """
    if here + 1 < end:
        return here + 1, azimuth[here + 1]
    first_again = azimuth[start] + 2.0 * math.pi
    if here + 1 == end and first_again - azimuth[end - 1] < math.pi:
        return start, first_again
    return -1, math.inf
