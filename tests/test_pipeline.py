"""The whole method: scans in, flow out, on generated scenes and on real recordings with known motion."""

from dataclasses import replace

import numpy as np
import pytest
import worlds
from numpy.testing import assert_allclose
from scipy.spatial import KDTree
from shared_data import SHARED, needs_shared

from lidarflow import aside, pipeline, pose, synthetic
from lidarflow.config import Config, EgoConfig, ObjectsConfig, PreparationConfig, load
from lidarflow.datasets import open_dataset
from lidarflow.datasets.clouds import read_points
from lidarflow.errors import DataError, LidarflowError
from lidarflow.lidar import ego, frontend, odometry, registration, start
from lidarflow.pipeline import FlowEstimator, estimate_flow
from lidarflow.types import FlowResult, Scan, ScanPair, Truth

# The factor graph by itself, over all points, as in the paper; tests/test_objects.py tests the defaults.
GRAPH_ALONE = replace(Config(), objects=ObjectsConfig(enabled=False))
SENSOR = synthetic.hdl64e(columns=900)
COARSE = synthetic.hdl64e(columns=450)


def rng(seed: int) -> np.random.Generator:
    return np.random.default_rng(seed)


def pair_of(scene, sensor, seed: int) -> tuple[ScanPair, Truth]:
    (source, truth), (target, _) = synthetic.scan_sequence(scene, sensor, 2, rng(seed))
    return ScanPair(source, target), truth


def flow_error_m(result: FlowResult, truth: Truth) -> np.ndarray:
    return np.linalg.norm(result.flow - truth.flow, axis=1)


def assert_same_motion(found: np.ndarray, known: np.ndarray, limit_m: float, limit_deg: float) -> None:
    assert pose.translation_distance(found, known) <= limit_m
    assert np.degrees(pose.rotation_distance(found, known)) <= limit_deg


def assert_valid(pair: ScanPair, result: FlowResult) -> None:
    """What holds for every result: shapes, rigid motions, flow = τ p − p, masks inside one another."""
    points = pair.source.points
    finite = np.isfinite(points).all(axis=1)
    assert len(result.flow) == len(points) and pose.is_rigid(result.motions)
    assert_allclose(result.flow[finite], (pose.apply(result.motions, points) - points)[finite], atol=1e-12)
    assert np.isnan(result.flow[~finite]).all()
    assert not (result.is_dynamic & ~(result.in_graph & result.valid)).any()
    outside = ~result.in_graph
    assert (result.motions[outside] == result.ego_motion).all()


# --- generated scenes ---

@pytest.fixture(scope="module")
def car():
    """One moving car: pair, truth, result."""
    pair, truth = pair_of(synthetic.one_car(8.0, rng(0)), SENSOR, 1)
    return pair, truth, estimate_flow(pair, GRAPH_ALONE)


def test_the_motion_of_one_car_is_found(car):
    pair, truth, result = car
    assert_valid(pair, result)
    assert_same_motion(result.ego_motion, truth.ego_motion, 0.03, 0.1)
    error_m = flow_error_m(result, truth)
    moves = truth.is_dynamic
    assert moves.sum() > 500
    assert np.median(error_m[moves]) <= 0.10
    assert result.is_dynamic[moves].mean() >= 0.70
    static_graph = result.in_graph & result.valid & ~moves
    assert static_graph.sum() > 5000
    assert error_m[static_graph].mean() <= 0.10
    assert result.is_dynamic[static_graph].mean() <= 0.02


def test_a_thing_that_the_next_scan_hides_is_neither_solved_nor_valid():
    """What is near and small is refined; with nothing of it in reach, nothing says that it stood still."""
    scans = synthetic.scan_sequence(synthetic.room(rng(3)), synthetic.hdl64e(400), 2, rng(4))
    pair, config = ScanPair(scans[0][0], scans[1][0]), Config()
    with aside.Aside() as beside:
        prepared = pipeline.prepare(pair, config, beside)
        scene = prepared.scene.result()
        component = scene.graph.problem.component
        thing = scene.graph.rows[component == np.bincount(component[scene.wanted]).argmax()]
        shown, _ = pipeline.explain(prepared, config, beside)
    there = pose.apply(shown.ego_motion, pair.source.points[thing])
    gone = KDTree(there).query(pair.target.points)[0] < 1.0
    hidden = estimate_flow(
        ScanPair(pair.source, Scan(np.where(gone[:, None], np.nan, pair.target.points))), config)
    assert len(thing) > 50 and shown.in_graph[thing].all() and shown.valid[thing].all()
    assert not hidden.in_graph[thing].any() and not hidden.valid[thing].any()
    assert np.isnan(hidden.std_m[thing]).all()


