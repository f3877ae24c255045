"""Classes of labelled data, and flow from labelled boxes, on rows worked out by hand."""

import numpy as np
import pytest

from lidarflow import pose
from lidarflow.datasets import categories
from lidarflow.datasets.boxes import Box, box_around, height_in_box, truth_of_boxes
from lidarflow.types import Category


@pytest.mark.parametrize(("name", "category"), [
    ("Car", "CAR"), ("Van", "CAR"), ("Truck", "OTHER_VEHICLES"), ("Tram", "OTHER_VEHICLES"),
    ("Pedestrian", "PEDESTRIAN"), ("Person_sitting", "PEDESTRIAN"), ("Person", "PEDESTRIAN"),
    ("Cyclist", "WHEELED_VRU"), ("Misc", "OTHER"),
    ("REGULAR_VEHICLE", "CAR"), ("BOX_TRUCK", "OTHER_VEHICLES"), ("STROLLER", "PEDESTRIAN"),
    ("WHEELED_RIDER", "WHEELED_VRU"), ("DOG", "OTHER"), ("STOP_SIGN", "OTHER"), ("NONE", "BACKGROUND"),
])
def test_names_become_classes(name, category):
    assert categories.category_of(name) == Category[category]


def test_numbers_of_argoverse_begin_with_the_background():
    found = categories.categories_of_argoverse2(np.array([0, 17, 19, 30, 1], np.uint8))
    assert [Category(number).name for number in found] == [
        "BACKGROUND", "PEDESTRIAN", "CAR", "WHEELED_VRU", "OTHER"]
    assert len(categories.ARGOVERSE2) == 30 and list(categories.ARGOVERSE2) == sorted(categories.ARGOVERSE2)


def box(track, place, yaw=0.0, size=(4.0, 2.0, 1.0), category=Category.CAR):
    return Box(track, category, pose.from_yaw(yaw, place), np.array(size))


def test_a_point_belongs_to_the_box_around_it():
    boxes = [box(7, (10.0, 0, 0)), box(8, (0.0, 10.0, 0), yaw=np.pi / 2), box(9, (12.0, 0, 0))]
    points = np.array([[8.0, 1.0, 0.5], [7.85, 0, 0], [0.0, 12.0, 0.0], [2.0, 10.0, 0], [11.0, 0, 0],
                       [10.0, 0, 0.55], [np.nan, 0, 0]])
    np.testing.assert_array_equal(box_around(points, boxes, (1e-9, 1e-9, 0)), [0, -1, 1, -1, 2, -1, -1])
    np.testing.assert_array_equal(box_around(points, boxes, (0.2, 1e-9, 0.06)), [0, 0, 1, -1, 2, 2, -1])
    height_m = height_in_box(points, boxes, np.array([0, 0, 1, -1, 2, -1, -1]))
    np.testing.assert_allclose(height_m, [1.0, 0.5, 0.5, np.inf, 0.5, np.inf, np.inf])


def test_points_move_with_their_box_and_the_rest_with_the_sensor():
    ego_motion = pose.from_translation([-1.0, 0, 0])
    source = [box(3, (10.0, 0, 0)), box(5, (20.0, 0, 0)), box(6, (30.0, 0, 0), category=Category.PEDESTRIAN)]
    target = [box(5, (18.97, 0, 0)), box(3, (11.0, 2.0, 0), yaw=np.pi / 2)]
    points = np.array([[12.0, 1.0, 0], [20.0, 0, 0], [30.0, 0, 0], [40.0, 0, 0], [np.nan] * 3])
    row = np.array([0, 1, 2, -1, -1])
    truth = truth_of_boxes(points, row, source, target, ego_motion, "boxes")
    # (2, 1) in the first box is turned to (-1, 2) and lands on (10, 4).
    np.testing.assert_allclose(
        truth.flow[:4], [[-2, 3, 0], [-1.03, 0, 0], [-1, 0, 0], [-1, 0, 0]], atol=1e-12)
    np.testing.assert_array_equal(truth.valid, [True, True, False, True, False])
    np.testing.assert_array_equal(truth.is_dynamic, [True, False, False, False, False])
    np.testing.assert_array_equal(truth.object_id, [3, 5, 6, -1, -1])
    np.testing.assert_array_equal(truth.category, [1, 1, 3, 0, 0])
    still = truth_of_boxes(points, row, source, target, ego_motion, "boxes", {3, 6})
    np.testing.assert_allclose(still.flow[:3], [[-1, 0, 0], [-1.03, 0, 0], [-1, 0, 0]], atol=1e-12)
    assert still.valid[:4].all() and not still.is_dynamic.any()


def test_without_boxes_all_is_background():
    points = np.ones((2, 3))
    row = box_around(points, [], (0.1, 0.1, 0.1))
    truth = truth_of_boxes(points, row, [], [box(1, (1.0, 1, 1))], pose.from_yaw(0.1), "boxes")
    assert truth.valid.all() and (truth.object_id == -1).all() and not truth.is_foreground.any()
