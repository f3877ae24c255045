"""Generated scenes: the truth obeys identities, the sensor its geometry, the files their layout."""

import builtins
import dataclasses

import numpy as np
import pytest

from lidarflow import open3d_import, pose, synthetic
from lidarflow.errors import DataError, InstallError
from lidarflow.synthetic import Part, Scene, shapes
from lidarflow.synthetic.people import pedestrian
from lidarflow.synthetic.raycast import raycasting_scene

DT_S = 0.1
EXACT = synthetic.hdl64e(columns=300, range_noise_m=0.0, drop_probability=0.0)
NOISY = synthetic.hdl64e(columns=300)


def rng(seed: int) -> np.random.Generator:
    return np.random.default_rng(seed)


def distance_m(scene, points: np.ndarray) -> np.ndarray:
    """Distances (N,) of world points (N, 3) to the surfaces of a RaycastingScene."""
    tensor = open3d_import.open3d().core.Tensor(points.astype(np.float32))
    return scene.compute_distance(tensor).numpy()


def walls_around(range_m: float) -> Scene:
    """A closed ball of walls, nearly `range_m` from the sensor in every direction."""
    ball = shapes.ellipsoid((0.0, 0.0, EXACT.height_m), (range_m,) * 3, count=64)
    return Scene((Part(ball, "walls"),), synthetic.scene.at_rest)


@pytest.fixture(scope="module")
def street() -> Scene:
    return synthetic.street(rng(0))


@pytest.fixture(scope="module")
def street_pair(street):
    return synthetic.scan_sequence(street, NOISY, 2, rng(1), DT_S)


@pytest.fixture(scope="module")
def yard_sequence():
    return synthetic.scan_sequence(synthetic.room(rng(2)), NOISY, 4, rng(3), DT_S)


def test_hdl64e_has_two_laser_blocks():
    elevations_deg = np.rad2deg(synthetic.hdl64e().elevations_rad)
    steps_deg = -np.diff(elevations_deg)
    np.testing.assert_allclose(elevations_deg[[0, 31, 32, 63]], [2.0, -8.333, -8.83, -24.33], atol=1e-3)
    np.testing.assert_allclose(steps_deg[:31], 1 / 3)
    np.testing.assert_allclose(steps_deg[32:], 1 / 2)


def test_hdl32e_spans_its_field_of_view():
    elevations_deg = np.rad2deg(synthetic.hdl32e().elevations_rad)
    assert len(elevations_deg) == 32
    np.testing.assert_allclose(elevations_deg[[0, -1]], [10.67, -30.67])


@pytest.mark.parametrize("wrong", [{"columns": 0}, {"drop_probability": 1.5}, {"max_range_m": 0.0},
                                   {"elevations_rad": np.array([-0.1, 0.1])}])
def test_an_impossible_sensor_is_refused(wrong):
    with pytest.raises(ValueError, match="Sensor"):
        dataclasses.replace(EXACT, **wrong)


def test_points_come_ring_by_ring_with_rising_azimuth():
    (scan, _), = synthetic.scan_sequence(walls_around(20.0), EXACT, 1, rng(0))
    points = scan.points.reshape(len(EXACT.elevations_rad), EXACT.columns, 3)
    elevation = np.arctan2(points[..., 2], np.linalg.norm(points[..., :2], axis=-1))
    azimuth = np.arctan2(points[..., 1], points[..., 0]) % (2 * np.pi)
    np.testing.assert_allclose(elevation, np.broadcast_to(EXACT.elevations_rad[:, None], elevation.shape))
    np.testing.assert_allclose(np.diff(azimuth, axis=1), 2 * np.pi / EXACT.columns)


def test_range_noise_and_dropped_returns_have_the_stated_size():
    noisy = dataclasses.replace(EXACT, range_noise_m=0.03, drop_probability=0.2)
    scene = walls_around(20.0)
    (exact, _), = synthetic.scan_sequence(scene, EXACT, 1, rng(5))
    (scan, _), = synthetic.scan_sequence(scene, dataclasses.replace(noisy, drop_probability=0.0), 1, rng(5))
    error_m = np.linalg.norm(scan.points, axis=1) - np.linalg.norm(exact.points, axis=1)
    assert abs(error_m.mean()) < 0.001
    assert error_m.std() == pytest.approx(0.03, rel=0.05)
    direction = exact.points / np.linalg.norm(exact.points, axis=1, keepdims=True)
    np.testing.assert_allclose(np.cross(direction, scan.points), 0.0, atol=1e-9)

    (thinned, _), = synthetic.scan_sequence(scene, noisy, 1, rng(5))
    assert len(thinned) / len(exact) == pytest.approx(0.8, abs=0.02)