def test_thinning_the_graph_loses_neither_matches_nor_points(car):
    pair, truth, whole = car
    thinned = estimate_flow(pair, load(overrides=("objects.enabled=false", "graph.thinning_m=0.2")))
    assert thinned.stats.variables < 0.6 * whole.stats.variables
    assert thinned.stats.matches > 0.5 * whole.stats.matches
    solved, of_whole = thinned.in_graph & thinned.valid, whole.in_graph & whole.valid
    assert solved.sum() > 0.9 * of_whole.sum() and np.isfinite(thinned.std_m[solved]).all()
    error_m = flow_error_m(thinned, truth)
    assert np.median(error_m[truth.is_dynamic]) <= 0.12
    assert error_m[solved & ~truth.is_dynamic].mean() <= 0.10


def test_explaining_a_prepared_pair_twice_gives_the_same(car):
    pair, _, _ = car
    config = Config()
    with aside.Aside() as beside:
        prepared = pipeline.prepare(pair, config, beside)
        first, _ = pipeline.explain(prepared, config, beside)
        second, _ = pipeline.explain(prepared, load(overrides=("objects.min_speed_m_per_s=50",)), beside)
        third, _ = pipeline.explain(prepared, config, beside)
    assert first.is_dynamic.any() and not second.is_dynamic.any()
    assert (second.motions[~second.in_graph] == second.ego_motion).all()
    np.testing.assert_array_equal(first.motions, third.motions)


def test_residual_flow_is_the_car_and_nothing_else(car):
    pair, truth, result = car
    residual_m = np.linalg.norm(result.residual_flow(pair.source.points), axis=1)
    true_m = np.linalg.norm(truth.flow - (pose.apply(truth.ego_motion, pair.source.points)
                                          - pair.source.points), axis=1)
    assert_allclose(np.median(residual_m[result.is_dynamic]), np.median(true_m[truth.is_dynamic]), atol=0.08)
    assert np.median(residual_m[result.in_graph & ~truth.is_dynamic]) < 0.05


def test_matches_and_stats_are_those_of_the_graph(car):
    pair, _, result = car
    stats = result.stats
    assert stats.variables >= result.in_graph.sum() > 0.9 * stats.variables
    assert len(result.match_source) == len(result.match_target) == stats.matches > stats.inliers > 500
    source = {row.tobytes() for row in pair.source.points[result.in_graph]}
    assert sum(row.tobytes() in source for row in result.match_source) >= stats.inliers
    target = {row.tobytes() for row in pair.target.points}
    assert all(row.tobytes() in target for row in result.match_target)
    assert stats.plain_final_error < stats.plain_initial_error
    assert stats.robust_final_error <= stats.robust_initial_error
    stages = {"features", "ego-motion", "mesh", "graph", "matching", "objects", "solver", "refinement",
              "dense answer"}
    assert stages == set(result.seconds)


def test_nan_rows_stay_where_they_are(car):
    pair, _, result = car
    before = np.unique(rng(2).integers(0, len(pair.source), 200))
    target_before = np.unique(rng(3).integers(0, len(pair.target), 200))
    holed = ScanPair(worlds.with_nan_rows(pair.source, before),
                     worlds.with_nan_rows(pair.target, target_before))
    again = estimate_flow(holed, GRAPH_ALONE)
    assert_valid(holed, again)
    is_hole = np.isnan(holed.source.points).all(axis=1)
    assert is_hole.sum() == len(before)
    assert np.isnan(again.flow[is_hole]).all()
    assert not (again.valid | again.in_graph | again.is_dynamic)[is_hole].any()
    assert (again.in_graph[~is_hole] == result.in_graph).mean() > 0.99
    assert (again.is_dynamic[~is_hole] == result.is_dynamic).mean() > 0.995
    off_m = np.linalg.norm(again.flow[~is_hole] - result.flow, axis=1)
    assert np.quantile(off_m, 0.98) < 0.01


