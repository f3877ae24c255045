"""The fast solver's kernels against slow twins: rotations, inertias, the hierarchy, and the linear solver."""

import numpy as np
import pytest
import worlds
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from lidarflow import pose
from lidarflow.kernels import hierarchy, inertia, multigrid, rotations

DATA, TIE, DAMPING, STIFFNESS = 2.0, 7.0, 0.01, 3.0


def rng(seed: int) -> np.random.Generator:
    return np.random.default_rng(seed)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 0.19, 0.21, 1.0, 3.0, 3.1415])
def test_rotations_match_scipy(angle):
    first, second = Rotation.random(2, rng=rng(0))
    vector = np.array([0.3, -1.2, 0.7])
    x, y, z = rotations.turned(*first.as_quat(), *vector)
    assert_allclose([x, y, z], first.apply(vector), atol=1e-14)
    found = rotations.between(*first.as_quat(), *second.as_quat())
    assert_allclose(found, (first.inv() * second).as_quat(canonical=True), atol=1e-14)

    turn = angle * np.array([2.0, -1.0, 2.0]) / 3.0
    *omega, c, slope = rotations.logarithm(*Rotation.from_rotvec(turn).as_quat(canonical=True))
    assert_allclose(omega, turn, atol=1e-12)
    jacobian = pose.exp(np.stack([[*turn, *axis] for axis in np.eye(3)]))[:, :3, 3].T
    assert_allclose(rotations.inverse_jacobian(*omega, c, 1.0, *vector), np.linalg.solve(jacobian, vector),
                    atol=1e-11)
    assert_allclose(rotations.inverse_jacobian(*omega, c, -1.0, *vector),
                    np.linalg.solve(jacobian.T, vector), atol=1e-11)
    if 1e-3 < angle < 3.0:
        ends = [rotations.logarithm(*Rotation.from_rotvec(turn * s).as_quat(canonical=True))[3]
                for s in (1 + 1e-5, 1 - 1e-5)]
        assert_allclose(slope, (ends[0] - ends[1]) / (4e-5 * angle**2), rtol=1e-4)


def dense(numbers: np.ndarray) -> np.ndarray:
    """The 6x6 matrix of an inertia (10,)."""
    mass, moment, upper = numbers[0], pose.hat(numbers[1:4]), numbers[4:]
    rotational = np.empty((3, 3))
    rotational[np.triu_indices(3)] = rotational.T[np.triu_indices(3)] = upper
    return np.block([[rotational, moment], [-moment, mass * np.eye(3)]])


def at(place: np.ndarray, mass: float, against_rotation: float) -> np.ndarray:
    """Matrix (6, 6) of what resists a twist at a place: Aᵀ diag(s, s, s, m, m, m) A, A = Ad(Trans(−q))."""
    seen = pose.adjoint(pose.from_translation(-place))
    return seen.T @ np.diag([against_rotation] * 3 + [mass] * 3) @ seen


def test_inertias_are_blocks_of_the_normal_equations():
    places = rng(1).normal(scale=10, size=(5, 3))
    masses, rotational = rng(2).uniform(0.5, 3.0, 5), rng(3).uniform(0.0, 2.0, 5)
    total = np.zeros((1, 10))
    for k in range(5):
        inertia.add_at(total, 0, places, k, masses[k], rotational[k])
    expected = sum(at(*row) for row in zip(places, masses, rotational, strict=True))
    assert_allclose(dense(total[0]), expected, atol=1e-10)
    twist = rng(4).normal(size=6)
    wrench = inertia.wrench(total, 0, *twist)
    assert_allclose(wrench, expected @ twist, atol=1e-10)
    inverse = np.empty((1, 10))
    inertia.invert(total, np.zeros((1, 10)), inverse, 0)
    assert_allclose(inertia.twist(inverse, 0, *wrench), twist, atol=1e-9)


def mesh(shape):
    """Points (M, 3) and sorted edges (E, 2) of a room grid."""
    points, edges = worlds.room_grid((9.0, 2.0, 0.0), *shape), worlds.grid_edges(*shape)
    return points, edges[np.lexsort(edges.T[::-1])].astype(np.int32)


