"""Exposure that changes between two frames, and what must not be taken for it."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import rgbd_corner
from rgbd_worlds import QVGA, frames

from lidarflow import pose, rgbd_metrics
from lidarflow.config import load
from lidarflow.rgbd import RgbdEstimator, estimate_flow, exposure, pyramid
from lidarflow.rgbd_config import RgbdConfig
from lidarflow.rgbd_types import Exposure, RgbdFrame, RgbdPair

DEFAULTS = RgbdConfig()
MOTION = pose.exp(np.array([0.012, -0.02, 0.01, 0.03, -0.015, 0.02]))
JUMPS = [(1.3, 0.1), (1.0, 0.1), (0.7, -0.05), (2.0, 0.0), (0.5, 0.0)]


def exposed(frame: RgbdFrame, gain: float, offset: float) -> RgbdFrame:
    """The frame as a sensor of 256 greys has it in another exposure."""
    greys = np.round(255 * np.clip(gain * frame.intensity + offset, 0.0, 1.0)).astype(np.float32)
    return RgbdFrame(greys / np.float32(255), frame.depth, frame.time_ns, frame.name)


def levels(frame: RgbdFrame) -> tuple[pyramid.Level, ...]:
    return pyramid.build(frame, QVGA, DEFAULTS.images)


@pytest.mark.parametrize(("gain", "offset"), [(1.0, 0.0), *JUMPS])
def test_a_line_through_most_intensities_is_found(gain, offset):
    rng = np.random.default_rng(1)
    before = rng.uniform(0.1, 0.9, 3000)
    after = gain * before + offset + rng.normal(0.0, 0.01, len(before))
    after[:900] = rng.uniform(0.0, 1.0, 900)     # something else is seen there
    np.testing.assert_allclose(exposure.fit(before, after), (gain, offset), atol=0.02)


def test_noise_in_both_images_is_no_gain():
    rng = np.random.default_rng(2)
    true = rng.uniform(0.4, 0.6, 5000)
    before, after = true + rng.normal(0.0, 0.03, (2, len(true)))
    np.testing.assert_allclose(exposure.fit(before, after), (1.0, 0.0), atol=0.03)
    assert abs(np.polyfit(before, after, 1)[0] - 1.0) > 0.15     # which regression would have


def test_grey_all_over_has_an_offset_alone():
    grey = np.full(500, 0.4)
    np.testing.assert_allclose(exposure.fit(grey, grey + 0.2), (1.0, 0.2), atol=1e-9)


@pytest.mark.parametrize("name", ["living_room", "passing_wardrobe"])
def test_images_of_one_exposure_are_left_as_they_are(name):
    sequence = [levels(frame) for frame, _ in frames(name)]
    for pair in itertools.pairwise(sequence):
        for level in range(len(pair[0])):
            matched = exposure.matched(*pair, np.eye(4), DEFAULTS, level)
            assert matched[0] is pair[0] and matched[1] is pair[1]


@pytest.mark.parametrize("change", [
    pytest.param(lambda image: np.random.default_rng(3).uniform(0.0, 1.0, image.shape), id="another texture"),
    pytest.param(lambda image: 0.5 * image, id="a shadow"),
])
def test_what_changes_in_a_part_of_the_image_is_no_exposure(change):
    source, target = rgbd_corner.pair(MOTION).source, rgbd_corner.pair(MOTION).target
    intensity = target.intensity.copy()
    intensity[:, :128] = change(intensity[:, :128])     # 40 %
    pair = levels(source), levels(RgbdFrame(intensity, target.depth))
    assert exposure.matched(*pair, MOTION, DEFAULTS)[1] is pair[1]


@pytest.mark.parametrize(("gain", "offset"), JUMPS)
def test_both_images_become_those_of_one_exposure(gain, offset):
    pair = rgbd_corner.pair(MOTION)
    plain = levels(pair.source), levels(exposed(pair.target, gain, offset))
    source, target, _ = exposure.matched(*plain, MOTION, DEFAULTS)
    found = exposure.between(source[0], target[0], MOTION)
    np.testing.assert_allclose(found[:2], (1.0, 0.0), atol=0.02)
    assert found[2] < 0.01 and exposure.between(plain[0][0], plain[1][0], MOTION)[2] > 0.05
    for before, after in zip(plain[1], target, strict=True):
        assert before.points.tobytes() == after.points.tobytes()     # depth stays
    as_exposed = 255 * gain * source[0].packed[..., 0] + 255 * offset
    assert as_exposed.min() > -2.0 and as_exposed.max() < 257.0     # what one cuts off, both do


def test_too_little_in_common_is_no_exposure():
    pair = rgbd_corner.pair(MOTION)
    source, target = levels(pair.source), levels(exposed(pair.target, 1.3, 0.1))
    away = pose.from_translation((50.0, 0.0, 0.0))
    assert exposure.between(source[0], target[0], away) == (1.0, 0.0, 0.0)


@pytest.mark.parametrize(("gain", "offset"), JUMPS)
@pytest.mark.parametrize("name", ["living_room", "passing_wardrobe"])
def test_odometry_and_segmentation_are_as_good_after_a_jump(name, gain, offset):
    (source, truth), (target, _) = frames(name)[:2]
    found = rgbd_metrics.score(estimate_flow(RgbdPair(source, exposed(target, gain, offset), QVGA)), truth)
    plain = rgbd_metrics.score(estimate_flow(RgbdPair(source, target, QVGA)), truth)
    assert found.odometry_error_m < plain.odometry_error_m + 0.0005
    assert found.odometry_error_deg < plain.odometry_error_deg + 0.01
    assert found.iou > plain.iou - 0.05
    assert found.epe_m < plain.epe_m + 0.003     # twice as bright, half of the texture is cut off


@pytest.mark.parametrize(("gain", "offset"), [(1.3, 0.1), (0.7, -0.05)])
def test_residuals_are_of_the_images_that_were_compared(gain, offset):
    """What is left is what texture leaves, not what the exposure changed."""
    (source, _), (target, _) = frames("living_room")[:2]
    plain, jumped = RgbdPair(source, target, QVGA), RgbdPair(source, exposed(target, gain, offset), QVGA)
    usual, found = (rgbd_metrics.warp_scores(pair, estimate_flow(pair)) for pair in (plain, jumped))
    result = estimate_flow(jumped)
    assert (result.exposure.gain, result.exposure.offset) == pytest.approx((gain, offset), abs=0.03)
    assert found.after.photometric == pytest.approx(usual.after.photometric, abs=0.005)
    assert found.before.photometric == pytest.approx(usual.before.photometric, abs=0.005)
    raw = rgbd_metrics.warp_scores(jumped, replace(result, exposure=Exposure()))
    assert raw.after.photometric > 2 * found.after.photometric
    assert raw.after.geometric_m == found.after.geometric_m


def test_an_exposure_that_did_not_change_is_told_as_none():
    (source, _), (target, _) = frames("living_room")[:2]
    assert estimate_flow(RgbdPair(source, target, QVGA)).exposure == Exposure(1.0, 0.0)
    never = load(overrides=("images.max_exposure_change=1",), kind=RgbdConfig)
    brighter = RgbdPair(source, exposed(target, 1.05, 0.0), QVGA)
    assert estimate_flow(brighter).exposure.gain > 1.02
    assert estimate_flow(brighter, never).exposure == Exposure()


def test_a_jump_is_of_one_pair_and_not_of_the_next():
    first, second, third = (frame for frame, _ in frames("living_room")[:3])
    bright = [exposed(frame, 1.3, 0.1) for frame in (second, third)]
    estimator = RgbdEstimator(QVGA)
    results = [estimator.step(frame) for frame in (first, *bright)]
    alone = estimate_flow(RgbdPair(*bright, QVGA), previous=results[1])
    assert results[2].flow.tobytes() == alone.flow.tobytes()