@pytest.mark.slow
def test_nothing_moves_in_a_room():
    pair, truth = pair_of(synthetic.room(rng(0)), synthetic.hdl64e(columns=700), 1)
    result = estimate_flow(pair, GRAPH_ALONE)
    assert_valid(pair, result)
    assert_same_motion(result.ego_motion, truth.ego_motion, 0.03, 0.1)
    graph = result.in_graph & result.valid
    assert graph.mean() > 0.4
    assert result.is_dynamic[graph].mean() <= 0.01
    assert flow_error_m(result, truth)[graph].mean() <= 0.10


@pytest.mark.slow
def test_the_street_moves_where_it_should():
    pair, truth = pair_of(synthetic.street(rng(0)), SENSOR, 1)
    result = estimate_flow(pair, GRAPH_ALONE)
    assert_valid(pair, result)
    assert_same_motion(result.ego_motion, truth.ego_motion, 0.03, 0.1)
    error_m, graph, moves = flow_error_m(result, truth), result.in_graph & result.valid, truth.is_dynamic
    assert np.median(error_m[moves]) <= 0.10
    assert error_m[graph & ~moves].mean() <= 0.10
    assert result.is_dynamic[moves].mean() >= 0.70
    assert result.is_dynamic[~moves].mean() <= 0.02


@pytest.mark.parametrize("how", ["rounded", "target twice", "each point twice"])
def test_points_that_coincide_are_no_trouble(how):
    """Clouds on a grid of 5 cm, merged ones, two returns a beam: triangles without an area come of them."""
    pair, truth = pair_of(synthetic.street(rng(0)), COARSE, 1)
    source, target = pair.source.points, pair.target.points
    if how == "rounded":
        source, target = np.round(source / 0.05) * 0.05, np.round(target / 0.05) * 0.05
    elif how == "target twice":
        target = np.concatenate([target, target])
    else:
        source, target = np.repeat(source, 2, axis=0), np.repeat(target, 2, axis=0)
    result = estimate_flow(ScanPair(Scan(source), Scan(target, pair.target.time_ns)))
    rows = np.arange(len(truth.flow)) * len(source) // len(truth.flow)
    error_m = np.linalg.norm(result.flow[rows] - truth.flow, axis=1)
    assert result.is_dynamic[rows][truth.is_dynamic].mean() > 0.7
    assert np.median(error_m[truth.is_dynamic]) < 0.1 and error_m[~truth.is_dynamic].mean() < 0.03


@pytest.mark.parametrize("step_m", [0.02, 0.05])
def test_rounded_rings_on_an_open_road_are_no_surfaces_that_travel_with_the_sensor(step_m):
    pair, truth = pair_of(synthetic.one_car(8.0, rng(0)), SENSOR, 1)
    scans = [np.round(scan.points / step_m) * step_m for scan in (pair.source, pair.target)]
    found = ego.register(*(ego.Thinned.of(points, Config()) for points in scans))
    assert_same_motion(found, truth.ego_motion, 0.03, 0.1)


@pytest.mark.parametrize("seed", [4, 6, 7])
def test_the_sensor_does_not_seem_to_rest_where_little_but_a_road_and_a_car_beside_it_is_seen(seed):
    scans = synthetic.scan_sequence(synthetic.one_car(4.0, rng(seed)), synthetic.hdl32e(), 4, rng(0))
    thinned, last = [ego.Thinned.of_scan(scan, Config()) for scan, _ in scans], None
    for source, target, (_, truth) in zip(thinned, thinned[1:], scans, strict=False):
        last = ego.find(source, target, last, Config().ego)
        assert_same_motion(last, truth.ego_motion, 0.05, 0.1)
        assert_same_motion(ego.register(source, target), truth.ego_motion, 0.05, 0.1)


def test_identical_scans_do_not_flow():
    pair, _ = pair_of(synthetic.one_car(8.0, rng(1)), COARSE, 2)
    same = ScanPair(pair.source, Scan(pair.source.points.copy(), 100_000_000, "again"))
    result = estimate_flow(same, GRAPH_ALONE)
    assert_valid(same, result)
    assert result.in_graph.sum() > 3000
    assert np.linalg.norm(result.flow, axis=1).max() <= 0.01
    assert not result.is_dynamic.any()


def test_swapping_the_scans_inverts_the_motion(car):
    pair, _, there = car
    back = estimate_flow(worlds.swap(pair), GRAPH_ALONE)
    assert_same_motion(there.ego_motion, pose.inverse(back.ego_motion), 0.03, 0.1)
    there_m = np.median(there.residual_flow(pair.source.points)[there.is_dynamic], axis=0)
    back_m = np.median(back.residual_flow(pair.target.points)[back.is_dynamic], axis=0)
    assert np.linalg.norm(there_m) > 0.5
    assert_allclose(there_m, -back_m, atol=0.1)


