"""Matches of one scan in the next agree with the motion that really happened."""

import numpy as np
import pytest
from shared_data import SHARED, needs_shared

from lidarflow import metrics, pose, synthetic
from lidarflow.config import Config, MatchingConfig
from lidarflow.datasets import open_dataset
from lidarflow.lidar import features, matching
from lidarflow.types import Scan, Truth

CONFIG = Config()
GOOD_M = 0.3
DT_S = 0.1


def errors_m(source: Scan, target: Scan, truth: Truth) -> np.ndarray:
    """How far each match, searched around the unmoved keypoint, is from the true place of its keypoint."""
    here, there = features.extract(source, CONFIG), features.extract(target, CONFIG)
    here, there = here.keypoints, there.keypoints
    targets = target.points[there.row]
    query, found = matching.match(source.points[here.row], here.descriptors, targets, there.descriptors,
                                  DT_S, CONFIG.matching)
    rows = here.row[query]
    known = truth.valid[rows]
    true_places = source.points[rows] + truth.flow[rows]
    return np.linalg.norm(targets[found] - true_places, axis=1)[known]


def assert_mostly_right(error_m: np.ndarray, at_least: int, share: float) -> None:
    good = (error_m <= GOOD_M).mean()
    assert len(error_m) >= at_least
    assert good >= share, f"{good:.3f} of {len(error_m)} matches"


def test_matches_on_a_generated_street():
    rng = np.random.default_rng(0)
    (source, truth), (target, _) = synthetic.scan_sequence(
        synthetic.street(rng), synthetic.hdl64e(), 2, rng, DT_S)
    assert_mostly_right(errors_m(source, target, truth), 5000, 0.8)


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


def unit_vectors(count: int, seed: int) -> np.ndarray:
    rows = np.random.default_rng(seed).uniform(size=(count, 30)).astype(np.float32)
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def test_equal_descriptors_find_each_other_within_the_gate():
    points = np.random.default_rng(1).uniform(-20, 20, (300, 3))
    described, order = unit_vectors(300, seed=2), np.random.default_rng(3).permutation(300)
    moved = points + [1.0, 0.5, 0.0]
    config = MatchingConfig(max_speed_m_per_s=20.0)
    query, found = matching.match(points, described, moved[order], described[order], DT_S, config)
    np.testing.assert_array_equal(order[found], query)
    assert len(query) == 300
    moved += [3.0, 0.0, 0.0]
    query, found = matching.match(points, described, moved[order], described[order], DT_S, config)
    assert (order[found] != query).all()


def test_a_rival_elsewhere_makes_a_match_ambiguous_and_one_beside_it_does_not():
    descriptor = unit_vectors(1, seed=4)
    here = np.zeros((1, 3))
    for apart_m, survivors in ((1.0, 0), (0.2, 1)):
        candidates = np.array([[0.1, 0, 0], [0.1 + apart_m, 0, 0]])
        twins = np.vstack([descriptor, descriptor])
        twins[1] += 1e-3 * unit_vectors(1, seed=5)[0]
        query, _ = matching.match(here, unit_vectors(1, seed=6), candidates, twins, DT_S, MatchingConfig())
        assert len(query) == survivors


def test_a_match_must_be_mutual_up_to_the_radius():
    best, other = unit_vectors(2, seed=7)
    candidates, described = np.zeros((1, 3)), best[None]
    for apart_m, expected in ((1.0, [0]), (0.2, [0, 1])):
        queries = np.array([[0.0, 0, 0], [apart_m, 0, 0]])
        query, _ = matching.match(queries, np.stack([best, other]), candidates, described, DT_S,
                                  MatchingConfig())
        np.testing.assert_array_equal(query, expected)


def test_nothing_to_match_gives_no_matches():
    points, described = np.zeros((4, 3)), unit_vectors(4, seed=8)
    some, none = (points, described), (points[:0], described[:0])
    for queries, candidates in ((none, some), (some, none), (none, none)):
        query, found = matching.match(*queries, *candidates, DT_S, MatchingConfig())
        assert len(query) == len(found) == 0
