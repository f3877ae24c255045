"""Matches of one scan in the next agree with the motion that really happened."""

import numpy as np
import pytest
from shared_data import SHARED, needs_shared

from lidarflow import metrics, pose, synthetic
from lidarflow.config import Config, MatchingConfig
from lidarflow.datasets import open_dataset
from lidarflow.kernels.matching import Described
from lidarflow.lidar import features, matching
from lidarflow.lidar.keypoints import Keypoints
from lidarflow.types import Scan, Truth

CONFIG = Config()
GOOD_M = 0.3
DT_S = 0.1


def errors_m(source: Scan, target: Scan, truth: Truth) -> np.ndarray:
    """How far each match, searched around the unmoved keypoint, is from the true place of its keypoint."""
    here, there = (features.extract(scan, CONFIG).keypoints for scan in (source, target))
    rows, places = matches_of(here, there).of(here.row)
    known = truth.valid[rows]
    true_places = source.points[rows] + truth.flow[rows]
    return np.linalg.norm(places - true_places, axis=1)[known]


def matches_of(here: Keypoints, there: Keypoints) -> matching.Matches:
    """The matches of all keypoints, each expected where it is."""
    return matching.Matches(here, np.arange(len(here.row)), here.points, there, DT_S, CONFIG.matching)


def assert_mostly_right(error_m: np.ndarray, at_least: int, share: float) -> None:
    good = (error_m <= GOOD_M).mean()
    assert len(error_m) >= at_least
    assert good >= share, f"{good:.3f} of {len(error_m)} matches"


def test_matches_on_a_generated_street():
    rng = np.random.default_rng(0)
    (source, truth), (target, _) = synthetic.scan_sequence(
        synthetic.street(rng), synthetic.hdl64e(), 2, rng, DT_S)
    assert_mostly_right(errors_m(source, target, truth), 5000, 0.8)


def test_what_else_is_asked_for_changes_no_match():
    rng = np.random.default_rng(5)
    sensor = synthetic.hdl64e(columns=700)
    sequence = synthetic.scan_sequence(synthetic.one_car(8.0, rng), sensor, 2, rng, DT_S)
    here, there = (features.extract(scan, CONFIG).keypoints for scan, _ in sequence)
    queries, candidates = here.described(), there.described()
    query, found = matching.match(
        queries, candidates, lambda _: queries, CONFIG.matching.max_speed_m_per_s * DT_S, CONFIG.matching)
    expected = here.row[queries.row[query]], candidates.points[found]
    assert len(query) > 300

    here, there = (features.extract(scan, CONFIG).keypoints for scan, _ in sequence)
    at_once, bit_by_bit = matches_of(here, there), matches_of(here, there)
    for chosen in np.array_split(rng.permutation(here.row), 40)[:20]:
        rows, places = bit_by_bit.of(chosen)
        np.testing.assert_array_equal(rows, expected[0][np.isin(expected[0], chosen)])
        np.testing.assert_array_equal(places, expected[1][np.isin(expected[0], chosen)])
    for rows, places in (at_once.of(here.row), bit_by_bit.of(here.row)):
        np.testing.assert_array_equal(rows, expected[0])
        np.testing.assert_array_equal(places, expected[1])


@needs_shared
@pytest.mark.parametrize("name", ["kitti_tracked_0005_from_000", "kitti_tracked_0005_from_040"])
def test_matches_on_tracked_kitti(name):
    data = open_dataset(SHARED / name)
    assert_mostly_right(errors_m(data.scan(0), data.scan(1), data.truth(0)), 2000, 0.8)


@needs_shared
@pytest.mark.parametrize(
    "name", ["kitti_odometry_00_start", "kitti_odometry_00_pair_094", "kitti_odometry_00_pair_198"])
def test_matches_on_kitti_odometry(name):
    data = open_dataset(SHARED / name)
    first, second = data.world_from_sensor()[:2]
    source = data.scan(0)
    truth = metrics.static_truth(source.points, pose.inverse(second) @ first)
    assert_mostly_right(errors_m(source, data.scan(1), truth), 8000, 0.8)


def matched(points, descriptors, candidates, candidate_descriptors, config=CONFIG.matching):
    """Queries and candidates that match, both with all others as rivals."""
    queries = Described.whole(points, descriptors)
    return matching.match(queries, Described.whole(candidates, candidate_descriptors), lambda _: queries,
                          config.max_speed_m_per_s * DT_S, config)


def unit_vectors(count: int, seed: int) -> np.ndarray:
    rows = np.random.default_rng(seed).uniform(size=(count, 30)).astype(np.float32)
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def test_equal_descriptors_find_each_other_within_the_gate():
    points = np.random.default_rng(1).uniform(-20, 20, (300, 3))
    described, order = unit_vectors(300, seed=2), np.random.default_rng(3).permutation(300)
    moved = points + [1.0, 0.5, 0.0]
    config = MatchingConfig(max_speed_m_per_s=20.0)
    query, found = matched(points, described, moved[order], described[order], config)
    np.testing.assert_array_equal(order[found], query)
    assert len(query) == 300
    moved += [3.0, 0.0, 0.0]
    query, found = matched(points, described, moved[order], described[order], config)
    assert (order[found] != query).all()


def test_a_rival_elsewhere_makes_a_match_ambiguous_and_one_beside_it_does_not():
    descriptor = unit_vectors(1, seed=4)
    here = np.zeros((1, 3))
    for apart_m, survivors in ((1.0, 0), (0.2, 1)):
        candidates = np.array([[0.1, 0, 0], [0.1 + apart_m, 0, 0]])
        twins = np.vstack([descriptor, descriptor])
        twins[1] += 1e-3 * unit_vectors(1, seed=5)[0]
        query, _ = matched(here, unit_vectors(1, seed=6), candidates, twins)
        assert len(query) == survivors


def test_a_match_must_be_mutual_up_to_the_radius():
    best, other = unit_vectors(2, seed=7)
    candidates, described = np.zeros((1, 3)), best[None]
    for apart_m, expected in ((1.0, [0]), (0.2, [0, 1])):
        queries = np.array([[0.0, 0, 0], [apart_m, 0, 0]])
        query, _ = matched(queries, np.stack([best, other]), candidates, described)
        np.testing.assert_array_equal(query, expected)


def test_nothing_to_match_gives_no_matches():
    points, described = np.zeros((4, 3)), unit_vectors(4, seed=8)
    some, none = (points, described), (points[:0], described[:0])
    for queries, candidates in ((none, some), (some, none), (none, none)):
        query, found = matched(*queries, *candidates)
        assert len(query) == len(found) == 0
