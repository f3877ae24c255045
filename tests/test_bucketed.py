"""Errors by class, speed and range, on rows worked out by hand."""

import numpy as np
import pytest

from lidarflow import metrics
from lidarflow.types import Category

# class, speed [m/frame], error [m], x [m]
ROWS = [
    (Category.BACKGROUND, 0.0, 0.02, 1.0),
    (Category.BACKGROUND, 0.039, 0.04, 1.0),
    (Category.CAR, 0.04, 0.02, 1.0),            # the second bucket begins at 0.04
    (Category.CAR, 1.0, 0.1, 1.0),
    (Category.CAR, 1.02, 0.3, 34.9),            # in one bucket with the row before: 1.00 to 1.04
    (Category.CAR, 0.01, 0.05, -34.9),
    (Category.PEDESTRIAN, 0.1, 0.1, 1.0),
    (Category.PEDESTRIAN, 2.0, 1.0, 1.0),       # the last bucket has no end
    (Category.PEDESTRIAN, 6.0, 1.0, 1.0),
    (Category.OTHER, 0.0, 9.0, 1.0),
    (Category.CAR, 1.0, 9.0, 35.0),
    (Category.CAR, 1.0, 9.0, -35.1),
]


def rows(chosen):
    kind, speed_m, error, x = (np.array([row[k] for row in chosen]) for k in range(4))
    points = np.stack([x, np.zeros_like(x), np.full_like(x, 100.0)], axis=1)
    return points, error, speed_m[:, None] * [0.0, 0.6, 0.8], kind


def test_twelve_rows_are_bucketed_as_by_hand():
    sums = metrics.buckets(*rows(ROWS))
    assert sums.points.shape == (5, 51) and sums.points.sum() == 9, "the last three are too far or no class"
    found = metrics.bucketed(sums)
    background, car = found.classes["BACKGROUND"], found.classes["CAR"]
    assert background.static_m == pytest.approx(0.03) and np.isnan(background.dynamic)
    assert car.static_m == pytest.approx(0.05)
    assert car.dynamic == pytest.approx((0.02 / 0.04 + 0.2 / 1.01) / 2)
    pedestrian = found.classes["PEDESTRIAN"]
    assert np.isnan(pedestrian.static_m) and pedestrian.dynamic == pytest.approx((0.1 / 0.1 + 1.0 / 4.0) / 2)
    assert np.isnan([found.classes["OTHER_VEHICLES"].static_m, found.classes["WHEELED_VRU"].dynamic]).all()
    assert found.mean.static_m == pytest.approx((0.03 + 0.05) / 2)
    assert found.mean.dynamic == pytest.approx((car.dynamic + pedestrian.dynamic) / 2)


def test_y_counts_like_x():
    points, error, residual, kind = rows(ROWS)
    sums = metrics.buckets(points[:, [1, 0, 2]], error, residual, kind)
    np.testing.assert_array_equal(sums.points, metrics.buckets(points, error, residual, kind).points)


def test_pairs_are_weighted_by_their_points():
    """Mean errors of 0.1 and 0.3 m at 1.00 and 1.02 m a frame, three times and once."""
    once, thrice = metrics.buckets(*rows([ROWS[4]])), metrics.buckets(*rows([ROWS[3]] * 3))
    found = metrics.bucketed(metrics.pooled_buckets([once, thrice])).classes["CAR"]
    assert found.dynamic == pytest.approx((0.3 + 3 * 0.1) / (1.02 + 3 * 1.0))


def test_ego_motion_alone_scores_one_and_the_truth_zero():
    points, _, residual, kind = rows(ROWS[2:5])
    for share in (0.0, 0.5, 1.0):
        error = share * np.linalg.norm(residual, axis=1)
        assert metrics.bucketed(metrics.buckets(points, error, residual, kind)).mean.dynamic \
            == pytest.approx(share)


def test_without_points_all_is_nan():
    found = metrics.bucketed(metrics.buckets(*rows(ROWS[-1:])))
    assert np.isnan([found.mean.static_m, found.mean.dynamic]).all()


def test_a_flow_whose_length_overflows_is_in_the_last_bucket():
    points, error, residual, kind = rows(ROWS[3:4])
    with np.errstate(over="ignore"):
        sums = metrics.buckets(points, error, residual * 1e200, kind)
    assert sums.points[1, -1] == 1


def test_errors_by_range():
    points = np.array([[34.0, 0, 0], [0, 30, 40.0], [0, 0, 35.0], [60, 80, 0.0], [200, 0, 0]])
    error, moves = np.array([0.1, 0.2, 0.4, 0.8, 1.6]), np.array([True, False, False, False, True])
    found = metrics.by_range(points, error, moves)
    assert [(part.low_m, part.high_m) for part in found] == [
        (0, 35), (35, 50), (50, 75), (75, 100), (100, np.inf)]
    assert [part.all.points for part in found] == [1, 1, 1, 0, 2]
    assert [part.all.mean for part in found[:3]] == pytest.approx([0.1, 0.4, 0.2])
    assert found[4].static == metrics.MeanError(1, 0.8) and found[4].dynamic == metrics.MeanError(1, 1.6)
    assert np.isnan(found[3].all.mean)
    both = metrics.pooled_intervals([found, metrics.by_range(points[:1], error[3:4], moves[:1])])
    assert both[0].dynamic == metrics.MeanError(2, pytest.approx(0.45)) and both[4] == found[4]


def test_errors_by_speed():
    speed_m = np.array([0.0, 0.049, 0.05, 0.5, 2.0, 30.0])
    error = np.array([0.1, 0.3, 0.5, 0.7, 0.9, 1.1])
    found = metrics.by_speed(speed_m[:, None] * [0, 1.0, 0], error, speed_m > 0.04)
    assert [part.all.points for part in found] == [2, 1, 0, 1, 0, 2]
    assert found[0].all.mean == pytest.approx(0.2) and found[0].dynamic == metrics.MeanError(1, 0.3)
    assert found[-1].all.mean == pytest.approx(1.0) and found[-1].high_m == np.inf
