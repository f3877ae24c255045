"""Truth of Argoverse 2 logs: from boxes as the official labels are made, and ground from the map."""

import json
import shutil

import numpy as np
import pytest
from cloud_files import message
from shared_data import SHARED, needs_shared

from lidarflow import pose
from lidarflow.datasets import argoverse2_map, open_dataset
from lidarflow.types import Category

TIMES = (315966265259836000, 315966265360032000, 315966265459992000)
CITY_FROM_VEHICLE = np.stack([pose.from_yaw(0.05 * k, (100.0 + k, 200.0, 3.0)) for k in range(3)])
CAR = np.stack([pose.from_yaw(0.1 * k, (10.0 + 0.5 * k, 2.0, 0.5)) for k in range(3)])     # vehicle_from_box
DOG = np.tile(pose.from_translation([5.0, -5.0, 0.0]), (3, 1, 1))
POINTS = np.array([[10.0, 2.0, 0.5], [12.0625, 2.0, 0.0], [10.0, 2.0, 1.53125], [5.0, -5.0, 0.0],
                   [20.0, 20.0, 0.25], [20.0, 20.0, 0.5], [20.0, 20.0, -4.0], [-90.0, 0.0, 0.0]])


def write_log(folder, labelled=((0, 1, 2), (0, 1))):
    """Three sweeps of the same points; a car of 4 x 2 x 2 m and a dog, labelled in the given sweeps."""
    feather, pa = pytest.importorskip("pyarrow.feather"), pytest.importorskip("pyarrow")
    log = folder / "val" / "7fab"
    (log / "sensors" / "lidar").mkdir(parents=True)

    def write(name, columns):
        feather.write_feather(pa.table(columns), str(log / name))

    def placed(motions):
        rows = pose.to_translation_quaternion(motions).T
        return dict(zip(("tx_m", "ty_m", "tz_m", "qx", "qy", "qz", "qw"), rows, strict=True))

    for time_ns in TIMES:
        write(f"sensors/lidar/{time_ns}.feather",
              {axis: POINTS[:, k].astype(np.float16) for k, axis in enumerate("xyz")})
    write("city_SE3_egovehicle.feather", {"timestamp_ns": TIMES, **placed(CITY_FROM_VEHICLE)})
    cars, dogs = labelled
    kinds = ["REGULAR_VEHICLE"] * len(cars) + ["DOG"] * len(dogs)
    is_car = np.array(kinds) == "REGULAR_VEHICLE"
    write("annotations.feather", {
        "timestamp_ns": [TIMES[k] for k in (*cars, *dogs)],
        "track_uuid": [f"uuid of a {kind}" for kind in kinds], "category": kinds,
        "length_m": np.where(is_car, 4.0, 1.0), "width_m": np.where(is_car, 2.0, 0.5),
        "height_m": np.where(is_car, 2.0, 0.5),
        **placed(np.concatenate([CAR[list(cars)], DOG[list(dogs)]]))})
    return log


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
