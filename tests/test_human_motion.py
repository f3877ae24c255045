"""The person who moves: limbs are rigid, hang together, and carry their points onto the next scan."""

import dataclasses

import numpy as np
import pytest

from lidarflow import open3d_import, pose, synthetic
from lidarflow.datasets import open_dataset
from lidarflow.errors import DataError
from lidarflow.synthetic.human_motion import LIMBS, MOTIONS, person
from lidarflow.synthetic.raycast import raycasting_scene
from lidarflow.synthetic.scene import Part

DT_S = 0.1
NOISY = synthetic.hdl32e()
EXACT = dataclasses.replace(NOISY, range_noise_m=0.0, drop_probability=0.0)
LEGS, ABDOMEN, CHEST, LEFT_UPPER, LEFT_LOWER, RIGHT_UPPER, RIGHT_LOWER = range(7)
TIMES_S = np.linspace(0.0, 0.9, 10)

every_motion = pytest.mark.parametrize("name", MOTIONS)


def rng(seed: int) -> np.random.Generator:
    return np.random.default_rng(seed)


def limbs_of(scene: synthetic.Scene) -> list[Part]:
    return sorted((part for part in scene.parts if part.object_id >= 0), key=lambda part: part.object_id)


def standing(name: str) -> list[Part]:
    """The person at the origin, looking along x."""
    return person(MOTIONS[name], lambda time_s: pose.identity())


def distance_m(parts: list[Part], time_s: float, points: np.ndarray) -> np.ndarray:
    """Distances (N,) of world points (N, 3) to the surfaces of parts."""
    tensor = open3d_import.open3d().core.Tensor(points.astype(np.float32))
    return raycasting_scene(parts, time_s).compute_distance(tensor).numpy()


def hand(limb: Part, time_s: float) -> np.ndarray:
    """The middle (3,) of the forearm's far end, in world coordinates."""
    vertices = limb.mesh.vertices
    end = vertices[vertices[:, 2] <= vertices[:, 2].min() + 0.01].mean(axis=0)
    return pose.apply(limb.world_from_part(time_s), end)


def turning_rad_per_s(limb: Part) -> np.ndarray:
    """How fast (T-1,) a limb turns against the ground."""
    poses = np.stack([limb.world_from_part(time_s) for time_s in TIMES_S])
    return pose.rotation_distance(poses[:-1], poses[1:]) / np.diff(TIMES_S)


@every_motion
def test_points_of_a_limb_move_with_its_rigid_motion(name):
    scene = synthetic.human_motion(name, rng(0), 6.0)
    (scan, truth), _ = synthetic.scan_sequence(scene, NOISY, 2, rng(1), DT_S)
    sensor = scene.world_from_sensor(0.0, NOISY.height_m)
    for limb in limbs_of(scene):
        rows = truth.object_id == limb.object_id
        world_motion = limb.world_from_part(DT_S) @ pose.inverse(limb.world_from_part(0.0))
        motion = pose.inverse(sensor) @ world_motion @ sensor
        moved = pose.apply(motion, scan.points[rows])
        np.testing.assert_allclose(scan.points[rows] + truth.flow[rows], moved, atol=1e-9)
    assert (truth.flow[truth.object_id == -1] == 0.0).all()
    assert np.linalg.norm(truth.flow[truth.object_id >= 0], axis=1).max() > 0.03


@every_motion
def test_the_flow_ends_on_the_limb_where_it_is_at_the_next_scan(name):
    scene = synthetic.human_motion(name, rng(2), 7.0)
    (scan, truth), _ = synthetic.scan_sequence(scene, EXACT, 2, rng(3), DT_S)
    sensor = scene.world_from_sensor(0.0, EXACT.height_m)
    for limb in limbs_of(scene):
        rows = truth.object_id == limb.object_id
        arrived = pose.apply(sensor, scan.points[rows] + truth.flow[rows])
        assert distance_m([limb], DT_S, arrived).max(initial=0.0) < 1e-4


