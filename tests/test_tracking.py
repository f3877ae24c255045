"""Objects over time: ids that stay, and what is expected of an object that was missed."""

import numpy as np
import pytest

from lidarflow import pose, synthetic
from lidarflow.lidar import tracking
from lidarflow.lidar.tracking import Tracks
from lidarflow.pipeline import FlowEstimator
from lidarflow.types import Scan

EGO = pose.from_yaw(0.02, (-0.8, 0.05, 0.0))
STEP = pose.from_translation([0.9, 0.0, 0.0])
DT_S = 0.1


def rng(seed: int) -> np.random.Generator:
    return np.random.default_rng(seed)


def car(x: float, y: float) -> np.ndarray:
    return rng(1).uniform(-1, 1, (300, 3)) * [2.0, 0.9, 0.7] + [x, y, 0.0]


def test_ids_are_kept_and_new_objects_get_new_ones():
    near, far = car(8.0, 2.0), car(20.0, -4.0)
    ids = tracking.identify(Tracks(), [near, far])
    assert ids == [0, 1]
    tracks = tracking.advance(Tracks(), ids, [near, far], [STEP, STEP], EGO, DT_S)
    later = [pose.apply(STEP @ EGO, cloud) for cloud in (far, near)]
    newcomer = car(40.0, 0.0)
    assert tracking.identify(tracks, [newcomer, *later]) == [2, 1, 0]


def test_two_pieces_of_one_object_do_not_share_its_id():
    whole = car(8.0, 2.0)
    tracks = tracking.advance(Tracks(), [0], [whole], [STEP], EGO, DT_S)
    moved = pose.apply(STEP @ EGO, whole)
    front = moved[:, 0] > np.median(moved[:, 0])
    assert sorted(tracking.identify(tracks, [moved[front], moved[~front]])) == [0, 1]


def test_a_missed_object_is_expected_where_it_would_be():
    cloud = car(8.0, 2.0)
    tracks = tracking.advance(Tracks(), [0], [cloud], [STEP], EGO, DT_S)
    for _ in range(2):
        tracks = tracking.advance(tracks, [], [], [], EGO, DT_S)
    expected = cloud
    motion = STEP @ EGO
    over_ground = STEP
    for _ in range(3):
        expected = pose.apply(motion, expected)
        over_ground = EGO @ over_ground @ pose.inverse(EGO)
        motion = over_ground @ EGO
    found, = tracks.followed
    np.testing.assert_allclose(found.points, expected, atol=1e-9)
    assert tracking.identify(tracks, [expected]) == [0]
    for _ in range(3):
        tracks = tracking.advance(tracks, [], [], [], EGO, DT_S)
    assert tracks.followed == () and tracks.next_id == 1, "forgotten, but its id is not used again"


def test_what_was_missed_for_long_is_expected_where_its_speed_took_it():
    cloud, still = car(8.0, 2.0), pose.identity()
    tracks = tracking.advance(Tracks(), [0], [cloud], [pose.from_translation([0.6, 0.0, 0.0])], still, 0.1)
    tracks = tracking.advance(tracks, [], [], [], still, 0.5)
    reached = cloud + [3.6, 0.0, 0.0]
    np.testing.assert_allclose(tracks.followed[0].points, reached, atol=1e-9)
    assert tracking.identify(tracks, [reached]) == [0]
    np.testing.assert_allclose(tracks.followed[0].goes_on(still, 0.2)[:3, 3], [1.2, 0.0, 0.0], atol=1e-9)


def test_a_turning_object_goes_on_along_its_circle_as_the_sensor_moves():
    """A turn of 0.1 rad about (5, 0) in the world; the sensor drives on between the pairs."""
    centre = pose.from_translation([5.0, 0.0, 0.0])
    turned = [centre @ pose.from_yaw(angle) @ pose.inverse(centre) for angle in (0.1, 0.6)]
    cloud = car(8.0, 2.0)
    world_from_sensor = [pose.identity(), pose.inverse(EGO), pose.inverse(pose.exp(5 * pose.log(EGO)) @ EGO)]
    to_sensor = [pose.inverse(at) for at in world_from_sensor]
    over_ground = to_sensor[1] @ turned[0] @ world_from_sensor[1]
    tracks = tracking.advance(Tracks(), [0], [cloud], [over_ground], EGO, 0.1)
    tracks = tracking.advance(tracks, [], [], [], to_sensor[2] @ world_from_sensor[1], 0.5)
    reached = pose.apply(to_sensor[2] @ turned[1], cloud)
    np.testing.assert_allclose(tracks.followed[0].points, reached, atol=1e-9)


def test_equal_times_let_no_rounding_in():
    track = tracking.advance(Tracks(), [0], [car(8.0, 2.0)], [STEP], EGO, DT_S).followed[0]
    np.testing.assert_array_equal(track.goes_on(EGO, DT_S), EGO @ STEP @ pose.inverse(EGO))


@pytest.mark.slow
@pytest.mark.parametrize("times", [1, 5])
def test_a_scan_that_comes_again_ends_no_id(times):
    """Were the tracks led on meanwhile, what moves by its own length would be another object afterwards."""
    scans = [scan for scan, _ in synthetic.scan_sequence(
        synthetic.street(rng(1)), synthetic.hdl64e(900), 3, rng(2))]
    again = [Scan(scans[1].points, scans[1].time_ns + (k + 1) * 10**8) for k in range(times)]
    late = Scan(scans[2].points, scans[2].time_ns + times * 10**8)
    plain, stuttering = FlowEstimator(), FlowEstimator()
    expected, after = [[estimator.step(scan) for scan in sequence][-1] for estimator, sequence in (
        (plain, scans), (stuttering, [*scans[:2], *again, late]))]
    assert len(expected.objects) > 5
    places = [{found.id: found.box_centre for found in result.objects} for result in (expected, after)]
    assert places[0].keys() == places[1].keys()
    for number, centre in places[0].items():
        np.testing.assert_allclose(places[1][number], centre, atol=0.3)


@pytest.mark.slow
def test_a_car_keeps_its_id_along_a_street():
    scans = synthetic.scan_sequence(synthetic.street(rng(1)), synthetic.hdl64e(900), 4, rng(2))
    estimator = FlowEstimator()
    ids_of: dict[int, set[int]] = {}
    for index, (scan, _) in enumerate(scans):
        result = estimator.step(scan)
        if result is None:
            continue
        truth = scans[index - 1][1]
        for true_id in np.unique(truth.object_id[truth.is_dynamic]):
            mine = result.object_id[(truth.object_id == true_id) & truth.is_dynamic]
            mine = mine[mine >= 0]
            if len(mine) > 150:
                ids_of.setdefault(int(true_id), set()).add(int(np.bincount(mine).argmax()))
    assert len(ids_of) >= 2
    assert all(len(ids) == 1 for ids in ids_of.values()), ids_of
    assert len({next(iter(ids)) for ids in ids_of.values()}) == len(ids_of)
