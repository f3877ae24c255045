"""Metrics on rows small enough to work out by hand."""

from dataclasses import replace

import numpy as np
import pytest

from lidarflow import metrics, pose
from lidarflow.types import Category, FlowResult, Scan, SolveStats, Truth

STATS = SolveStats("none", 0, 0, 0, 0, 0, 0, 0, 0.0, 0.0, 0.0, 0.0, 0, {})
SIGMA_M = 0.2
EGO = pose.from_translation([-1.0, 0.0, 0.0])
# Row      error  moves  truth valid  in graph  solved  called moving
ROWS = [
    (0.0, False, True, True, True, False),
    (0.2, False, True, True, True, True),
    (0.4, False, True, False, True, False),
    (0.6, False, True, True, False, False),
    (1.0, True, True, True, True, True),
    (3.0, True, True, False, False, False),
    (9.0, True, False, True, True, True),
    (np.nan, False, True, True, True, True),
]


def eight_rows() -> tuple[np.ndarray, FlowResult, Truth]:
    """Errors along y; the world moves by EGO and what moves, 2 m more along z."""
    error, moves, known, in_graph, solved, called = map(np.array, zip(*ROWS, strict=True))
    true_flow = np.tile([-1.0, 0.0, 0.0], (8, 1)) + moves[:, None] * [0.0, 0.0, 2.0]
    flow = true_flow + error[:, None] * [0.0, 1.0, 0.0]
    motions = pose.from_translation(np.nan_to_num(flow))
    ego_motion = pose.from_translation([-1.0, 0.3, 0.4])
    result = FlowResult(flow, motions, solved, in_graph, called, ego_motion, STATS)
    points = np.arange(24.0).reshape(8, 3)
    return points, result, Truth(true_flow, EGO, known, moves, np.where(moves, 1, -1))


def test_eight_rows_are_scored_as_by_hand():
    scores = metrics.score(*eight_rows())
    expected = {
        "all": (6, (0 + 0.2 + 0.4 + 0.6 + 1 + 3) / 6, 0.5),
        "static": (4, 0.3, 0.3),
        "dynamic": (2, 2.0, 2.0),
        "graph_static": (2, 0.1, 0.1),
        "graph_dynamic": (1, 1.0, 1.0),
    }
    for name, (points, mean, median) in expected.items():
        summary = getattr(scores, name)
        assert summary.points == points, name
        assert (summary.mean, summary.median) == pytest.approx((mean, median)), name
    assert scores.t_e == pytest.approx(0.1) and scores.r_e_rad == pytest.approx(0.0)
    assert scores.movers_found == pytest.approx(1 / 2)
    assert scores.false_movers == pytest.approx(1 / 4)
    assert scores.ego_error_m == pytest.approx(0.5) and scores.ego_error_rad == pytest.approx(0.0)
    assert scores.dynamic_error_over_speed == pytest.approx(2.0 / 2.0), "mean error 2 m, and 2 m a frame"
    assert (scores.accuracy_all.strict, scores.accuracy_static.strict) == pytest.approx((1 / 6, 1 / 4))
    assert scores.accuracy_dynamic.strict == 0.0
    three_way = scores.three_way
    assert three_way.foreground_dynamic == metrics.MeanError(2, 2.0)
    assert three_way.background_static.mean == pytest.approx(0.3)
    assert three_way.foreground_static.points == 0 and np.isnan(three_way.mean_m)
    assert three_way.dynamic_iou == pytest.approx(1 / 3), "row 4 of rows 1, 4 and 5"


def test_without_movers_their_scores_are_nan_and_the_rest_stays():
    points, result, truth = eight_rows()
    scores = metrics.score(points, result, replace(truth, is_dynamic=np.zeros(8, bool)))
    assert scores.dynamic.points == 0 and np.isnan(scores.dynamic.mean) and np.isnan(scores.dynamic.median)
    assert np.isnan(scores.movers_found) and scores.static.points == 6
    three_way = scores.three_way
    assert (three_way.foreground_dynamic.points, three_way.foreground_static.points) == (0, 2)
    assert (three_way.missed_movers, three_way.false_movers) == (0, 2), "the flow has a length, labels decide"


def test_poses_alone_do_not_say_which_points_move():
    """A point that is called moving is not wrong for that; its flow is scored as before."""
    points, result, truth = eight_rows()
    nothing = replace(truth, is_dynamic=np.zeros(8, bool))
    of_poses = metrics.score(points, result, replace(nothing, origin=metrics.POSES_ONLY))
    of_labels = metrics.score(points, result, nothing)
    assert of_labels.false_movers == pytest.approx(2 / 6) and of_labels.three_way.dynamic_iou == 0.0
    assert np.isnan([of_poses.false_movers, of_poses.movers_found, of_poses.three_way.dynamic_iou]).all()
    assert of_poses.static == of_labels.static and of_poses.all == of_labels.all


def test_a_truth_that_knows_nothing_gives_nan_everywhere():
    points, result, truth = eight_rows()
    scores = metrics.score(points, result, replace(truth, valid=np.zeros(8, bool)))
    assert scores.all.points == 0
    assert np.isnan([scores.all.mean, scores.t_e, scores.r_e_rad, scores.false_movers]).all()


def test_identical_clouds_are_perfectly_crisp():
    points = np.random.default_rng(0).normal(size=(50, 3))
    assert metrics.crispness(points, points[::-1], SIGMA_M) == 1.0


