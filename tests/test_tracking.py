"""Objects over time: ids that stay, and what is expected of an object that was missed."""

import numpy as np
import pytest

from lidarflow import pose, synthetic
from lidarflow.lidar import tracking
from lidarflow.lidar.tracking import Tracks
from lidarflow.pipeline import FlowEstimator

EGO = pose.from_yaw(0.02, (-0.8, 0.05, 0.0))
STEP = pose.from_translation([0.9, 0.0, 0.0])


def rng(seed: int) -> np.random.Generator:
    return np.random.default_rng(seed)


def car(x: float, y: float, seed: int = 1) -> np.ndarray:
    return rng(seed).uniform(-1, 1, (300, 3)) * [2.0, 0.9, 0.7] + [x, y, 0.0]


def test_ids_are_kept_and_new_objects_get_new_ones():
    near, far = car(8.0, 2.0), car(20.0, -4.0)
    ids = tracking.identify(Tracks(), [near, far])
    assert ids == [0, 1]
    tracks = tracking.advance(Tracks(), ids, [near, far], [STEP, STEP], EGO)
    later = [pose.apply(STEP @ EGO, cloud) for cloud in (far, near)]
    newcomer = car(40.0, 0.0)
    assert tracking.identify(tracks, [newcomer, *later]) == [2, 1, 0]


def test_two_pieces_of_one_object_do_not_share_its_id():
    whole = car(8.0, 2.0)
    tracks = tracking.advance(Tracks(), [0], [whole], [STEP], EGO)
    moved = pose.apply(STEP @ EGO, whole)
    front = moved[:, 0] > np.median(moved[:, 0])
    assert sorted(tracking.identify(tracks, [moved[front], moved[~front]])) == [0, 1]


def test_a_missed_object_is_expected_where_it_would_be():
    cloud = car(8.0, 2.0)
    tracks = tracking.advance(Tracks(), [0], [cloud], [STEP], EGO)
    for _ in range(2):
        tracks = tracking.advance(tracks, [], [], [], EGO)
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
        tracks = tracking.advance(tracks, [], [], [], EGO)
    assert tracks.followed == () and tracks.next_id == 1, "forgotten, but its id is not used again"


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
