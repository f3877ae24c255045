"""The fast solver: its energy, gradient and normal equations, and how well it agrees with gtsam's."""

import subprocess
import sys
from dataclasses import replace

import gtsam
import numpy as np
import pytest
import worlds
from energies import energy
from numpy.testing import assert_allclose
from shared_data import ROOT, SHARED, needs_shared, with_paths

from lidarflow import config as settings
from lidarflow import pipeline, pose
from lidarflow.config import SolverConfig
from lidarflow.datasets import open_dataset
from lidarflow.kernels import parts, pose_graph, twist_errors
from lidarflow.solve import fast, gtsam_lm
from lidarflow.types import ScanPair

MIN_MATCHES = 3
POINT = SolverConfig(data_weight=2.0, smoothness_weight=5.0)
SENSOR = replace(POINT, smoothness_frame="sensor")
both_frames = pytest.mark.parametrize("config", [POINT, SENSOR], ids=["point", "sensor"])


def rng(seed: int) -> np.random.Generator:
    return np.random.default_rng(seed)


def tied_world(seed: int, shift_m: float = 0.1, turn_deg: float = 2.0) -> worlds.World:
    """A room with wrong matches whose variables start apart; half of them tied, a few of these to far off."""
    world = worlds.moved_room(0.4, 2.0, rng(seed), wrong_matches=0.2, noise_m=0.02)
    world = worlds.jittered(world, rng(seed + 1), shift_m, turn_deg)
    count = len(world.motions)
    group = np.where(np.arange(count) % 2, 0, -1).astype(np.int32)
    group[:9:2] = 1
    ties = np.stack([world.motions[0], world.motions[0] @ pose.from_translation([1.0, 0.0, 0.0])])
    return replace(world, problem=replace(world.problem, group=group, group_motions=ties))


def linearised(problem, config: SolverConfig, robust: bool):
    """Energy and gradient (M, 6) at the start of a problem of one component, its factors and variables."""
    count = len(problem.points)
    edges = problem.edges[np.lexsort(problem.edges.T[::-1])]
    factors = pose_graph.factors_of(
        fast.graph_of(problem), fast.weights_of(config), np.arange(count, dtype=np.int32), edges)
    variables = pose_graph.variables_of(problem.initial, np.arange(count), problem.points)
    found, gradient = evaluated(factors, variables, robust)
    return found, gradient, factors, variables


def evaluated(factors, variables, robust: bool):
    """Energy and gradient (M, 6) of variables (M, 7)."""
    count = len(variables)
    gradient, active = np.empty((count, 6)), np.empty(count, np.uint8)
    block = twist_errors.room()
    smooth = pose_graph.smoothness(factors, variables, block, gradient)
    return smooth + pose_graph.evidence(factors, variables, robust, block, gradient, active), gradient


# --- energy and derivatives ---

@both_frames
@pytest.mark.parametrize("robust", [False, True], ids=["plain", "robust"])
@pytest.mark.parametrize(("shift_m", "turn_deg"), [(0.0, 0.0), (0.02, 0.5), (0.3, 40.0)])
def test_the_energy_is_that_of_gtsams_graph(config, robust, shift_m, turn_deg):
    problem = tied_world(0, shift_m, turn_deg).problem
    part, = gtsam_lm._components(problem)
    noises = ((gtsam_lm._robust_data_noise, gtsam_lm._robust_tie_noise) if robust
              else (gtsam_lm._data_noise, gtsam_lm._tie_noise))
    graph = gtsam.NonlinearFactorGraph(gtsam_lm._smoothness_factors(part, config))
    graph.push_back(gtsam_lm._data_factors(part, noises[0](config)))
    graph.push_back(gtsam_lm._tie_factors(part, noises[1](config)))
    found, _, _, _ = linearised(problem, config, robust)
    assert_allclose(found, graph.error(gtsam_lm._values(part.initial, part.points)), rtol=1e-10)


