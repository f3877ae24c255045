"""Truth of Argoverse 2 logs: from boxes as the official labels are made, and ground from the map."""

import json
import shutil

import numpy as np
from argoverse_log import CAR, CITY_FROM_VEHICLE, POINTS, write_log
from cloud_files import message
from shared_data import SHARED, needs_shared

from lidarflow import pose
from lidarflow.datasets import argoverse2_map, open_dataset
from lidarflow.types import Category


def write_map(log):
    """Ground at a height of 3 m, but for a hole; pixels of 0.5 m from (50, 100) on."""
    (log / "map").mkdir()
    height_m = np.full((400, 300), 3.0, np.float16)
    height_m[0:10] = np.nan
    np.save(log / "map" / "7fab_ground_height_surface____PIT.npy", height_m)
    (log / "map" / "7fab___img_Sim2_city.json").write_text(
        json.dumps({"R": [1.0, 0.0, 0.0, 1.0], "t": [-50.0, -100.0], "s": 2.0}))


def test_flow_of_a_log_follows_its_boxes(tmp_path):
    write_log(tmp_path)
    data = open_dataset(tmp_path)
    for index in (0, 1):
        truth = data.truth(index)
        ego_motion = pose.inverse(CITY_FROM_VEHICLE[index + 1]) @ CITY_FROM_VEHICLE[index]
        np.testing.assert_allclose(truth.ego_motion, ego_motion, atol=1e-9)
        expected = pose.apply(ego_motion, POINTS) - POINTS
        inside = truth.category == Category.CAR
        car = CAR[index + 1] @ pose.inverse(CAR[index])
        expected[inside] = pose.apply(car, POINTS[inside]) - POINTS[inside]
        if index == 0:
            expected[3] = 0.0     # the dog keeps up with the vehicle
        np.testing.assert_allclose(truth.flow, expected, atol=1e-9)
    truth = data.truth(0)
    assert truth.origin == "boxes (no map, so ground counts)"
    np.testing.assert_array_equal(
        truth.category, [1, 1, 0, Category.OTHER, 0, 0, 0, 0], "0.06 m in front is on the car, above is not")
    np.testing.assert_array_equal(truth.object_id, [1, 1, -1, 0, -1, -1, -1, -1])
    assert truth.valid.all() and truth.is_dynamic[:2].all()
    gone = data.truth(1)
    assert not gone.valid[3] and gone.valid.sum() == 7, "the dog has no box in the last sweep"
    assert data.truth(2) is None


def test_the_map_tells_what_is_ground(tmp_path):
    log = write_log(tmp_path)
    write_map(log)
    truth = open_dataset(tmp_path).truth(0)
    # Half a metre above, at it, above the car, at it, 0.25 m above, 0.5 m above, under it, off the map.
    np.testing.assert_array_equal(truth.is_ground, [False, True, False, True, True, False, True, False])
    np.testing.assert_array_equal(truth.valid, ~truth.is_ground)
    assert truth.origin == "boxes (ground from the map)"
    points = np.array([[51.0, 101.0, 3.0], [51.0, 105.2, 3.0], [49.7, 150.0, 3.0], [49.4, 150.0, 3.0]])
    ground = argoverse2_map.is_ground(log / "map", points)
    np.testing.assert_array_equal(ground, [False, True, True, False],
                                  "no height; known; cut towards pixel 0; off the map")
    assert argoverse2_map.is_ground(log, points) is None


def test_a_damaged_map(tmp_path):
    log = write_log(tmp_path)
    write_map(log)
    (log / "map" / "7fab___img_Sim2_city.json").write_text('{"R": [1, 0, 0, 1], "t": [0, 0]}')
    assert "expected R, t and s of a similarity" in message(open_dataset(tmp_path).truth, 0)
    np.save(log / "map" / "7fab_ground_height_surface____PIT.npy", np.zeros(3, np.int8))
    assert "expected heights in rows and columns" in message(open_dataset(tmp_path).truth, 0)


def test_without_boxes_there_is_no_flow(tmp_path):
    log = write_log(tmp_path, labelled=((0,), (0,)))
    assert open_dataset(tmp_path).truth(0) is None
    (log / "annotations.feather").unlink()
    assert open_dataset(tmp_path).truth(0) is None


@needs_shared
def test_flow_from_boxes_is_the_official_flow(tmp_path):
    official = open_dataset(SHARED / "argoverse2").truth(0)
    shutil.copytree(SHARED / "argoverse2" / "val", tmp_path / "val")     # without the labels beside it
    made = open_dataset(tmp_path).truth(0)
    assert (official.origin, made.origin) == ("flow (official labels)", "boxes (no map, so ground counts)")
    apart_m = np.linalg.norm(made.flow - official.flow, axis=1)
    assert (apart_m > 0.002).sum() <= 11 and np.median(apart_m) < 0.001
    assert (made.category != official.category).sum() <= 2
    assert (made.is_dynamic != official.is_dynamic).sum() <= 10 and official.is_dynamic.sum() == 2037
    assert (made.object_id != official.object_id).sum() <= 2
    assert official.is_ground.sum() == 17374 and not (official.valid & official.is_ground).any()
    counts = np.bincount(official.category, minlength=6)
    assert counts[Category.CAR] > 8000 and counts[Category.PEDESTRIAN] > 300
