"""Clouds in which z is not up are told from those in which it may be."""

from dataclasses import replace

import numpy as np
import pytest
from cloud_files import write_bin
from command_line import drive
from shared_data import SHARED, needs_shared

from lidarflow import checkpoints, estimate_flow, open_dataset, pose, read_scan, synthetic
from lidarflow.config import Config, load
from lidarflow.lidar import upright
from lidarflow.lidar.ego import Thinned
from lidarflow.lidar.tracking import Tracks
from lidarflow.open3d_import import open3d
from lidarflow.synthetic import Part, shapes
from lidarflow.synthetic.raycast import raycasting_scene
from lidarflow.types import Scan, ScanPair


def about(axis, deg):
    """The rotation (3, 3) about "x" or "y"."""
    twist = np.zeros(6)
    twist["xyz".index(axis)] = np.radians(deg)
    return pose.exp(twist)[:3, :3]


Y_UP = np.array([[0.0, -1, 0], [0, 0, 1], [-1, 0, 0]])       # x right, y up, z back
CAMERA = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])     # x right, y down, z forward
X_UP = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
SLIGHT = {"as it is": np.eye(3), "nods": about("y", 5), "nods back": about("y", -5), "rolls": about("x", 5)}
FLAT = {"y": Y_UP, "x": X_UP, "y, camera": CAMERA}
LEANING = {"pitch": about("y", 30), "pitch back": about("y", -30), "roll": about("x", 30)}


def doubt(points):
    return upright.doubt(points, Thinned.of_scan(Scan(points), Config()).planes.normals)


def seen(vertices, directions, place, sensor_from_world):
    """Points (N, 3) in the frame of a sensor that stands aslant, in a mesh."""
    origins = np.broadcast_to(np.asarray(place, float), directions.shape)
    rays = np.column_stack([origins, directions @ sensor_from_world]).astype(np.float32)
    world = raycasting_scene([Part(vertices, "world")], 0.0)
    range_m = world.cast_rays(open3d().core.Tensor(rays))["t_hit"].numpy().astype(float)
    hit = range_m < 100.0
    noise_m = np.random.default_rng(0).normal(scale=0.02, size=hit.sum())
    return directions[hit] * (range_m[hit] + noise_m)[:, None]


def fan(lowest_deg, highest_deg, rings, columns=600):
    return synthetic.Sensor("fan", np.deg2rad(np.linspace(highest_deg, lowest_deg, rings)), columns, 100.0,
                            0.0, 0.0, 1.0).directions()


SENSORS = {"64 rings": synthetic.hdl64e(columns=800).directions(), "45 degrees": fan(-22.5, 22.5, 64),
           "90 degrees": fan(-45, 45, 64), "16 rings": fan(-15, 15, 16, 1800)}


def walls(length, width, height):
    """A hollow box: floor, ceiling and walls 0.1 m thick; the floor is at z = 0."""
    return [shapes.shifted(shapes.box((length, width, 0.1)), z=-0.05),
            shapes.shifted(shapes.box((length, width, 0.1)), z=height + 0.05),
            *(shapes.shifted(shapes.box((length, 0.1, height)), y=side * width / 2, z=height / 2)
              for side in (-1, 1)),
            *(shapes.shifted(shapes.box((0.1, width, height)), x=side * length / 2, z=height / 2)
              for side in (-1, 1))]


def furniture(length, width, count=12):
    rng = np.random.default_rng(1)
    return [shapes.shifted(shapes.box((0.8, 0.6, height)), x, y, height / 2) for x, y, height in zip(
        rng.uniform(-length / 2, length / 2, count), rng.uniform(-width / 2, width / 2, count),
        rng.uniform(0.4, 1.5, count), strict=True)]


def alley(width, height):
    return [shapes.shifted(shapes.box((400, 400, 0.1)), z=-0.05),
            *(shapes.shifted(shapes.box((120, 5, height)), y=side * (width / 2 + 2.5), z=height / 2)
              for side in (-1, 1))]


PLACES = {
    "room": [*walls(5, 4, 2.5), *furniture(5, 4)], "hall": [*walls(20, 12, 6), *furniture(20, 12)],
    "corridor": walls(40, 2, 2.6), "corridor on edge": walls(30, 1.2, 4),
    "garage": [*walls(60, 40, 2.4), *furniture(60, 40, 40)], "shaft": walls(3, 3, 20),
    "alley": alley(3, 10), "gap between houses": alley(2, 20),
    "a wall, nothing else": [shapes.shifted(shapes.box((0.1, 200, 200)), x=5)],
}


@pytest.fixture(scope="module")
def street():
    scene = synthetic.street(np.random.default_rng(0))
    return shapes.merged(shapes.moved(part.mesh, part.world_from_part(0.5)) for part in scene.parts), (
        pose.apply(scene.world_from_sensor(0.5, 1.8), np.zeros((1, 3)))[0])


