"""Triangles between neighbouring points of a cloud without rings: stars in tangent planes."""

import math
from typing import NamedTuple

import numba
import numpy as np

from lidarflow.kernels import cells, grid
from lidarflow.kernels.compiled import njit
from lidarflow.kernels.mesh import continuous_at
from lidarflow.kernels.sorting import sort

_MAX_NEIGHBOURS = 100   # looked at per point, as in Marton et al. 2009
_MAX_STAR = 16          # triangles around one point
_MIN_LEVEL = 0.5        # cosine of the angle between an edge and the tangent plane
_REACHES = 2            # each half the next: where points are dense, a star is found in the shorter
_WORTH = 30             # points that a short reach must hold for a star to be likely within it


class Cloud(NamedTuple):
    """Points with a grid for each of R reaches.

    points     (N, 3) float64   in metres, sensor frame
    normals    (N, 3) float64   NaN where there is no surface
    ranges_m   (N,) float64     distance from the sensor
    reaches_m  (R,) float64     ascending; the other fields are what grid.build gives for each of them
    """

    points: np.ndarray
    normals: np.ndarray
    ranges_m: np.ndarray
    reaches_m: np.ndarray
    orders: np.ndarray
    keys: np.ndarray
    lowers: np.ndarray
    shapes: np.ndarray


def triangles(
    points: np.ndarray, normals: np.ndarray, max_edge_m: float, max_edge_rad: float, max_depth_jump_m: float,
    min_grazing_rad: float, max_surface_angle_rad: float, min_angle_rad: float, max_angle_rad: float,
) -> np.ndarray:
    """Triangles (T, 3) int32, i < j < k, that at least two of their corners have in their own star.

    points (N, 3), normals (N, 3), NaN where there is no surface. The star of a point is its ring of
    Delaunay neighbours in its tangent plane, among neighbours whose normals agree within
    `max_surface_angle_rad`; triangles keep the angle limits of Marton et al. 2009.
    """
    limits = (max_edge_m, max_edge_rad, max_depth_jump_m, math.sin(min_grazing_rad))
    order, cloud = _arranged(points, normals, max_edge_m)
    stars = _star_triangles(
        cloud, limits, math.cos(max_surface_angle_rad), math.cos(min_angle_rad), math.cos(max_angle_rad))
    return _agreed(stars.reshape(-1, 3), order)


def _arranged(points: np.ndarray, normals: np.ndarray, max_edge_m: float) -> tuple[np.ndarray, Cloud]:
    """The order (N,) that points are walked through in, that of the finest grid, and them in it."""
    reaches_m = max_edge_m / 2.0 ** np.arange(_REACHES)[::-1]
    order, *finest = grid.build(points, reaches_m[0])
    points = points[order]
    coarser = (grid.build(points, reach_m) for reach_m in reaches_m[1:])
    grids = zip((np.arange(len(points)), *finest), *coarser, strict=True)
    return order, Cloud(
        points, normals[order], np.linalg.norm(points, axis=1), reaches_m, *map(np.stack, grids))


@njit(parallel=True)
def _star_triangles(cloud, limits, min_agreement, max_cosine, min_cosine):
    """Triangles (N, _MAX_STAR, 3) of every point's own star, rows of -1 where there is none."""
    triangles = np.full((len(cloud.points), _MAX_STAR, 3), -1, np.int64)
    for i in numba.prange(len(cloud.points)):
        if math.isnan(cloud.normals[i, 0]):
            continue
        near, plane, hull = _star(i, cloud, limits, min_agreement)
        slot = 0
        for s in range(len(hull)):
            a, b = hull[s], hull[(s + 1) % len(hull)]
            if a != b and _well_shaped(plane[a], plane[b], max_cosine, min_cosine):
                triangles[i, slot, 0] = i
                triangles[i, slot, 1], triangles[i, slot, 2] = near[a], near[b]
                slot += 1
    return triangles