def test_nothing_is_seen_beyond_the_maximal_range():
    far, near = dataclasses.replace(EXACT, max_range_m=21.0), dataclasses.replace(EXACT, max_range_m=19.0)
    (scan, _), = synthetic.scan_sequence(walls_around(20.0), far, 1, rng(0))
    (nothing, _), = synthetic.scan_sequence(walls_around(20.0), near, 1, rng(0))
    assert len(scan) == 64 * EXACT.columns
    assert len(nothing) == 0


def test_scans_carry_time_and_name_and_only_the_last_has_no_truth(yard_sequence):
    assert [scan.time_ns for scan, _ in yard_sequence] == [0, 100_000_000, 200_000_000, 300_000_000]
    assert [scan.name for scan, _ in yard_sequence] == ["000000", "000001", "000002", "000003"]
    assert [truth is None for _, truth in yard_sequence] == [False, False, False, True]


def test_a_static_world_moves_with_the_ego_motion_alone(yard_sequence):
    scan, truth = yard_sequence[0]
    np.testing.assert_allclose(truth.flow, pose.apply(truth.ego_motion, scan.points) - scan.points, atol=1e-9)
    assert np.median(np.linalg.norm(truth.flow, axis=1)) > 0.1
    assert not truth.is_dynamic.any() and (truth.object_id == -1).all() and truth.valid.all()


def test_the_flow_of_a_static_world_ends_on_its_surfaces():
    scene = synthetic.room(rng(2))
    (scan, truth), _ = synthetic.scan_sequence(scene, EXACT, 2, rng(3), DT_S)
    world_from_target = scene.world_from_sensor(DT_S, EXACT.height_m)
    arrived = pose.apply(world_from_target, scan.points + truth.flow)
    left = pose.apply(world_from_target, scan.points)
    surfaces = raycasting_scene(list(scene.parts), 0.0)
    assert distance_m(surfaces, arrived).max() < 1e-4
    assert np.median(distance_m(surfaces, left)) > 0.01


def test_the_flow_of_a_moving_car_ends_on_the_car():
    scene = synthetic.one_car(11.0, rng(4))
    (scan, truth), _ = synthetic.scan_sequence(scene, EXACT, 2, rng(5), DT_S)
    on_car = truth.object_id == 0
    world_from_target = scene.world_from_sensor(DT_S, EXACT.height_m)
    car = raycasting_scene([part for part in scene.parts if part.object_id == 0], DT_S)
    arrived = pose.apply(world_from_target, scan.points[on_car] + truth.flow[on_car])
    turned_back = pose.apply(world_from_target, scan.points[on_car] - truth.flow[on_car])
    assert on_car.sum() > 50
    assert distance_m(car, arrived).max() < 1e-4
    assert np.median(distance_m(car, turned_back)) > 0.3


@pytest.mark.parametrize(("speed_m_per_s", "expected"), [(11, True), (-3, True), (0.6, True), (0.4, False)])
def test_a_car_is_dynamic_from_half_a_metre_per_second(speed_m_per_s, expected):
    scene = synthetic.one_car(speed_m_per_s, rng(4))
    (scan, truth), _ = synthetic.scan_sequence(scene, NOISY, 2, rng(5), DT_S)
    on_car = truth.object_id == 0
    residual = truth.flow - (pose.apply(truth.ego_motion, scan.points) - scan.points)
    np.testing.assert_allclose(np.linalg.norm(residual[on_car], axis=1), abs(speed_m_per_s) * DT_S)
    np.testing.assert_allclose(residual[~on_car], 0.0, atol=1e-9)
    assert (truth.is_dynamic == (on_car & expected)).all()


def test_the_dynamic_mask_is_about_speed_not_about_the_step_between_scans():
    scene = synthetic.one_car(0.4, rng(4))
    (_, truth), _ = synthetic.scan_sequence(scene, NOISY, 2, rng(5), dt_s=1.0)
    assert (truth.object_id == 0).any() and not truth.is_dynamic.any()


def test_playing_time_backwards_inverts_the_ego_motion():
    scene = synthetic.room(rng(2))
    backwards = Scene(scene.parts, lambda time_s: scene.world_from_vehicle(DT_S - time_s))
    (_, there), _ = synthetic.scan_sequence(scene, NOISY, 2, rng(0), DT_S)
    (_, back), _ = synthetic.scan_sequence(backwards, NOISY, 2, rng(0), DT_S)
    np.testing.assert_allclose(back.ego_motion, pose.inverse(there.ego_motion), atol=1e-12)


