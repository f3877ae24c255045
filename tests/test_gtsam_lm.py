"""The pointwise graph in gtsam: residuals and kernel against the formulas, answers on known worlds."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
import worlds
from numpy.testing import assert_allclose

from lidarflow import pose, robust
from lidarflow.config import SolverConfig
from lidarflow.solve import gtsam_lm

MIN_MATCHES = 3
DEFAULT = SolverConfig()
SENSOR = SolverConfig(smoothness_frame="sensor")
PLAIN_ONLY = SolverConfig(truncation_m=1e4)   # a kernel that lets nothing go: the robust step changes nothing
both_frames = pytest.mark.parametrize("config", [DEFAULT, SENSOR], ids=["point", "sensor"])


def rng(seed: int) -> np.random.Generator:
    return np.random.default_rng(seed)


def solve(world: worlds.World, config: SolverConfig = DEFAULT):
    return gtsam_lm.solve(world.problem, config, MIN_MATCHES)


def moved_apart_m(a: np.ndarray, b: np.ndarray, points: np.ndarray) -> float:
    """Largest distance in metres between where two sets of motions put the points."""
    return float(np.linalg.norm(pose.apply(a, points) - pose.apply(b, points), axis=1).max())


def pair_of_points(seed: int, apart: float):
    """A component of two neighbours far from the sensor, one matched; `apart` parts their motions."""
    random = rng(seed)
    points = random.normal(size=(2, 3)) + [18.0, -7.0, 1.0]
    first = pose.exp(random.normal(scale=0.4, size=6))
    motions = np.stack([first, first @ pose.exp(random.normal(scale=apart, size=6))])
    target = pose.apply(motions[1], points[1]) + random.normal(scale=0.1, size=3)
    return gtsam_lm._Component(
        np.arange(2), points, motions, np.array([1]), target[None], np.array([[0, 1]]),
        np.empty(0, np.int64), np.empty((0, 4, 4)))


def smoothness_factor(part, config: SolverConfig):
    return gtsam_lm._smoothness_factors(part, config).at(0)


def smoothness_residuals(problem, motions, config: SolverConfig) -> np.ndarray:
    """Eq. 10 (E, 6) by direct evaluation, at the point j of every edge or at the sensor."""
    i, j = problem.edges.T
    twist = pose.log(pose.inverse(motions[i]) @ motions[j])
    if config.smoothness_frame == "point":
        seen = np.linalg.inv(pose.adjoint(pose.from_translation(problem.points[j])))
        twist = np.einsum("nij,nj->ni", seen, twist)
    return twist


def match_distances_sq(problem, motions) -> np.ndarray:
    index = problem.match_index
    return ((pose.apply(motions[index], problem.points[index]) - problem.match_target) ** 2).sum(axis=1)


def energy(problem, motions, config: SolverConfig) -> float:
    """Eq. 4 with the kernel of eq. 13, by direct evaluation."""
    loss, _ = robust.truncated(match_distances_sq(problem, motions), config.truncation_m)
    smooth = (smoothness_residuals(problem, motions, config) ** 2).sum()
    return 0.5 * (config.data_weight * loss.sum() + config.smoothness_weight * smooth)


# --- residuals and derivatives ---

def test_data_residual_is_the_moved_point_off_its_match():
    part = pair_of_points(0, 0.1)
    factor = gtsam_lm._data_factors(part, gtsam_lm._data_noise(DEFAULT)).at(0)
    residual = factor.unwhitenedError(gtsam_lm._values(part.initial, part.points))
    expected = pose.apply(part.initial[1], part.points[1]) - part.match_target[0]
    assert_allclose(np.linalg.norm(residual), np.linalg.norm(expected), atol=1e-12)
    assert_allclose(residual, expected, atol=1e-12)


@pytest.mark.parametrize("apart", [1e-3, 0.05, 0.6])
def test_smoothness_residual_is_the_twist_of_eq_10_seen_at_the_point(apart):
    part = pair_of_points(1, apart)
    twist = pose.log(pose.inverse(part.initial[0]) @ part.initial[1])
    residual = smoothness_factor(part, DEFAULT).unwhitenedError(gtsam_lm._values(part.initial, part.points))
    at_point = pose.adjoint(pose.from_translation(part.points[1]))
    assert_allclose(residual, np.linalg.solve(at_point, twist), atol=1e-9)
    # The same without an adjoint: rotation as it is, translation the velocity ω × p + v of the point j.
    velocity = np.cross(twist[:3], part.points[1]) + twist[3:]
    assert_allclose(residual, [*twist[:3], *velocity], atol=1e-9)


@pytest.mark.parametrize("weight", [1.0, 10.0])
@pytest.mark.parametrize("apart", [1e-3, 0.05, 0.6])
def test_smoothness_weights_give_back_eq_10(apart, weight):
    part = pair_of_points(2, apart)
    values = gtsam_lm._values(part.initial, part.points)
    twist = pose.log(pose.inverse(part.initial[0]) @ part.initial[1])
    at_sensor = smoothness_factor(part, replace(SENSOR, smoothness_weight=weight))
    assert_allclose(2.0 * at_sensor.error(values), weight * (twist @ twist), rtol=1e-9)
    at_point = smoothness_factor(part, replace(DEFAULT, smoothness_weight=weight))
    seen = np.linalg.solve(pose.adjoint(pose.from_translation(part.points[1])), twist)
    assert_allclose(2.0 * at_point.error(values), weight * (seen @ seen), rtol=1e-9)
    assert abs(at_point.error(values) / at_sensor.error(values) - 1.0) > 0.05   # the two frames do differ


@both_frames
@pytest.mark.parametrize("apart", [1e-3, 0.3, 1.0])
def test_derivatives_match_numerical_ones(config, apart):
    part = pair_of_points(3, apart)
    values = gtsam_lm._values(part.initial, part.points)
    smoothness = gtsam_lm._smoothness_factors(part, config)
    data = gtsam_lm._data_factors(part, gtsam_lm._data_noise(replace(config, data_weight=4.0)))
    for factor in (smoothness.at(0), data.at(0)):
        jacobian, _ = factor.linearize(values).jacobian()
        numerical = numerical_jacobian(factor, values)
        assert_allclose(jacobian, numerical, atol=1e-6 * np.abs(numerical).max())


def numerical_jacobian(factor, values, step: float = 1e-6) -> np.ndarray:
    """Derivative of the whitened residual in gtsam's retraction, by central differences."""
    columns = []
    keys = factor.keys()
    for key in keys:
        for axis in range(6):
            ends = []
            for signed in (step, -step):
                shifted = gtsam.Values(values)
                shifted.update(key, values.atPose3(key).retract(signed * np.eye(6)[axis]))
                ends.append(factor.noiseModel().whiten(factor.unwhitenedError(shifted)))
            columns.append((ends[0] - ends[1]) / (2 * step))
    return np.stack(columns, axis=1)


