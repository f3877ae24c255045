"""What any solver of the pointwise graph must do: answers on known worlds, and what it says of itself."""

from dataclasses import replace

import numpy as np
import pytest
import worlds
from energies import energy, match_distances_sq, moved_apart_m
from numpy.testing import assert_allclose

from lidarflow import pose
from lidarflow.config import SolverConfig
from lidarflow.errors import SolveError
from lidarflow.solve import solve as solve_by_name
from lidarflow.types import FlowProblem

MIN_MATCHES = 3
DEFAULT = SolverConfig()
SENSOR = SolverConfig(smoothness_frame="sensor")
both_frames = pytest.mark.parametrize("config", [DEFAULT, SENSOR], ids=["point", "sensor"])


class Solver:
    """A solver as the tests call it, and how near it comes to the one minimum of a problem in metres.

    exact_m  where the least energy is zero
    same_m   where the same problem is put in another way
    """

    def __init__(self, name: str, exact_m: float, same_m: float):
        self.name, self.exact_m, self.same_m = name, exact_m, same_m

    def __call__(self, problem, config=DEFAULT, min_matches=MIN_MATCHES):
        return solve_by_name(problem, replace(config, method=self.name), min_matches)


# The fast one solves its normal equations by iteration, and stops by the energy, which is squared.
@pytest.fixture(params=[("gtsam", 1e-9, 1e-9), ("fast", 3e-5, 3e-3)], ids=["gtsam", "fast"])
def solve(request):
    return Solver(*request.param)


def rng(seed: int) -> np.random.Generator:
    return np.random.default_rng(seed)


# --- known worlds ---

@both_frames
def test_clean_matches_give_the_exact_motion(solve, config):
    world = worlds.moved_room(0.8, 5.0, rng(0))
    motions, solved, stats = solve(world.problem, config)
    assert solved.all() and stats.inliers == len(world.wrong)
    assert pose.translation_distance(motions, world.motions).max() < solve.exact_m
    assert pose.rotation_distance(motions, world.motions).max() < max(1e-7, solve.exact_m)


@both_frames
@pytest.mark.parametrize("share", [0.2, 0.3])
def test_wrong_matches_are_let_go(solve, config, share):
    for seed in range(3):
        world = worlds.moved_room(0.8, 5.0, rng(seed), share, noise_m=0.01)
        motions, solved, stats = solve(world.problem, config)
        plain, _, _ = solve(world.problem, replace(config, truncation_m=1e4))
        error_m, plain_error_m = world.error_m(motions), world.error_m(plain)
        assert solved.all() and stats.inliers == (~world.wrong).sum()
        assert error_m.max() < (0.015 if config is DEFAULT else 0.03)
        assert np.median(plain_error_m) > 0.05 and plain_error_m.max() > 10 * error_m.max()


@both_frames
def test_unmatched_points_follow_their_neighbours(solve, config):
    world = worlds.moved_room(0.8, 5.0, rng(1))
    few = rng(2).permutation(len(world.wrong))[:6]
    problem = replace(world.problem, match_index=world.problem.match_index[few],
                      match_target=world.problem.match_target[few])
    motions, solved, _ = solve(problem, config)
    assert solved.all() and world.error_m(motions).max() < 0.01


@both_frames
@pytest.mark.parametrize("share", [0.0, 0.25])
def test_jittered_starts_converge_to_the_same_motions(solve, config, share):
    world = worlds.moved_room(0.5, 3.0, rng(3), share, noise_m=0.02)
    motions, _, _ = solve(world.problem, config)
    for seed in range(4):
        again, _, _ = solve(worlds.jittered(world, rng(10 + seed)).problem, config)
        assert moved_apart_m(motions, again, world.problem.points) < 1e-3


def test_ten_equal_runs_give_the_same_bytes(solve):
    world = worlds.joined(worlds.two_bodies(rng(4), wrong_matches=0.2, noise_m=0.02))
    answers = {solve(world.problem)[0].tobytes() for _ in range(10)}
    assert len(answers) == 1