@both_frames
@pytest.mark.parametrize("robust", [False, True], ids=["plain", "robust"])
@pytest.mark.parametrize(("shift_m", "turn_deg"), [(0.02, 0.5), (0.2, 40.0)])
def test_the_gradient_is_the_numerical_one(config, robust, shift_m, turn_deg):
    _, gradient, factors, variables = linearised(tied_world(2, shift_m, turn_deg).problem, config, robust)
    count = len(variables)
    for seed in range(8):
        twists = rng(seed).normal(size=(count, 6)) * [1.0, 1.0, 1.0, 0.3, 0.3, 0.3]
        if seed < 4:
            twists[rng(seed).permutation(count)[1:]] = 0.0
        ends = []
        for size in (1e-6, -1e-6):
            moved = np.empty_like(variables)
            pose_graph.step(variables, size * twists, moved)
            ends.append(evaluated(factors, moved, robust)[0])
        assert_allclose((gradient * twists).sum(), (ends[0] - ends[1]) / 2e-6, rtol=1e-4, atol=1e-4)


@both_frames
def test_a_twist_that_all_share_costs_no_smoothness(config):
    problem = tied_world(3, 0.3, 40.0).problem
    _, gradient, _, _ = linearised(
        replace(problem, group=np.empty(0, np.int32), match_index=problem.match_index[:0],
                match_target=problem.match_target[:0]), config, False)
    assert np.abs(gradient).max() > 1.0
    assert_allclose(gradient.sum(axis=0), 0.0, atol=1e-9)


def test_variables_give_back_the_motions():
    random = rng(5)
    points = random.normal(scale=30, size=(40, 3))
    twists = random.normal(size=(40, 6))
    twists[:12, :3] = np.pi * np.repeat(np.vstack([np.eye(3), -np.eye(3)]), 2, axis=0)   # half turns
    motions = pose.exp(twists)
    back = np.tile(np.eye(4), (40, 1, 1))
    variables = pose_graph.variables_of(motions, np.arange(40), points)
    pose_graph.motions_of(variables, points, np.arange(40), back)
    assert_allclose(back, motions, atol=1e-11)


def test_edges_are_between_places_and_sorted():
    edges = np.array([[0, 5], [1, 2], [0, 3], [1, 7], [2, 7]], np.int32)
    place = np.array([2, 0, 1, 4, -1, 3, -1, 2], np.int32)
    assert pose_graph.edges_between(edges, place, 5).tolist() == [[0, 1], [0, 2], [1, 2], [2, 3], [2, 4]]


def test_wanted_components_are_split_from_each_other():
    random = rng(6)
    component = random.integers(0, 7, 60).astype(np.int32)
    pairs = np.stack(np.triu_indices(60, 1), axis=1).astype(np.int32)
    edges = random.permutation(pairs[component[pairs[:, 0]] == component[pairs[:, 1]]])
    wanted = np.array([True, False, True, True, False, True, True, True])    # the last has no variables
    found = parts.split(component, edges, wanted)
    for c, label in enumerate(np.flatnonzero(wanted)):
        rows = found.rows[found.bounds[c]:found.bounds[c + 1]]
        assert (rows == np.flatnonzero(component == label)).all()
        assert (found.place[rows] == np.arange(len(rows))).all()
        between = found.edges[found.edge_bounds[c]:found.edge_bounds[c + 1]]
        assert (between == edges[component[edges[:, 0]] == label]).all()
    assert found.bounds[-1] == wanted[component].sum() and found.edge_bounds[-1] == len(found.edges)


@both_frames
def test_levers_follow_variables_that_have_moved_far(config):
    """To the point itself, or to where the sensor would be if it moved with the point."""
    problem = tied_world(4, 0.3, 20.0).problem
    _, _, factors, variables = linearised(problem, config, False)
    expected = pose.apply(problem.initial, problem.points if config is POINT else np.zeros((1, 3)))
    levers = np.full_like(expected, np.inf)
    assert pose_graph.place_levers(factors, variables, 0.05, levers)
    assert_allclose(levers, expected, atol=1e-9)
    variables[7, 4:] += [0.0, 0.04, 0.0]
    assert not pose_graph.place_levers(factors, variables, 0.05, levers)
    assert_allclose(levers, expected, atol=1e-9)
    assert pose_graph.place_levers(factors, variables, 0.03, levers)
    assert_allclose(levers[7], expected[7] + [0.0, 0.04, 0.0], atol=1e-9)