def test_variables_give_back_the_motions():
    random = rng(4)
    points, motions = random.normal(scale=30, size=(12, 3)), pose.exp(random.normal(size=(12, 6)))
    assert_allclose(gtsam_lm._motions(gtsam_lm._values(motions, points), points), motions, atol=1e-12)


# --- the kernel ---

@pytest.mark.parametrize("weight", [1.0, 4.0])
@pytest.mark.parametrize("truncation_m", [DEFAULT.truncation_m, 0.5])
def test_kernel_is_eq_13_on_metres(weight, truncation_m):
    config = SolverConfig(data_weight=weight, truncation_m=truncation_m)
    off_m = np.concatenate([np.linspace(0.0, 3.0, 61), truncation_m * np.array([0.999, 1.001])])
    plain, saturated = [], []
    for r in off_m:
        part = replace(pair_of_points(5, 0.1), initial=pose.identity(2))
        part = replace(part, match_target=part.points[1:] + r * np.array([[0.6, 0.0, -0.8]]))
        values = gtsam_lm._values(part.initial, part.points)
        plain.append(gtsam_lm._data_factors(part, gtsam_lm._data_noise(config)).error(values))
        saturated.append(gtsam_lm._data_factors(part, gtsam_lm._robust_data_noise(config)).error(values))
    assert_allclose(plain, 0.5 * weight * off_m**2, atol=1e-10)
    assert_allclose(saturated, 0.5 * weight * np.minimum(off_m**2, truncation_m**2), atol=1e-10)


# --- known worlds ---

@both_frames
def test_clean_matches_give_the_exact_motion(config):
    world = worlds.moved_room(0.8, 5.0, rng(0))
    motions, solved, stats = solve(world, config)
    assert solved.all() and stats.inliers == len(world.wrong)
    assert pose.translation_distance(motions, world.motions).max() < 1e-9
    assert pose.rotation_distance(motions, world.motions).max() < 1e-7