@both_frames
def test_swapping_the_scans_inverts_the_motion(solve, config):
    world = worlds.moved_room(0.8, 5.0, rng(5), wrong_matches=0.2, noise_m=0.005)
    there, _, _ = solve(world.problem, config)
    back, _, _ = solve(worlds.swapped_world(world).problem, config)
    # Noise parts the two, as the neighbours' twist is weighed elsewhere: by far less than the noise itself.
    assert moved_apart_m(there, pose.inverse(back), world.problem.points) < 2e-3


def test_bodies_do_not_influence_each_other(solve):
    bodies = worlds.two_bodies(rng(6), wrong_matches=0.2, noise_m=0.02)
    together, solved, stats = solve(worlds.joined(bodies).problem)
    alone = [solve(body.problem) for body in bodies]
    assert together.tobytes() == np.concatenate([motions for motions, _, _ in alone]).tobytes()
    assert solved.all() and stats.solved_components == stats.components == 2
    assert stats.inliers == sum(s.inliers for _, _, s in alone)
    assert_allclose(stats.robust_final_error, sum(s.robust_final_error for _, _, s in alone))
    assert worlds.joined(bodies).error_m(together).max() < 0.03


@both_frames
def test_the_order_of_the_input_does_not_matter(solve, config):
    world = worlds.joined(worlds.two_bodies(rng(7), wrong_matches=0.2, noise_m=0.01))
    motions, solved, stats = solve(world.problem, config)
    for seed in range(3):
        other, old = worlds.permuted(world, rng(20 + seed))
        again, again_solved, again_stats = solve(other.problem, config)
        # An edge that turns around is weighed at its other end in the point frame; at the sensor nothing is.
        tolerance_m = max(1e-3, solve.same_m) if config is DEFAULT else solve.same_m
        assert moved_apart_m(again, motions[old], other.problem.points) < tolerance_m
        assert (again_solved == solved[old]).all() and again_stats.inliers == stats.inliers


def test_the_order_of_components_does_not_matter(solve):
    bodies = worlds.two_bodies(rng(8), wrong_matches=0.2, noise_m=0.02)
    motions, _, _ = solve(worlds.joined(bodies).problem)
    again, _, _ = solve(worlds.joined(bodies[::-1]).problem)
    first = len(bodies[0].motions)
    assert np.concatenate([again[-first:], again[:-first]]).tobytes() == motions.tobytes()


def test_the_distance_to_the_sensor_does_not_matter_in_the_point_frame(solve):
    away = pose.from_translation(np.array([40.0, -25.0, 2.0]))
    near_motion = pose.from_yaw(0.05, np.array([0.4, 0.1, 0.0]))
    far_motion = away @ near_motion @ pose.inverse(away)
    near = worlds.body((0.0, 0.0, 0.0), near_motion, rng(21), 0.2, noise_m=0.02)
    far = worlds.body(away[:3, 3], far_motion, rng(21), 0.2, noise_m=0.02)
    start = away @ near.problem.initial @ pose.inverse(away)
    far = replace(far, problem=replace(far.problem, initial=start))
    motions, far_motions = solve(near.problem)[0], solve(far.problem)[0]
    assert moved_apart_m(far_motions, away @ motions @ pose.inverse(away), far.problem.points) < 1e-6
    far_at_sensor, near_at_sensor = solve(far.problem, SENSOR)[0], solve(near.problem, SENSOR)[0]
    apart = moved_apart_m(far_at_sensor, away @ near_at_sensor @ pose.inverse(away), far.problem.points)
    assert apart > 0.02   # the lever arm of eq. 10


# --- components that cannot be solved ---

def test_components_without_evidence_keep_their_start(solve):
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
        motions, solved, stats = solve(world.problem)
        unsolved = len(thing.motions)
        assert (motions[:unsolved] == start).all(), name
        assert not solved[:unsolved].any() and solved[unsolved:].all(), name
        assert world.error_m(motions)[unsolved:].max() < solve.exact_m, name
        assert stats.components == 2 and stats.solved_components == 1, name
        assert sum(stats.stopped.values()) == steps and stats.inliers == len(room.wrong), name


