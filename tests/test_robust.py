"""Robust kernels: the loss and the weight of each belong together."""

import numpy as np
import pytest

from lidarflow import robust

KERNELS = [robust.truncated, robust.cauchy, robust.geman_mcclure]
R2 = np.array([0.0, 1e-6, 0.01, 0.1, 0.24, 0.26, 1.0, 4.0, 100.0])
SCALE = 0.5


@pytest.mark.parametrize("kernel", KERNELS)
def test_the_weight_is_the_slope_of_the_loss(kernel):
    step = 1e-7
    slope = (kernel(R2 + step, SCALE)[0] - kernel(np.maximum(R2 - step, 0), SCALE)[0])
    slope /= (R2 + step) - np.maximum(R2 - step, 0)
    np.testing.assert_allclose(kernel(R2, SCALE)[1], slope, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("kernel", KERNELS)
def test_the_weight_ignores_the_unit_of_length(kernel):
    loss, weight = kernel(R2, SCALE)
    loss_cm, weight_cm = kernel(R2 * 1e4, SCALE * 100)
    np.testing.assert_allclose(weight_cm, weight, rtol=1e-12)
    np.testing.assert_allclose(loss_cm, loss * 1e4, rtol=1e-12)


@pytest.mark.parametrize("kernel", KERNELS)
def test_small_residuals_are_squared_and_large_ones_count_less(kernel):
    loss, weight = kernel(np.array([0.0, 1e-8]), SCALE)
    np.testing.assert_allclose(loss, [0.0, 1e-8], rtol=1e-6)
    np.testing.assert_allclose(weight, 1.0, rtol=1e-6)
    losses, weights = kernel(np.linspace(0.0, 50.0, 400), SCALE)
    assert (np.diff(losses) >= 0).all() and (np.diff(weights) <= 0).all() and (weights >= 0).all()
    assert (losses <= np.linspace(0.0, 50.0, 400) + 1e-12).all()


def test_truncated_is_twice_equation_13():
    c2 = 0.05
    r = np.linspace(-1.0, 1.0, 401)
    equation_13 = np.where(r**2 <= c2, r**2 / 2, c2 / 2)
    loss, weight = robust.truncated(r**2, np.sqrt(c2))
    np.testing.assert_allclose(loss, 2 * equation_13, rtol=1e-12)
    np.testing.assert_array_equal(weight, np.abs(r) <= np.sqrt(c2))


def test_limits_of_the_bounded_kernels():
    assert robust.truncated(1e9, SCALE)[0] == SCALE**2
    np.testing.assert_allclose(robust.geman_mcclure(1e9, SCALE)[0], SCALE**2, rtol=1e-6)
    np.testing.assert_allclose(robust.geman_mcclure(SCALE**2, SCALE), (SCALE**2 / 2, 0.25))
    np.testing.assert_allclose(robust.cauchy(SCALE**2, SCALE), (SCALE**2 * np.log(2), 0.5))


@pytest.mark.parametrize("kernel", KERNELS)
def test_any_shape_goes_in_and_comes_out(kernel):
    r2 = np.arange(12.0).reshape(3, 4)
    loss, weight = kernel(r2, SCALE)
    assert loss.shape == weight.shape == (3, 4)
    np.testing.assert_array_equal(r2, np.arange(12.0).reshape(3, 4))