@njit()
def _agreed(stars, order):
    """Triangles (T, 3) int32, i < j < k, ascending, that are more than once among those of stars (S, 3).

    Corners of stars, -1 where there is no triangle, are places in `order` (N,), which has their rows.
    """
    count, found = len(order), 0
    lowest, others = np.empty(len(stars), np.int64), np.empty(len(stars), np.int64)
    for t in range(len(stars)):
        if stars[t, 0] >= 0:
            a, b, c = order[stars[t, 0]], order[stars[t, 1]], order[stars[t, 2]]
            low, high = min(a, b, c), max(a, b, c)
            # Three rows in one number would overflow where there are millions of points.
            lowest[found], others[found] = low, (a + b + c - low - high) * count + high
            found += 1
    lowest, others = lowest[:found], others[:found]
    by_lowest, bounds = cells.by_number(lowest, np.bincount(lowest, minlength=count))
    others = others[by_lowest]
    for i in range(count):
        sort(others[bounds[i]: bounds[i + 1]])
    return _repeated(others, bounds, found // 2)


@njit()
def _repeated(others, bounds, room):
    """Triangles (T, 3) int32, at most `room`, that are there more than once.

    Point i is the lowest corner of those whose `others`, ascending, are others[bounds[i]: bounds[i + 1]].
    """
    count = len(bounds) - 1
    triangles, found = np.empty((room, 3), np.int32), 0
    for i in range(count):
        for at in range(bounds[i] + 1, bounds[i + 1]):
            is_second = at == bounds[i] + 1 or others[at - 2] != others[at]
            if others[at - 1] == others[at] and is_second:
                triangles[found, 0] = i
                triangles[found, 1], triangles[found, 2] = others[at] // count, others[at] % count
                found += 1
    return triangles[:found].copy()


@njit()
def _star(i, cloud, limits, min_agreement):
    """Neighbours of point i on its surface, (n,), their places in its plane, (n, 2), and which are its star.

    The star found within a short reach is final where nothing beyond it can lie in one of its circles.
    """
    starts, ends = np.empty(9, np.int64), np.empty(9, np.int64)
    near, plane, hull = np.empty(0, np.int64), np.empty((0, 2)), np.empty(0, np.int64)
    for k in range(_REACHES):
        reach_m, is_last = cloud.reaches_m[k], k == _REACHES - 1
        run_count = grid.runs(
            cloud.points[i], cloud.keys[k], cloud.lowers[k], cloud.shapes[k], reach_m, starts, ends)
        if grid.room(starts, ends, run_count) < _WORTH and not is_last:
            continue
        near = _on_surface(
            i, cloud, cloud.orders[k], starts, ends, run_count, reach_m, limits, min_agreement)
        if len(near) < 2:
            continue
        plane = np.empty((len(near), 2))
        _project(cloud.points, i, cloud.normals[i], near, plane)
        hull, circle_m = _delaunay_ring(plane)
        if len(near) == _MAX_NEIGHBOURS or circle_m <= reach_m * _MIN_LEVEL:
            break
    return near, plane, hull


@njit()
def _on_surface(i, cloud, order, starts, ends, run_count, reach_m, limits, min_agreement):
    """The up to _MAX_NEIGHBOURS nearest points within reach on the surface of point i.

    Their normals agree with its own, and they are not over or under it, on another surface close by.
    """
    points, normals, ranges_m = cloud.points, cloud.normals, cloud.ranges_m
    room = grid.room(starts, ends, run_count)
    near, near_sq = np.empty(room, np.int64), np.empty(room)
    count, max_sine_sq = 0, 1.0 - _MIN_LEVEL * _MIN_LEVEL
    nx, ny, nz = normals[i, 0], normals[i, 1], normals[i, 2]
    for run in range(run_count):
        for place in range(starts[run], ends[run]):
            j = order[place]
            dx, dy, dz = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1], points[j, 2] - points[i, 2]
            apart_sq, off_m = dx * dx + dy * dy + dz * dz, nx * dx + ny * dy + nz * dz
            if j == i or apart_sq > reach_m * reach_m or off_m * off_m > max_sine_sq * apart_sq:
                continue
            agreement = nx * normals[j, 0] + ny * normals[j, 1] + nz * normals[j, 2]
            if abs(agreement) >= min_agreement and continuous_at(apart_sq, ranges_m[i], ranges_m[j], limits):
                near[count], near_sq[count] = j, apart_sq
                count += 1
    if count > _MAX_NEIGHBOURS:
        farthest_sq = np.partition(near_sq[:count], _MAX_NEIGHBOURS - 1)[_MAX_NEIGHBOURS - 1]
        return near[:count][near_sq[:count] <= farthest_sq][:_MAX_NEIGHBOURS]
    return near[:count]


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
    images; gift wrapping walks it from the farthest image, the nearest neighbour. Returned with them is the
    diameter of the largest of these circles, infinite where the ring does not close around the origin.
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
    hull = hull[:size]
    return hull, _largest_circle(image, hull) if after == first else math.inf


@njit()
def _largest_circle(image, hull):
    """Diameter of the largest circle through the origin that is the inverse of a side of the closed hull.

    Infinite where the origin is not within it.
    """
    diameter = 0.0
    for s in range(len(hull)):
        a, b = image[hull[s]], image[hull[(s + 1) % len(hull)]]
        cross = a[0] * b[1] - a[1] * b[0]
        if cross <= 0.0:
            return math.inf
        diameter = max(diameter, math.hypot(b[0] - a[0], b[1] - a[1]) / cross)
    return diameter


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