def test_the_least_number_of_matches_is_a_setting(solve):
    world = worlds.without_matches(worlds.moved_room(0.3, 2.0, rng(12)), keep=5)
    assert solve(world.problem, DEFAULT, 5)[1].all()
    assert not solve(world.problem, DEFAULT, 6)[1].any()


@pytest.mark.parametrize("keep", [3, 8])
@pytest.mark.parametrize(("config", "noise_m"), [(DEFAULT, 0.0), (DEFAULT, 0.02), (SENSOR, 0.0)])
def test_collinear_matches_stay_near_their_start(solve, config, noise_m, keep):
    """The turn about the matches' line is free: it must stay small, and what is known must be right.

    With noise this holds for the point frame only: there a turn costs the same at any distance.
    """
    for seed in range(3):
        full = worlds.moved_room(0.3, 0.0, rng(seed), noise_m=noise_m)
        world = worlds.without_matches(full, keep)   # the first points are a vertical line
        motions, solved, _ = solve(world.problem, config)
        problem = world.problem
        assert solved.all() and pose.is_rigid(motions)
        assert world.error_m(motions)[:keep].max() < 0.06
        assert pose.rotation_distance(motions, problem.initial).max() < np.radians(10.0)
        assert moved_apart_m(motions, problem.initial, problem.points) < 0.6


def test_a_point_without_edges_moves_by_its_match_alone(solve):
    world = worlds.moved_room(0.3, 0.0, rng(14))
    lone = replace(world.problem, points=world.problem.points[:1], initial=world.problem.initial[:1],
                   match_index=world.problem.match_index[:1], match_target=world.problem.match_target[:1],
                   edges=np.empty((0, 2), np.int32), component=world.problem.component[:1])
    motions, solved, _ = solve(lone, DEFAULT, 1)
    assert solved.all()
    assert_allclose(motions[0], world.motions[0], atol=max(1e-6, solve.exact_m))


def test_without_the_plain_step_a_near_start_is_kept(solve):
    """Most matches are wrong, all by the same: the plain step follows them, a right start does not."""
    world = worlds.moved_room(0.8, 5.0, rng(21), noise_m=0.005)
    wrong = rng(22).random(len(world.problem.match_index)) < 0.7
    target = world.problem.match_target + np.where(wrong[:, None], [0.0, 0.5, 0.0], 0.0)
    problem = replace(world.problem, match_target=target, initial=world.motions)
    followed, _, both = solve(problem)
    kept, solved, stats = solve(problem, SolverConfig(plain_first=False))
    assert world.error_m(followed).min() > 0.3 and world.error_m(kept).max() < 0.03
    assert solved.all() and stats.inliers == (~wrong).sum() and both.inliers == wrong.sum()
    assert both.plain_iterations > 0 and both.stopped == {"converged": 2}
    assert (stats.plain_iterations, stats.plain_initial_error, stats.plain_final_error) == (0, 0.0, 0.0)
    assert stats.stopped == {"converged": 1} and stats.robust_iterations > 0
    assert_allclose(stats.robust_initial_error, energy(problem, problem.initial, DEFAULT), rtol=1e-9)


# --- what the solver says of itself ---

@both_frames
def test_stats_match_direct_evaluation(solve, config):
    config = replace(config, data_weight=2.0, smoothness_weight=5.0)
    world = worlds.joined(worlds.two_bodies(rng(15), wrong_matches=0.2, noise_m=0.02))
    problem = world.problem
    motions, _, stats = solve(world.problem, config)
    no_kernel = replace(config, truncation_m=1e4)
    plain, _, plain_stats = solve(world.problem, no_kernel)
    assert (stats.solver, stats.variables) == (solve.name, len(problem.points))
    assert stats.matches == len(world.wrong)
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


def test_inliers_are_the_matches_within_the_truncation(solve):
    world = worlds.moved_room(0.4, 2.0, rng(22), noise_m=0.2)   # many matches end just inside or outside
    motions, solved, stats = solve(world.problem)
    off_sq = match_distances_sq(world.problem, motions)
    near = np.abs(np.sqrt(off_sq) - DEFAULT.truncation_m) < 0.1
    assert solved.all() and near.sum() > 20
    assert stats.inliers == (off_sq <= DEFAULT.truncation_m**2).sum()


