"""Moving objects: the evidence for them, their fit, and what is found in generated scenes."""

import numpy as np
import pytest
from scipy.spatial import cKDTree
from shared_data import SHARED, needs_shared

from lidarflow import pose, synthetic
from lidarflow.config import ObjectsConfig
from lidarflow.datasets import open_dataset
from lidarflow.lidar import clusters, evidence, frontend, objects, rigid_fit
from lidarflow.pipeline import FlowEstimator, estimate_flow, run
from lidarflow.types import FlowProblem, ScanPair

CONFIG = ObjectsConfig()


def rng(seed: int) -> np.random.Generator:
    return np.random.default_rng(seed)


def box_surface(count: int, seed: int) -> np.ndarray:
    """Points (count, 3) on the sides of a 4 x 2 x 1.5 m box at the origin."""
    random = rng(seed)
    points = random.uniform(-0.5, 0.5, (count, 3))
    axis = random.integers(0, 2, count)
    points[np.arange(count), axis] = random.choice([-0.5, 0.5], count)
    return points * [4.0, 2.0, 1.5]


def test_points_link_up_to_the_distance_and_not_beyond():
    row = np.column_stack([np.arange(0, 4, 0.1), np.zeros(40), np.zeros(40)])
    label = clusters.linked(np.concatenate([row, row + [0, 1.5, 0]]), 0.5)
    assert len(np.unique(label[:40])) == len(np.unique(label[40:])) == 1
    assert label[0] != label[-1]
    assert len(clusters.linked(np.empty((0, 3)), 0.5)) == 0


@pytest.mark.parametrize("turn", [-0.08, 0.0, 0.05])
def test_a_rigid_fit_finds_turn_and_shift(turn):
    truth = pose.from_translation([8.4, 3.1, 0.02]) @ pose.from_yaw(turn) @ pose.from_translation([-8, -3, 0])
    source = box_surface(800, 1) + [8.0, 3.0, 0.0]
    target = pose.apply(truth, box_surface(4000, 2) + [8.0, 3.0, 0.0])
    found = rigid_fit.onto(source, cKDTree(target), np.array([0.3, 0.2, 0.0]))
    off_m = (pose.apply(found, source) - pose.apply(truth, source))[:, :2]   # sides say nothing of height
    assert np.linalg.norm(off_m, axis=1).mean() < 0.01


def test_a_rigid_fit_without_counterparts_keeps_its_start():
    found = rigid_fit.onto(box_surface(50, 3), cKDTree([[90.0, 0, 0]]), np.array([0.3, 0.2, 0.1]))
    np.testing.assert_allclose(found, pose.from_translation([0.3, 0.2, 0.1]), atol=1e-12)


def wall(x: float, seed: int) -> np.ndarray:
    """Points (4000, 3) of a wall across the line of sight, `x` metres ahead."""
    random = rng(seed)
    return np.column_stack([np.full(4000, x), random.uniform(-3, 3, 4000), random.uniform(-2, 2, 4000)])


def test_evidence_tells_what_is_gone_from_what_is_out_of_view():
    still, gone, beside = wall(10.0, 1), np.array([[6.0, 0.0, 0.0]]), np.array([[0.0, 10.0, 0.0]])
    found = evidence.gather(np.concatenate([gone, beside, still]), wall(10.0, 2), CONFIG)
    assert found.unexplained[0] and not found.blind[0], "the sensor looks through where it was"
    assert found.blind[1] and not found.unexplained[1], "nothing was looked at there"
    assert not found.blind[2:].any() and found.unexplained[2:].mean() < 0.05
    assert (found.left_m[2:][~found.unexplained[2:]] <= evidence.tolerance(np.array(12.0), CONFIG)).all()


def test_an_object_is_described_along_its_way():
    truth = pose.from_yaw(0.6, (10.0, 4.0, 0.0))
    points = pose.apply(truth, box_surface(2000, 4))
    along = truth[:3, :3] @ [0.5, 0.0, 0.0]
    ego_motion = pose.from_yaw(0.02, (-0.7, 0.0, 0.0))
    found = objects.describe(3, points, ego_motion @ pose.from_translation(along), ego_motion, 0.1)
    assert found.id == 3 and found.points == 2000 and found.box_yaw == pytest.approx(0.6, abs=0.01)
    np.testing.assert_allclose(found.box_size, [4.0, 2.0, 1.5], atol=0.1)
    np.testing.assert_allclose(found.box_centre, [10.0, 4.0, 0.0], atol=0.05)
    assert np.linalg.norm(found.velocity) == pytest.approx(5.0, abs=0.01)