def test_limbs_swing_about_joints_that_stay_with_the_torso():
    def feet(time_s: float) -> np.ndarray:
        return pose.from_translation(np.array([1.4 * time_s, 0.0, 0.0]))

    torso, *limbs = pedestrian(0, feet, 1.4, rng(6))
    assert {part.object_id for part in (torso, *limbs)} == {0}
    angles = []
    for time_s in np.linspace(0.0, 1.2, 13):
        torso_from_limb = [pose.inverse(torso.world_from_part(time_s)) @ limb.world_from_part(time_s)
                           for limb in limbs]
        joints = [pose.inverse(torso.world_from_part(0.0)) @ limb.world_from_part(0.0) for limb in limbs]
        for now, start in zip(torso_from_limb, joints, strict=True):
            np.testing.assert_allclose(now[:3, 3], start[:3, 3], atol=1e-12)
        angles.append([pose.log(motion)[1] for motion in torso_from_limb])
    left_leg, right_leg, left_arm, right_arm = np.array(angles).T
    assert np.ptp(left_leg) > 0.6
    np.testing.assert_allclose(left_leg, -right_leg, atol=1e-9)
    np.testing.assert_allclose(left_arm, -right_arm, atol=1e-9)
    assert (left_leg * left_arm <= 1e-12).all()


def test_feet_stay_on_the_ground_while_walking():
    parts = pedestrian(0, lambda time_s: pose.identity(), 1.4, rng(6))
    for time_s in np.linspace(0.0, 1.0, 11):
        vertices = [pose.apply(part.world_from_part(time_s), part.mesh.vertices) for part in parts]
        assert -0.12 < np.concatenate(vertices)[:, 2].min() < 0.06


def test_points_of_one_pedestrian_move_differently(street, street_pair):
    scan, truth = street_pair[0]
    ids = {part.object_id for part in street.parts if "pedestrian" in part.name}
    residual = truth.flow - (pose.apply(truth.ego_motion, scan.points) - scan.points)
    speeds = [np.linalg.norm(residual[truth.object_id == i], axis=1) / DT_S for i in ids]
    seen = [speed for speed in speeds if len(speed) >= 15]
    assert len(seen) >= 2
    assert all(np.ptp(speed) > 0.3 for speed in seen)
    assert all(0.5 < np.median(speed) < 3.0 for speed in seen)


def test_the_street_has_movers_of_every_kind_and_parked_cars(street, street_pair):
    (scan, truth), _ = street_pair
    kinds = [{part.name.split()[0] for part in street.parts if part.object_id == i}.pop()
             for i in np.unique(truth.object_id) if i >= 0]
    assert kinds.count("car") >= 4 and kinds.count("pedestrian") >= 4
    assert kinds.count("cyclist") == 2 and kinds.count("van") >= 1
    assert 0.01 < truth.is_dynamic.mean() < 0.2
    assert (truth.object_id[truth.is_dynamic] >= 0).all()
    parked = raycasting_scene([part for part in street.parts if part.name == "parked cars"], 0.0)
    on_parked = distance_m(parked, pose.apply(street.world_from_sensor(0.0), scan.points)) < 0.05
    assert on_parked.sum() > 500 and not truth.is_dynamic[on_parked].any()


@pytest.mark.parametrize("seed", range(4))
def test_nothing_comes_near_the_sensor_or_runs_into_anything(seed):
    scene = synthetic.street(rng(seed))
    things = [part for part in scene.parts if part.name != "ground"]
    movers = [part for part in things if not part.is_static]
    static = raycasting_scene([part for part in things if part.is_static], 0.0)
    for time_s in (0.0, 0.4, 0.8, 1.2):
        sensor = scene.world_from_sensor(time_s)[None, :3, 3]
        assert distance_m(static, sensor).min() > 2.0
        assert distance_m(raycasting_scene(movers, time_s), sensor).min() > 2.0
        for mover in movers:
            mine = pose.apply(mover.world_from_part(time_s), mover.mesh.vertices)
            strangers = [part for part in movers if part.object_id != mover.object_id]
            assert distance_m(static, mine).min() > 0.05, f"{mover.name} at {time_s} s"
            assert distance_m(raycasting_scene(strangers, time_s), mine).min() > 0.05, mover.name


def test_a_full_scan_of_the_street_looks_like_one(street):
    (scan, _), = synthetic.scan_sequence(street, synthetic.hdl64e(), 1, rng(1))
    assert 90_000 < len(scan) < 125_000
    ground = raycasting_scene([part for part in street.parts if part.name == "ground"], 0.0)
    in_world = pose.apply(street.world_from_sensor(0.0), scan.points)
    assert 0.2 < (distance_m(ground, in_world) < 0.1).mean() < 0.65