@both_frames
@pytest.mark.parametrize("share", [0.2, 0.3])
def test_wrong_matches_are_let_go(config, share):
    for seed in range(3):
        world = worlds.moved_room(0.8, 5.0, rng(seed), share, noise_m=0.01)
        motions, solved, stats = solve(world, config)
        plain, _, _ = solve(world, PLAIN_ONLY if config is DEFAULT else replace(SENSOR, truncation_m=1e4))
        error_m, plain_error_m = world.error_m(motions), world.error_m(plain)
        assert solved.all() and stats.inliers == (~world.wrong).sum()
        assert error_m.max() < (0.015 if config is DEFAULT else 0.03)
        assert np.median(plain_error_m) > 0.05 and plain_error_m.max() > 10 * error_m.max()


@both_frames
def test_unmatched_points_follow_their_neighbours(config):
    world = worlds.moved_room(0.8, 5.0, rng(1))
    few = rng(2).permutation(len(world.wrong))[:6]
    problem = replace(world.problem, match_index=world.problem.match_index[few],
                      match_target=world.problem.match_target[few])
    motions, solved, _ = gtsam_lm.solve(problem, config, MIN_MATCHES)
    assert solved.all() and world.error_m(motions).max() < 0.01


@both_frames
@pytest.mark.parametrize("share", [0.0, 0.25])
def test_jittered_starts_converge_to_the_same_motions(config, share):
    world = worlds.moved_room(0.5, 3.0, rng(3), share, noise_m=0.02)
    motions, _, _ = solve(world, config)
    for seed in range(4):
        again, _, _ = solve(worlds.jittered(world, rng(10 + seed)), config)
        assert moved_apart_m(motions, again, world.problem.points) < 1e-3


def test_ten_equal_runs_give_the_same_bytes():
    world = worlds.joined(worlds.two_bodies(rng(4), wrong_matches=0.2, noise_m=0.02))
    answers = {solve(world)[0].tobytes() for _ in range(10)}
    assert len(answers) == 1


@both_frames
def test_swapping_the_scans_inverts_the_motion(config):
    world = worlds.moved_room(0.8, 5.0, rng(5), wrong_matches=0.2, noise_m=0.005)
    there, _, _ = solve(world, config)
    back, _, _ = solve(worlds.swapped_world(world), config)
    # Noise parts the two, as the neighbours' twist is weighed elsewhere: by far less than the noise itself.
    assert moved_apart_m(there, pose.inverse(back), world.problem.points) < 2e-3


def test_bodies_do_not_influence_each_other():
    bodies = worlds.two_bodies(rng(6), wrong_matches=0.2, noise_m=0.02)
    together, solved, stats = solve(worlds.joined(bodies))
    alone = [solve(body) for body in bodies]
    assert together.tobytes() == np.concatenate([motions for motions, _, _ in alone]).tobytes()
    assert solved.all() and stats.solved_components == stats.components == 2
    assert stats.inliers == sum(s.inliers for _, _, s in alone)
    assert_allclose(stats.robust_final_error, sum(s.robust_final_error for _, _, s in alone))
    assert worlds.joined(bodies).error_m(together).max() < 0.03


@both_frames
def test_the_order_of_the_input_does_not_matter(config):
    world = worlds.joined(worlds.two_bodies(rng(7), wrong_matches=0.2, noise_m=0.01))
    motions, solved, stats = solve(world, config)
    for seed in range(3):
        other, old = worlds.permuted(world, rng(20 + seed))
        again, again_solved, again_stats = solve(other, config)
        # An edge that turns around is weighed at its other end in the point frame; at the sensor nothing is.
        tolerance_m = 1e-3 if config is DEFAULT else 1e-9
        assert moved_apart_m(again, motions[old], other.problem.points) < tolerance_m
        assert (again_solved == solved[old]).all() and again_stats.inliers == stats.inliers


def test_the_order_of_components_does_not_matter():
    bodies = worlds.two_bodies(rng(8), wrong_matches=0.2, noise_m=0.02)
    motions, _, _ = solve(worlds.joined(bodies))
    again, _, _ = solve(worlds.joined(bodies[::-1]))
    first = len(bodies[0].motions)
    assert np.concatenate([again[-first:], again[:-first]]).tobytes() == motions.tobytes()


