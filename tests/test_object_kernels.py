"""Kernels of the object search against slow twins, as in test_kernels.py."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from lidarflow import pose, robust
from lidarflow.kernels import (
    directions,
    grid,
    ground_level,
    ground_plane,
    icp,
    linalg,
    links,
    misfit,
    neighbours,
    registration,
    tree,
    votes,
)

UP = np.array([0.0, 0.0, 1.0])


def rng(seed: int) -> np.random.Generator:
    return np.random.default_rng(seed)


def clumps(count: int, seed: int) -> np.ndarray:
    """Points (count, 3) that are dense in places, with some of them twice."""
    random = rng(seed)
    points = random.normal(size=(count, 3)) * random.choice([0.05, 0.5, 3.0], (count, 1))
    points[: count // 10] = points[count // 10: 2 * (count // 10)]
    return points


def units(count: int, seed: int, unknown: float = 0.1) -> np.ndarray:
    """Unit vectors (count, 3), some NaN."""
    vectors = rng(seed).normal(size=(count, 3))
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    vectors[rng(seed + 1).random(count) < unknown] = np.nan
    return vectors


def some_motion(seed: int) -> np.ndarray:
    random = rng(seed)
    return pose.from_yaw(random.uniform(-0.1, 0.1), random.uniform(-0.3, 0.3, 3))


# ---- tree -----------------------------------------------------------------------------------------------

def check_tree(count: int) -> None:
    points, queries = clumps(count, 1), np.vstack([clumps(count // 2, 2), [[90.0, 0, 0]]])
    built = tree.build(points)
    np.testing.assert_array_equal(built.points, points[built.rows])
    np.testing.assert_array_equal(np.sort(built.rows), np.arange(count))
    apart_m = cdist(queries, points)

    found_m, row = neighbours.query(built, queries, 0.7)
    near = apart_m.min(axis=1) < 0.7
    assert near.any() and not near.all()
    np.testing.assert_allclose(found_m[near], apart_m.min(axis=1)[near], atol=1e-12)
    np.testing.assert_allclose(apart_m[near, row[near]], found_m[near], atol=1e-12)
    assert np.isinf(found_m[~near]).all() and (row[~near] == -1).all()

    reach_m = rng(3).uniform(0.01, 1.0, len(queries))
    np.testing.assert_array_equal(
        neighbours.any_within(built, queries, reach_m), apart_m.min(axis=1) <= reach_m)
    np.testing.assert_allclose(
        neighbours.nearest_m(built, queries, reach_m, 0.7),
        np.where(near, np.minimum(apart_m.min(axis=1), reach_m), reach_m), atol=1e-12)
    np.testing.assert_array_equal(
        neighbours.number_around(built, queries, 0.5), (apart_m <= 0.5).sum(axis=1))
    marks = rng(4).random((count, 2)) < 0.4
    expected = [[(inside & mark).sum() for mark in marks.T] for inside in apart_m <= 0.5]
    np.testing.assert_array_equal(neighbours.counts_around(built, marks, queries, 0.5), expected)
    for radius_m in (0.05, 0.4, 3.0):
        body = queries[:: max(1, count // 20)]
        expected = np.flatnonzero(cdist(points, body).min(axis=1) < radius_m)
        np.testing.assert_array_equal(neighbours.near_rows(built, tree.build(body), radius_m), expected)


def check_moved_tree(count: int) -> None:
    points, motion = clumps(count, 28), some_motion(29)
    there = pose.apply(motion, points)
    found = tree.moved(tree.build(points), there)
    np.testing.assert_array_equal(found.points, there[found.rows])
    for start, end, (low, high) in zip(found.starts, found.ends, found.boxes, strict=True):
        np.testing.assert_array_equal(low, found.points[start:end].min(axis=0))
        np.testing.assert_array_equal(high, found.points[start:end].max(axis=0))
    distance_m, row = neighbours.query(found, there, 0.1)
    assert (distance_m == 0.0).all() and (there[row] == there).all()


def check_empty_tree() -> None:
    nothing, points = tree.build(np.empty((0, 3))), np.ones((2, 3))
    for mine, given in zip(nothing, tree.NOTHING, strict=True):
        np.testing.assert_array_equal(mine, given)
    assert np.isinf(neighbours.query(nothing, points, 9.0)[0]).all()
    assert not neighbours.any_within(nothing, points, np.full(2, 9.0)).any()
    assert len(neighbours.near_rows(nothing, tree.build(points), 9.0)) == 0
    assert len(neighbours.near_rows(tree.build(points), nothing, 9.0)) == 0
    assert (neighbours.counts_around(nothing, np.zeros((0, 1), bool), points, 9.0) == 0).all()


# ---- voxels, links, votes -------------------------------------------------------------------------------

def check_voxel_numbers(count: int) -> None:
    points = clumps(count, 5)
    number, counts = grid.voxels(points, 0.3)
    _, first, member, expected = np.unique(
        np.floor(points / 0.3), axis=0, return_index=True, return_inverse=True, return_counts=True)
    rank = np.argsort(np.argsort(first))
    np.testing.assert_array_equal(number, rank[member.ravel()])
    np.testing.assert_array_equal(counts[rank], expected)


def links_twin(points: np.ndarray, link_m: float) -> np.ndarray:
    cells, member = np.unique(np.floor(points / (link_m / 3)), axis=0, return_inverse=True)
    member = member.ravel()
    means = np.stack([points[member == cell].mean(axis=0) for cell in range(len(cells))])
    _, label = connected_components(cdist(means, means) <= link_m)
    return label[member]


def check_links(count: int) -> None:
    points = clumps(count, 6) * 2.0
    label = links.components(points, 0.9)
    np.testing.assert_array_equal(label, links_twin(points, 0.9))
    assert 3 <= label.max() < count / 2


def check_votes(count: int) -> None:
    random = rng(8)
    shifts = np.concatenate([random.normal(size=(count, 3)), random.normal(0.5, 0.03, (count // 2, 3))])
    for some in (shifts[:1], shifts[:6], shifts[:7]):
        np.testing.assert_array_equal(votes.median(some), np.median(some, axis=0))

    source, target = random.uniform(-2, 2, (count, 3)), random.uniform(-2, 2, (count + 5, 3))
    every = (target[None] - source[:, None]).reshape(-1, 3)
    every = every[(np.hypot(every[:, 0], every[:, 1]) <= 1.5) & (np.abs(every[:, 2]) <= 0.6)]
    _, member, size = np.unique(
        np.floor(every[:, :2] / 0.2), axis=0, return_inverse=True, return_counts=True)
    best = np.argsort(-size, kind="stable")[:3]
    expected = [every[member.ravel() == cell].mean(axis=0) for cell in best]
    np.testing.assert_allclose(votes.peaks(source, target, 1.5, 0.6, 0.2, 3), expected, atol=1e-12)
    assert len(votes.peaks(source, target + 50.0, 1.5, 0.6, 0.2, 3)) == 0


# ---- misfit, directions, ground -------------------------------------------------------------------------

def counterparts_twin(points, normals, target, target_normals, reach_m):
    apart_m = cdist(points, target)
    row, distance_m = apart_m.argmin(axis=1), apart_m.min(axis=1)
    cosine = (target_normals[row] * normals).sum(axis=1)
    agrees = (distance_m < reach_m) & (np.abs(np.nan_to_num(cosine)) > 0.7)
    offset_m = (target_normals[row] * (target[row] - points)).sum(axis=1)
    return row, distance_m, agrees, offset_m


def check_counterparts(count: int) -> None:
    points, target = clumps(count, 9), clumps(count + 40, 11) + 0.02
    normals, target_normals = units(count, 12), units(count + 40, 13)
    given = points, normals, target, target_normals, 0.4
    _, distance_m, agrees, offset_m = counterparts_twin(*given)
    found = misfit.counterparts(points, normals, tree.build(target), target_normals, 0.4, 0.7)
    within = distance_m < 0.4
    np.testing.assert_array_equal(found[0] >= 0, within)
    np.testing.assert_allclose(found[1], np.where(within, distance_m, np.inf), atol=1e-12)
    once = ~(np.abs(np.sort(cdist(points, target), axis=1)[:, 1] - distance_m) < 1e-12)
    np.testing.assert_array_equal(found[2][once], agrees[once])
    both = once & agrees
    np.testing.assert_allclose(found[3][both], offset_m[both], atol=1e-12)
    assert both.any() and np.isnan(found[3][~found[2]]).all()


def check_misfit_after(count: int) -> None:
    points, target, beside = clumps(count, 14), rng(15).normal(size=(count, 3)), rng(16).normal(size=(30, 3))
    normals, target_normals = units(count, 17), units(count, 18)
    rows = np.arange(0, count, 2)
    bounds, group = np.array([0, 5, len(rows)]), np.array([1, 0, 1])
    motions = np.stack([some_motion(19), some_motion(20), np.eye(4)])
    trees = tree.build(target), target_normals, tree.build(beside)
    means = misfit.mean_sq_after(points, normals, rows, bounds, group, motions, *trees, 0.3, 0.7, 0.25)
    for h, motion in enumerate(motions):
        own = rows[bounds[group[h]]: bounds[group[h] + 1]]
        moved, turned = pose.apply(motion, points[own]), pose.turn(motion, normals[own])
        _, distance_m, agrees, offset_m = counterparts_twin(moved, turned, target, target_normals, 0.6)
        distance_m = np.minimum(np.minimum(distance_m, cdist(moved, beside).min(axis=1)), 0.3)
        plane_m = np.where(agrees, np.minimum(np.abs(offset_m), distance_m), distance_m)
        found = np.empty((2, len(own)))
        misfit.after(points, normals, own, motion, *trees, 0.3, 0.7, *found)
        np.testing.assert_allclose(found, [distance_m, plane_m], atol=1e-12)
        np.testing.assert_allclose(means[h], (plane_m**2 + 0.25 * distance_m**2).mean(), atol=1e-12)


def check_directions(count: int) -> None:
    axes = np.vstack([np.eye(3), -np.eye(3)])
    others = np.concatenate([rng(21).normal(size=(count, 3)) * 7.0, 3.0 * axes, 5.0 * axes, [[0.0, 0, 0]]])
    wanted = np.concatenate([units(count, 22, unknown=0.0), axes])
    seen = others / np.maximum(np.linalg.norm(others, axis=1, keepdims=True), 1e-6)
    expected = (cdist(wanted, seen) < 0.1).sum(axis=1) >= 2
    assert expected.any() and not expected.all()
    np.testing.assert_array_equal(directions.looked_at(wanted, others, 0.1, 2), expected)


def check_ground(count: int) -> None:
    points = rng(23).uniform(-3, 3, (count, 3)) * [1.0, 1.0, 0.02]
    points[:, 2] += 0.1 * points[:, 0] - 0.05 * points[:, 1]
    ground, centre = tree.build(points), np.array([0.4, -0.3, 0.2])
    near = points[np.linalg.norm(points - centre, axis=1) <= 2.0]
    level = near - near.mean(axis=0)
    expected = np.linalg.lstsq(level[:, :2], level[:, 2], rcond=1e-3)[0]
    np.testing.assert_allclose(ground_plane.slope(ground, centre, 2.0), [*expected, len(near)], atol=1e-9)
    inside = np.hypot(points[:, 0] - 0.4, points[:, 1] + 0.3) <= 1.5
    found = ground_plane.heights(ground, 0.4, -0.3, 1.5)
    np.testing.assert_array_equal(np.sort(found), np.sort(points[inside, 2]))

    row = np.column_stack([np.linspace(0, 1, 9), np.zeros(9), np.linspace(0, 0.1, 9)])
    np.testing.assert_allclose(
        ground_plane.slope(tree.build(row), row[4], 2.0), [0.1, 0.0, 9], atol=1e-9)


# ---- rigid fits -----------------------------------------------------------------------------------------

def about(centre: np.ndarray, turn: float, shift: np.ndarray) -> np.ndarray:
    return pose.from_translation(centre + shift) @ pose.from_yaw(turn) @ pose.from_translation(-centre)


def onto_points_twin(points, translation, target, gates_m, rounds):
    centre, turn, shift = points.mean(axis=0), 0.0, translation
    for gate_m in gates_m:
        for _ in range(rounds):
            moved = pose.apply(about(centre, turn, shift), points)
            distance_m, row = cKDTree(target).query(moved, distance_upper_bound=gate_m)
            paired = np.isfinite(distance_m)
            if paired.sum() < 4:
                break
            a, b, last = points[paired] - centre, target[row[paired]] - centre, (turn, *shift)
            turn = 0.0
            if len(a) >= 16:
                left, right = a[:, :2] - a[:, :2].mean(axis=0), b[:, :2] - b[:, :2].mean(axis=0)
                turn = np.angle((np.conj(left @ [1, 1j]) * (right @ [1, 1j])).sum())
                turn = float(np.clip(turn, -0.15, 0.15))
            shift = b.mean(axis=0) - pose.apply(pose.from_yaw(turn), a.mean(axis=0))
            if np.abs(np.subtract((turn, *shift), last)).max() < 1e-4:
                break
    return about(centre, turn, shift)


def check_onto_points(count: int) -> None:
    target = rng(24).uniform(-1, 1, (3 * count, 3)) * [2.0, 1.0, 0.7]
    groups = [pose.apply(pose.inverse(some_motion(25)), target[:count]), target[count: count + 9] + 0.1]
    group = np.array([0, 1, 0])
    starts = np.array([[0.0, 0.1, 0.0], [-0.1, 0.0, 0.1], [40.0, 0.0, 0.0]])
    found = icp.onto_points(
        np.concatenate(groups), np.array([0, count, count + 9]), group, starts, tree.build(target),
        np.array([1.0, 0.3]), 4)
    for h in range(3):
        expected = onto_points_twin(groups[group[h]], starts[h], target, (1.0, 0.3), 4)
        np.testing.assert_allclose(found[h], expected, atol=1e-9)


def plane_step_twin(points, normals, centre, turn, shift, target, target_normals, gate_m, along_ground):
    """One Gauss-Newton step from stacked, weighted rows."""
    motion = about(centre, turn, shift)
    moved, turned = pose.apply(motion, points), pose.turn(motion, normals)
    row, distance_m, agrees, offset_m = counterparts_twin(moved, turned, target, target_normals, gate_m)
    paired = np.flatnonzero(distance_m < gate_m)
    if len(paired) < 4:
        return None
    rows, rights, total = [], [], 0.0
    for i in paired:
        x, off = moved[i] - centre - shift, target[row[i]] - moved[i]
        jacobian = np.column_stack([np.cross(UP, x), np.eye(3)])
        weight = 0.05 * robust.geman_mcclure(off @ off, 0.15)[1]
        rows += list(np.sqrt(weight) * jacobian)
        rights += list(np.sqrt(weight) * off)
        total += weight
        if agrees[i]:
            _, weight = robust.geman_mcclure(offset_m[i] ** 2, 0.05)
            rows.append(np.sqrt(weight) * target_normals[row[i]] @ jacobian)
            rights.append(np.sqrt(weight) * offset_m[i])
            total += weight
    rows.append(np.sqrt(along_ground * total) * np.array([0.0, *UP]))
    rights.append(-np.sqrt(along_ground * total) * shift[2])
    rows = np.array(rows)
    if len(paired) < 16:
        rows[:, 0] = 0.0
    held = np.sqrt(1e-6 * max(total, 1.0)) * np.eye(4)
    return np.linalg.lstsq(np.vstack([rows, held]), np.concatenate([rights, np.zeros(4)]), rcond=None)[0]


def check_onto_planes(count: int, own: int) -> None:
    random = rng(26)
    target = random.uniform(-1, 1, (4 * count, 3)) * [2.0, 1.0, 0.7]
    side = random.integers(0, 3, len(target))
    target[np.arange(len(target)), side] = np.array([2.0, 1.0, 0.7])[side]
    target_normals = np.eye(3)[side]
    motion = some_motion(27)
    points = pose.apply(pose.inverse(motion), target[:own] + random.normal(0, 0.01, (own, 3)))
    normals = pose.turn(pose.inverse(motion), target_normals[:own])
    gates_m = np.array([0.5, 0.5, 0.3, 0.3])
    found = icp.onto_planes(
        points, normals, tree.build(target), target_normals, 0.02, np.array([0.1, 0.05, -0.05]), gates_m, UP,
        1.0, 0.05, 0.15, 0.05, 0.7)
    centre, turn, shift = points.mean(axis=0), 0.02, np.array([0.1, 0.05, -0.05])
    for gate_m in gates_m:
        step = plane_step_twin(
            points, normals, centre, turn, shift, target, target_normals, gate_m, 1.0)
        turn, shift = float(np.clip(turn + step[0], -0.15, 0.15)), shift + step[1:]
    np.testing.assert_allclose(found, about(centre, turn, shift), atol=2e-4 if own >= 16 else 1e-9)


def check_solve_positive4(count: int) -> None:
    for seed in range(count):
        root, right = rng(seed).normal(size=(4, 6)), rng(100 + seed).normal(size=4)
        solution = right.copy()
        linalg.solve_positive4(root @ root.T, solution)
        np.testing.assert_allclose(solution, np.linalg.solve(root @ root.T, right), rtol=1e-6, atol=1e-9)


def check_registration_equations(count: int) -> None:
    cloud, normal = rng(30).uniform(-2, 2, (count, 3)), rng(31).normal(size=(count, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    normal[::7] = np.nan
    target = tree.build(cloud)
    ordered = np.ascontiguousarray(normal[target.rows])
    points, reach_m = rng(32).uniform(-2, 2, (2 * count, 3)), 0.4
    known = icp.nothing_known(len(points))
    for step in range(3):   # what is nearest is kept from round to round
        motion = pose.exp(0.02 * step * np.ones(6))
        found = registration.normal_equations(points, motion, target, ordered, reach_m, known)
        moved = pose.apply(motion, points)
        apart = np.linalg.norm(moved[:, None] - cloud[None], axis=2)
        nearest = apart.argmin(axis=1)
        paired = (apart.min(axis=1) < reach_m) & np.isfinite(normal[nearest, 0])
        n, x = normal[nearest[paired]], moved[paired]
        off_m = ((cloud[nearest[paired]] - x) * n).sum(axis=1)
        weight = (1 - (off_m / reach_m) ** 2) ** 2
        rows = np.hstack([np.cross(x, n), n])
        np.testing.assert_allclose(found[0], (weight[:, None] * rows).T @ rows, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(found[1], rows.T @ (weight * off_m), rtol=1e-9, atol=1e-12)
        assert found[2] == paired.sum() > 0


def check_ground_level(ground: np.ndarray, places: np.ndarray) -> None:
    """Heights of sloping ground (G, 3) around places (K, 3); which of them lie within 0.1 m of it."""
    points = np.vstack([places, ground])
    rows, ground_rows = np.arange(len(places))[::-1], len(places) + np.arange(len(ground))
    off = places[rows, None, :2] - ground[None, :, :2]
    apart_sq = off[..., 0] ** 2 + off[..., 1] ** 2
    for count_near, reach_m in ((1, np.inf), (8, 1.2), (5, 0.8)):
        expected = np.full(len(rows), np.nan)
        for k in range(len(rows)):
            nearest = np.lexsort((ground[:, 2], apart_sq[k]))[:count_near]
            if apart_sq[k, nearest[-1]] < reach_m * reach_m:
                expected[k] = np.median(ground[nearest, 2])
        flat = ground_level.flat(points, ground_rows, min(reach_m, 2.0))
        found = ground_level.around(flat, points, rows, count_near, reach_m)
        np.testing.assert_allclose(found, expected, rtol=1e-12)
        if np.isfinite(reach_m):
            level = ground_level.is_level(flat, points, rows, count_near, 0.1)
            np.testing.assert_array_equal(level, np.abs(places[rows, 2] - expected) <= 0.1)
            assert 0 < level.sum() < len(level) - np.isnan(expected).sum()


def ground_and_places(count: int, seed: int, width_m: float, step_m: float) -> tuple[np.ndarray, np.ndarray]:
    """A slope with a curb (count, 3), and places (count, 3) in, over, under and beside it.

    All are where rows and columns of `step_m` cross, or anywhere where that is 0.
    """
    random = rng(seed)
    both = random.uniform(-width_m, width_m, (2 * count, 3)) * random.choice([0.2, 1.0], (2 * count, 1))
    if step_m:
        both[:, :2] = np.round(both[:, :2] / step_m) * step_m
    ground, places = both[:count], both[count:] + [0.3, 0, 0]
    ground[:, 2] = 0.05 * ground[:, 0] + 0.4 * (ground[:, 1] > 0) + random.normal(0, 0.03, count)
    over_m = random.choice([-1.0, 0.0, 0.4, 1.0], count) + random.normal(0, 0.1, count)
    places[:, 2] = 0.05 * places[:, 0] + over_m
    places[0] = [20 * width_m, -7 * width_m, 0.0]
    return ground, places


def check_lowest_per_cell(count: int) -> None:
    points, rows = rng(42).uniform(-5, 5, (count, 3)), np.arange(0, count, 2)
    lowest, counts = ground_level.lowest_per_cell(points, rows, 3.0, 1.5)
    near = points[rows][np.hypot(*points[rows, :2].T) < 3.0]
    cells, own = np.unique(np.floor(near[:, :2] / 1.5), axis=0, return_inverse=True)
    expected = [near[own.ravel() == cell, 2].min() for cell in range(len(cells))]
    np.testing.assert_array_equal(np.sort(lowest[counts > 0]), np.sort(expected))
    np.testing.assert_array_equal(np.sort(counts[counts > 0]), np.sort(np.bincount(own.ravel())))
    assert np.isinf(lowest[counts == 0]).all()


def check_is_low(count: int) -> None:
    points, rows = rng(43).uniform(-3, 3, (count, 3)), np.arange(0, count, 2)
    points[:, 2] *= np.where(points[:, 0] < 0, 0.1, 1.0)     # cells of half of it are low altogether
    own = points[rows]
    same = (np.floor(own[:, None, :2] / 1.5) == np.floor(own[None, :, :2] / 1.5)).all(axis=2)
    for share in (0.0, 0.3):
        heights = [np.sort(own[cell, 2]) for cell in same]
        low = np.array([height[int(share * (len(height) - 1))] for height in heights])
        found = ground_level.is_low(points, rows, 1.5, share, 0.7)
        np.testing.assert_array_equal(found, own[:, 2] - low <= 0.7)
        assert 0 < found.sum() < len(found)


def check_lifted(count: int) -> None:
    points, rows = rng(44).uniform(-50, 50, (count, 3)), np.arange(0, count, 3)
    expected = np.hstack([points[rows], np.zeros((len(rows), 1))]).astype(np.float32)
    expected[:, 2] += 0.3
    found = ground_level.lifted(points, rows, 0.3)
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, expected)


def check_all_tiny() -> None:
    """Every comparison on tiny inputs, for interpreted kernels."""
    check_tree(60)
    check_moved_tree(60)
    check_empty_tree()
    check_voxel_numbers(40)
    check_links(60)
    check_votes(12)
    check_counterparts(40)
    check_misfit_after(24)
    check_directions(30)
    check_ground(60)
    check_onto_points(20)
    check_onto_planes(20, 20)
    check_solve_positive4(2)
    check_registration_equations(40)
    check_ground_level(*ground_and_places(120, 40, 2.0, 0.0))
    check_ground_level(*ground_and_places(120, 41, 2.0, 0.25))
    check_lowest_per_cell(40)
    check_is_low(60)
    check_lifted(40)


@pytest.mark.parametrize("width_m", [1.0, 4.0, 20.0])
@pytest.mark.parametrize("step_m", [0.0, 0.25])
def test_ground_level(width_m, step_m):
    """Cells with many points and with few; places anywhere and equally far from several points."""
    check_ground_level(*ground_and_places(2500, 40, width_m, step_m))


def test_the_order_of_ground_points_does_not_matter():
    ground, places = ground_and_places(900, 45, 4.0, 0.25)
    points, rows = np.vstack([places, ground]), np.arange(900)
    found = [ground_level.around(ground_level.flat(points, order, 2.0), points, rows, 8, 2.0)
             for order in (900 + rows, 900 + rng(46).permutation(900))]
    np.testing.assert_array_equal(*found)


def test_points_of_cells():
    check_lowest_per_cell(700)
    check_is_low(700)
    check_lifted(700)


def test_registration_equations():
    check_registration_equations(900)


def test_tree():
    check_tree(700)
    check_tree(1500)           # more queries than one thread takes at a time
    check_empty_tree()


def test_a_moved_tree():
    check_moved_tree(700)
    assert len(tree.moved(tree.NOTHING, np.empty((0, 3))).points) == 0


def test_a_tree_of_many_equal_points():
    built = tree.build(np.zeros((500, 3)))
    found_m, _ = neighbours.query(built, np.array([[0.0, 0.0, 0.3]]), 1.0)
    assert found_m[0] == 0.3
    assert len(neighbours.near_rows(built, tree.build(np.zeros((1, 3))), 0.1)) == 500


def test_voxel_numbers():
    check_voxel_numbers(900)
    number, counts = grid.voxels(np.empty((0, 3)), 0.5)
    assert len(number) == len(counts) == 0


def test_links():
    check_links(400)


def test_votes():
    check_votes(60)


def test_counterparts():
    check_counterparts(500)
    check_counterparts(1200)   # more than one thread takes at a time


def test_misfit_after():
    check_misfit_after(300)


def test_directions():
    check_directions(600)


def test_ground():
    check_ground(800)


def test_onto_points():
    check_onto_points(120)


def test_onto_planes():
    check_onto_planes(150, 150)
    check_onto_planes(150, 10)


def test_solve_positive4():
    check_solve_positive4(20)


def test_object_kernels_are_plain_python_underneath():
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    done = subprocess.run(
        [sys.executable, "-c", "import test_object_kernels; test_object_kernels.check_all_tiny()"],
        cwd=Path(__file__).parent, env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
