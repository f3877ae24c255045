"""Compiled kernels against slow NumPy twins that share no code with them.

Every check takes a size, so that the same comparison also runs with compilation off, on tiny inputs.
"""

import os
import subprocess
import sys
from itertools import combinations, pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import Delaunay

from lidarflow.kernels import (
    cells,
    coherence,
    graphs,
    grid,
    linalg,
    matching,
    mesh,
    normals,
    rings,
    shot,
    tangent_stars,
)

RADIUS_M = 1.0


def rng(seed: int) -> np.random.Generator:
    return np.random.default_rng(seed)


def bumpy_surface(count: int, random: np.random.Generator) -> np.ndarray:
    """Points (count, 3) on a patch of hills in front of the sensor, 40 per square metre."""
    side = np.sqrt(count / 40.0)
    u, v = random.uniform(-side / 2, side / 2, (2, count))
    depth = 6.0 + 0.4 * np.sin(1.7 * u + 0.5) * np.cos(1.3 * v) + 0.15 * np.sin(4.1 * v + u)
    return np.column_stack([depth, u, v]) + random.normal(scale=0.01, size=(count, 3))


def random_rotation(random: np.random.Generator) -> np.ndarray:
    q, r = np.linalg.qr(random.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.linalg.det(q)


# ---- grid -----------------------------------------------------------------------------------------------

def check_voxels(count: int) -> None:
    points = rng(0).uniform(-3, 3, (count, 3))
    points[: count // 10] = points[count // 10: 2 * (count // 10)]
    nearest: dict[tuple, tuple[float, int]] = {}
    for row, point in enumerate(points):
        cell = np.floor(point / 0.7)
        candidate = (((point / 0.7 - cell - 0.5) ** 2).sum(), row)
        key = tuple(cell)
        nearest[key] = min(candidate, nearest.get(key, (np.inf, -1)))
    expected = sorted(row for _, row in nearest.values())
    np.testing.assert_array_equal(grid.first_per_voxel(points, 0.7), expected)


def check_means(count: int) -> None:
    points = rng(3).uniform(-3, 3, (count, 3))
    members: dict[tuple, list[int]] = {}
    for row, point in enumerate(points):
        members.setdefault(tuple(np.floor((point - points.min(axis=0)) / 0.7 + 0.5)), []).append(row)
    expected = [points[rows].mean(axis=0) for rows in members.values()]
    np.testing.assert_allclose(grid.means(points, 0.7), expected, atol=1e-12)


def check_grid_queries(count: int) -> None:
    random = rng(1)
    points = random.uniform(-2, 2, (count, 3))
    queries = np.vstack([random.uniform(-3, 3, (count // 2, 3)), points[:5], [[50.0, 0, 0], [0, -50, 90]]])
    order, keys, lower, shape = grid.build(points, 0.5)
    assert (np.diff(keys) >= 0).all() and sorted(order) == list(range(count))
    for query in queries:
        starts, ends = np.empty(9, np.int64), np.empty(9, np.int64)
        runs = grid.runs(query, keys, lower, shape, 0.5, starts, ends)
        seen = [row for k in range(runs) for row in order[starts[k]:ends[k]]]
        assert len(set(seen)) == len(seen)
        within = np.flatnonzero(np.linalg.norm(points - query, axis=1) <= 0.5)
        assert set(within) <= set(seen)


def check_far_points(count: int) -> None:
    """A point far off, in a grid of more cells than there are numbers, changes nothing for the others."""
    points = rng(10).uniform(-2, 2, (count, 3))
    for far in (np.full(3, 1e12), np.full(3, -1e12), np.array([1.0, -1e300, 1e300]), np.full(3, 1e300)):
        order, keys, lower, shape = grid.build(np.vstack([points, far]), 0.5)
        for query in (*points[::5], far):
            starts, ends = np.empty(9, np.int64), np.empty(9, np.int64)
            runs = grid.runs(query, keys, lower, shape, 0.5, starts, ends)
            seen = [row for k in range(runs) for row in order[starts[k]:ends[k]]]
            assert len(set(seen)) == len(seen)
            within = np.flatnonzero(np.abs(points - query).max(axis=1) <= 0.5)
            assert set(within) <= set(seen) and (count in seen or query is not far)


# ---- linear algebra -------------------------------------------------------------------------------------

def symmetric_matrices(count: int) -> list[np.ndarray]:
    random = rng(2)
    matrices = [m + m.T for m in random.normal(size=(count, 3, 3))]
    matrices += [np.outer(v, v) for v in random.normal(size=(count, 3))]
    for values in ([1, 1, 2], [0, 3, 3], [5, 5, 5], [-1, 0, 1], [1e-9, 1e-9, 1], [1e-6, 1, 1e6]):
        q = random_rotation(random)
        turned = q @ np.diag(np.array(values, float)) @ q.T
        matrices.append((turned + turned.T) / 2)
    exchange = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, 0]])
    return matrices + [np.zeros((3, 3)), np.eye(3), np.diag([3.0, 1.0, 2.0]), exchange, 1e-12 * matrices[0]]


def check_eigen(count: int) -> None:
    for m in symmetric_matrices(count):
        values, vectors = np.empty(3), np.empty((3, 3))
        linalg.symmetric_eigen3(m[0, 0], m[0, 1], m[0, 2], m[1, 1], m[1, 2], m[2, 2], values, vectors)
        size = np.abs(m).max() + 1e-300
        np.testing.assert_allclose(values / size, np.linalg.eigh(m)[0] / size, atol=1e-12)
        np.testing.assert_allclose(vectors.T @ vectors, np.eye(3), atol=1e-12)
        np.testing.assert_allclose((vectors * values) @ vectors.T / size, m / size, atol=1e-12)


def check_plane_eigen(count: int) -> None:
    for m in symmetric_matrices(count):
        values, normal = np.empty(3), np.empty(3)
        linalg.plane_eigen3(m[0, 0], m[0, 1], m[0, 2], m[1, 1], m[1, 2], m[2, 2], values, normal)
        size = np.abs(m).max() + 1e-300
        expected = np.linalg.eigh(m)[0]
        np.testing.assert_allclose(values / size, expected / size, atol=1e-7)
        np.testing.assert_allclose(normal @ normal, 1.0, atol=1e-12)
        if expected[1] - expected[0] > 0.01 * size:
            np.testing.assert_allclose(m @ normal / size, expected[0] * normal / size, atol=1e-12)


# ---- normals --------------------------------------------------------------------------------------------

def normals_twin(points: np.ndarray, surface: np.ndarray, radius_m: float) -> np.ndarray:
    found = np.full(points.shape, np.nan)
    for row, point in enumerate(points):
        near = surface[np.linalg.norm(surface - point, axis=1) <= radius_m]
        if len(near) < 4:
            continue
        values, vectors = np.linalg.eigh(np.cov(near.T, bias=True))
        if values[1] <= 1e-3 * values[2]:
            continue
        found[row] = vectors[:, 0] * (-1.0 if vectors[:, 0] @ point > 0 else 1.0)
    return found


def check_normals(count: int) -> None:
    random = rng(3)
    surface = bumpy_surface(count, random)
    lone = np.array([[20.0, 0, 0], [20.1, 0, 0], [20.2, 0, 0]])
    line = np.column_stack([np.linspace(30, 31, 12), np.linspace(1, 2, 12), np.zeros(12)])
    surface = np.vstack([surface, lone, line])
    points = np.vstack([surface[:: max(1, count // 60)], lone, line[:5], surface[:5] + 0.1, [[99.0, 99, 99]]])
    estimated, expected = normals.estimate(points, surface, 0.5), normals_twin(points, surface, 0.5)
    np.testing.assert_array_equal(np.isnan(estimated), np.isnan(expected))
    assert np.isnan(expected).any() and np.isfinite(expected).all(axis=1).sum() >= 10
    np.testing.assert_allclose(estimated, expected, atol=1e-4)     # sums are in single precision


# ---- local shifts ---------------------------------------------------------------------------------------

def local_shifts_twin(points, plane_normals, offsets_m, radius_m):
    known = np.isfinite(plane_normals).all(axis=1) & np.isfinite(offsets_m)
    rows = []
    for point in points:
        near = known & (np.linalg.norm(points - point, axis=1) <= radius_m)
        n, r = plane_normals[near], offsets_m[near]
        if near.any():
            # Damping as extra rows of the least-squares problem.
            stacked = np.vstack([n, np.sqrt(0.02 * len(n)) * np.eye(3)])
            t = np.linalg.lstsq(stacked, np.concatenate([r, np.zeros(3)]), rcond=None)[0]
            rows.append((t, len(n), np.sqrt((r**2).mean()), np.sqrt(((r - n @ t) ** 2).mean())))
        else:
            rows.append((np.zeros(3), 0, 0.0, 0.0))
    return [np.array(column) for column in zip(*rows, strict=True)]


def check_local_shifts(count: int) -> None:
    random = rng(9)
    points = bumpy_surface(count, random)
    planes = normals_twin(points, points, 0.5)
    offsets_m = (planes * [0.1, -0.05, 0.2]).sum(axis=1) + random.normal(0, 0.01, len(points))
    offsets_m[::7] = np.nan
    given = points, planes, offsets_m, 0.5
    for found, expected in zip(coherence.local_shifts(*given), local_shifts_twin(*given), strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-5)     # sums are in single precision
    shift, planes_around, before_m, after_m = coherence.local_shifts(*given)
    least, least_m = int(np.median(planes_around)), float(np.median(before_m))
    told = (planes_around >= least) & (before_m >= least_m)
    assert 0 < told.sum() < count
    limited = coherence.local_shifts(*given, least, least_m)
    np.testing.assert_array_equal(limited[0], np.where(told[:, None], shift, 0.0))
    np.testing.assert_array_equal(limited[3], np.where(told, after_m, before_m))


# ---- SHOT -----------------------------------------------------------------------------------------------

def shot_frame_twin(offsets: np.ndarray, radius_m: float) -> tuple[np.ndarray, bool]:
    """Frame (3, 3), rows x y z, and whether the signs of its axes are beyond doubt (equations 1-3)."""
    distance = np.linalg.norm(offsets, axis=1)
    weight = radius_m - distance
    covariance = (weight[:, None] * offsets).T @ offsets / weight.sum()
    _, vectors = np.linalg.eigh(covariance)
    is_certain, axes = True, {}
    for name, column in (("x", 2), ("z", 0)):
        axis = vectors[:, column]
        ahead = (offsets @ axis >= 0).sum()
        is_certain &= 2 * ahead != len(offsets)
        axes[name] = axis if 2 * ahead >= len(offsets) else -axis
    return np.stack([axes["x"], np.cross(axes["z"], axes["x"]), axes["z"]]), bool(is_certain)


def pcl_sector(x: float, y: float) -> int:
    """Azimuth sector by the sign tests of PCL's shot.hpp."""
    bit4 = int(y > 0 or (y == 0 and x < 0))
    bit3 = (1 - bit4) if (x > 0 or (x == 0 and y > 0)) else bit4
    bit2 = not abs(x) >= abs(y) if x * y > 0 or x == 0 else abs(x) > abs(y)
    return 4 * bit4 + 2 * bit3 + int(bit2)


def shot_vote_twin(histogram: np.ndarray, local: np.ndarray, cosine: float, radius_m: float) -> None:
    """One neighbour's votes in a histogram (8, 2, 2, 11) of azimuth, shell, elevation and cosine.

    Along each of the four axes, one unit is split between the bin the neighbour is in and the next one
    along that axis, by how far it is from their centres; what would leave the support is lost.
    """
    x, y, z = local
    distance = np.linalg.norm(local)
    azimuth, polar = np.arctan2(y, x), np.arctan2(np.hypot(x, y), z)
    place = np.array([
        (azimuth + np.pi) / (np.pi / 4) - 0.5, distance / (radius_m / 2) - 0.5,
        1.5 - polar / (np.pi / 2), (1 + cosine) / 2 * 10])
    own = np.array([pcl_sector(x, y), distance > radius_m / 2, z > 0, np.floor(place[3] + 0.5)], int)
    for axis, size in enumerate(histogram.shape):
        beside = place[axis] - own[axis]
        histogram[tuple(own)] += 1 - abs(beside)
        neighbour = own.copy()
        neighbour[axis] += 1 if beside > 0 else -1
        if axis == 0:
            neighbour[axis] %= size
        if 0 <= neighbour[axis] < size:
            histogram[tuple(neighbour)] += abs(beside)


def shot_twin(keypoint, surface, surface_normals, radius_m):
    offsets = surface - keypoint
    distance = np.linalg.norm(offsets, axis=1)
    near = (distance > 0) & (distance <= radius_m)
    frame, is_certain = shot_frame_twin(offsets[near], radius_m)
    histogram = np.zeros((8, 2, 2, 11))
    for offset, normal in zip(offsets[near], surface_normals[near], strict=True):
        if np.isfinite(normal).all():
            shot_vote_twin(histogram, frame @ offset, float(np.clip(frame[2] @ normal, -1, 1)), radius_m)
    return histogram.ravel() / np.linalg.norm(histogram), frame, is_certain


def described_surface(count: int, keypoints: int):
    surface = bumpy_surface(count, rng(4))
    surface_normals = normals_twin(surface, surface, 0.5)
    surface_normals[::17] = np.nan
    inner = np.flatnonzero(np.abs(surface[:, 1:]).max(axis=1) < np.abs(surface[:, 1:]).max() * 0.8)
    chosen = surface[inner[np.linspace(0, len(inner) - 1, keypoints).astype(int)]]
    chosen[1::2] += rng(5).normal(scale=0.03, size=chosen[1::2].shape)
    return chosen, surface, surface_normals


def check_shot(count: int, keypoints: int) -> None:
    chosen, surface, surface_normals = described_surface(count, keypoints)
    descriptors, frames = shot.describe(chosen, shot.support(surface, surface_normals, RADIUS_M), 5)
    compared = 0
    for row, keypoint in enumerate(chosen):
        expected, frame, is_certain = shot_twin(keypoint, surface, surface_normals, RADIUS_M)
        if is_certain:
            compared += 1
            np.testing.assert_allclose(frames[row], frame, atol=1e-7)
            np.testing.assert_allclose(descriptors[row], expected, atol=2e-5)
    assert compared >= 0.8 * keypoints


# ---- matching -------------------------------------------------------------------------------------------

def matching_twin(queries, among, gate_m, rival_radius_m):
    centres, descriptors = queries.points, queries.table[queries.row]
    candidates, candidate_descriptors = among.points, among.table[among.row]
    best = np.full(len(centres), -1)
    best_sq, rival_sq = np.full(len(centres), np.inf), np.full(len(centres), np.inf)
    for i, centre in enumerate(centres):
        inside = np.flatnonzero(np.linalg.norm(candidates - centre, axis=1) <= gate_m)
        if len(inside) == 0:
            continue
        apart_sq = ((candidate_descriptors[inside].astype(float) - descriptors[i]) ** 2).sum(axis=1)
        best[i], best_sq[i] = inside[apart_sq.argmin()], apart_sq.min()
        away = np.linalg.norm(candidates[inside] - candidates[best[i]], axis=1) > rival_radius_m
        rival_sq[i] = apart_sq[away].min(initial=np.inf)
    return best, best_sq, rival_sq


def check_matching(count: int) -> None:
    random = rng(6)
    candidates, centres = random.uniform(-2, 2, (count, 3)), random.uniform(-3, 3, (count // 2, 3))
    centres[0] = (40.0, 0, 0)
    unit = [d / np.linalg.norm(d, axis=1, keepdims=True) for d in random.uniform(size=(2, count, 20))]
    unit = [d.astype(np.float32) for d in unit]
    row, candidate_row = random.integers(0, count, len(centres)), random.permutation(count)
    queries = matching.Described(centres, row, unit[0])
    given = (queries, matching.Described(candidates, candidate_row, unit[1]), 1.1, 0.6)
    found, expected = matching.best_in_gate(*given), matching_twin(*given)
    assert (expected[0] == -1).any() and (expected[0] >= 0).any() and np.isfinite(expected[2]).any()
    np.testing.assert_array_equal(found[0], expected[0])
    np.testing.assert_allclose(found[1], expected[1], atol=1e-5)
    np.testing.assert_allclose(found[2], expected[2], atol=1e-5)
    nothing = matching.best_in_gate(queries, matching.Described.whole(candidates[:0], unit[1]), 1.1, 0.6)
    assert (nothing[0] == -1).all() and np.isinf(nothing[1]).all() and np.isinf(nothing[2]).all()


# ---- mesh -----------------------------------------------------------------------------------------------

def check_ring_basics(count: int) -> None:
    random = rng(14)
    points = random.normal(size=(count, 3)) * random.choice([0.01, 1.0], (count, 1))
    points[::7] = [[np.nan, 1.0, 1.0]]
    points[::11] = [[1.0, 1.0, -np.inf]]
    points[5::13] = points[4::13][:len(points[5::13])]
    expected = [bool(np.isfinite(point).all() and np.linalg.norm(point) > 0.1) for point in points]
    is_new = [k == 0 or not (point == points[k - 1]).all() for k, point in enumerate(points)]
    np.testing.assert_array_equal(rings.usable(points, 0.1), np.logical_and(expected, is_new))

    azimuth = (np.cumsum(random.normal(0.4, 0.5, count)) + np.pi) % (2 * np.pi) - np.pi
    turn = 2 * np.pi
    for angles in (azimuth, azimuth[::-1].copy()):
        np.testing.assert_array_equal(rings.steps(angles), (np.diff(angles) + np.pi) % turn - np.pi)
    for direction in (1.0, -1.0):
        turned = (direction * (azimuth - azimuth[0]) + 0.1) % turn
        expected = np.flatnonzero(np.diff(turned) < -1.0) + 1
        assert 0 < len(expected) < (np.diff(turned) < 0).sum()
        np.testing.assert_array_equal(rings.cuts(azimuth, direction, 0.1, 1.0), expected)

    bounds = np.array([0, 1, count // 2, count])
    ranks = np.array([[0, 0], [1, count // 2 - 1], [count // 2 + 3, count // 2 + 3]])
    runs = np.split(azimuth, bounds[1:-1])
    expected = [np.sort(run)[rank - first] for run, rank, first in zip(runs, ranks, bounds, strict=False)]
    np.testing.assert_array_equal(rings.at_ranks(azimuth, bounds, ranks), expected)


def check_ring_strips(levels: int, columns: int) -> None:
    """A band of a cylinder: all of its strips, nothing else; also where azimuth wraps around."""
    limits = (0.9, 0.0, 1.0, np.radians(4.0))
    azimuth = (np.arange(columns) + 0.3) * (2 * np.pi / columns) - np.pi
    angle, level = np.tile(azimuth, levels), np.repeat(np.arange(levels), columns)
    points = np.column_stack([5 * np.cos(angle), 5 * np.sin(angle), 0.5 * level])
    bounds, all_wanted = np.arange(levels + 1) * columns, np.ones(len(points), bool)
    assert 5 * 2 * np.pi / columns < 0.7, "columns must be close enough to be joined"
    grid_all_round = mesh.scan_grid(points, angle, np.arange(len(points)), bounds)
    around = mesh.ring_strips(grid_all_round, 1, all_wanted, *limits)
    assert len(around) == 2 * (levels - 1) * columns
    assert len(np.unique(np.sort(around, axis=1), axis=0)) == len(around)
    assert (np.ptp(level[around], axis=1) == 1).all()
    column_steps = (around % columns - around[:, :1] % columns + 1) % columns
    assert (column_steps <= 2).all()

    gap = (angle > 0.5) & (angle < 1.5)
    opened = mesh.ring_strips(mesh.part(grid_all_round, ~gap), 1, all_wanted, *limits)
    assert not gap[opened].any()
    missing = 2 * (levels - 1) * (gap.sum() // levels + 1)
    assert len(opened) == len(around) - missing
    for i, j in ((0, 1), (1, 2), (0, 2)):
        assert np.linalg.norm(points[opened[:, i]] - points[opened[:, j]], axis=1).max() <= 0.9


def continuous_twin(a, b, max_edge_m, max_edge_rad, max_depth_jump_m, min_grazing_rad) -> bool:
    length, ranges_m = np.linalg.norm(b - a), np.linalg.norm([a, b], axis=1)
    jump = abs(ranges_m[1] - ranges_m[0])
    across = np.sqrt(max(length**2 - jump**2, 0.0))
    is_short = length <= max(max_edge_m, max_edge_rad * ranges_m.min())
    return is_short and jump <= max_depth_jump_m and across >= np.sin(min_grazing_rad) * length


def strips_twin(points, azimuth, rows_of_rings, step, wanted, limits) -> list[tuple[int, int, int]]:
    """Rings are walked in the order of all their points' azimuths, the upper of two equal ones first."""
    triangles = []
    for pair in (pair for first in range(step) for pair in pairwise(rows_of_rings[first::step])):
        if not all(pair):
            continue
        walk = [(azimuth[row], side, row) for side, ring in enumerate(pair) for row in ring[1:]]
        walk += [(azimuth[ring[0]] + 2 * np.pi, side, ring[0]) for side, ring in enumerate(pair)
                 if azimuth[ring[0]] + np.pi < azimuth[ring[-1]]]
        last = [pair[0][0], pair[1][0]]
        for _, side, row in sorted(walk):
            corners = (*last, row)
            if wanted[list(corners)].any() and all(
                    continuous_twin(points[a], points[b], *limits) for a, b in combinations(corners, 2)):
                triangles.append(corners)
            last[side] = row
    return triangles


def check_strips_and_edges(levels: int, columns: int) -> None:
    """A ragged surface against walks along pairs of rings.

    Where it is thinned, one ring ends before the half turn behind, one has less of a gap there, one is empty.
    """
    random = rng(9)
    azimuth = random.uniform(-np.pi, np.pi, levels * columns).round(2)
    ring = np.repeat(np.arange(levels), columns)
    range_m = 4.0 + 2.0 * (azimuth > 1.0) + random.normal(0, 0.2, len(azimuth))
    points = range_m[:, None] * np.column_stack([np.cos(azimuth), np.sin(azimuth), 0.08 * ring])
    in_fragment = random.random(len(points)) < 0.2
    order = np.lexsort((azimuth, ring))
    whole = mesh.scan_grid(points, azimuth, order, np.arange(levels + 1) * columns)
    behind = np.abs(azimuth[order])
    kept = (random.random(len(points)) < 0.8) & (ring[order] != 2)
    kept &= ~((ring[order] == 0) & (behind > 1.4)) & ~((ring[order] == 1) & (behind > 2.2))
    some = mesh.part(whole, kept)
    surface, anything = (0.9, 0.2, 0.5, np.radians(10.0)), (20.0, 0.0, 10.0, 0.01)
    for one, limits in ((whole, surface), (some, surface), (some, anything)):
        chosen = order if one is whole else order[kept]
        np.testing.assert_array_equal(one.row, chosen)
        rows_of_rings = [chosen[ring[chosen] == level].tolist() for level in range(levels)]
        for step, wanted in ((1, np.ones(len(points), bool)), (1, in_fragment), (2, in_fragment)):
            expected = strips_twin(points, azimuth, rows_of_rings, step, wanted, limits)
            found = mesh.ring_strips(one, step, wanted[one.row], *limits)
            assert 0 < len(expected) < len(chosen) * 2
            np.testing.assert_array_equal(found, expected)
        expected = [sorted(pair) for rows in rows_of_rings for pair in pairwise(rows)
                    if in_fragment[list(pair)].any() and continuous_twin(*points[list(pair)], *limits)]
        np.testing.assert_array_equal(mesh.ring_edges(one, in_fragment[one.row], *limits), expected)


def check_graphs(count: int) -> None:
    triangles = np.array([rng(k).choice(count, 3, replace=False) for k in range(count // 2)], np.int32)
    triangles[1::2, 0], triangles[1::2, 1] = triangles[::2, 2][: count // 4], triangles[::2, 1][: count // 4]
    triangles[2::4, 0] = triangles[1::4, 2][: len(triangles[2::4])]     # a corner alone makes no strip
    more = np.array([[0, count - 1], [count - 1, 1], *triangles[:2, 1:]], np.int32)
    edges = graphs.sides(triangles, more, count)
    both = [*triangles.tolist(), *more.tolist()]
    wanted = {(min(pair), max(pair)) for corners in both for pair in combinations(corners, 2)}
    assert list(map(tuple, edges.tolist())) == sorted(wanted)
    among = [row in set(triangles.ravel().tolist()) for row in range(count)]
    assert not all(among)
    np.testing.assert_array_equal(graphs.touched(triangles, count), among)
    few = edges[: len(edges) // 3]
    label = list(range(count))
    for _ in range(count):
        for a, b in few.tolist():
            label[a] = label[b] = min(label[a], label[b])
    _, expected = np.unique(label, return_inverse=True)
    np.testing.assert_array_equal(graphs.components(few, count), expected)
    of_sides = graphs.sides(triangles, more[:0], count)
    np.testing.assert_array_equal(graphs.components(triangles, count), graphs.components(of_sides, count))
    assert len(graphs.sides(triangles[:0], more[:0], 5)) == 0
    np.testing.assert_array_equal(graphs.components(edges[:0], 3), [0, 1, 2])


STAR_LIMITS = (0.4, 0.0, 0.36, np.radians(4.0), np.radians(45), np.radians(2), np.radians(120))


def check_tangent_stars(count: int) -> None:
    points = bumpy_surface(count, rng(7))
    surface_normals = normals_twin(points, points, 0.5)
    triangles = tangent_stars.triangles(points, surface_normals, *STAR_LIMITS)
    assert (triangles[:, 0] < triangles[:, 1]).all() and (triangles[:, 1] < triangles[:, 2]).all()
    assert len(np.unique(triangles, axis=0)) == len(triangles)
    corners = points[triangles]
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    assert sides.max() <= 0.4
    assert 1.2 * count < len(triangles) < 2.0 * count


def check_agreed(count: int) -> None:
    random = rng(9)
    order, stars = random.permutation(count), random.integers(0, count, (4 * count, 3))
    again = stars[random.integers(0, len(stars), 2 * count)][:, [1, 2, 0]]
    stars = np.concatenate([stars, again, again[: count // 2], np.full((count, 3), -1)])
    random.shuffle(stars)
    found, votes = np.unique(
        np.sort(order[stars[stars[:, 0] >= 0]], axis=1), axis=0, return_counts=True)
    np.testing.assert_array_equal(tangent_stars._agreed(stars, order), found[votes >= 2])


def check_all_tiny() -> None:
    """Every comparison on tiny inputs, for interpreted kernels."""
    check_voxels(60)
    check_means(60)
    check_grid_queries(40)
    check_far_points(20)
    check_eigen(2)
    check_plane_eigen(2)
    check_normals(120)
    check_local_shifts(80)
    check_shot(160, 4)
    check_matching(40)
    check_ring_strips(3, 60)
    check_strips_and_edges(5, 40)
    check_ring_basics(60)
    check_graphs(30)
    check_tangent_stars(150)
    check_agreed(20)


def test_first_per_voxel():
    check_voxels(2000)
    assert len(grid.first_per_voxel(np.empty((0, 3)), 0.1)) == 0
    np.testing.assert_array_equal(grid.first_per_voxel(np.array([[1e300, 0, 0], [1, 1, 1]]), 0.1), [0, 1])


def test_means_per_voxel():
    check_means(2000)
    assert grid.means(np.empty((0, 3)), 0.1).shape == (0, 3)


def test_grid_queries_see_every_neighbour_once():
    check_grid_queries(400)
    check_far_points(400)


def test_symmetric_eigen3():
    check_eigen(60)


def test_plane_eigen3():
    check_plane_eigen(60)


def test_normals():
    check_normals(1500)


def test_narrow_pieces_are_told_from_others():
    along = np.linspace(0.0, 1.4, 60)
    piece = np.column_stack([along, rng(7).normal(0.0, (0.005, 0.02), (60, 2))]) + [0.0, 20.0, -1.7]
    wall = np.concatenate([piece, piece + [0.0, 0.0, 0.4]]) + [5.0, 0.0, 0.0]
    points = np.concatenate([piece, wall])
    near = cells.build(points, 0.7)
    found, is_narrow = normals.estimated(points, near, points, near, 0.05)
    np.testing.assert_array_equal(is_narrow, np.arange(len(points)) < len(piece))
    np.testing.assert_array_equal(found, normals.estimate(points, points, 0.7))
    assert not normals.estimated(points, near, points, near, 0.0)[1].any()


def test_narrow_pieces_have_the_normal_of_the_ground_where_they_are_level_and_else_none():
    ground = np.array([[0.1, 0.0, 1.0], [-0.3, 0.0, 1.0], [0.0, 0.2, -1.0]])
    ground /= np.linalg.norm(ground, axis=1, keepdims=True)
    up = (ground[0] + ground[1] - ground[2]) / np.linalg.norm(ground[0] + ground[1] - ground[2])
    leaning, ceiling = np.array([0.0, 0.6, 0.8]), np.array([0.0, 0.6, -0.8])
    wall, unknown = np.array([1.0, 0.0, 0.0]), np.full(3, np.nan)
    given = np.vstack([ground, wall, unknown, leaning, ceiling, wall])
    is_narrow = np.arange(len(given)) >= 5
    found = given.copy()
    normals.level(found, is_narrow)
    np.testing.assert_allclose(found, np.vstack([given[:5], up, -up, unknown]), atol=1e-12)
    alone = given[5:].copy()
    normals.level(alone, np.ones(3, bool))
    assert np.isnan(alone).all(), "no ground tells which way is up"


def test_normals_without_any_surface_are_nan():
    assert np.isnan(normals.estimate(np.ones((3, 3)), np.empty((0, 3)), 0.5)).all()


def test_local_shifts():
    check_local_shifts(600)


def test_a_bent_surface_tells_its_whole_shift_and_a_plane_the_part_across_it():
    random = rng(10)
    bent, shift = random.normal(size=(200, 3)), np.array([0.1, -0.2, 0.05])
    across = bent / np.linalg.norm(bent, axis=1, keepdims=True)
    found, count, before_m, after_m = coherence.local_shifts(0.1 * across, across, across @ shift, 1.0)
    np.testing.assert_allclose(found, np.tile(shift, (200, 1)), atol=0.015)   # damping holds back a little
    assert (count == 200).all() and (after_m < 0.1 * before_m).all()
    flat = np.tile([0.0, 0.0, 1.0], (200, 1))
    found, *_ = coherence.local_shifts(random.uniform(0, 0.3, (200, 3)), flat, np.full(200, 0.2), 1.0)
    np.testing.assert_allclose(found, np.tile([0.0, 0.0, 0.2], (200, 1)), atol=0.005)


def test_shot():
    check_shot(1500, 40)


def test_shot_has_unit_norm_or_is_nan():
    chosen, surface, surface_normals = described_surface(1500, 20)
    far = np.vstack([chosen, [[40.0, 0, 0]], surface[:1] + [0, 50, 0]])
    descriptors, frames = shot.describe(far, shot.support(surface, surface_normals, RADIUS_M), 10)
    assert descriptors.dtype == np.float32 and descriptors.shape == (22, 352)
    np.testing.assert_allclose(np.linalg.norm(descriptors[:20], axis=1), 1.0, atol=1e-5)
    assert np.isnan(descriptors[20:]).all() and np.isnan(frames[20:]).all()
    np.testing.assert_allclose(frames[:20] @ np.swapaxes(frames[:20], 1, 2), np.tile(np.eye(3), (20, 1, 1)),
                               atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(frames[:20]), 1.0)
    counts = (np.linalg.norm(surface - chosen[:, None], axis=2) <= RADIUS_M).sum(axis=1)
    around = shot.support(surface, surface_normals, RADIUS_M)
    nothing, _ = shot.describe(chosen, around, int(counts.max()) + 1)
    assert np.isnan(nothing).all()


def test_shot_turns_with_the_cloud():
    chosen, surface, surface_normals = described_surface(1500, 40)
    rotation, shift = random_rotation(rng(8)), np.array([3.0, -7.0, 1.0])
    there, frames = shot.describe(chosen, shot.support(surface, surface_normals, RADIUS_M), 10)
    around = shot.support(surface @ rotation.T + shift, surface_normals @ rotation.T, RADIUS_M)
    turned, turned_frames = shot.describe(chosen @ rotation.T + shift, around, 10)
    cosine = (there.astype(float) * turned).sum(axis=1)
    assert cosine.min() >= 0.999
    np.testing.assert_allclose(turned_frames, frames @ rotation.T, atol=1e-6)


def test_best_in_gate():
    check_matching(400)


def test_ring_strips():
    check_ring_strips(6, 90)


def test_graphs():
    check_graphs(120)


def test_ring_strips_and_edges_of_a_ragged_surface():
    check_strips_and_edges(7, 60)


def test_ring_basics():
    check_ring_basics(500)


def test_tangent_stars():
    check_tangent_stars(1200)
    check_agreed(300)


def test_corners_of_stars_are_told_apart_among_millions_of_points():
    order, star = np.arange(2_500_000), np.array([2_400_000, 5, 2_200_000])
    stars = np.stack([star, star[[1, 2, 0]], star - [1, 0, 0]])
    np.testing.assert_array_equal(tangent_stars._agreed(stars, order), [[5, 2_200_000, 2_400_000]])
    assert len(tangent_stars._agreed(stars[1:], order)) == 0


@pytest.mark.parametrize("spacing_m", [0.25, 0.08, 0.02])
def test_stars_of_a_plane_are_its_delaunay_triangles_however_dense(spacing_m):
    random, many = rng(5), 1500
    half_m = 0.5 * spacing_m * np.sqrt(many)
    flat = random.uniform(-half_m, half_m, (many, 2))
    points = np.column_stack([flat, np.full(many, 5.0)])
    found = tangent_stars.triangles(points, np.tile([0.0, 0.0, 1.0], (many, 1)), *STAR_LIMITS)
    expected = np.sort(Delaunay(flat).simplices, axis=1)
    sides = [flat[expected[:, k]] - flat[expected[:, k - 1]] for k in range(3)]
    lengths = np.sort([np.hypot(*side.T) for side in sides], axis=0)
    low, middle, long = lengths
    sharp = np.arccos(np.clip((middle**2 + long**2 - low**2) / (2 * middle * long), -1, 1))
    blunt = np.arccos(np.clip((low**2 + middle**2 - long**2) / (2 * low * middle), -1, 1))
    well_shaped = (sharp > np.radians(2)) & (blunt < np.radians(120)) & (long < 0.4)
    inside = (np.abs(flat[expected]) < 0.8 * half_m).all(axis=(1, 2))
    known = set(map(tuple, found.tolist()))
    missed = [t for t in map(tuple, expected[well_shaped & inside].tolist()) if t not in known]
    assert well_shaped.sum() > 1000 and len(missed) == 0
    assert known <= set(map(tuple, expected.tolist()))


def test_stars_do_not_join_sheets_above_one_another():
    random = rng(6)
    flat = random.uniform(-1.0, 1.0, (2000, 2))
    over = np.arange(2000) % 2
    points = np.column_stack([flat, 5.0 + 0.3 * over])
    found = tangent_stars.triangles(points, np.tile([0.0, 0.0, 1.0], (2000, 1)), *STAR_LIMITS)
    mixed = (over[found].min(axis=1) != over[found].max(axis=1)).mean()
    assert len(found) > 2000 and mixed < 0.01


@pytest.mark.parametrize("seed", range(3))
def test_kernels_leave_their_arguments_alone(seed):
    points = bumpy_surface(300, rng(seed))
    before = points.copy()
    own = normals.estimate(points, points, 0.5)
    own_before = own.copy()
    shot.describe(points[:10], shot.support(points, own, RADIUS_M), 10)
    grid.first_per_voxel(points, 0.3)
    np.testing.assert_array_equal(points, before)
    np.testing.assert_array_equal(own, own_before)


def test_kernels_are_plain_python_underneath():
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    done = subprocess.run(
        [sys.executable, "-c", "import test_kernels; test_kernels.check_all_tiny()"],
        cwd=Path(__file__).parent, env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