def test_the_distance_to_the_sensor_does_not_matter_in_the_point_frame():
    away = pose.from_translation(np.array([40.0, -25.0, 2.0]))
    near_motion = pose.from_yaw(0.05, np.array([0.4, 0.1, 0.0]))
    far_motion = away @ near_motion @ pose.inverse(away)
    near = worlds.body((0.0, 0.0, 0.0), near_motion, rng(21), 0.2, noise_m=0.02)
    far = worlds.body(away[:3, 3], far_motion, rng(21), 0.2, noise_m=0.02)
    start = away @ near.problem.initial @ pose.inverse(away)
    far = replace(far, problem=replace(far.problem, initial=start))
    motions, far_motions = solve(near)[0], solve(far)[0]
    assert moved_apart_m(far_motions, away @ motions @ pose.inverse(away), far.problem.points) < 1e-6
    far_at_sensor, near_at_sensor = solve(far, SENSOR)[0], solve(near, SENSOR)[0]
    apart = moved_apart_m(far_at_sensor, away @ near_at_sensor @ pose.inverse(away), far.problem.points)
    assert apart > 0.02   # the lever arm of eq. 10


# --- components that cannot be solved ---

def test_components_without_evidence_keep_their_start():
    room, thing = worlds.two_bodies(rng(9))
    start = pose.exp(rng(10).normal(scale=0.1, size=(len(thing.motions), 6)))
    thing = replace(thing, problem=replace(thing.problem, initial=start))
    cases = {
        "no matches": (worlds.without_matches(thing), 2),
        "two matches": (worlds.without_matches(thing, keep=2), 2),
        "only wrong matches": (worlds.all_wrong(thing, rng(11)), 4),
    }
    for name, (unsolvable, steps) in cases.items():
        world = worlds.joined([unsolvable, room])
        motions, solved, stats = solve(world)
        unsolved = len(thing.motions)
        assert (motions[:unsolved] == start).all(), name
        assert not solved[:unsolved].any() and solved[unsolved:].all(), name
        assert world.error_m(motions)[unsolved:].max() < 1e-9, name
        assert stats.components == 2 and stats.solved_components == 1, name
        assert sum(stats.stopped.values()) == steps and stats.inliers == len(room.wrong), name


def test_the_least_number_of_matches_is_a_setting():
    world = worlds.without_matches(worlds.moved_room(0.3, 2.0, rng(12)), keep=5)
    assert gtsam_lm.solve(world.problem, DEFAULT, 5)[1].all()
    assert not gtsam_lm.solve(world.problem, DEFAULT, 6)[1].any()


@pytest.mark.parametrize("keep", [3, 8])
@pytest.mark.parametrize(("config", "noise_m"), [(DEFAULT, 0.0), (DEFAULT, 0.02), (SENSOR, 0.0)])
def test_collinear_matches_stay_near_their_start(config, noise_m, keep):
    """The turn about the matches' line is free: it must stay small, and what is known must be right.

    With noise this holds for the point frame only: there a turn costs the same at any distance.
    """
    for seed in range(3):
        full = worlds.moved_room(0.3, 0.0, rng(seed), noise_m=noise_m)
        world = worlds.without_matches(full, keep)   # the first points are a vertical line
        motions, solved, _ = solve(world, config)
        problem = world.problem
        assert solved.all() and pose.is_rigid(motions)
        assert world.error_m(motions)[:keep].max() < 0.06
        assert pose.rotation_distance(motions, problem.initial).max() < np.radians(10.0)
        assert moved_apart_m(motions, problem.initial, problem.points) < 0.6


def test_a_point_without_edges_moves_by_its_match_alone():
    world = worlds.moved_room(0.3, 0.0, rng(14))
    lone = replace(world.problem, points=world.problem.points[:1], initial=world.problem.initial[:1],
                   match_index=world.problem.match_index[:1], match_target=world.problem.match_target[:1],
                   edges=np.empty((0, 2), np.int32), component=world.problem.component[:1])
    motions, solved, _ = gtsam_lm.solve(lone, DEFAULT, 1)
    assert solved.all()
    assert_allclose(motions[0], world.motions[0], atol=1e-6)


# --- what the solver says of itself ---

