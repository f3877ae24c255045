"""Robust odometry before anything is known about what moves (Jaimez et al. 2017)."""

import numpy as np

from lidarflow import pose
from lidarflow.errors import DataError
from lidarflow.kernels import alignment
from lidarflow.rgbd.clusters import Clusters
from lidarflow.rgbd.pyramid import Level
from lidarflow.rgbd_config import AlignmentConfig, RgbdConfig

_NO_NOISE_MODEL = np.ones(2, np.float32)
_WORTH_SHARING = 300_000   # numbers in a system: for fewer, waking a second thread takes longer than the sums
# Of the source's depth. Real frames see 90 % of it again, even half a metre apart three quarters. Where more
# and more depth is cut away, motions are found nearly always down to a tenth, and below that by chance.
_MIN_SEEN_AGAIN = 0.1
# Of what is seen again. Consecutive frames have 94 % and more, with several times the usual noise 82 %; of
# unrelated frames, whose median is 8 %, one pair in a hundred has more.
_MIN_ALIKE = 0.5
_ALIKE_DEPTH = 0.05        # of the depth: sensors are this precise as far as they see
_ALIKE_INTENSITY = 0.1
_MOST_COMPARED = 2000      # pixels


def robust(
    source: tuple[Level, ...], target: tuple[Level, ...], clusters: Clusters, b_before: np.ndarray,
    config: RgbdConfig,
) -> np.ndarray:
    """target_from_source (4, 4) of most of the image, coarse to fine, minimising Σ F(w r_Z) + F(α_I w r_I).

    w = Z1 (1 − B^T), Z1 to the power of `robust.depth_power`, with `b_before` (K,) the previous pair's
    segmentation in this pair's clusters; F is the Cauchy loss.
    """
    static = np.append(np.clip(1.0 - b_before, 0.0, 1.0), 0.0).astype(np.float32)
    motion, power = np.eye(4), np.float32(config.robust.depth_power)
    for level in reversed(range(len(source))):
        weight = source[level].points[..., 2] ** power * static[clusters.labels[level]]
        for _ in range(config.robust.max_warps):
            twist = step(source[level], target[level], motion, weight, _NO_NOISE_MODEL, 0.0,
                         config.robust.cauchy_scale, config.alignment)
            motion = pose.exp(twist) @ motion
            if np.linalg.norm(twist) < config.robust.small_step:
                break
    return motion


def require_overlap(source: Level, target: Level, motion: np.ndarray) -> None:
    """Raise DataError unless a motion (4, 4) leads enough of the source to where the target has depth."""
    found = alignment.seen_again(source.points, target.packed, source.intrinsics, rows34(motion))
    if found < _MIN_SEEN_AGAIN:
        raise DataError(
            f"odometry: {found:.0%} of the first frame's depth is seen again in the second, at least "
            f"{_MIN_SEEN_AGAIN:.0%} should be; are these consecutive frames of one camera?")


def require_likeness(source: Level, target: Level, flow: np.ndarray) -> None:
    """Raise DataError unless most of what a flow (H, W, 3) leads to depth looks there as it did."""
    found = likeness(source, target, flow)
    if found < _MIN_ALIKE:
        raise DataError(
            f"odometry: {found:.0%} of what the second frame sees again has the depth and brightness of the "
            f"first, at least {_MIN_ALIKE:.0%} should; are these consecutive frames of one camera?")


def likeness(source: Level, target: Level, flow: np.ndarray) -> float:
    """Share whose depth and intensity fit, of the points that a flow (H, W, 3) leads to depth.

    Images of one exposure; 0 where none are led to any.
    """
    pixels = source.some_pixels(_MOST_COMPARED)
    moved = (source.points + flow).reshape(-1, 3)[pixels]
    inside, there = target.nearest_pixels(moved)
    intensity, depth = target.packed.reshape(-1, 6)[there, :2].T
    seen = inside & (depth > 0)
    alike = ((np.abs(depth - moved[:, 2]) < _ALIKE_DEPTH * moved[:, 2])
             & (np.abs(intensity - source.packed.reshape(-1, 6)[pixels, 0]) < _ALIKE_INTENSITY))
    return float(alike[seen].mean()) if seen.any() else 0.0


def rows34(motion: np.ndarray) -> np.ndarray:
    """The upper rows (..., 3, 4) float32 of motions (..., 4, 4), as kernels take them."""
    return np.ascontiguousarray(motion[..., :3, :], np.float32)


def step(
    source: Level, target: Level, motion: np.ndarray, weight: np.ndarray, noise: np.ndarray, weighting: float,
    cauchy_scale: float, config: AlignmentConfig,
) -> np.ndarray:
    """Twist (6,) that improves a motion (4, 4) of all pixels of a `weight` (H, W) over 0, after one warp.

    `noise` and `weighting` are those of `alignment.linearise`; its weights are divided by the largest.
    """
    pixels = np.flatnonzero(weight)
    system, counts, largest_weights = alignment.linearise(
        source.points, source.packed, target.packed, source.intrinsics, rows34(motion), pixels,
        weight.ravel()[pixels], noise, np.float32(weighting), np.float32(config.max_jump_m))
    scales = np.array([config.photometric_weight, 1.0]) / np.maximum(largest_weights, 1e-12)
    return alignment.solve(
        system, counts, scales, cauchy_scale, config.max_irls_rounds, config.min_gain, config.min_step,
        config.damping, system.size < _WORTH_SHARING)
