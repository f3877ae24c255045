"""SE(3) by its identities: what undoes what, and what commutes with what."""

import numpy as np
import pytest

from lidarflow import pose


def rng(seed: int) -> np.random.Generator:
    return np.random.default_rng(seed)


def twists(count: int, largest_angle: float, seed: int) -> np.ndarray:
    """Twists (count, 6) with rotation angles spread over 0 .. largest_angle and translations of metres."""
    random = rng(seed)
    axis = random.normal(size=(count, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    angle = np.linspace(0.0, largest_angle, count)[:, None]
    return np.hstack([axis * angle, random.normal(scale=20.0, size=(count, 3))])


def series_exp(twist: np.ndarray) -> np.ndarray:
    """Motion (4, 4) of a twist (6,) by the power series of its 4×4 generator."""
    generator = np.zeros((4, 4))
    x, y, z = twist[:3]
    generator[:3, :3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
    generator[:3, 3] = twist[3:]
    total, term = np.eye(4), np.eye(4)
    for k in range(1, 60):
        term = term @ generator / k
        total = total + term
    return total


def test_exp_is_the_matrix_exponential():
    for twist in twists(30, 3.1, seed=0):
        np.testing.assert_allclose(pose.exp(twist), series_exp(twist), atol=1e-10)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-8, 1e-5, 0.99e-4, 1.01e-4, 1e-3, 0.1, 1.0, 3.0])
def test_log_undoes_exp_at_every_size_of_angle(angle):
    xi = twists(20, 1.0, seed=1)
    axis = xi[1:, :3] / np.linalg.norm(xi[1:, :3], axis=1, keepdims=True)
    xi = np.hstack([angle * axis, xi[1:, 3:]])
    np.testing.assert_allclose(pose.log(pose.exp(xi)), xi, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("short_of_pi", [1e-3, 1e-6, 1e-9, 0.0])
def test_exp_undoes_log_near_half_a_turn(short_of_pi):
    xi = twists(20, 1.0, seed=2)[1:]
    xi[:, :3] *= (np.pi - short_of_pi) / np.linalg.norm(xi[:, :3], axis=1, keepdims=True)
    motion = pose.exp(xi)
    again = pose.log(motion)
    np.testing.assert_allclose(np.linalg.norm(again[:, :3], axis=1), np.pi - short_of_pi, atol=1e-7)
    np.testing.assert_allclose(pose.exp(again), motion, atol=1e-6)


def test_inverse_undoes_and_reverses_products():
    a, b = pose.exp(twists(25, 3.0, seed=3)), pose.exp(twists(25, 2.0, seed=4))
    np.testing.assert_allclose(pose.inverse(a) @ a, pose.identity(25), atol=1e-12)
    np.testing.assert_allclose(pose.inverse(a @ b), pose.inverse(b) @ pose.inverse(a), atol=1e-10)
    np.testing.assert_allclose(pose.inverse(pose.exp(twists(25, 3.0, seed=3))),
                               pose.exp(-twists(25, 3.0, seed=3)), atol=1e-10)


def test_the_adjoint_carries_a_twist_to_another_frame():
    motion, xi = pose.exp(twists(25, 3.0, seed=5)), twists(25, 1.5, seed=6)
    elsewhere = pose.log(motion @ pose.exp(xi) @ pose.inverse(motion))
    carried = (pose.adjoint(motion) @ xi[..., None])[..., 0]
    np.testing.assert_allclose(elsewhere, carried, rtol=1e-8, atol=1e-8)
    a, b = pose.exp(twists(3, 2.0, seed=7)), pose.exp(twists(3, 2.0, seed=8))
    np.testing.assert_allclose(pose.adjoint(a @ b), pose.adjoint(a) @ pose.adjoint(b), atol=1e-9)


def test_hat_is_the_cross_product():
    a, b = rng(9).normal(size=(2, 10, 3))
    np.testing.assert_allclose((pose.hat(a) @ b[..., None])[..., 0], np.cross(a, b), atol=1e-14)


def test_interpolation_meets_its_ends_and_halves_its_way():
    start, end = pose.exp(twists(25, 2.0, seed=10)), pose.exp(twists(25, 1.0, seed=11))
    np.testing.assert_allclose(pose.interpolate(start, end, 0.0), start, atol=1e-9)
    np.testing.assert_allclose(pose.interpolate(start, end, 1.0), end, atol=1e-9)
    middle = pose.interpolate(start, end, 0.5)
    np.testing.assert_allclose(pose.inverse(start) @ middle, pose.inverse(middle) @ end, atol=1e-9)
    straight = pose.interpolate(np.eye(4), pose.from_translation([4.0, 0.0, 2.0]), 0.25)
    np.testing.assert_allclose(straight[:3, 3], [1.0, 0.0, 0.5])


def test_quaternion_rows_round_trip_with_a_positive_last_number():
    motion = pose.exp(twists(40, np.pi, seed=12))
    rows = pose.to_translation_quaternion(motion)
    assert rows.shape == (40, 7) and (rows[:, 6] >= 0).all()
    np.testing.assert_allclose(np.linalg.norm(rows[:, 3:], axis=1), 1.0)
    np.testing.assert_allclose(pose.from_translation_quaternion(rows), motion, atol=1e-12)
    flipped = rows * np.array([1, 1, 1, -1, -1, -1, -1])
    again = pose.to_translation_quaternion(pose.from_translation_quaternion(flipped))
    np.testing.assert_allclose(again[:-1], rows[:-1], atol=1e-12)


def test_quaternions_are_stored_as_x_y_z_w_after_the_translation():
    quarter_turn = pose.from_yaw(np.pi / 2, (1.0, 2.0, 3.0))
    half = np.sqrt(0.5)
    np.testing.assert_allclose(pose.to_translation_quaternion(quarter_turn), [1, 2, 3, 0, 0, half, half],
                               atol=1e-15)
    np.testing.assert_allclose(pose.apply(quarter_turn, np.array([1.0, 0.0, 0.0])), [1, 3, 3], atol=1e-15)


def test_leading_shapes_broadcast():
    motions, points = pose.exp(twists(4, 2.0, seed=13)), rng(14).normal(size=(5, 3))
    crossed = pose.apply(motions[:, None], points)
    paired = pose.apply(motions, points[:4])
    single = pose.apply(motions[0], points)
    assert crossed.shape == (4, 5, 3) and paired.shape == (4, 3) and single.shape == (5, 3)
    for i in range(4):
        by_hand = points @ motions[i, :3, :3].T + motions[i, :3, 3]
        np.testing.assert_allclose(crossed[i], by_hand, atol=1e-12)
        np.testing.assert_allclose(paired[i], by_hand[i], atol=1e-12)
    np.testing.assert_allclose(single, crossed[0], atol=1e-12)
    grid = motions.reshape(2, 2, 4, 4)
    np.testing.assert_allclose(pose.exp(pose.log(grid)), grid, atol=1e-9)
    assert pose.to_translation_quaternion(grid).shape == (2, 2, 7)
    assert pose.identity(2, 3).shape == (2, 3, 4, 4) and pose.identity().shape == (4, 4)


def test_no_motion_at_all_is_an_empty_answer():
    none = np.zeros((0, 4, 4))
    assert pose.exp(np.zeros((0, 6))).shape == (0, 4, 4)
    assert pose.from_translation_quaternion(np.zeros((0, 7))).shape == (0, 4, 4)
    assert pose.log(none).shape == (0, 6) and pose.to_translation_quaternion(none).shape == (0, 7)
    assert pose.rotation_distance(none, none).shape == pose.translation_distance(none, none).shape == (0,)


def test_distances_are_those_of_the_relative_motion():
    start = pose.exp(twists(10, 2.0, seed=15))
    step = pose.exp(np.array([0.0, 0.3, 0.0, 0.0, 0.0, 0.0])) @ pose.from_translation([3.0, 0.0, 4.0])
    np.testing.assert_allclose(pose.translation_distance(start, start @ step), 5.0, rtol=1e-9)
    np.testing.assert_allclose(pose.rotation_distance(start, start @ step), 0.3, rtol=1e-9)


def spoilt(row: int, column: int, value: float) -> np.ndarray:
    motion = pose.from_yaw(0.3, (1.0, 2.0, 3.0))
    motion[row, column] = value
    return motion


@pytest.mark.parametrize("wrong", [
    spoilt(0, 0, 2.0), spoilt(0, 3, np.nan), spoilt(1, 3, np.inf), spoilt(3, 0, 0.1), spoilt(3, 3, 2.0),
    np.diag([1.0, 1.0, -1.0, 1.0]), np.diag([2.0, 2.0, 2.0, 1.0]), np.eye(3), np.zeros((4, 4)),
    np.stack([np.eye(4), spoilt(2, 2, 1.1)]),
])
def test_what_is_no_rigid_motion_is_told_apart(wrong):
    assert not pose.is_rigid(wrong)


def test_rigid_motions_are_recognised_up_to_the_tolerance():
    assert pose.is_rigid(pose.exp(twists(20, 3.1, seed=16)))
    nearly = spoilt(2, 2, 1.0 + 2e-5)
    assert pose.is_rigid(nearly, tolerance=1e-4) and not pose.is_rigid(nearly, tolerance=1e-6)


def test_arguments_are_not_written_to():
    motion = pose.exp(twists(3, 2.0, seed=17))
    points = rng(18).normal(size=(3, 3))
    before = motion.copy(), points.copy()
    pose.apply(motion, points), pose.inverse(motion), pose.log(motion), pose.interpolate(motion, motion, 0.5)
    np.testing.assert_array_equal(motion, before[0])
    np.testing.assert_array_equal(points, before[1])


def test_alignment_finds_the_motion_of_every_cloud():
    known = pose.exp(twists(6, 3.0, seed=8))
    points = rng(9).normal(scale=5.0, size=(6, 12, 3))
    found = pose.aligned(points, pose.apply(known[:, None], points))
    np.testing.assert_allclose(found, known, atol=1e-9)


def test_alignment_never_mirrors():
    points = rng(10).normal(size=(10, 3))
    assert pose.is_rigid(pose.aligned(points, points * [1.0, 1.0, -1.0]))


def test_alignment_of_three_points_of_a_plane():
    known = pose.exp(twists(2, 1.0, seed=11)[1])
    points = rng(12).normal(size=(3, 3))
    np.testing.assert_allclose(pose.aligned(points, pose.apply(known, points)), known, atol=1e-9)


def test_a_trajectory_undoes_its_steps():
    steps = pose.exp(np.random.default_rng(3).normal(scale=0.3, size=(4, 6)))
    poses = pose.trajectory(steps)
    np.testing.assert_array_equal(poses[0], np.eye(4))
    np.testing.assert_allclose(pose.inverse(poses[1:]) @ poses[:-1], steps, atol=1e-12)
    assert pose.trajectory(np.empty((0, 4, 4))).shape == (1, 4, 4)
