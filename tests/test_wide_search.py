"""Ego-motion without a guess where scans lie far apart: a slow sensor, a fast one, or one that was turned."""

import numpy as np
import pytest

from lidarflow import pose, synthetic
from lidarflow.config import Config
from lidarflow.errors import DataError
from lidarflow.lidar import ego

CONFIG = Config()
SENSOR = synthetic.hdl64e(columns=500)


def sequence(seed: int, dt_s: float, count: int = 2):
    """Scans of a street, thinned, at 8 m/s, and the motions between them."""
    scans = synthetic.scan_sequence(
        synthetic.street(np.random.default_rng(seed)), SENSOR, count, np.random.default_rng(1), dt_s)
    return [scan for scan, _ in scans], [truth.ego_motion for _, truth in scans[:-1]]


def assert_near(found: np.ndarray, expected: np.ndarray) -> None:
    assert pose.translation_distance(found, expected) < 0.03
    assert pose.rotation_distance(found, expected) < 0.003


@pytest.mark.parametrize("seed, dt_s, pair", [(6, 0.7, 0), (1, 1.0, 0), (2, 1.5, 0)])
def test_scans_that_lie_far_apart_are_found_from_all_around(seed, dt_s, pair):
    """5.6, 8 and 12 m between scans, where the search from rest ends metres off."""
    scans, motions = sequence(seed, dt_s, pair + 2)
    source, target = (ego.Thinned.of_scan(scan, CONFIG) for scan in scans[pair: pair + 2])
    assert pose.translation_distance(ego.register(source, target), motions[pair]) > 1.0
    assert_near(ego.find(source, target, None, CONFIG.ego), motions[pair])


@pytest.mark.parametrize("turn_rad", [-0.7, 0.6, 1.1])
def test_a_sensor_that_was_turned_is_found_from_all_around(turn_rad):
    (here, there), (motion,) = sequence(0, 0.1)
    turned = pose.from_yaw(turn_rad)
    source = ego.Thinned.of_scan(here, CONFIG)
    target = ego.Thinned.of(pose.apply(turned, there.points), CONFIG)
    assert_near(ego.find(source, target, None, CONFIG.ego), turned @ motion)


def test_a_guess_far_off_leads_to_the_search_from_all_around():
    scans, motions = sequence(2, 1.5)
    source, target = (ego.Thinned.of_scan(scan, CONFIG) for scan in scans)
    assert_near(ego.find(source, target, np.eye(4), CONFIG.ego), motions[0])


def test_scans_with_nothing_in_common_are_still_refused():
    """A floor below the sensor and a ceiling above it: no motion along the ground brings them together."""
    floor = np.random.default_rng(0).uniform(-20.0, 20.0, (4000, 3)) * (1.0, 1.0, 0.001)
    below, above = (ego.Thinned.of(floor + (0.0, 0.0, height_m), CONFIG) for height_m in (-2.0, 20.0))
    with pytest.raises(DataError, match="are these consecutive scans"):
        ego.find(below, above, None, CONFIG.ego)


def test_sparse_scans_are_not_searched_from_all_around(monkeypatch):
    """A tenth of the points: few meet within the last reach, but nearly all come near."""
    scans, motions = sequence(0, 0.1)
    source, target = (
        ego.Thinned.of(scan.points[np.random.default_rng(seed).random(len(scan.points)) < 0.1], CONFIG)
        for seed, scan in enumerate(scans))
    monkeypatch.setattr(ego.wide_search, "from_all_around", lambda _: pytest.fail("searched all around"))
    assert pose.translation_distance(ego.find(source, target, None, CONFIG.ego), motions[0]) < 0.05
