"""Which points take part, and which of them are ground, for sensors at any height."""

import numpy as np
import pytest

from lidarflow import open3d_import, pose, synthetic
from lidarflow.config import GroundConfig, PreparationConfig
from lidarflow.kernels import thinning
from lidarflow.lidar import ground, preparation
from lidarflow.synthetic import Part, Scene, shapes
from lidarflow.synthetic.raycast import raycasting_scene

CONFIG = GroundConfig()


def rng(seed: int) -> np.random.Generator:
    return np.random.default_rng(seed)


def test_missing_near_and_far_returns_are_masked():
    points = np.array([[5.0, 0, 0], [np.nan, 0, 0], [np.nan] * 3, [0, np.inf, 0], [1.9, 0, 0], [0, 0, 0],
                       [0, 0, 2.0], [79.9, 0, 0], [60, 60, 0], [80.0, 0, 0]])
    kept = preparation.usable(points, PreparationConfig(min_range_m=2.0, max_range_m=80.0))
    np.testing.assert_array_equal(kept, [True, False, False, False, False, False, True, True, False, True])
    assert preparation.usable(np.empty((0, 3)), PreparationConfig()).shape == (0,)


def test_what_is_no_return_is_masked_whatever_the_limits():
    points = np.array([[5.0, 0, 0], [np.nan, 0, 0], [0, np.inf, 0], [-np.inf] * 3, [0, 0, 0], [0, 0.01, 0],
                       [1e12, 0, 0], [0, 0, 1e300], [5000.0, 0, 0]])
    limits = PreparationConfig(min_range_m=0.0, max_range_m=np.inf)
    kept = preparation.usable(points, limits)
    np.testing.assert_array_equal(kept, [True, False, False, False, False, True, False, False, True])
    in_range, _ = thinning.in_range(points, *preparation.range_limits_m(limits))
    np.testing.assert_array_equal(in_range, points[kept])


def distance_to(parts, points: np.ndarray) -> np.ndarray:
    tensor = open3d_import.open3d().core.Tensor(points.astype(np.float32))
    return raycasting_scene(parts, 0.0).compute_distance(tensor).numpy()


@pytest.fixture(scope="module")
def street():
    """A scan of a street, metres from its ground and from everything else, per point."""
    scene, sensor = synthetic.street(rng(0)), synthetic.hdl64e(columns=1000)
    points = synthetic.scan_sequence(scene, sensor, 1, rng(1))[0][0].points
    in_world = pose.apply(scene.world_from_sensor(0.0, sensor.height_m), points)
    floor = [part for part in scene.parts if part.name == "ground"]
    things = [part for part in scene.parts if part.name != "ground"]
    return points, distance_to(floor, in_world), distance_to(things, in_world)


def assert_found(points: np.ndarray, from_floor_m: np.ndarray, from_things_m: np.ndarray) -> None:
    kept = preparation.usable(points, PreparationConfig(max_range_m=50.0))
    found = ground.detect(points, kept, CONFIG).mask
    assert found.dtype == bool and not found[~kept].any()
    is_floor = kept & (from_floor_m < 0.1) & (from_things_m > 0.2)
    is_thing = kept & (from_floor_m > 0.2)
    assert is_floor.sum() > 5000 and is_thing.sum() > 5000
    right, wrong = (found & is_floor).sum(), (found & is_thing).sum()
    precision, recall = right / (right + wrong), right / is_floor.sum()
    assert precision >= 0.95, f"precision {precision:.3f}"
    assert recall >= 0.95, f"recall {recall:.3f}"


def test_the_street_is_told_from_what_stands_on_it(street):
    assert_found(*street)


@pytest.mark.parametrize("raised_m", [-1.73, -1.2, 1.5])
def test_the_height_of_the_origin_does_not_matter(street, raised_m):
    points, from_floor_m, from_things_m = street
    assert_found(points + [0, 0, -raised_m], from_floor_m, from_things_m)


def yard(height_m: float, ring_step_deg: float = 1.0) -> np.ndarray:
    """Scan from `height_m` over flat ground, with boxes and a wall around."""
    random = rng(2)
    boxes = [shapes.box((2.0, 1.5, 1.2), (*place, 0.6)) for place in random.uniform(-18, 18, (25, 2))
             if np.hypot(*place) > 4]
    wall = shapes.box((0.3, 40.0, 4.0), (22.0, 0.0, 2.0))
    floor = shapes.box((120.0, 120.0, 0.1), (0.0, 0.0, -0.05))
    parts = tuple(Part(mesh, "thing") for mesh in (floor, wall, *boxes))
    elevations = np.radians(np.arange(10.0, -30.0, -ring_step_deg))
    sensor = synthetic.Sensor("test", elevations, 700, 60.0, 0.02, 0.0, height_m)
    return synthetic.scan_sequence(Scene(parts, synthetic.scene.at_rest), sensor, 1, rng(3))[0][0].points


