"""Cells found by hashing, numbers side by side, and what a twist's covariance means, against slow twins."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np

from lidarflow import pose
from lidarflow.kernels import cells, deviation, grid, lanes, normals, queue, stack, thinning
from lidarflow.kernels.compiled import njit


def rng(seed: int) -> np.random.Generator:
    return np.random.default_rng(seed)


def check_cells(count: int) -> None:
    points = rng(0).uniform(-3, 3, (count, 3))
    points[: count // 8] = points[count // 8: 2 * (count // 8)]
    found = cells.build(points, 0.7)
    places = np.floor(points / 0.7).astype(int)
    _, first = np.unique(places, axis=0, return_index=True)
    np.testing.assert_array_equal(found.place, places[np.sort(first)])
    assert found.bounds[0] == 0 and found.bounds[-1] == count
    for cell, place in enumerate(found.place):
        members = found.order[found.bounds[cell]: found.bounds[cell + 1]]
        np.testing.assert_array_equal(members, np.flatnonzero((places == place).all(axis=1)))
    near = np.empty(cells.NEAR, np.int64)
    for place in [*found.place[::5], np.array([90, -7, 0])]:
        touching = np.flatnonzero((np.abs(found.place - place) <= 1).all(axis=1))
        assert sorted(near[: cells.around(found, place, near)]) == touching.tolist()


def check_no_cells() -> None:
    found = cells.build(np.empty((0, 3)), 0.7)
    assert len(found.place) == 0 and found.bounds.tolist() == [0]
    assert cells.around(found, np.zeros(3, np.int64), np.empty(cells.NEAR, np.int64)) == 0


def check_lanes(count: int) -> None:
    numbers = rng(1).normal(size=(count, 3)).astype(np.float32)
    block = lanes.blocks(3, count)
    assert len(block) == 3 * lanes.padded(count) and 0 <= lanes.padded(count) - count < lanes.WIDTH
    block[:] = np.nan
    for k, point in enumerate(numbers):
        for row in range(3):
            block[lanes.column(3, k) + row * lanes.WIDTH] = point[row]
    lanes.pad(block, 3, count)
    rows = block.reshape(-1, 3, lanes.WIDTH).transpose(0, 2, 1).reshape(-1, 3)
    np.testing.assert_array_equal(rows[:count], numbers)
    assert (rows[count:] == [lanes.FAR, 0.0, 0.0]).all()
    sums = np.concatenate([np.zeros(lanes.WIDTH), np.arange(lanes.WIDTH)]).astype(np.float32)
    assert lanes.total(sums, 1) == lanes.WIDTH * (lanes.WIDTH - 1) / 2


def check_gathered(count: int) -> None:
    numbers, corner = rng(4).uniform(-1, 1, (count, 5)), np.array([0.5, -0.5, 0.25])
    seen = cells.build(numbers[:, :3], 0.7)
    near = np.arange(0, len(seen.place), 2)
    block = lanes.gathered(numbers, seen, near, corner).reshape(-1, 5, lanes.WIDTH)
    rows = block.transpose(0, 2, 1).reshape(-1, 5)
    members = np.concatenate([seen.order[seen.bounds[cell]: seen.bounds[cell + 1]] for cell in near])
    expected = numbers[members] - np.append(corner, [0.0, 0.0])
    np.testing.assert_allclose(rows[: len(members)], expected, atol=1e-6)
    assert (rows[len(members):, 0] == lanes.FAR).all()


def check_deviation(count: int) -> None:
    random = rng(2)
    root, points, centre = 0.01 * random.normal(size=(6, 6)), random.normal(0, 9, (count, 3)), np.arange(3.0)
    found = deviation.of_twist(root @ root.T, points, centre, 0.02, 0.001)
    for at, deviation_m in zip(points, found, strict=True):
        moves = np.hstack([-pose.hat(at - centre), np.eye(3)]) @ root
        own_sq = 0.02**2 + (0.001 * np.linalg.norm(at)) ** 2
        np.testing.assert_allclose(deviation_m**2, (moves**2).sum() + own_sq, rtol=1e-9)


def check_information(count: int) -> None:
    random = rng(5)
    at, across, centre = random.normal(0, 9, (count, 3)), random.normal(size=(count, 3)), np.arange(3.0)
    weights = random.uniform(1.0, 9.0, count)
    rows = np.hstack([np.cross(at - centre, across), across])
    expected = (rows * weights[:, None]).T @ rows
    np.testing.assert_allclose(deviation.information(at, across, centre, weights), expected, rtol=1e-9)


def check_thinned(count: int) -> None:
    points = rng(6).uniform(-9.0, 9.0, (count, 3))
    points[::7] *= 5.0
    points[3] = np.nan
    points[4] = [0.1, -0.2, 0.0]
    range_m = np.linalg.norm(points, axis=1)
    kept = points[(range_m >= 1.5) & (range_m <= 30.0)]
    for wanted_m, share in ((0.5, 1.0), (0.5, 0.04)):
        means, grown, found, voxel_m, in_range = thinning.thinned(
            points, 1.5, 30.0, wanted_m, share, 3.5, 0.25)
        assert in_range == len(kept)
        np.testing.assert_allclose(voxel_m, min(wanted_m, share * np.sqrt(np.median((kept**2).sum(axis=1)))))
        np.testing.assert_array_equal(means, grid.means(kept, voxel_m))
        np.testing.assert_array_equal(grown.points, means[grown.rows])
        np.testing.assert_array_equal(np.sort(grown.rows), np.arange(len(means)))
        near = cells.build(grown.points, 3.5 * voxel_m)
        expected, is_narrow = normals.estimated(grown.points, near, grown.points, near, 0.25 * voxel_m)
        normals.level(expected, is_narrow)
        np.testing.assert_array_equal(found, expected)


def check_nothing_thinned() -> None:
    clouds = [np.full((4, 3), value) for value in (np.nan, np.inf, 0.0, 1e12, 1e300)]
    for points in (np.empty((0, 3)), *clouds):
        means, grown, found, _, in_range = thinning.thinned(points, 1e-3, 1e4, 0.2, 0.04, 3.5, 0.25)
        assert len(means) == len(grown.points) == len(found) == in_range == 0
        assert np.isnan(found).all()


def tasks_taken() -> None:
    waiting = queue.tasks()
    assert [queue.take(waiting) for _ in range(3)] == [0, 1, 2]


@njit()
def tripled(count):
    """Sums over arrays on the stack: of a caller, and of a function it calls while its own are in use."""
    own, total = stack.integers(), 0.0
    for k in range(count):
        own[k] = k
        total += doubled(k)
    for k in range(count):
        total += own[k]
    return total


@njit()
def doubled(k):
    reals, integers = stack.reals(), stack.integers()
    for i in range(stack.SIZE):
        reals[i], integers[i] = 2.0 * k, -7
    return reals[stack.SIZE - 1]


def check_stack() -> None:
    assert tripled(stack.SIZE) == 3.0 * sum(range(stack.SIZE))


def check_all_tiny() -> None:
    """Every comparison on tiny inputs, for interpreted kernels."""
    check_information(5)
    check_thinned(30)
    check_nothing_thinned()
    check_stack()
    tasks_taken()
    check_cells(40)
    check_no_cells()
    check_lanes(20)
    check_gathered(40)
    check_deviation(5)


def test_cells():
    check_cells(2000)
    check_no_cells()


def test_lanes():
    for count in (0, 1, lanes.WIDTH, 100):
        check_lanes(count)
    check_gathered(300)


def test_deviation():
    check_deviation(200)
    check_information(100)


def test_a_scan_is_thinned_for_registration():
    check_thinned(3000)
    check_nothing_thinned()


def test_arrays_on_the_stack_are_each_functions_own():
    check_stack()
    tasks_taken()


def test_blocks_are_plain_python_underneath():
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    done = subprocess.run(
        [sys.executable, "-c", "import test_blocks; test_blocks.check_all_tiny()"],
        cwd=Path(__file__).parent, env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
