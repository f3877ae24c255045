"""Exposure that changes between the frames of a pair: found as one gain and offset, and undone."""

import numpy as np

from lidarflow import pose
from lidarflow.rgbd import pyramid
from lidarflow.rgbd.pyramid import Level
from lidarflow.rgbd_config import RgbdConfig
from lidarflow.rgbd_types import Exposure
from lidarflow.robust import cauchy

_GREY = 1.0 / 255.0
_DARKEST, _BRIGHTEST = 5 * _GREY, 250 * _GREY   # beyond, a sensor cuts off what it sees
_MOST_PIXELS = 2000
_FEWEST_PIXELS = 50
_MOST_ROUNDS, _SMALL_STEP = 10, 1e-3
_CAUCHY_SCALE = 5 * _GREY
_LARGEST_GAIN = 4.0          # an exposure control takes smaller steps
_SAME_SURFACE = 0.1          # of the depth: what differs by more hides the surface or is hidden by it


def matched(
    source: tuple[Level, ...], target: tuple[Level, ...], motion: np.ndarray, config: RgbdConfig,
    level: int = 0,
) -> tuple[tuple[Level, ...], tuple[Level, ...], Exposure]:
    """Both pyramids as one exposure shows them, themselves where they hardly differ, and what was undone.

    What a motion (4, 4) leads onto each other is compared, at one level.
    """
    gain, offset, change = between(source[level], target[level], motion)
    if change <= config.images.max_exposure_change:
        return source, target, Exposure()
    undone = Exposure(gain, offset)
    shown = undone.undone(source[0].packed[..., 0], target[0].packed[..., 0])
    return *(pyramid.with_intensity(levels, intensity, config.images)
             for levels, intensity in zip((source, target), shown, strict=True)), undone


def between(source: Level, target: Level, motion: np.ndarray) -> tuple[float, float, float]:
    """Gain and offset with target = gain · source + offset for most pixels, and the mean change they make.

    1, 0 and 0 where too few pixels are seen in both and well exposed.
    """
    before, after = _seen_in_both(source, target, motion)
    if len(before) < _FEWEST_PIXELS:
        return 1.0, 0.0, 0.0
    gain, offset = fit(before, after)
    return gain, offset, float(np.abs((gain - 1.0) * before + offset).mean())


def fit(before: np.ndarray, after: np.ndarray) -> tuple[float, float]:
    """Gain and offset of the line after = gain · before + offset that most of (N,) intensities lie on.

    The least Cauchy loss that is reached from no change, from an offset alone, and from the quartiles. The
    gain is a ratio of spreads: noise and what is led a little astray are in both images, and regression on
    one of them would make it smaller.
    """
    low, middle, high = np.quantile(before, (0.25, 0.5, 0.75))
    low_after, middle_after, high_after = np.quantile(after, (0.25, 0.5, 0.75))
    spread = _possible((high_after - low_after) / max(high - low, _GREY))
    ends = [_reweighted(before, after, *start) for start in (
        (1.0, 0.0), (1.0, middle_after - middle), (spread, middle_after - spread * middle))]
    losses = [cauchy((after - gain * before - offset) ** 2, _CAUCHY_SCALE)[0].sum() for gain, offset in ends]
    return ends[int(np.argmin(losses))]


def _reweighted(before: np.ndarray, after: np.ndarray, gain: float, offset: float) -> tuple[float, float]:
    for _ in range(_MOST_ROUNDS):
        last = gain, offset
        residual = after - gain * before - offset
        scale = max(_CAUCHY_SCALE, float(np.median(np.abs(residual))))
        weight = cauchy(residual**2, scale)[1]
        weight /= weight.sum()
        mean, mean_after = weight @ before, weight @ after
        spread, spread_after = (np.sqrt(weight @ (values - middle) ** 2)
                                for values, middle in ((before, mean), (after, mean_after)))
        gain = _possible(spread_after / spread) if spread > _GREY else 1.0
        offset = float(mean_after - gain * mean)
        if max(abs(gain - last[0]), abs(offset - last[1])) < _SMALL_STEP:
            break
    return gain, offset


def _possible(gain: float) -> float:
    return float(np.clip(gain, 1.0 / _LARGEST_GAIN, _LARGEST_GAIN))


def _seen_in_both(source: Level, target: Level, motion: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Intensities (N,) of well exposed source pixels and of the nearest target pixel of the same surface."""
    pixels = source.some_pixels(_MOST_PIXELS)
    moved = pose.apply(motion, source.points.reshape(-1, 3)[pixels].astype(float))
    inside, there = target.nearest_pixels(moved)
    intensity, depth = target.packed.reshape(-1, 6)[there, :2].T.astype(float)
    before, z = source.packed.reshape(-1, 6)[pixels, 0].astype(float), moved[:, 2]
    useful = inside & (depth > 0) & (np.abs(depth - z) < _SAME_SURFACE * z)
    for values in (before, intensity):
        useful &= (values > _DARKEST) & (values < _BRIGHTEST)
    return before[useful], intensity[useful]
