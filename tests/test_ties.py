"""Variables tied to the motion of their group: the world, or an object."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
import worlds

from lidarflow import pose
from lidarflow.config import SolverConfig
from lidarflow.solve import gtsam_lm, solve
from lidarflow.types import FlowProblem

CONFIG = SolverConfig()
both_solvers = pytest.mark.parametrize("config", [
    SolverConfig(method="gtsam"), SolverConfig(method="fast")], ids=["gtsam", "fast"])
WORLD = pose.exp(np.array([0.01, -0.02, 0.03, -0.7, 0.1, 0.02]))


def rng(seed: int) -> np.random.Generator:
    return np.random.default_rng(seed)


def tied(problem: FlowProblem, group: np.ndarray, *motions: np.ndarray) -> FlowProblem:
    return replace(problem, group=group.astype(np.int32), group_motions=np.stack(motions))


def test_the_tie_is_the_twist_from_the_group_to_the_point():
    """Its error is ½ w ‖Ad(Trans(p))⁻¹ Log(G⁻¹ τ)‖², and constant beyond the truncation."""
    point = np.array([20.0, -5.0, 1.0])
    motion = WORLD @ pose.exp(np.array([0.0, 0.002, 0.0, 0.02, 0.01, 0.0]))
    problem = FlowProblem(
        points=point[None], initial=motion[None], match_index=np.zeros(1, np.int32), match_target=point[None],
        edges=np.empty((0, 2), np.int32), component=np.zeros(1, np.int32), group=np.zeros(1, np.int32),
        group_motions=WORLD[None])
    part, = gtsam_lm._components(problem)
    values = gtsam_lm._values(part.initial, part.points)
    twist = pose.log(pose.inverse(WORLD) @ motion)
    at_point = np.linalg.solve(pose.adjoint(pose.from_translation(point)), twist)
    error = gtsam_lm._tie_factors(part, gtsam_lm._tie_noise(CONFIG)).error(values)
    assert error == pytest.approx(0.5 * CONFIG.tie_weight * at_point @ at_point, rel=1e-6)
    far = gtsam_lm._values(part.initial @ pose.from_translation([3.0, 0, 0]), part.points)
    truncated = gtsam_lm._tie_factors(part, gtsam_lm._robust_tie_noise(CONFIG)).error(far)
    assert truncated == pytest.approx(0.5 * CONFIG.tie_weight * CONFIG.tie_truncation**2)
    assert isinstance(gtsam_lm._robust_tie_noise(CONFIG), gtsam.noiseModel.Robust)


@both_solvers
def test_noisy_matches_hardly_move_what_is_tied_to_the_world(config):
    world = worlds.body((15.0, 3.0, 0.0), WORLD, rng(1), wrong_matches=0.3, noise_m=0.1)
    free, _, _ = solve(world.problem, config, 3)
    held, solved, stats = solve(tied(world.problem, np.zeros(len(free)), WORLD), config, 3)
    assert solved.all() and stats.solved_components == 1
    assert world.error_m(held).max() < 0.01
    assert world.error_m(held).mean() < 0.5 * world.error_m(free).mean()


@both_solvers
def test_a_group_of_minus_one_is_free(config):
    world = worlds.body((15.0, 3.0, 0.0), WORLD, rng(2), wrong_matches=0.1, noise_m=0.02)
    free, _, _ = solve(world.problem, config, 3)
    same, _, _ = solve(tied(world.problem, np.full(len(free), -1), np.eye(4)), config, 3)
    assert free.tobytes() == same.tobytes()


@both_solvers
def test_two_groups_on_one_mesh_keep_their_own_motions(config):
    """A foot on the kerb: the mesh joins them, the ties hold them apart."""
    world = worlds.body((10.0, 0.0, 0.0), WORLD, rng(3))
    points = world.problem.points
    on_object = points[:, 1] > np.median(points[:, 1])
    car = WORLD @ pose.from_translation([0.6, 0.0, 0.0])
    truth = np.where(on_object[:, None, None], car, WORLD)
    problem = replace(world.problem, match_target=pose.apply(truth, points), initial=truth)
    problem = tied(problem, on_object, WORLD, car)
    motions, _, _ = solve(problem, config, 3)
    off_m = np.linalg.norm(pose.apply(motions, points) - pose.apply(truth, points), axis=1)
    assert np.median(off_m) < 0.02 and off_m.max() < 0.2


@pytest.mark.parametrize("group, message", [
    (np.zeros(3, np.int32), "expected shape"), (np.full(128, 2, np.int32), "there are 1 group motions")])
def test_groups_are_checked_at_the_door(group, message):
    problem = worlds.body((10.0, 0.0, 0.0), WORLD, rng(4)).problem
    with pytest.raises(ValueError, match=message):
        replace(problem, group=group, group_motions=WORLD[None])
