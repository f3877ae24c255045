"""Triangles between neighbouring points: strips between scan rings, or stars in tangent planes."""

import math

import numba
import numpy as np

from lidarflow.kernels import grid
from lidarflow.kernels.compiled import njit

_MAX_NEIGHBOURS = 100   # looked at per point, as in Marton et al. 2009
_MAX_STAR = 16          # triangles around one point


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
    max_edge_m, max_edge_rad, max_depth_jump_m, min_sine = limits
    edge_sq = (a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2
    range_a = math.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])
    range_b = math.sqrt(b[0] * b[0] + b[1] * b[1] + b[2] * b[2])
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


def tangent_stars(
    points: np.ndarray, normals: np.ndarray, max_edge_m: float, max_edge_rad: float, max_depth_jump_m: float,
    min_grazing_rad: float, max_surface_angle_rad: float, min_angle_rad: float, max_angle_rad: float,
) -> np.ndarray:
    """Triangles (T, 3) int32, i < j < k, that at least two of their corners have in their own star.

    points (N, 3), normals (N, 3), NaN where there is no surface. The star of a point is its ring of
    Delaunay neighbours in its tangent plane, among neighbours whose normals agree within
    `max_surface_angle_rad`; triangles keep the angle limits of Marton et al. 2009.
    """
    order, keys, lower, shape = grid.build(points, max_edge_m)
    limits = (max_edge_m, max_edge_rad, max_depth_jump_m, math.sin(min_grazing_rad))
    corners = _star_triangles(
        points[order], normals[order], keys, lower, shape, limits, math.cos(max_surface_angle_rad),
        math.cos(min_angle_rad), math.cos(max_angle_rad))
    corners = np.sort(order[corners.reshape(-1, 3)[corners.reshape(-1, 3)[:, 0] >= 0]], axis=1)
    n = np.int64(len(points))
    keys, votes = np.unique((corners[:, 0] * n + corners[:, 1]) * n + corners[:, 2], return_counts=True)
    keys = keys[votes >= 2]
    return np.stack([keys // (n * n), keys // n % n, keys % n], axis=1).astype(np.int32)


@njit(parallel=True)
def _star_triangles(points, normals, keys, lower, shape, limits, min_agreement, max_cosine, min_cosine):
    """Triangles (N, _MAX_STAR, 3) of every point's own star, rows of -1 where there is none."""
    triangles = np.full((len(points), _MAX_STAR, 3), -1, np.int64)
    reach_m = limits[0]
    for i in numba.prange(len(points)):
        normal = normals[i]
        if normal[0] != normal[0]:
            continue
        starts, ends = np.empty(9, np.int64), np.empty(9, np.int64)
        run_count = grid.runs(points[i], keys, lower, shape, reach_m, starts, ends)
        room = 0
        for run in range(run_count):
            room += ends[run] - starts[run]
        near, near_sq = np.empty(room, np.int64), np.empty(room)
        count = 0
        for run in range(run_count):
            for j in range(starts[run], ends[run]):
                agreement = normal[0] * normals[j, 0] + normal[1] * normals[j, 1] + normal[2] * normals[j, 2]
                close = abs(agreement) >= min_agreement and continuous(points[i], points[j], limits)
                if j == i or not close:
                    continue
                near[count] = j
                near_sq[count] = ((points[i, 0] - points[j, 0]) ** 2 + (points[i, 1] - points[j, 1]) ** 2
                                  + (points[i, 2] - points[j, 2]) ** 2)
                count += 1
        if count >= 2:
            nearest = near[:count][np.argsort(near_sq[:count])[:_MAX_NEIGHBOURS]]
            plane = np.empty((len(nearest), 2))
            _project(points, i, normal, nearest, plane)
            hull = _delaunay_ring(plane)
            slot = 0
            for s in range(len(hull)):
                a, b = hull[s], hull[(s + 1) % len(hull)]
                if a != b and _well_shaped(plane[a], plane[b], max_cosine, min_cosine):
                    triangles[i, slot, 0] = i
                    triangles[i, slot, 1], triangles[i, slot, 2] = nearest[a], nearest[b]
                    slot += 1
    return triangles


@njit()
def _project(points, i, normal, near, plane):
    """Coordinates (n, 2) of the points `near` in the tangent plane of point i, relative to it."""
    if abs(normal[0]) < 0.9:
        ux, uy, uz = 0.0, normal[2], -normal[1]
    else:
        ux, uy, uz = -normal[2], 0.0, normal[0]
    length = math.sqrt(ux * ux + uy * uy + uz * uz)
    ux, uy, uz = ux / length, uy / length, uz / length
    vx = normal[1] * uz - normal[2] * uy
    vy = normal[2] * ux - normal[0] * uz
    vz = normal[0] * uy - normal[1] * ux
    for k in range(len(near)):
        dx = points[near[k], 0] - points[i, 0]
        dy = points[near[k], 1] - points[i, 1]
        dz = points[near[k], 2] - points[i, 2]
        plane[k, 0], plane[k, 1] = dx * ux + dy * uy + dz * uz, dx * vx + dy * vy + dz * vz


@njit()
def _delaunay_ring(plane):
    """Rows of `plane` (n, 2) that are Delaunay neighbours of the origin, counter-clockwise.

    The inversion q / |q|² turns empty circles through the origin into edges of the convex hull of the
    images; gift wrapping walks it from the farthest image, the nearest neighbour.
    """
    n = len(plane)
    image = np.empty((n, 2))
    first = 0
    for k in range(n):
        square = max(plane[k, 0] ** 2 + plane[k, 1] ** 2, 1e-12)
        image[k, 0], image[k, 1] = plane[k, 0] / square, plane[k, 1] / square
        if image[k, 0] ** 2 + image[k, 1] ** 2 > image[first, 0] ** 2 + image[first, 1] ** 2:
            first = k
    hull = np.empty(min(n, _MAX_STAR), np.int64)
    size = 0
    here = first
    while size < len(hull):
        hull[size] = here
        size += 1
        after = first if here != first else (first + 1) % n
        for k in range(n):
            if k == here:
                continue
            cross = ((image[after, 0] - image[here, 0]) * (image[k, 1] - image[here, 1])
                     - (image[after, 1] - image[here, 1]) * (image[k, 0] - image[here, 0]))
            if cross < 0.0:
                after = k
        if after == first:
            break
        here = after
    return hull[:size]


@njit()
def _well_shaped(a, b, max_cosine, min_cosine):
    """Whether the origin, a and b make a counter-clockwise triangle within the angle limits."""
    if a[0] * b[1] - a[1] * b[0] <= 0.0:
        return False
    cx, cy = b[0] - a[0], b[1] - a[1]
    la, lb, lc = math.sqrt(a[0] ** 2 + a[1] ** 2), math.sqrt(b[0] ** 2 + b[1] ** 2), math.sqrt(cx**2 + cy**2)
    if la * lb * lc == 0.0:
        return False
    at_origin = (a[0] * b[0] + a[1] * b[1]) / (la * lb)
    at_a = -(a[0] * cx + a[1] * cy) / (la * lc)
    at_b = (b[0] * cx + b[1] * cy) / (lb * lc)
    return min(at_origin, at_a, at_b) >= min_cosine and max(at_origin, at_a, at_b) <= max_cosine