def prepared(at_sensor: bool, shape, all_tied: bool = False):
    """A hierarchy with random evidence, or with ties of all points, ready to solve, and the dense normal
    equations of the points' edges and of what holds the points."""
    points, edges = mesh(shape)
    levels = hierarchy.build(edges, len(points), STIFFNESS)
    levels.lever[:] = 0.1 * points if at_sensor else points
    room = multigrid.room_for(levels)
    active = rng(5).integers(2 * all_tied, 4, len(points)).astype(np.uint8)
    hierarchy.weigh(levels)
    multigrid.hold(levels, room, points, active, DATA, TIE, DAMPING)
    joined, held = np.zeros((2, len(points), 6, len(points), 6))
    for i, j in edges:
        block = at(levels.lever[j], STIFFNESS, STIFFNESS)
        for a, b, sign in ((i, i, 1), (j, j, 1), (i, j, -1), (j, i, -1)):
            joined[a, :, b] += sign * block
    for i, point in enumerate(points):
        tie = TIE * (active[i] >> 1) + DAMPING
        held[i, :, i] += at(point, DATA * (active[i] & 1) + tie, tie)
    return levels, room, joined.reshape(6 * len(points), -1), held.reshape(6 * len(points), -1)


@pytest.mark.parametrize(("shape", "least"), [((40, 20), 4), ((5, 4), 2), ((2, 1), 2), ((1, 1), 1)])
def test_the_hierarchy_joins_neighbours_until_no_edge_is_left(shape, least):
    points, edges = mesh(shape)
    levels = hierarchy.build(edges, len(points), STIFFNESS)
    sizes = np.diff(levels.bounds)
    assert len(sizes) >= least and sizes[0] == len(points) and sizes[-1] == 1
    assert (sizes[1:] <= 0.5 * sizes[:-1]).all()
    level = np.repeat(np.arange(len(sizes)), sizes)
    assert (level[levels.parent[:-1]] == level[:-1] + 1).all() and levels.parent[-1] == -1
    assert set(levels.parent[:-1]) == set(range(len(points), len(level)))
    ends = [(i, j) for i in range(len(level)) for j in levels.up[levels.up_start[i]:levels.up_start[i + 1]]]
    downs = [(j, i) for i in range(len(level))
             for j in levels.down[levels.down_start[i]:levels.down_start[i + 1]]]
    assert [ends[e] for e in levels.down_edge] == downs
    for e, (i, j) in enumerate(ends):
        assert i < j and level[i] == level[j]
        parents = {levels.parent[i], levels.parent[j]}
        assert (levels.edge_parent[e] < 0) == (len(parents) == 1)
        assert len(parents) == 1 or set(ends[levels.edge_parent[e]]) == parents


@pytest.mark.parametrize("at_sensor", [False, True], ids=["point", "sensor"])
def test_coarse_equations_are_sums_of_the_fine_ones(at_sensor):
    levels, room, joined, held = prepared(at_sensor, (9, 7))
    first, second, third = (np.arange(*levels.bounds[k:k + 2]) for k in range(3))
    for fine, coarse in ((first, second), (second, third)):
        members = np.zeros((len(fine), len(coarse)))
        kept = levels.parent[fine] >= 0
        members[np.flatnonzero(kept), levels.parent[fine][kept] - coarse[0]] = 1.0
        spread = np.kron(members, np.eye(6))
        joined, held = 0.5 * spread.T @ joined @ spread, spread.T @ held @ spread   # edges are softened
        blocks = (joined + held).reshape(len(coarse), 6, len(coarse), 6)
        expected = np.zeros_like(blocks)
        edges_of_points = len(levels.up) - len(levels.inertias)
        for i in coarse:
            expected[i - coarse[0], :, i - coarse[0]] += dense(levels.incident[i] + room.held[i])
            for e in range(levels.up_start[i], levels.up_start[i + 1]):
                block = dense(levels.inertias[e - edges_of_points])
                expected[i - coarse[0], :, levels.up[e] - coarse[0]] -= block
                expected[levels.up[e] - coarse[0], :, i - coarse[0]] -= block
        assert_allclose(blocks, expected, atol=1e-8 * np.abs(blocks).max())