@both_frames
def test_stats_match_direct_evaluation(config):
    config = replace(config, data_weight=2.0, smoothness_weight=5.0)
    world = worlds.joined(worlds.two_bodies(rng(15), wrong_matches=0.2, noise_m=0.02))
    problem = world.problem
    motions, _, stats = solve(world, config)
    no_kernel = replace(config, truncation_m=1e4)
    plain, _, plain_stats = solve(world, no_kernel)
    assert (stats.solver, stats.variables, stats.matches) == ("gtsam", len(problem.points), len(world.wrong))
    assert (stats.edges, stats.components, stats.solved_components) == (len(problem.edges), 2, 2)
    assert_allclose(stats.plain_initial_error, energy(problem, problem.initial, no_kernel), rtol=1e-9)
    assert_allclose(plain_stats.robust_final_error, energy(problem, plain, no_kernel), rtol=1e-9)
    assert_allclose(stats.plain_final_error, energy(problem, plain, no_kernel), rtol=1e-3)
    assert_allclose(stats.robust_initial_error, energy(problem, plain, config), rtol=1e-2)
    assert_allclose(stats.robust_final_error, energy(problem, motions, config), rtol=1e-9)
    assert stats.plain_final_error < 0.5 * stats.plain_initial_error
    assert stats.robust_final_error < 0.9 * stats.robust_initial_error
    assert stats.inliers == (match_distances_sq(problem, motions) <= config.truncation_m**2).sum()
    assert stats.stopped == {"converged": 4}
    assert 2 <= stats.plain_iterations <= 60 and 2 <= stats.robust_iterations <= 60


def test_inliers_are_the_matches_within_the_truncation():
    world = worlds.moved_room(0.4, 2.0, rng(22), noise_m=0.2)   # many matches end just inside or outside
    motions, solved, stats = solve(world)
    off_sq = match_distances_sq(world.problem, motions)
    near = np.abs(np.sqrt(off_sq) - DEFAULT.truncation_m) < 0.1
    assert solved.all() and near.sum() > 20
    assert stats.inliers == (off_sq <= DEFAULT.truncation_m**2).sum()


@both_frames
def test_the_answer_is_a_minimum_of_the_energy(config):
    world = worlds.moved_room(0.4, 2.0, rng(16), wrong_matches=0.2, noise_m=0.02)
    tight = replace(config, relative_tolerance=1e-9)
    motions, _, _ = solve(world, tight)
    problem, at_point = world.problem, pose.from_translation(world.problem.points)
    least = energy(problem, motions, tight)
    assert_allclose(energy(problem, solve(world, config)[0], config), least, rtol=1e-4)
    for seed in range(20):
        twist = rng(30 + seed).normal(scale=1e-4, size=(len(motions), 6))
        nearby = motions @ at_point @ pose.exp(twist) @ pose.inverse(at_point)
        everything_alike = motions @ pose.exp(twist[0])
        assert energy(problem, nearby, tight) > least and energy(problem, everything_alike, tight) > least


def test_the_iteration_limit_is_kept_and_told():
    world = worlds.moved_room(0.8, 5.0, rng(17), wrong_matches=0.3, noise_m=0.02)
    _, _, stats = solve(world, replace(DEFAULT, max_iterations=1))
    assert stats.plain_iterations == 1 and stats.robust_iterations == 1
    assert stats.stopped == {"max_iterations": 2}


@both_frames
def test_empty_problems(config):
    motions, solved, stats = gtsam_lm.solve(worlds.empty_problem(), config, MIN_MATCHES)
    assert motions.shape == (0, 4, 4) and solved.shape == (0,)
    assert (stats.components, stats.solved_components, stats.inliers, stats.stopped) == (0, 0, 0, {})
    unmatched = worlds.without_matches(worlds.moved_room(0.3, 1.0, rng(18)))
    motions, solved, stats = solve(unmatched, config)
    assert (motions == unmatched.problem.initial).all() and not solved.any()
    assert (stats.components, stats.plain_initial_error, stats.stopped) == (1, 0, {})


def test_the_problem_is_left_as_it_was():
    problem = worlds.moved_room(0.3, 1.0, rng(19), wrong_matches=0.2).problem
    before = {name: getattr(problem, name).copy() for name in problem.__slots__}
    gtsam_lm.solve(problem, DEFAULT, MIN_MATCHES)
    for name, array in before.items():
        assert (getattr(problem, name) == array).all(), name