@pytest.mark.parametrize("sensor", ["64 rings", "45 degrees", "16 rings"])
def test_axes_that_are_called_otherwise_are_noticed(street, sensor):
    points = seen(street[0], SENSORS[sensor], street[1], np.eye(3))
    for how, turn in FLAT.items():
        assert doubt(points @ turn.T) == (
            f"the cloud is flat along {how[0]}; expected z up, turn the clouds")


@pytest.mark.parametrize("sensor", ["64 rings", "45 degrees", "90 degrees"])
@pytest.mark.parametrize("how", LEANING)
def test_a_sensor_that_stands_aslant_is_noticed(street, sensor, how):
    said = doubt(seen(street[0], SENSORS[sensor], street[1], LEANING[how]))
    assert said.startswith("the ground leans by ")
    assert 26 <= float(said.split(" by ")[1].split()[0]) <= 34


@pytest.mark.parametrize("sensor", SENSORS)
@pytest.mark.parametrize("how", SLIGHT)
def test_a_street_with_z_up_is_taken_as_it_is(street, sensor, how):
    assert doubt(seen(street[0], SENSORS[sensor], street[1], SLIGHT[how])) == ""


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("height_m", [0.3, 1.9])
def test_rooms_and_places_without_ground_are_taken_as_they_are(place, height_m):
    mesh = shapes.merged(PLACES[place])
    for sensor, directions in SENSORS.items():
        for how in ("as it is", "nods"):
            points = seen(mesh, directions, (0.1, 0.1, height_m), SLIGHT[how])
            assert doubt(points) == "", (sensor, how)


@pytest.mark.parametrize("points", [np.empty((0, 3)), np.full((9, 3), np.nan), np.ones((5, 3)),
                                    np.full((40, 3), 1e300), np.zeros((40, 3))])
def test_what_is_no_cloud_raises_no_doubt(points):
    for normals in (np.empty((0, 3)), np.full((7, 3), np.nan)):
        assert upright.doubt(points, normals) == ""


def test_the_result_says_so_and_is_no_other_for_it():
    points = [scan.points for scan, _ in drive()[:2]]
    assert estimate_flow(tuple(points)).doubt == ""
    assert "flat along y" in estimate_flow(tuple(cloud @ Y_UP.T for cloud in points)).doubt


def test_a_checkpoint_keeps_the_doubt(tmp_path):
    pair = ScanPair(*(scan for scan, _ in drive()[:2]))
    result = replace(estimate_flow(pair, load(overrides=("objects.enabled=false",))), doubt="flat along x")
    file = tmp_path / "0.npz"
    file.write_bytes(checkpoints.packed(pair, result, Tracks(), checkpoints.Stretch(0, 0)))
    assert checkpoints.unpacked(file, pair)[0].doubt == "flat along x"


def test_the_command_line_says_so_once(lidarflow, tmp_path):
    for k, (scan, _) in enumerate(drive()):
        write_bin(tmp_path / "turned" / f"{k}.bin", scan.points @ Y_UP.T)
        write_bin(tmp_path / "upright" / f"{k}.bin", scan.points)
    line = "the cloud is flat along y; expected z up, turn the clouds"
    for folder, count in (("turned", 1), ("upright", 0)):
        there = tmp_path / folder
        told = lidarflow.ok("run", there, "--out", tmp_path / "run", "--no-record")
        assert told.count("expected z up") == count
        assert (f"0 and 1 more of 2 scans: {line}\n" in told) == bool(count)
        told = lidarflow.ok("pair", there / "0.bin", there / "1.bin", "--out", tmp_path / "f.npz")
        notes = [row.split(maxsplit=1)[1].strip() for row in told.splitlines() if row.startswith("note ")]
        assert notes == [line] * count


REAL = ("kitti_odometry_00_start", "kitti_raw_0048", "kitti_tracked_0005_from_040", "argoverse2",
        "moosmann_durlacher_tor", "ouster_os1_128/000000.bin", "mrpt_hdl32_vlp16/hdl32_1.bin",
        "mrpt_hdl32_vlp16/vlp16_1.bin", "small_gicp_pair/source.ply")


@needs_shared
@pytest.mark.parametrize("name", REAL)
def test_real_scans_turned_and_as_they_are(name):
    place = SHARED / name
    points = (open_dataset(place).scan(0) if place.is_dir() else read_scan(place)).points
    for how, turn in SLIGHT.items():
        assert doubt(points @ turn.T) == "", how
    for how, turn in FLAT.items():
        assert f"flat along {how[0]};" in doubt(points @ turn.T), how
    assert "leans by" in doubt(points @ LEANING["pitch"].T)
