"""Triangles and edges between neighbouring points of scan rings."""

import math

import numpy as np

from lidarflow.kernels.compiled import njit


def ring_strips(
    points: np.ndarray, azimuth: np.ndarray, order: np.ndarray, bounds: np.ndarray,
    max_edge_m: float, max_edge_rad: float, max_depth_jump_m: float, min_grazing_rad: float,
) -> np.ndarray:
    """Triangles (T, 3) int32 of the strips between each ring and the next where the surface is continuous.

    points (N, 3), azimuth (N,); `order` (P,) lists points ring by ring with azimuth ascending, ring r being
    order[bounds[r]:bounds[r + 1]].
    """
    room = 2 * len(order)
    triangles = np.empty((room, 3), np.int32)
    limits = (max_edge_m, max_edge_rad, max_depth_jump_m, math.sin(min_grazing_rad))
    count = _ring_strips(points, azimuth, order, bounds, limits, triangles)
    return triangles[:count].copy()


@njit()
def continuous(a, b, limits):
    """Whether the segment between points a and b can lie on one surface, as seen from the origin."""
    edge_sq = (a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2
    return continuous_at(edge_sq, _range(a), _range(b), limits)


@njit(inline="always")
def _range(a):
    return math.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])


@njit(inline="always")
def continuous_at(edge_sq, range_a, range_b, limits):
    """As `continuous`, from the squared length of the segment and how far away its ends are."""
    max_edge_m, max_edge_rad, max_depth_jump_m, min_sine = limits
    longest = max(max_edge_m, max_edge_rad * min(range_a, range_b))
    jump = abs(range_a - range_b)
    if edge_sq > longest * longest or jump > max_depth_jump_m:
        return False
    # Sine of the angle between the edge and the line of sight, from the edge's share along it.
    return edge_sq - jump * jump >= min_sine * min_sine * edge_sq


@njit()
def _ring_strips(points, azimuth, order, bounds, limits, triangles):
    count = 0
    for ring in range(len(bounds) - 2):
        i, i_end = bounds[ring], bounds[ring + 1]
        j, j_end = bounds[ring + 1], bounds[ring + 2]
        if i == i_end or j == j_end:
            continue
        a, b = order[i], order[j]
        while True:
            upper, upper_azimuth = _next_on_ring(azimuth, order, bounds[ring], i, i_end)
            lower, lower_azimuth = _next_on_ring(azimuth, order, bounds[ring + 1], j, j_end)
            if upper < 0 and lower < 0:
                break
            c = upper if upper_azimuth <= lower_azimuth else lower
            if (continuous(points[a], points[b], limits) and continuous(points[a], points[c], limits)
                    and continuous(points[b], points[c], limits)):
                triangles[count, 0], triangles[count, 1], triangles[count, 2] = a, b, c
                count += 1
            if upper_azimuth <= lower_azimuth:
                i, a = i + 1, c
            else:
                j, b = j + 1, c
    return count


def ring_edges(
    points: np.ndarray, order: np.ndarray, bounds: np.ndarray, wanted: np.ndarray,
    max_edge_m: float, max_edge_rad: float, max_depth_jump_m: float, min_grazing_rad: float,
) -> np.ndarray:
    """Edges (E, 2) int32, i < j, between neighbours on a ring where the surface is continuous.

    `order` and `bounds` as for `ring_strips`; edges without a `wanted` (N,) end are left out.
    """
    limits = (max_edge_m, max_edge_rad, max_depth_jump_m, math.sin(min_grazing_rad))
    return np.sort(_ring_edges(points, order, bounds, wanted, limits), axis=1)


@njit()
def _ring_edges(points, order, bounds, wanted, limits):
    edges = np.empty((len(order), 2), np.int32)
    count = 0
    for ring in range(len(bounds) - 1):
        for k in range(bounds[ring], bounds[ring + 1] - 1):
            a, b = order[k], order[k + 1]
            if (wanted[a] or wanted[b]) and continuous(points[a], points[b], limits):
                edges[count, 0], edges[count, 1] = a, b
                count += 1
    return edges[:count].copy()


@njit()
def _next_on_ring(azimuth, order, start, here, end):
    """Point after position `here` of a ring and its azimuth; past the last the first one, a turn on.

    -1 and infinity at the end, which a ring with no point in the half turn across ±π has at its last point.
    """
    if here + 1 < end:
        return order[here + 1], azimuth[order[here + 1]]
    first_again = azimuth[order[start]] + 2.0 * math.pi
    if here + 1 == end and first_again - azimuth[order[end - 1]] < math.pi:
        return order[start], first_again
    return -1, math.inf
