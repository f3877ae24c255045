"""What holds for any input of the public API: an answer that makes sense, or a LidarflowError."""

import numpy as np
import pytest
from fuzzing import STATS
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from lidarflow import metrics, pose
from lidarflow.config import Config, load
from lidarflow.errors import ConfigError, DataError, LidarflowError
from lidarflow.methods import METHODS
from lidarflow.pipeline import FlowEstimator, estimate_flow
from lidarflow.settings import describe, to_dict, updated
from lidarflow.types import FlowResult, Scan, ScanPair, Truth

LENIENT = settings(deadline=None, derandomize=True,
                   suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large])
COORDINATES = st.one_of(
    st.floats(-60, 60, width=32), st.sampled_from([0.0, -0.0, np.nan, np.inf, 1e-30, 1e30, 1e300, -1e308]))
ODD_CLOUDS = arrays.arrays(np.float64, st.tuples(st.integers(0, 60), st.just(3)), elements=COORDINATES)


@st.composite
def small_clouds(draw):
    """Clouds that may have an answer: planes, lines, clumps and noise, damaged a little."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    count = draw(st.integers(30, 400))
    shape = draw(st.sampled_from(["floor", "line", "clump", "noise", "one"]))
    points = {"floor": rng.uniform(-20, 20, (count, 3)) * (1, 1, 0) - (0, 0, 1.7),
              "line": np.linspace(2, 30, count)[:, None] * (1, 1, 0), "clump": rng.normal(5, 0.3, (count, 3)),
              "noise": rng.uniform(-30, 30, (count, 3)), "one": np.full((count, 3), 4.0)}[shape]
    odd = rng.integers(0, count, draw(st.integers(0, 5)))
    points[odd, rng.integers(0, 3, len(odd))] = draw(COORDINATES)
    return points + draw(st.sampled_from([0.0, 1e3, 1e7]))


def check_answer(pair, result):
    points = pair.source.points
    finite = np.isfinite(points).all(axis=1)
    assert result.flow.shape == points.shape and np.isfinite(result.flow[finite]).all()
    assert not np.isfinite(result.flow[~finite]).all(axis=1).any()
    assert not (result.valid | result.is_dynamic)[~finite].any()
    assert pose.is_rigid(result.ego_motion, 1e-4)
    assert {found.id for found in result.objects} >= set(result.object_id[result.object_id >= 0].tolist())


# Scans.

@LENIENT
@given(st.one_of(ODD_CLOUDS, arrays.arrays(st.sampled_from([np.float32, np.int32, np.bool_, np.complex64]),
                                           arrays.array_shapes(max_dims=3, max_side=5))))
def test_a_scan_is_points_or_refused(values):
    try:
        scan = Scan(values)
    except ValueError as error:
        assert "expected" in str(error)
        return
    assert scan.points.dtype == np.float64 and scan.points.shape == (len(scan), 3)
    finite = np.isfinite(values).all(axis=1)
    np.testing.assert_array_equal(scan.points[finite], values[finite].astype(np.float64))
    assert np.isnan(scan.points[~finite]).all()


@LENIENT
@given(st.integers(-2**62, 2**62), st.integers(-2**62, 2**62))
def test_the_time_between_scans_is_positive(first_ns, second_ns):
    points = np.zeros((1, 3))
    assert ScanPair(Scan(points, first_ns), Scan(points, second_ns)).dt_s > 0


# Flow.

@settings(LENIENT, max_examples=60)
@given(ODD_CLOUDS, ODD_CLOUDS, st.sampled_from(sorted(METHODS)))
def test_tiny_odd_clouds(source, target, method):
    pair = ScanPair(Scan(source), Scan(target))
    try:
        result = METHODS[method].estimate(pair, Config())
    except LidarflowError:
        return
    check_answer(pair, result)


@settings(LENIENT, max_examples=40)
@given(small_clouds(), small_clouds())
def test_clouds_that_are_no_scans(source, target):
    pair = ScanPair(Scan(source), Scan(target))
    try:
        result = estimate_flow(pair)
    except LidarflowError:
        return
    check_answer(pair, result)


@settings(LENIENT, max_examples=15)
@given(st.lists(small_clouds(), min_size=2, max_size=4))
def test_a_sequence_goes_on_after_what_it_cannot_use(clouds):
    estimator, last = FlowEstimator(), None
    for k, points in enumerate(clouds):
        scan = Scan(points, k * 10**8)
        try:
            result = estimator.step(scan)
        except LidarflowError:
            estimator.reset()
            last = None
            continue
        assert (result is None) == (last is None)
        if result is not None:
            check_answer(ScanPair(last, scan), result)
        last = scan


# Settings.

KEYS = [key for key, *_ in describe(Config)]
TEXTS = st.one_of(st.text(max_size=20), st.integers().map(str), st.floats().map(str),
                  st.sampled_from(["true", "[1]", "{a=1}", "1e999", "0x" + "f" * 5000, "9" * 5000,
                                   "[" * 5000]))


@LENIENT
@given(st.one_of(st.sampled_from(KEYS), st.text(max_size=20)), TEXTS)
def test_overrides_are_taken_or_refused(key, text):
    try:
        config = load(overrides=(f"{key}={text}",))
    except ConfigError as error:
        assert str(error)
        return
    assert updated(Config(), to_dict(config)) == config


@LENIENT
@given(st.dictionaries(st.one_of(st.sampled_from(sorted(to_dict(Config()))), st.text(max_size=5)), st.one_of(
    st.none(), st.integers(), st.dictionaries(st.text(max_size=5), st.integers(), max_size=2)), max_size=3))
def test_any_table_of_settings_is_taken_or_refused(changes):
    try:
        assert isinstance(updated(Config(), changes), Config)
    except ConfigError as error:
        assert str(error)


# Scores.

@LENIENT
@given(st.integers(0, 2**32 - 1), st.integers(1, 50), st.floats(0, 5))
def test_scores_of_the_truth_are_perfect_and_grow_with_the_error(seed, count, error_m):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-30, 30, (count, 3))
    ego_motion = pose.from_yaw(0.05, (1.0, 0.2, 0.0))
    moving = rng.random(count) < 0.4
    flow = pose.apply(ego_motion, points) - points + moving[:, None] * (0.7, 0.0, 0.0)
    truth = Truth(flow, ego_motion, np.ones(count, bool), moving, np.where(moving, 0, -1))
    scores = metrics.score(points, as_result(flow + (error_m, 0, 0), ego_motion, moving), truth)
    assert scores.all.mean == pytest.approx(error_m, abs=1e-9)
    assert metrics.figures(scores)["epe_all_m"] == pytest.approx(error_m, abs=1e-9)
    if moving.any():
        assert scores.movers_found == 1.0


def as_result(flow, ego_motion, moving):
    count = len(flow)
    return FlowResult(flow, np.tile(ego_motion, (count, 1, 1)), np.ones(count, bool), np.ones(count, bool),
                      moving, ego_motion, STATS)


@LENIENT
@given(small_clouds(), st.floats(0.01, 1.0))
def test_crispness_is_a_share(points, sigma_m):
    try:
        found = metrics.crispness(points, points, sigma_m)
    except DataError:
        return
    assert np.isnan(found) or -1e-9 <= found <= 1 + 1e-9