def test_only_components_with_an_object_stay_in_the_graph():
    points = rng(5).normal(size=(6, 3))
    problem = FlowProblem(
        points=points, initial=pose.identity(6), match_index=np.array([0, 2, 4], np.int32),
        match_target=points[[0, 2, 4]] + 1.0, edges=np.array([[0, 1], [2, 3], [4, 5]], np.int32),
        component=np.array([0, 0, 1, 1, 2, 2], np.int32))
    variable = np.array([-1, 0, 1, 2, 3, 4, 5, -1], np.int32)
    object_id = np.array([-1, -1, -1, 0, -1, -1, -1, 0], np.int32)   # scan row 3 is variable 2
    car, ego_motion = pose.from_translation([[1.0, 0, 0]]), pose.from_yaw(0.1)
    graph = frontend.focused(frontend.Graph(problem, variable, np.arange(1, 7)), object_id, car, ego_motion)
    np.testing.assert_array_equal(graph.variable, [-1, -1, -1, 0, 1, -1, -1, -1])
    np.testing.assert_array_equal(graph.rows, [3, 4])
    np.testing.assert_array_equal(graph.problem.points, points[2:4])
    np.testing.assert_array_equal(graph.problem.edges, [[0, 1]])
    np.testing.assert_array_equal(graph.problem.match_target, points[[2]] + 1.0)
    np.testing.assert_array_equal(graph.problem.group_motions[graph.problem.group], [car[0], ego_motion])
    np.testing.assert_array_equal(graph.problem.initial, [car[0], ego_motion])


def street_pair(columns: int) -> tuple[ScanPair, object]:
    scans = synthetic.scan_sequence(synthetic.street(rng(1)), synthetic.hdl64e(columns), 2, rng(2))
    return ScanPair(scans[0][0], scans[1][0]), scans[0][1]


def test_objects_of_a_street_move_as_they_should():
    pair, truth = street_pair(1200)
    result = estimate_flow(pair)
    error_m = np.linalg.norm(result.flow - truth.flow, axis=1)
    still = ~truth.is_dynamic
    assert error_m[still].mean() < 0.01
    assert result.is_dynamic[still].mean() < 0.003
    for car in np.unique(truth.object_id[truth.is_dynamic]):
        on_car = (truth.object_id == car) & truth.is_dynamic
        if on_car.sum() > 600:
            assert result.is_dynamic[on_car].mean() > 0.85, f"object {car}"
            assert np.median(error_m[on_car]) < 0.05, f"object {car}"
    np.testing.assert_array_equal(result.object_id >= 0, result.is_dynamic)
    assert [found.id for found in result.objects] == list(range(len(result.objects)))
    for found in result.objects:
        assert found.points == (result.object_id == found.id).sum()


def test_nothing_moves_in_a_static_yard():
    scans = synthetic.scan_sequence(synthetic.room(rng(3)), synthetic.hdl64e(900), 2, rng(4))
    result = estimate_flow(ScanPair(scans[0][0], scans[1][0]))
    assert result.objects == () and not result.is_dynamic.any()
    assert np.linalg.norm(result.flow - scans[0][1].flow, axis=1).mean() < 0.01


@needs_shared
@pytest.mark.slow
@pytest.mark.parametrize("name", ["kitti_tracked_0005_from_000", "kitti_tracked_0005_from_040"])
def test_tracked_kitti_drives(name):
    dataset = open_dataset(SHARED / name)
    for index, (_, result) in enumerate(run(dataset, [0, 1, 2], FlowEstimator())):
        truth = dataset.truth(index)
        error_m = np.linalg.norm(result.flow - truth.flow, axis=1)
        moving, still = truth.is_dynamic & truth.valid, ~truth.is_dynamic & truth.valid
        assert error_m[still].mean() < 0.010
        assert result.is_dynamic[still].mean() < 0.003
        assert np.median(error_m[moving]) < 0.11
        assert result.is_dynamic[moving].mean() > 0.78


@needs_shared
@pytest.mark.parametrize(
    "name", ["kitti_odometry_00_pair_094", "kitti_odometry_00_pair_198", "ouster_os1_128"])
def test_nothing_moves_in_static_folders(name):
    dataset = open_dataset(SHARED / name)
    (_, result), = run(dataset, [0, 1], FlowEstimator())
    assert result.objects == ()