@pytest.mark.parametrize("at_sensor", [False, True], ids=["point", "sensor"])
def test_the_cycle_is_a_symmetric_preconditioner(at_sensor):
    levels, room, joined, held = prepared(at_sensor, (12, 7))
    matrix = joined + held
    count = len(matrix) // 6
    columns = []
    for k in range(6 * count):
        room.loads[:count] = np.eye(6 * count)[k].reshape(-1, 6)
        multigrid.cycle(levels, room)
        columns.append(room.twists[:count].ravel().copy())
    inverse = np.stack(columns, axis=1)
    assert_allclose(inverse, inverse.T, atol=1e-9 * np.abs(inverse).max())
    shares = np.linalg.eigvals(inverse @ matrix).real
    assert shares.min() > 0.03 and shares.max() < 1.9    # a step by 2 would gain nothing


@pytest.mark.parametrize("at_sensor", [False, True], ids=["point", "sensor"])
@pytest.mark.parametrize("shape", [(16, 9), (3, 3), (1, 1)])
def test_steps_solve_the_normal_equations(at_sensor, shape):
    levels, room, joined, held = prepared(at_sensor, shape)
    matrix = joined + held
    count = len(matrix) // 6
    gradient = rng(6).normal(size=(count, 6))
    assert multigrid.solve(levels, room, gradient, 1e-24, 0.0, 0.0, 200) < 60
    expected = -np.linalg.solve(matrix, gradient.ravel()).reshape(-1, 6)
    assert_allclose(room.step, expected, atol=1e-7 * np.abs(expected).max())
    assert multigrid.solve(levels, room, gradient, 1e-24, 0.0, 1e9, 200) == -1   # not enough to gain


@pytest.mark.parametrize("at_sensor", [False, True], ids=["point", "sensor"])
@pytest.mark.parametrize("shape", [(12, 7), (1, 1)])
def test_directions_come_with_their_product(at_sensor, shape):
    levels, room, joined, held = prepared(at_sensor, shape)
    count = len(levels.lever)
    for share in (0.0, 0.3):
        room.loads[:count] = rng(7).normal(size=(count, 6))
        multigrid.cycle(levels, room)
        last = room.direction.copy()
        total = multigrid._turn(levels, room, share)
        expected = room.twists[:count] + (share * last if share else 0.0)
        assert_allclose(room.direction, expected, rtol=1e-12)
        product = (joined + held) @ expected.ravel()
        assert_allclose(room.product.ravel(), product, atol=1e-10 * np.abs(product).max())
        assert_allclose(total, product @ expected.ravel(), rtol=1e-10)


@pytest.mark.parametrize("all_tied", [False, True])
def test_a_cycle_that_is_about_the_inverse_is_made_once(all_tied):
    levels, room, joined, held = prepared(False, (16, 9), all_tied)
    gradient = rng(6).normal(size=(len(levels.lever), 6))
    products = multigrid.solve(levels, room, gradient, 0.05, 0.0, 0.0, 200)
    same = np.abs(np.corrcoef(room.step.ravel(), room.twists[:len(room.step)].ravel())[0, 1] - 1.0) < 1e-9
    assert same == all_tied and (products == 1 or not all_tied)
    step, matrix, pull = room.step.ravel(), joined + held, gradient.ravel()
    gain, most = -step @ pull - 0.5 * step @ matrix @ step, 0.5 * pull @ np.linalg.solve(matrix, pull)
    assert 0.95 * most < gain <= most


def test_negligible_gains_end_the_iterations():
    levels, room, _, _ = prepared(False, (16, 9))
    gradient = rng(6).normal(size=(len(levels.lever), 6))
    counts = [multigrid.solve(levels, room, gradient, 1e-12, little, 0.0, 200)
              for little in (0.0, 0.01, 1e9)]
    assert counts[0] > counts[1] > counts[2] == 0