@pytest.mark.parametrize("height_m", [0.6, 1.0, 1.73, 2.5, 3.5])
def test_the_sensor_height_is_estimated(height_m):
    points = yard(height_m)
    rows = np.arange(len(points))
    assert ground.estimate_sensor_height(points, rows) == pytest.approx(height_m, abs=0.1)
    on_ground = points + [0, 0, height_m]
    assert ground.estimate_sensor_height(on_ground, rows) == pytest.approx(0.0, abs=0.1)


@pytest.mark.parametrize("height_m", [0.6, 1.73, 2.5])
@pytest.mark.parametrize("is_origin_on_ground", [False, True])
def test_flat_ground_is_found_from_any_height(height_m, is_origin_on_ground):
    points = yard(height_m)
    height_over_ground = points[:, 2] + height_m
    if is_origin_on_ground:
        points = points + [0, 0, height_m]
    found = ground.detect(points, np.ones(len(points), bool), CONFIG).mask
    is_floor, is_thing = height_over_ground < 0.06, height_over_ground > 0.5
    assert found[is_floor].mean() > 0.95
    assert is_floor.sum() > 5000 and is_thing.sum() > 500
    assert found[is_thing].mean() < 0.01


@pytest.mark.parametrize("aside_m", [1.8, 2.2, 3.5])
def test_a_car_beside_the_sensor_is_no_ground(aside_m):
    """Its bonnet and roof are flat, and no road is seen around them: 13,000 of its 17,000 points were."""
    floor, wall = shapes.box((120.0, 120.0, 0.1), (0.0, 0.0, -0.05)), shapes.box((60, 0.3, 4), (0, 9, 2))
    body = shapes.box((4.4, 1.8, 0.75), (0.5, aside_m, 0.6))
    cabin = shapes.box((2.4, 1.6, 0.5), (0.2, aside_m, 1.2))
    parts = tuple(Part(mesh, "thing") for mesh in (floor, wall, body, cabin))
    scene = Scene(parts, synthetic.scene.at_rest)
    sensor = synthetic.hdl64e(columns=1000)
    points = synthetic.scan_sequence(scene, sensor, 1, rng(5))[0][0].points
    found = ground.detect(points, np.ones(len(points), bool), CONFIG).mask
    height_over_ground = points[:, 2] + sensor.height_m
    on_car = (np.abs(points[:, :2] - [0.5, aside_m]) < [2.3, 1.0]).all(axis=1) & (height_over_ground > 0.4)
    assert on_car.sum() > 5000 and not found[on_car].any()
    assert found[height_over_ground < 0.06].mean() > 0.95


def test_ground_may_rise_away_from_the_sensor():
    x, y = rng(6).uniform(-40, 40, (2, 60_000))
    road = np.column_stack([x, y, np.maximum(0.12 * (x - 5.0), 0.0) - 1.73 + rng(7).normal(0, 0.01, len(x))])
    assert ground.detect(road, np.ones(len(road), bool), CONFIG).mask.mean() > 0.95


def test_a_given_height_is_used_instead_of_the_estimate():
    points = yard(1.73)
    kept = np.ones(len(points), bool)
    by_estimate = ground.detect(points, kept, CONFIG).mask
    assert (ground.detect(points, kept, GroundConfig(sensor_height_m=1.73)).mask == by_estimate).mean() > 0.99


def test_clouds_too_small_or_too_far_have_no_ground():
    flat = np.column_stack([rng(4).uniform(-5, 5, (1000, 2)), np.full(1000, -1.7)])
    kept = np.zeros(1000, bool)
    kept[:40] = True
    for points, rows in ((flat, kept), (flat[:0], kept[:0]), (flat[:3], np.ones(3, bool)),
                         (np.full((1000, 3), np.nan), np.zeros(1000, bool)),
                         (flat + [200.0, 0, 0], np.ones(1000, bool))):
        found = ground.detect(points, rows, CONFIG).mask
        assert found.shape == (len(points),) and not found.any()
    assert ground.estimate_sensor_height(np.empty((0, 3)), np.arange(0)) is None
    assert ground.estimate_sensor_height(flat + [200.0, 0, 0], np.arange(1000)) is None
    given = GroundConfig(sensor_height_m=1.7)     # Patchwork++ finds nothing so far away
    assert not ground.detect(flat + [200.0, 0, 0], np.ones(1000, bool), given).mask.any()


def test_nothing_is_printed(capfd):
    points = yard(1.73)
    before = points.copy()
    ground.detect(points, np.ones(len(points), bool), CONFIG)
    captured = capfd.readouterr()
    assert captured.out == "" and captured.err == ""
    np.testing.assert_array_equal(points, before)