@every_motion
def test_noise_moves_points_off_the_body_by_no_more_than_its_size(name):
    scene = synthetic.human_motion(name, rng(2), 7.0)
    (scan, truth), _ = synthetic.scan_sequence(scene, NOISY, 2, rng(3), DT_S)
    rows = truth.object_id >= 0
    arrived = pose.apply(scene.world_from_sensor(0.0, NOISY.height_m), scan.points[rows] + truth.flow[rows])
    off_m = distance_m(limbs_of(scene), DT_S, arrived)
    assert off_m.max() < 5 * NOISY.range_noise_m
    assert 0.2 * NOISY.range_noise_m < off_m.mean() < NOISY.range_noise_m


@every_motion
def test_limbs_hang_together_at_their_joints(name):
    limbs = standing(name)
    for child, parent in ((ABDOMEN, LEGS), (CHEST, ABDOMEN), (LEFT_UPPER, CHEST), (LEFT_LOWER, LEFT_UPPER),
                          (RIGHT_UPPER, CHEST), (RIGHT_LOWER, RIGHT_UPPER)):
        joints = [(pose.inverse(limbs[parent].world_from_part(time_s))
                   @ limbs[child].world_from_part(time_s))[:3, 3] for time_s in TIMES_S]
        np.testing.assert_allclose(joints, np.tile(joints[0], (len(TIMES_S), 1)), atol=1e-12)
        for time_s in TIMES_S:
            joint = limbs[child].world_from_part(time_s)[None, :3, 3]
            for limb in (child, parent):
                assert distance_m([limbs[limb]], time_s, joint)[0] < 0.15, f"{LIMBS[limb]} at {time_s} s"


@every_motion
def test_the_legs_stand_on_the_ground(name):
    legs = standing(name)[LEGS]
    assert (turning_rad_per_s(legs) == 0.0).all()
    assert -0.02 < legs.mesh.vertices[:, 2].min() < 0.02


@every_motion
def test_a_bent_trunk_has_no_gap(name):
    """Rays from far in front, level with the joints of the trunk, never pass through."""
    limbs = standing(name)
    for time_s in TIMES_S:
        for joint in (ABDOMEN, CHEST):
            x, y, z = limbs[joint].world_from_part(time_s)[:3, 3]
            rays = np.array([[x + 5.0, y, z + rise, -1.0, 0.0, 0.0] for rise in np.linspace(-0.05, 0.05, 11)])
            trunk = raycasting_scene([limbs[LEGS], limbs[ABDOMEN], limbs[CHEST]], time_s)
            tensor = open3d_import.open3d().core.Tensor(rays.astype(np.float32))
            assert (trunk.cast_rays(tensor)["t_hit"].numpy() < 5.0).all()


@pytest.mark.parametrize(("name", "moving"), [
    ("arms_up_down", (LEFT_UPPER, RIGHT_UPPER)), ("arms_backwards", (LEFT_UPPER, RIGHT_UPPER)),
    ("bend_sidewards", (CHEST,)), ("bend_forward", (CHEST,))])
def test_speeds_are_those_of_a_person(name, moving):
    low, high = (0.5, 1.02) if moving == (CHEST,) else (0.95, 2.02)
    limbs = standing(name)
    for limb in moving:
        speed = turning_rad_per_s(limbs[limb])
        assert speed.min() >= low and speed.max() <= high, f"{LIMBS[limb]}: {speed}"


def test_one_arm_goes_up_while_the_other_goes_down():
    limbs = standing("arms_up_down")
    left, right = (np.array([hand(limbs[limb], t) for t in TIMES_S]) for limb in (LEFT_LOWER, RIGHT_LOWER))
    assert (np.diff(left[:, 2]) > 0).all() and (np.diff(right[:, 2]) < 0).all()
    assert (left[:, 1] > 0.2).all() and (right[:, 1] < -0.2).all()


def test_both_arms_go_backwards_beside_the_body():
    limbs = standing("arms_backwards")
    for limb, side in ((LEFT_LOWER, 1), (RIGHT_LOWER, -1)):
        places = np.array([hand(limbs[limb], time_s) for time_s in TIMES_S])
        assert (np.diff(places[:, 0]) < 0).all()
        assert places[0, 0] > 0.3 and places[-1, 0] < 0.0
        assert (side * places[:, 1] > 0.2).all()


