"""How well a motion is known: right in size where the truth is known, large where nothing tells."""

import numpy as np

from lidarflow import pose, synthetic
from lidarflow.config import load
from lidarflow.lidar import uncertainty
from lidarflow.pipeline import estimate_flow
from lidarflow.types import ScanPair


def rng(seed: int) -> np.random.Generator:
    return np.random.default_rng(seed)


def fit_to_planes(normals: np.ndarray, at: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Translation (3,) that least squares finds for planes that are off by `noise` alone."""
    return np.linalg.lstsq(normals, noise, rcond=None)[0]


def test_the_spread_of_repeated_fits_is_what_is_predicted():
    random, noise_m = rng(1), 0.05
    # Planes a cell apart from one another err independently; rotations are held by their spread.
    at = np.floor(random.uniform(-200, 200, (60, 3))) + 0.25
    normals = random.normal(size=(60, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    found = [fit_to_planes(normals, at, random.normal(0, noise_m, 60)) for _ in range(400)]
    spread_m = np.sqrt((np.array(found) ** 2).sum(axis=1).mean())
    centre = at.mean(axis=0)[None]
    noises = random.normal(0, noise_m, (20, 60))
    nothing = np.zeros((0, 3))
    predicted = np.array([uncertainty._std(centre, at, normals, noise, nothing)[0] for noise in noises])
    by_angle_m = uncertainty._CALIBRATION_RAD * np.linalg.norm(centre)
    calibration_m = np.hypot(uncertainty._CALIBRATION_M, by_angle_m)
    assert abs(np.sqrt((predicted**2).mean() - calibration_m**2) / spread_m - 1.0) < 0.15


def test_a_lone_wall_leaves_the_way_along_it_open():
    random = rng(2)
    at = np.column_stack([np.full(500, 10.0), random.uniform(-3, 3, 500), random.uniform(0, 2, 500)])
    normals, off_m = np.tile([-1.0, 0.0, 0.0], (500, 1)), random.normal(0, 0.01, 500)
    open_m = uncertainty._std(at[:1], at, normals, off_m, np.zeros((0, 3)))
    held_m = uncertainty._std(at[:1], at, normals, off_m, np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]))
    assert open_m > 1.0 > 0.2 > held_m


def test_errors_in_a_street_are_as_large_as_expected():
    scans = synthetic.scan_sequence(synthetic.street(rng(1)), synthetic.hdl64e(1200), 2, rng(2))
    result, truth = estimate_flow(ScanPair(scans[0][0], scans[1][0])), scans[0][1]
    error_m = np.linalg.norm(result.flow - truth.flow, axis=1)
    known = np.isfinite(result.std_m)
    np.testing.assert_array_equal(known, result.valid)
    assert known.mean() > 0.95
    for rows in (known & ~truth.is_dynamic, known & result.is_dynamic):
        assert (error_m[rows] <= 3.0 * result.std_m[rows]).mean() > 0.8
        assert 0.3 < error_m[rows].mean() / result.std_m[rows].mean() < 3.0


def test_without_objects_the_matches_tell():
    scans = synthetic.scan_sequence(synthetic.room(rng(3)), synthetic.hdl64e(400), 2, rng(4))
    result = estimate_flow(
        ScanPair(scans[0][0], scans[1][0]), load(overrides=("objects.enabled=false",)))
    solved = result.in_graph & result.valid
    error_m = np.linalg.norm(result.flow - scans[0][1].flow, axis=1)
    assert np.isfinite(result.std_m[solved]).all() and solved.sum() > 2000
    assert (error_m[solved] <= 3.0 * result.std_m[solved]).mean() > 0.8
    assert pose.is_rigid(result.motions[solved])