# --- sequences ---

@pytest.fixture(scope="module")
def drive():
    """Three scans of the moving car, where it is, and a run with the start values each pair was given."""
    sequence = synthetic.scan_sequence(synthetic.one_car(8.0, rng(2)), COARSE, 3, rng(3))
    scans = [scan for scan, _ in sequence]
    return scans, [truth.is_dynamic for _, truth in sequence[:2]], *_estimated(scans)


def _estimated(scans: list[Scan], registered: list[np.ndarray] | None = None):
    """Results and start values of a run over `scans`; `registered` replaces the results of registration."""
    starts, started = [], frontend.started

    def recorded(graph, start_at):
        begun = started(graph, start_at)
        starts.append(np.full((len(graph.variable), 4, 4), np.nan))
        starts[-1][graph.rows] = begun.problem.initial
        return begun

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(frontend, "started", recorded)
        if registered is not None:
            given = iter(registered)
            patch.setattr(ego, "register", lambda *args: next(given))
        estimator = FlowEstimator(GRAPH_ALONE)
        return [estimator.step(scan) for scan in scans], starts


def test_motions_are_carried_to_where_their_points_went(drive):
    scans, moves, results, starts = drive
    first, second = results[1:]
    assert results[0] is None
    assert (starts[0][first.in_graph] == first.ego_motion).all()
    moved, known = scans[0].points + first.flow, first.in_graph & first.valid
    carried = start.carried(moved, scans[0].points, first, 0.1, second.ego_motion, 0.1)
    assert moved[known].shape == np.unique(moved[known], axis=0).shape   # so that the nearest is itself
    assert (carried[known] == first.motions[known]).all()
    far_away = start.carried(
        moved[known] + [0.0, 0.0, 50.0], scans[0].points, first, 0.1, second.ego_motion, 0.3)
    assert (far_away == second.ego_motion).all()
    again = start.carried(scans[1].points, scans[0].points, first, 0.1, second.ego_motion, 0.1)
    assert (starts[1] == again)[second.in_graph].all()
    on_car = moves[1] & second.in_graph & second.valid
    begun_m = np.linalg.norm(pose.apply(starts[1][on_car], scans[1].points[on_car])
                             - scans[1].points[on_car] - second.flow[on_car], axis=1)
    by_ego_m = np.linalg.norm(second.residual_flow(scans[1].points)[on_car], axis=1)
    assert on_car.sum() > 100 and np.median(begun_m) < 0.2 < 0.5 < np.median(by_ego_m)


def test_carried_motions_go_on_for_as_long_as_the_pair_takes(drive):
    scans, moves, (_, first, second), _ = drive
    longer = start.carried(scans[1].points, scans[0].points, first, 0.1, second.ego_motion, 0.3)
    once = start.carried(scans[1].points, scans[0].points, first, 0.1, second.ego_motion, 0.1)
    carried = (once != second.ego_motion).any(axis=(1, 2))
    assert (carried & moves[1]).sum() > 100 and (longer[~carried] == second.ego_motion).all()
    assert_allclose(longer[carried], (once @ once @ once)[carried], atol=1e-9)


def test_a_known_pair_leaves_the_next_one_of_another_length_as_it_would_be(drive):
    scans, _, (_, first, _), _ = drive
    late = replace(scans[2], time_ns=scans[1].time_ns + 300_000_000)
    whole, resumed = FlowEstimator(GRAPH_ALONE), FlowEstimator(GRAPH_ALONE)
    for scan in scans[:2]:
        whole.step(scan)
    resumed.step(scans[0])
    resumed.follow(scans[1], first, resumed.tracks)
    assert (whole.step(late).flow == resumed.step(late).flow).all()


def test_two_runs_with_one_ego_motion_give_the_same_bytes(drive):
    scans, _, results, _ = drive
    again, _ = _estimated(scans, [result.ego_motion for result in results[1:]])
    for a, b in zip(results[1:], again[1:], strict=True):
        for name in ("flow", "motions", "valid", "in_graph", "is_dynamic", "ego_motion", "match_target"):
            assert getattr(a, name).tobytes() == getattr(b, name).tobytes(), name
        assert a.stats == b.stats