# --- agreement with gtsam ---

def assert_agreement(problem, config, min_matches=MIN_MATCHES, flow_rms_m=5e-3):
    """Energy at most 0.1 % above gtsam's, the same components solved, and the flow within `flow_rms_m`."""
    motions, solved, stats = gtsam_lm.solve(problem, config, min_matches)
    found, found_solved, found_stats = fast.solve(problem, config, min_matches)
    assert found_stats.robust_final_error <= 1.001 * stats.robust_final_error
    assert (found_solved == solved).all() and pose.is_rigid(found)
    apart = pose.apply(found, problem.points) - pose.apply(motions, problem.points)
    assert np.sqrt((apart**2).sum(axis=1).mean()) < flow_rms_m
    return found, found_stats


@both_frames
@pytest.mark.parametrize("wrong_matches", [0.0, 0.25])
@pytest.mark.parametrize("turn_deg", [1.0, 8.0])
def test_free_bodies_agree_with_gtsam(config, wrong_matches, turn_deg):
    for seed in range(3):
        bodies = [worlds.moved_room(0.6, turn_deg, rng(seed), wrong_matches, noise_m=0.03),
                  *worlds.two_bodies(rng(10 + seed), wrong_matches, noise_m=0.03)]
        problem = worlds.joined(bodies).problem
        found, stats = assert_agreement(problem, config)
        assert_allclose(stats.robust_final_error, energy(problem, found, config), rtol=1e-9)


@both_frames
def test_large_bodies_agree_with_gtsam(config):
    """Large enough for four levels, few of the points matched."""
    motion = pose.from_yaw(0.03, np.array([0.7, 0.1, 0.02]))
    world = worlds.body((14.0, 3.0, 1.0), motion, rng(6), 0.15, noise_m=0.05, columns=60, rows=30)
    few = np.sort(rng(7).permutation(1800)[:300])
    problem = replace(world.problem, match_index=world.problem.match_index[few],
                      match_target=world.problem.match_target[few])
    assert_agreement(problem, config)


@both_frames
@pytest.mark.parametrize("plain_first", [True, False])
def test_tied_bodies_agree_with_gtsam(config, plain_first):
    for seed in range(3):
        assert_agreement(tied_world(20 + seed).problem, replace(config, plain_first=plain_first))


@needs_shared
@pytest.mark.slow
@pytest.mark.parametrize("folder", ["kitti_tracked_0005_from_000", "kitti_raw_0048", "argoverse2"])
def test_scans_agree_with_gtsam(folder, monkeypatch):
    config, seen = settings.Config(), []
    dataset = open_dataset(SHARED / folder)

    def remember(problem, solver, min_matches):
        seen.append((problem, solver, min_matches))
        return gtsam_lm.solve(problem, solver, min_matches)

    monkeypatch.setattr(pipeline, "solve", remember)
    pipeline.estimate_flow(ScanPair(dataset.scan(0), dataset.scan(1)), config)
    # The others refine, to no more than a percent.
    (problem, solver, min_matches), = [given for given in seen if given[1] == config.solver]
    assert len(problem.points) > 1000 and len(problem.group)
    assert_agreement(problem, solver, min_matches)


# --- several minima ---

def tried_twice_and_once(problem, config, min_matches: int, monkeypatch) -> list[tuple]:
    """Answers with second tries of all components, which are small, and without."""
    answers = [fast.solve(problem, config, min_matches)]
    monkeypatch.setattr(fast, "_SMALL", 0)
    return [*answers, fast.solve(problem, config, min_matches)]


def astray(count: int, wrong_matches: float, noise_m: float):
    """Bodies that hardly move, most matches of which are wrong: without truncation these lead them astray."""
    motion = pose.from_translation([0.1, 0.0, 0.0])
    return worlds.joined([
        worlds.body((8.0, 2.0, 0.5), motion, rng(seed), wrong_matches, noise_m, 6, 4)
        for seed in range(count)]).problem