def test_the_same_seed_gives_the_same_bytes(tmp_path):
    for name in ("first", "second"):
        sequence = synthetic.scan_sequence(synthetic.street(rng(7)), NOISY, 2, rng(8))
        synthetic.write_kitti(tmp_path / name, sequence)
    first = sorted(path for path in (tmp_path / "first").rglob("*") if path.is_file())
    assert len(first) == 6
    for path in first:
        again = tmp_path / "second" / path.relative_to(tmp_path / "first")
        assert path.read_bytes() == again.read_bytes(), path.name
    other = synthetic.scan_sequence(synthetic.street(rng(9)), NOISY, 1, rng(8))[0][0]
    assert not np.array_equal(other.points, sequence[0][0].points)


def test_kitti_folders_hold_points_and_truth(tmp_path, street_pair):
    synthetic.write_kitti(tmp_path, street_pair)
    base = tmp_path / "sequences" / "00"
    scan, truth = street_pair[0]
    rows = np.fromfile(base / "velodyne" / "000000.bin", np.float32).reshape(-1, 4)
    np.testing.assert_array_equal(rows[:, :3], scan.points.astype(np.float32))
    assert (rows[:, 3] == 0).all()
    assert sorted(path.name for path in (base / "truth").iterdir()) == ["000000.npz"]
    with np.load(base / "truth" / "000000.npz") as stored:
        kinds = {name: stored[name].dtype.name for name in stored.files}
        assert kinds == {"flow": "float32", "ego_flow": "float32", "valid": "bool", "dynamic": "bool",
                         "track": "int16", "target_from_source": "float64"}
        np.testing.assert_allclose(stored["flow"], truth.flow, atol=1e-6)
        np.testing.assert_array_equal(stored["dynamic"], truth.is_dynamic)
        np.testing.assert_array_equal(stored["track"], truth.object_id)
        np.testing.assert_array_equal(stored["target_from_source"], truth.ego_motion)
        static = truth.object_id == -1
        np.testing.assert_allclose(stored["ego_flow"][static], stored["flow"][static], atol=1e-6)


def test_kitti_poses_chain_the_ego_motions_through_tr(tmp_path, yard_sequence):
    synthetic.write_kitti(tmp_path, yard_sequence)
    base = tmp_path / "sequences" / "00"
    key, *numbers = (base / "calib.txt").read_text().split()
    camera_from_velodyne = np.vstack([np.array(numbers, float).reshape(3, 4), [0, 0, 0, 1]])
    assert key == "Tr:" and pose.is_rigid(camera_from_velodyne)
    forward_left_up = pose.apply(camera_from_velodyne, np.eye(3))
    np.testing.assert_array_equal(forward_left_up, [[0, 0, 1], [-1, 0, 0], [0, -1, 0]])

    rows = np.loadtxt(tmp_path / "poses" / "00.txt").reshape(-1, 3, 4)
    poses = pose.from_rotation_translation(rows[:, :, :3], rows[:, :, 3])
    np.testing.assert_array_equal(poses[0], np.eye(4))
    for k, (_, truth) in enumerate(yard_sequence[:-1]):
        target_from_source = pose.inverse(poses[k + 1]) @ poses[k]
        in_velodyne = pose.inverse(camera_from_velodyne) @ target_from_source @ camera_from_velodyne
        np.testing.assert_allclose(in_velodyne, truth.ego_motion, atol=1e-7)
    np.testing.assert_allclose(np.loadtxt(base / "times.txt"), [0.0, 0.1, 0.2, 0.3], atol=1e-9)


def test_a_folder_in_use_is_left_alone(tmp_path, street_pair):
    (tmp_path / "mine.txt").write_text("keep")
    with pytest.raises(DataError, match="empty"):
        synthetic.write_kitti(tmp_path, street_pair)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def test_a_sequence_with_a_missing_truth_is_refused(tmp_path, street_pair):
    (scan, _), last = street_pair
    with pytest.raises(DataError, match="truth"):
        synthetic.write_kitti(tmp_path / "new", [(scan, None), last])
    assert not (tmp_path / "new").exists()


def test_a_static_part_has_no_object_id():
    mesh = shapes.box((1.0, 1.0, 1.0))
    with pytest.raises(ValueError, match="at rest"):
        Part(mesh, "stone", 3)
    with pytest.raises(ValueError, match="at rest"):
        Part(mesh, "ball", -1, lambda time_s: pose.identity())


def test_a_missing_system_library_names_the_packages(monkeypatch):
    real_import = builtins.__import__

    def broken(name, *args, **kwargs):
        if name == "open3d":
            raise OSError("libEGL.so.1: cannot open shared object file")
        return real_import(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", broken)
    with pytest.raises(InstallError, match=r"libEGL.*apt-get install .*libegl1") as caught:
        open3d_import.open3d()
    assert "\n" not in str(caught.value)