@pytest.mark.parametrize(("name", "axis", "sign"), [("bend_sidewards", 1, -1), ("bend_forward", 0, 1)])
def test_the_head_goes_where_the_trunk_bends(name, axis, sign):
    limbs = standing(name)
    vertices = limbs[CHEST].mesh.vertices
    crown = vertices[np.argmax(vertices[:, 2])]
    places = np.array([pose.apply(limbs[CHEST].world_from_part(time_s), crown) for time_s in TIMES_S])
    assert (sign * np.diff(places[:, axis]) > 0).all()
    assert sign * (places[-1, axis] - places[0, axis]) > 0.3
    np.testing.assert_allclose(places[:, 1 - axis], places[0, 1 - axis], atol=0.05)


@every_motion
@pytest.mark.parametrize(("distance_m", "fewest", "most"), [(6.0, 130, 330), (10.0, 45, 130)])
def test_a_scan_sees_a_person_of_limbs(name, distance_m, fewest, most):
    scene = synthetic.human_motion(name, rng(4), distance_m)
    sequence = synthetic.scan_sequence(scene, NOISY, 5, rng(5), DT_S)
    ids = [truth.object_id for _, truth in sequence[:-1]]
    assert all(fewest < (seen >= 0).sum() < most for seen in ids)
    assert set(np.concatenate(ids)) == {-1, *range(len(LIMBS))}
    for scan, truth in sequence[:-1]:
        extent = np.ptp(scan.points[truth.object_id >= 0], axis=0)
        assert 1.2 < extent[2] < 2.0 and extent[0] < 1.4 and extent[1] < 1.9
        assert not truth.is_dynamic[truth.object_id <= LEGS].any()


def test_the_sensor_may_move():
    def along_x(time_s: float) -> np.ndarray:
        return pose.from_translation(np.array([time_s, 0.0, 0.0]))

    scene = synthetic.human_motion("bend_forward", rng(0), 8.0, along_x)
    (_, truth), _ = synthetic.scan_sequence(scene, NOISY, 2, rng(1), DT_S)
    on_legs = truth.object_id == LEGS
    np.testing.assert_allclose(truth.flow[on_legs] - [-0.1, 0.0, 0.0], 0.0, atol=1e-9)
    assert on_legs.any() and not truth.is_dynamic[on_legs].any()


def test_the_same_seed_gives_the_same_scans():
    first, again, other = (
        synthetic.scan_sequence(synthetic.human_motion("arms_up_down", rng(seed)), NOISY, 2, rng(seed), DT_S)
        for seed in (7, 7, 8))
    np.testing.assert_array_equal(first[0][0].points, again[0][0].points)
    np.testing.assert_array_equal(first[0][1].flow, again[0][1].flow)
    assert not np.array_equal(first[0][0].points, other[0][0].points)


def test_a_written_sequence_is_read_with_its_limbs(tmp_path):
    scene = synthetic.human_motion("arms_backwards", rng(0))
    sequence = synthetic.scan_sequence(scene, NOISY, 3, rng(1), DT_S)
    synthetic.write_kitti(tmp_path, sequence)
    data = open_dataset(tmp_path, kitti_correction="off")
    assert len(data) == 3
    for frame in range(2):
        (scan, truth), stored = sequence[frame], data.truth(frame)
        np.testing.assert_allclose(data.scan(frame).points, scan.points, atol=1e-5)
        np.testing.assert_allclose(stored.flow, truth.flow, atol=1e-6)
        np.testing.assert_array_equal(stored.object_id, truth.object_id)


def test_an_unknown_motion_and_a_person_outside_of_the_yard_are_refused():
    with pytest.raises(DataError, match="'dance': unknown, expected one of arms_up_down, "):
        synthetic.human_motion("dance", rng(0))
    with pytest.raises(DataError, match=r"2 m away .* expected 3 to 11 m"):
        synthetic.human_motion("bend_forward", rng(0), 2.0)