def test_two_runs_give_the_same_bytes(drive):
    """Registration sums in parallel, in no fixed order; the pipeline rounds that away."""
    scans, _, results, _ = drive
    again, _ = _estimated(scans)
    for a, b in zip(results[1:], again[1:], strict=True):
        for name in ("ego_motion", "flow", "motions", "valid", "in_graph", "is_dynamic", "match_target"):
            assert getattr(a, name).tobytes() == getattr(b, name).tobytes(), name


def test_a_sequence_agrees_with_pairs(drive):
    scans, _, results, _ = drive
    alone = estimate_flow(ScanPair(scans[0], scans[1]), GRAPH_ALONE)
    assert_same_motion(results[1].ego_motion, alone.ego_motion, 0.01, 0.03)
    graph = results[1].in_graph & results[1].valid & alone.valid
    off_m = np.linalg.norm(results[1].flow - alone.flow, axis=1)
    assert np.median(off_m[graph]) < 0.01


@pytest.mark.parametrize("before", [0, 1, 2])
@pytest.mark.parametrize("method", ["registration", "kiss_icp"])
def test_a_sequence_goes_on_after_a_bad_scan(drive, method, before):
    scans, *_ = drive
    config = replace(GRAPH_ALONE, ego=EgoConfig(method=method))
    estimator = FlowEstimator(config)
    for scan in scans[:before]:
        estimator.step(scan)
    with pytest.raises(DataError) as error:
        estimator.step(Scan(np.empty((0, 3)), 0, "empty"))
    assert "empty" in one_line(error.value)
    assert estimator.step(scans[1]) is None, "the bad scan is no source, nor is the one before it"
    result, fresh = estimator.step(scans[2]), FlowEstimator(config)
    fresh.step(scans[1])
    np.testing.assert_array_equal(result.flow, fresh.step(scans[2]).flow)


# --- scans that are hardly usable ---

def one_line(error: LidarflowError) -> str:
    text = str(error)
    assert text and "\n" not in text
    return text


def test_a_bare_floor_has_no_graph():
    pair = worlds.plane_pair(rng(4))
    result = estimate_flow(pair, GRAPH_ALONE)
    assert_valid(pair, result)
    assert not result.in_graph.any() and not result.is_dynamic.any()
    assert np.abs(result.flow[:, 2]).max() < 0.1   # along the floor nothing is known, across it all is


def test_a_bare_wall_stays_on_its_plane():
    points = rng(5).uniform([-5.0, 8.0, -1.0], [5.0, 8.0001, 3.0], (3000, 3))
    pair = ScanPair(Scan(points), Scan(points + [0.0, 0.1, 0.0], 100_000_000))
    result = estimate_flow(pair, GRAPH_ALONE)
    assert_valid(pair, result)
    assert_allclose(result.flow[:, 1], 0.1, atol=0.01)
    assert not result.is_dynamic.any()


@pytest.mark.parametrize(("source_rows", "target_rows", "text"), [
    (10, 10, "registration needs 30"), (4000, 10, "registration needs 30"),
    (10, 4000, "registration needs 30"),
    (0, 4000, "none of 0 points"), (4000, 0, "none of 0 points")])
def test_too_few_points_are_one_clear_line(source_rows, target_rows, text):
    pair = worlds.plane_pair(rng(6))
    cut = ScanPair(replace(pair.source, points=pair.source.points[:source_rows]),
                   replace(pair.target, points=pair.target.points[:target_rows]))
    with pytest.raises(LidarflowError) as caught:
        estimate_flow(cut, GRAPH_ALONE)
    assert text in one_line(caught.value)


def test_two_different_sensors_of_one_place():
    scene = synthetic.one_car(8.0, rng(1))
    other = replace(synthetic.hdl32e(columns=900), height_m=COARSE.height_m)
    source, truth = synthetic.scan_sequence(scene, COARSE, 2, rng(2))[0]
    target, _ = synthetic.scan_sequence(scene, other, 2, rng(3))[1]
    pair = ScanPair(source, target)
    result = estimate_flow(pair, GRAPH_ALONE)
    assert_valid(pair, result)
    assert_same_motion(result.ego_motion, truth.ego_motion, 0.05, 0.2)
    graph = result.in_graph & result.valid & ~truth.is_dynamic
    assert np.median(flow_error_m(result, truth)[graph]) < 0.15


# --- real recordings ---

