"""The pointwise graph in gtsam: residuals and kernel against the formulas."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from numpy.testing import assert_allclose

from lidarflow import pose
from lidarflow.config import SolverConfig
from lidarflow.solve import gtsam_lm

DEFAULT = SolverConfig()
SENSOR = SolverConfig(smoothness_frame="sensor")
both_frames = pytest.mark.parametrize("config", [DEFAULT, SENSOR], ids=["point", "sensor"])


def rng(seed: int) -> np.random.Generator:
    return np.random.default_rng(seed)


def pair_of_points(seed: int, apart: float):
    """A component of two neighbours far from the sensor, one matched; `apart` parts their motions."""
    random = rng(seed)
    points = random.normal(size=(2, 3)) + [18.0, -7.0, 1.0]
    first = pose.exp(random.normal(scale=0.4, size=6))
    motions = np.stack([first, first @ pose.exp(random.normal(scale=apart, size=6))])
    target = pose.apply(motions[1], points[1]) + random.normal(scale=0.1, size=3)
    return gtsam_lm._Component(
        np.arange(2), points, motions, np.array([1]), target[None], np.array([[0, 1]]),
        np.empty(0, np.int64), np.empty((0, 4, 4)))


def smoothness_factor(part, config: SolverConfig):
    return gtsam_lm._smoothness_factors(part, config).at(0)


# --- residuals and derivatives ---

def test_data_residual_is_the_moved_point_off_its_match():
    part = pair_of_points(0, 0.1)
    factor = gtsam_lm._data_factors(part, gtsam_lm._data_noise(DEFAULT)).at(0)
    residual = factor.unwhitenedError(gtsam_lm._values(part.initial, part.points))
    expected = pose.apply(part.initial[1], part.points[1]) - part.match_target[0]
    assert_allclose(np.linalg.norm(residual), np.linalg.norm(expected), atol=1e-12)
    assert_allclose(residual, expected, atol=1e-12)


@pytest.mark.parametrize("apart", [1e-3, 0.05, 0.6])
def test_smoothness_residual_is_the_twist_of_eq_10_seen_at_the_point(apart):
    part = pair_of_points(1, apart)
    twist = pose.log(pose.inverse(part.initial[0]) @ part.initial[1])
    residual = smoothness_factor(part, DEFAULT).unwhitenedError(gtsam_lm._values(part.initial, part.points))
    at_point = pose.adjoint(pose.from_translation(part.points[1]))
    assert_allclose(residual, np.linalg.solve(at_point, twist), atol=1e-9)
    # The same without an adjoint: rotation as it is, translation the velocity ω × p + v of the point j.
    velocity = np.cross(twist[:3], part.points[1]) + twist[3:]
    assert_allclose(residual, [*twist[:3], *velocity], atol=1e-9)


@pytest.mark.parametrize("weight", [1.0, 10.0])
@pytest.mark.parametrize("apart", [1e-3, 0.05, 0.6])
def test_smoothness_weights_give_back_eq_10(apart, weight):
    part = pair_of_points(2, apart)
    values = gtsam_lm._values(part.initial, part.points)
    twist = pose.log(pose.inverse(part.initial[0]) @ part.initial[1])
    at_sensor = smoothness_factor(part, replace(SENSOR, smoothness_weight=weight))
    assert_allclose(2.0 * at_sensor.error(values), weight * (twist @ twist), rtol=1e-9)
    at_point = smoothness_factor(part, replace(DEFAULT, smoothness_weight=weight))
    seen = np.linalg.solve(pose.adjoint(pose.from_translation(part.points[1])), twist)
    assert_allclose(2.0 * at_point.error(values), weight * (seen @ seen), rtol=1e-9)
    assert abs(at_point.error(values) / at_sensor.error(values) - 1.0) > 0.05   # the two frames do differ


@both_frames
@pytest.mark.parametrize("apart", [1e-3, 0.3, 1.0])
def test_derivatives_match_numerical_ones(config, apart):
    part = pair_of_points(3, apart)
    values = gtsam_lm._values(part.initial, part.points)
    smoothness = gtsam_lm._smoothness_factors(part, config)
    data = gtsam_lm._data_factors(part, gtsam_lm._data_noise(replace(config, data_weight=4.0)))
    for factor in (smoothness.at(0), data.at(0)):
        jacobian, _ = factor.linearize(values).jacobian()
        numerical = numerical_jacobian(factor, values)
        assert_allclose(jacobian, numerical, atol=1e-6 * np.abs(numerical).max())


def numerical_jacobian(factor, values, step: float = 1e-6) -> np.ndarray:
    """Derivative of the whitened residual in gtsam's retraction, by central differences."""
    columns = []
    keys = factor.keys()
    for key in keys:
        for axis in range(6):
            ends = []
            for signed in (step, -step):
                shifted = gtsam.Values(values)
                shifted.update(key, values.atPose3(key).retract(signed * np.eye(6)[axis]))
                ends.append(factor.noiseModel().whiten(factor.unwhitenedError(shifted)))
            columns.append((ends[0] - ends[1]) / (2 * step))
    return np.stack(columns, axis=1)


def test_variables_give_back_the_motions():
    random = rng(4)
    points, motions = random.normal(scale=30, size=(12, 3)), pose.exp(random.normal(size=(12, 6)))
    assert_allclose(gtsam_lm._motions(gtsam_lm._values(motions, points), points), motions, atol=1e-12)


# --- the kernel ---

@pytest.mark.parametrize("weight", [1.0, 4.0])
@pytest.mark.parametrize("truncation_m", [DEFAULT.truncation_m, 0.5])
def test_kernel_is_eq_13_on_metres(weight, truncation_m):
    config = SolverConfig(data_weight=weight, truncation_m=truncation_m)
    off_m = np.concatenate([np.linspace(0.0, 3.0, 61), truncation_m * np.array([0.999, 1.001])])
    plain, saturated = [], []
    for r in off_m:
        part = replace(pair_of_points(5, 0.1), initial=pose.identity(2))
        part = replace(part, match_target=part.points[1:] + r * np.array([[0.6, 0.0, -0.8]]))
        values = gtsam_lm._values(part.initial, part.points)
        plain.append(gtsam_lm._data_factors(part, gtsam_lm._data_noise(config)).error(values))
        saturated.append(gtsam_lm._data_factors(part, gtsam_lm._robust_data_noise(config)).error(values))
    assert_allclose(plain, 0.5 * weight * off_m**2, atol=1e-10)
    assert_allclose(saturated, 0.5 * weight * np.minimum(off_m**2, truncation_m**2), atol=1e-10)