@both_frames
def test_the_answer_is_a_minimum_of_the_energy(solve, config):
    world = worlds.moved_room(0.4, 2.0, rng(16), wrong_matches=0.2, noise_m=0.02)
    tight = replace(config, relative_tolerance=1e-9)
    motions, _, _ = solve(world.problem, tight)
    problem, at_point = world.problem, pose.from_translation(world.problem.points)
    least = energy(problem, motions, tight)
    assert_allclose(energy(problem, solve(world.problem, config)[0], config), least, rtol=1e-4)
    for seed in range(20):
        twist = rng(30 + seed).normal(scale=1e-4, size=(len(motions), 6))
        nearby = motions @ at_point @ pose.exp(twist) @ pose.inverse(at_point)
        everything_alike = motions @ pose.exp(twist[0])
        assert energy(problem, nearby, tight) > least and energy(problem, everything_alike, tight) > least


def test_the_iteration_limit_is_kept_and_told(solve):
    world = worlds.moved_room(0.8, 5.0, rng(17), wrong_matches=0.3, noise_m=0.02)
    _, _, stats = solve(world.problem, replace(DEFAULT, max_iterations=1))
    assert stats.plain_iterations == 1 and stats.robust_iterations == 1
    assert stats.stopped == {"max_iterations": 2}


@both_frames
def test_empty_problems(solve, config):
    motions, solved, stats = solve(worlds.empty_problem(), config)
    assert motions.shape == (0, 4, 4) and solved.shape == (0,)
    assert (stats.components, stats.solved_components, stats.inliers, stats.stopped) == (0, 0, 0, {})
    unmatched = worlds.without_matches(worlds.moved_room(0.3, 1.0, rng(18)))
    motions, solved, stats = solve(unmatched.problem, config)
    assert (motions == unmatched.problem.initial).all() and not solved.any()
    assert (stats.components, stats.plain_initial_error, stats.stopped) == (1, 0, {})


def test_the_problem_is_left_as_it_was(solve):
    problem = worlds.moved_room(0.3, 1.0, rng(19), wrong_matches=0.2).problem
    before = {name: getattr(problem, name).copy() for name in problem.__slots__}
    solve(problem, DEFAULT)
    for name, array in before.items():
        assert (getattr(problem, name) == array).all(), name


# --- bad numbers ---

@pytest.mark.parametrize("field", ["points", "initial", "match_target", "group_motions"])
def test_numbers_that_are_not_finite_are_an_error(solve, field):
    problem = worlds.moved_room(0.3, 1.0, rng(20)).problem
    tied = replace(problem, group=np.zeros(len(problem.points), np.int32), group_motions=pose.identity(1))
    broken = getattr(tied, field).copy()
    broken[0, 0] = np.nan
    with pytest.raises(SolveError, match=f"FlowProblem.{field}.*finite"):
        solve(replace(tied, **{field: broken}))


@pytest.mark.parametrize("changes, message", [
    ({"component": np.array([0, -1, 1], np.int32)}, "component: expected numbers from 0 on"),
    ({"component": np.array([0, 1, 1], np.int32)}, "edges: expected both ends of an edge in one component"),
    ({"edges": np.array([[1, 0]], np.int32)}, "edges: expected i < j"),
    ({"edges": np.array([[0, 3]], np.int32)}, "edges: indices must lie in 0..2"),
    ({"match_index": np.array([1, 1], np.int32), "match_target": np.zeros((2, 3))}, "more than one match")])
def test_what_would_lead_out_of_the_arrays_is_an_error(changes, message):
    problem = FlowProblem(np.zeros((3, 3)), pose.identity(3), np.array([1], np.int32), np.zeros((1, 3)),
                          np.array([[0, 2]], np.int32), np.array([0, 1, 0], np.int32))
    with pytest.raises(ValueError, match=message):
        replace(problem, **changes)
