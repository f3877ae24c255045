"""Errors, accuracies, angles and the three-way error on rows worked out by hand."""

import numpy as np
import pytest

from lidarflow import metrics, pose
from lidarflow.types import Category, Truth

# True flow, and how far the estimate is off along y.
TRUE_M = np.array([0.0, 0.5, 2.0, 2.0, 10.0, 10.0, 0.0])
OFF_M = np.array([0.04, 0.04, 0.09, 0.15, 0.4, 1.5, 0.0])
TRUTH = TRUE_M[:, None] * [1.0, 0.0, 0.0]
FLOW = TRUTH + OFF_M[:, None] * [0.0, 1.0, 0.0]


def test_errors_are_distances_and_shares_of_the_true_flow():
    np.testing.assert_allclose(metrics.end_point_error(FLOW, TRUTH), OFF_M)
    np.testing.assert_allclose(
        metrics.relative_error(FLOW, TRUTH), [np.inf, 0.08, 0.045, 0.075, 0.04, 0.15, 0.0])


def test_a_point_is_right_in_metres_or_beside_its_true_flow():
    found = metrics.accuracy(FLOW, TRUTH)
    assert found.strict == pytest.approx(5 / 7), "all but 0.15 m of 2 m and 1.5 m of 10 m"
    assert found.relaxed == pytest.approx(6 / 7), "all but 1.5 m of 10 m"
    assert found.outliers == pytest.approx(3 / 7), "0.04 m of nothing, 0.4 m, 1.5 m"


@pytest.mark.parametrize(("off_m", "strict", "relaxed", "outliers"), [
    (0.0499, 1, 1, 0), (0.0501, 0, 1, 0), (0.0999, 0, 1, 0), (0.1001, 0, 0, 1), (0.3001, 0, 0, 1)])
def test_thresholds_for_a_flow_of_one_metre(off_m, strict, relaxed, outliers):
    truth = np.array([[1.0, 0.0, 0.0]])
    found = metrics.accuracy(truth + [0.0, off_m, 0.0], truth)
    assert (found.strict, found.relaxed, found.outliers) == (strict, relaxed, outliers)


def test_an_outlier_may_be_one_by_metres_alone():
    truth = np.array([[4.0, 0.0, 0.0]])
    assert metrics.accuracy(truth + [0.0, 0.29, 0.0], truth).outliers == 0.0
    assert metrics.accuracy(truth + [0.0, 0.31, 0.0], truth).outliers == 1.0


def test_angles_in_space_and_in_space_and_time():
    truth = np.array([[1.0, 0, 0], [1.0, 0, 0], [0.1, 0, 0], [0.0, 0, 0]])
    flow = np.array([[0, 2.0, 0], [3.0, 0, 0], [0.0, 0, 0], [0.1, 0, 0]])
    found = metrics.angle_error(flow, truth)
    np.testing.assert_allclose(found[:2], [np.pi / 2, 0.0], atol=1e-12)
    assert np.isnan(found[2:]).all(), "no flow has no direction"
    # (0, 2, 0, 0.1) and (1, 0, 0, 0.1); (3, 0, 0, 0.1) and (1, 0, 0, 0.1); nothing and (0.1, 0, 0, 0.1)
    by_hand = [np.arccos(0.01 / np.sqrt(4.01 * 1.01)), np.arccos(3.01 / np.sqrt(9.01 * 1.01)),
               np.pi / 4, np.pi / 4]
    np.testing.assert_allclose(metrics.space_time_angle_error(flow, truth), by_hand)
    means = metrics.accuracy(flow, truth)
    assert means.angle_rad == pytest.approx(np.pi / 4)
    assert means.space_time_angle_rad == pytest.approx(np.mean(by_hand))


def test_error_over_speed_is_a_ratio_of_means():
    error, speed_m = np.array([0.1, 0.1]), np.array([[0.1, 0, 0], [0, 0.9, 0]])
    assert metrics.error_over_speed(error, speed_m) == pytest.approx(0.1 / 0.5)
    assert np.isnan(metrics.error_over_speed(error[:0], speed_m[:0]))
    assert np.isnan(metrics.error_over_speed(error, 0 * speed_m))


def test_three_way_on_eight_rows():
    error = np.array([0.1, 0.3, 0.05, 0.07, 0.01, 0.03, 0.9, 0.2])
    moves = np.array([1, 1, 0, 0, 0, 0, 1, 1], bool)
    on_object = np.array([1, 1, 1, 1, 0, 0, 0, 1], bool)
    called = np.array([1, 0, 1, 0, 0, 0, 1, 1], bool)
    found = metrics.three_way(error, moves, on_object, called)
    assert found.foreground_dynamic.mean == pytest.approx((0.1 + 0.3 + 0.2) / 3)
    assert found.foreground_static.mean == pytest.approx((0.05 + 0.07) / 2)
    assert found.background_static.mean == pytest.approx((0.01 + 0.03) / 2), "moving background is in none"
    assert found.mean_m == pytest.approx((0.2 + 0.06 + 0.02) / 3)
    assert found.dynamic_iou == pytest.approx(3 / 5), "rows 0, 6, 7 of rows 0, 1, 2, 6, 7"


def test_pairs_are_pooled_point_by_point():
    one, three, none = metrics.MeanError(1, 0.4), metrics.MeanError(3, 0.2), metrics.MeanError(0, np.nan)
    assert metrics.pooled([one, three, none]) == metrics.MeanError(4, pytest.approx(0.25))
    assert np.isnan(metrics.pooled([none, none]).mean)
    pairs = [metrics.ThreeWay(one, three, one, 3, 1, 0), metrics.ThreeWay(none, one, three, 0, 2, 2)]
    found = metrics.pooled_three_way(pairs)
    assert np.isnan(pairs[1].mean_m) and found.mean_m == pytest.approx((0.4 + 0.25 + 0.25) / 3)
    assert (found.foreground_dynamic.points, found.dynamic_iou) == (1, pytest.approx(3 / 8))
    nothing = metrics.ThreeWay(none, none, none, 0, 0, 0)
    assert np.isnan(nothing.dynamic_iou)


def test_three_way_looks_at_points_within_50_metres_above_ground():
    points = np.array([[50.0, -50.0, 90.0], [50.1, 0, 0], [0, -50.1, 0], [1, 1, 0]])
    counted = metrics.evaluated(points, np.array([False, False, False, True]))
    np.testing.assert_array_equal(counted, [True, False, False, False])


def test_foreground_is_what_has_a_class_or_else_an_object():
    truth = {"flow": np.zeros((3, 3)), "ego_motion": pose.from_translation([1.0, 0, 0]),
             "valid": np.ones(3, bool), "is_dynamic": np.zeros(3, bool), "object_id": np.array([-1, 0, 4])}
    np.testing.assert_array_equal(Truth(**truth).is_foreground, [False, True, True])
    category = np.array([Category.OTHER, Category.BACKGROUND, Category.CAR])
    np.testing.assert_array_equal(Truth(**truth, category=category).is_foreground, [True, False, True])
    np.testing.assert_allclose(Truth(**truth).residual_flow(np.ones((3, 3))), [[-1.0, 0, 0]] * 3)
    with pytest.raises(ValueError, match=r"category.*WHEELED_VRU"):
        Truth(**truth, category=np.array([0, 1, 6]))
    with pytest.raises(ValueError, match="is_ground"):
        Truth(**truth, is_ground=np.zeros(2, bool))