@pytest.mark.parametrize("distance_m", [0.05, 0.2, 0.6])
def test_crispness_of_one_point_is_equation_15(distance_m):
    found = metrics.crispness(np.array([[distance_m, 0, 0]]), np.array([[0.0, 0, 0], [9, 9, 9]]), SIGMA_M)
    assert found == pytest.approx(np.exp(-(distance_m**2) / (4 * SIGMA_M**2)))


def test_crispness_is_a_mean_and_leaves_nan_rows_out():
    target = np.array([[0.0, 0, 0], [10, 0, 0], [np.nan, 0, 0]])
    points = np.array([[0.0, 0, 0], [10, 0.4, 0], [np.nan, np.nan, np.nan], [5, 0, 0]])
    assert metrics.crispness(points, target, SIGMA_M) == pytest.approx((1 + np.exp(-1) + 0) / 3)
    assert np.isnan(metrics.crispness(points[2:3], target, SIGMA_M))
    assert np.isnan(metrics.crispness(points, target[2:], SIGMA_M))


def test_alignment_looks_at_known_points_above_ground_alone():
    points = np.arange(9.0).reshape(3, 3) * 10
    flow = np.array([[0.0, 0.4, 0], [5, 5, 5], [5, 5, 5]])
    known, on_ground = np.array([True, False, True]), np.array([False, False, True])
    result = FlowResult(flow, pose.from_translation(flow), known, np.zeros(3, bool), np.zeros(3, bool),
                        pose.from_translation([0.0, 0.2, 0.0]), STATS, is_ground=on_ground)
    target = Scan(points[:1] + [0, 0.4, 0])
    found = metrics.alignment(Scan(points), target, result, SIGMA_M)
    assert (found.before, found.by_ego, found.after) == pytest.approx((np.exp(-1), np.exp(-0.25), 1.0))
    assert found.sigma_m == SIGMA_M


def test_frames_have_a_mean_and_a_deviation():
    assert metrics.over_frames([0.1, 0.3, np.nan]) == pytest.approx((0.2, 0.1))
    assert metrics.over_frames(iter([0.5])) == (0.5, 0.0)
    assert np.isnan(metrics.over_frames([np.nan])).all()


def test_figures_say_in_their_names_what_they_are():
    points, result, truth = eight_rows()
    scores = metrics.score(points, result, truth)
    found = metrics.figures(scores)
    assert (found["epe_dynamic_median_m"], found["ego_error_deg"]) == pytest.approx((2.0, 0.0))
    assert (found["strict_accuracy"], found["strict_accuracy_dynamic"]) == (pytest.approx(1 / 6), 0.0)
    assert found["dynamic_iou"] == pytest.approx(1 / 3) and "bucketed_dynamic" not in found
    by_class = np.where(truth.is_dynamic, Category.CAR, Category.BACKGROUND)
    with_classes = metrics.score(points, result, replace(truth, category=by_class))
    found = metrics.figures(with_classes)
    assert found["bucketed_static_m"] == pytest.approx(0.3), "the four static rows of the background"
    assert found["bucketed_dynamic"] == pytest.approx(2.0 / 2.0)
    whole = metrics.pool([with_classes, with_classes])
    assert whole.bucketed.classes["CAR"].dynamic == pytest.approx(1.0)
    assert whole.by_range[0].all == metrics.MeanError(12, scores.all.mean)
    assert metrics.pool([with_classes, scores]).bucketed is None, "classes of one pair are not known"


def test_ground_has_no_part_in_the_scores_of_leaderboards():
    points, result, truth = eight_rows()
    by_class = np.where(truth.is_dynamic, Category.CAR, Category.BACKGROUND)
    ground = np.arange(8) < 2     # errors of 0 and 0.2 m; 0.4 and 0.6 m are left
    scores = metrics.score(points, result, replace(truth, category=by_class, is_ground=ground))
    assert scores.three_way.background_static == metrics.MeanError(2, pytest.approx(0.5))
    assert metrics.bucketed(scores.buckets).classes["BACKGROUND"].static_m == pytest.approx(0.5)
    assert scores.all.points == 6


def test_pose_errors_are_means_over_points():
    truth = pose.from_yaw(0.5, (1.0, 2.0, 0.0))
    motions = np.stack([truth, truth @ pose.from_yaw(0.2, (3.0, 4.0, 0.0))])
    assert metrics.pose_errors(np.zeros((2, 3)), motions, truth) == pytest.approx((2.5, 0.1))
    assert np.isnan(metrics.pose_errors(np.zeros((0, 3)), motions[:0], truth)).all()


def test_a_turn_in_place_is_no_translation_error_however_far_the_sensor():
    place = np.array([[30.0, 40.0, 0.0]])
    there, back = pose.from_translation(place), pose.from_translation(-place)
    turned = there @ pose.from_yaw(0.3) @ back
    assert metrics.pose_errors(place, turned, np.eye(4)) == pytest.approx((0.0, 0.3))


def test_the_truth_of_a_static_scene_is_the_ego_motion():
    points = np.array([[1.0, 0, 0], [0, 2, 0], [np.nan] * 3])
    truth = metrics.static_truth(points, pose.from_yaw(np.pi / 2, (0.0, 0.0, 1.0)))
    np.testing.assert_allclose(truth.flow[:2], [[-1, 1, 1], [-2, -2, 1]], atol=1e-12)
    np.testing.assert_array_equal(truth.valid, [True, True, False])
    assert not truth.is_dynamic.any() and (truth.object_id == -1).all()