@both_frames
def test_a_second_try_leaves_a_high_minimum(config, monkeypatch):
    problem = astray(12, 0.7, 0.02)
    (second, solved, stats), (first, solved_first, stats_first) = tried_twice_and_once(
        problem, config, MIN_MATCHES, monkeypatch)
    assert_allclose(stats.robust_final_error, energy(problem, second, config), rtol=1e-9)
    assert stats.robust_final_error < 0.97 * stats_first.robust_final_error
    assert (solved >= solved_first).all()
    for c in range(12):
        rows = np.flatnonzero(problem.component == c)
        found, before = (
            energy(problem.part(rows, motions[rows]), motions[rows], config) for motions in (second, first))
        same = (second[rows] == first[rows]).all()
        assert same or found < 0.99 * before


@pytest.mark.parametrize("min_matches", [3, 6, 9, 12])
def test_a_second_try_loses_no_component(min_matches, monkeypatch):
    """What is lowest with too few matches is not taken: it would not count as solved."""
    (_, solved, _), (_, solved_first, _) = tried_twice_and_once(
        astray(30, 0.6, 0.1), POINT, min_matches, monkeypatch)
    assert (solved >= solved_first).all()


def test_near_matches_are_counted():
    world = worlds.moved_room(0.4, 2.0, rng(4), wrong_matches=0.2, noise_m=0.02)
    problem = replace(world.problem, initial=world.motions, match_index=world.problem.match_index[::2],
                      match_target=world.problem.match_target[::2])
    _, _, factors, variables = linearised(problem, POINT, True)
    off_m = pose.apply(problem.initial[problem.match_index], problem.points[problem.match_index])
    near = ((off_m - problem.match_target) ** 2).sum(axis=1) <= POINT.truncation_m**2
    assert 0 < near.sum() < len(near)
    counts = pose_graph.near_matches(factors, variables)
    assert counts == (near.sum(), len(near))


# --- the same bytes ---

ANSWER = """
import hashlib, sys
import numpy as np
import worlds
from lidarflow.config import SolverConfig
from lidarflow.solve import fast
bodies = [w for seed in range(6) for w in worlds.two_bodies(np.random.default_rng(seed), 0.2, 0.05)]
digest = hashlib.sha256()
for frame in ("point", "sensor"):
    motions, _, stats = fast.solve(worlds.joined(bodies).problem, SolverConfig(smoothness_frame=frame), 3)
    digest.update(motions.tobytes() + repr(stats).encode())
print(digest.hexdigest())
"""


def answer(threads: int, **environment: str) -> str:
    """Digest of what a process of its own finds with so many threads."""
    done = subprocess.run(
        [sys.executable, "-c", ANSWER], check=True, capture_output=True, text=True,
        env={**with_paths(ROOT / "tests"), "NUMBA_NUM_THREADS": str(threads), **environment})
    return done.stdout


def test_the_number_of_threads_does_not_matter():
    assert answer(1) == answer(2) == answer(3)


@pytest.mark.slow
def test_fresh_code_gives_what_cached_code_gives(tmp_path):
    fresh = answer(1, NUMBA_CACHE_DIR=str(tmp_path))
    assert any(tmp_path.rglob("*.nbc"))
    assert fresh == answer(1, NUMBA_CACHE_DIR=str(tmp_path)) == answer(1)


INTERPRETED = """
import sys
import numpy as np
from lidarflow.solve import fast
from test_fast_solver import POINT, astray
motions, _, stats = fast.solve(astray(2, 0.4, 0.05), POINT, 3)
np.save(sys.argv[1], np.append(motions.ravel(), stats.robust_final_error))
"""


def test_the_solver_is_plain_python_underneath(tmp_path):
    file = tmp_path / "answer.npy"
    subprocess.run(
        [sys.executable, "-c", INTERPRETED, str(file)], check=True, capture_output=True, text=True,
        env={**with_paths(ROOT / "tests"), "NUMBA_DISABLE_JIT": "1"})
    motions, _, stats = fast.solve(astray(2, 0.4, 0.05), POINT, 3)
    assert_allclose(np.load(file), np.append(motions.ravel(), stats.robust_final_error), atol=1e-8)