@needs_shared
@pytest.mark.slow
def test_tracked_kitti_drive():
    dataset = open_dataset(SHARED / "kitti_tracked_0005_from_000")
    pair, truth = ScanPair(dataset.scan(0), dataset.scan(1)), dataset.truth(0)
    result = estimate_flow(pair, GRAPH_ALONE)
    assert_valid(pair, result)
    assert_same_motion(result.ego_motion, truth.ego_motion, 0.03, 0.1)
    error_m, graph = flow_error_m(result, truth), result.in_graph & result.valid & truth.valid
    assert (graph & truth.is_dynamic).sum() > 1000
    assert error_m[graph & ~truth.is_dynamic].mean() <= 0.10
    assert np.median(error_m[graph & truth.is_dynamic]) <= 0.07


def ego_motion_of(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Ego-motion as the pipeline computes it for a pair, without the rest of the pipeline."""
    config = Config()
    return ego.register(ego.Thinned.of(source, config), ego.Thinned.of(target, config))


def test_the_last_motion_goes_on_for_as_long_as_the_next_pair_takes():
    guess, motion = odometry.LastMotion(), pose.exp(np.array([0.0, 0.0, 0.04, 0.8, 0.02, 0.0]))
    assert guess.step(np.empty((0, 3)), 0.0) is None
    guess.found(motion, 0.1)
    assert guess.step(np.empty((0, 3)), 0.1) is motion
    assert guess.step(np.empty((0, 3)), 0.1) is None, "nothing is known of the motion to the last scan"
    guess.found(motion, 0.1)
    np.testing.assert_allclose(guess.step(np.empty((0, 3)), 0.2), motion @ motion, atol=1e-12)


def test_returns_at_the_sensor_are_none():
    pair, truth = pair_of(synthetic.street(rng(4)), COARSE, 5)
    config = replace(Config(), preparation=PreparationConfig(min_range_m=0.0))
    source, target = (
        ego.Thinned.of(np.vstack([scan.points, 0 * scan.points, scan.points[:9]]), config)
        for scan in (pair.source, pair.target))
    assert_same_motion(ego.register(source, target), truth.ego_motion, 0.05, 0.15)


def test_a_cloud_without_extent_cannot_be_registered():
    points = rng(1).normal(size=(100, 3))
    nothing = ego.Thinned(points, registration.Planes.of(points, 0.2), 0.0)
    with pytest.raises(DataError, match="no extent"):
        ego.register(nothing, nothing)


@pytest.mark.parametrize("wrong", [(0, 0, 0.3, 0, 0, 0), (0, 0, 0, 2.5, 0, 0), (0, 0, 3.0, 0, 0, 0),
                                   (0, 0, 0, 200.0, 0, 0), (0.01, -0.01, 0.02, 0.2, 0.1, 0.02)])
def test_a_wrong_guess_does_not_lead_ego_motion_astray(wrong):
    pair, truth = pair_of(synthetic.street(rng(4)), COARSE, 5)
    config = Config()
    source, target = (ego.Thinned.of(scan.points, config) for scan in (pair.source, pair.target))
    alone = ego.find(source, target, None, config.ego)
    assert_same_motion(alone, truth.ego_motion, 0.05, 0.15)
    guess = pose.exp(np.array(wrong, float)) @ truth.ego_motion
    assert_same_motion(ego.find(source, target, guess, config.ego), alone, 0.002, 0.01)


@needs_shared
@pytest.mark.parametrize("folder", [
    "kitti_tracked_0005_from_000", "kitti_tracked_0005_from_040", "kitti_raw_0048", "kitti_odometry_00_start",
    "kitti_odometry_00_pair_094", "kitti_odometry_00_pair_198", "moosmann_durlacher_tor", "argoverse2",
    "ouster_os1_128"])
def test_ego_motion_of_recordings(folder):
    dataset = open_dataset(SHARED / folder)
    truth, world_from_sensor = dataset.truth(0), dataset.world_from_sensor()
    known = truth.ego_motion if truth else pose.inverse(world_from_sensor[1]) @ world_from_sensor[0]
    assert_same_motion(ego_motion_of(dataset.scan(0).points, dataset.scan(1).points), known, 0.03, 0.1)


@needs_shared
def test_ego_motion_of_the_small_gicp_pair():
    folder = SHARED / "small_gicp_pair"
    known = np.loadtxt(folder / "T_target_source.txt")
    found = ego_motion_of(read_points(folder / "source.ply"), read_points(folder / "target.ply"))
    # The reference is itself the result of a registration (GICP), known to differ by some 0.2 degrees.
    assert_same_motion(found, known, 0.03, 0.3)
