"""Odometry from what is static, and a motion for every cluster that is not (Jaimez et al. 2017)."""

import numpy as np

from lidarflow import pose
from lidarflow.kernels import alignment, cluster_images
from lidarflow.rgbd.clusters import Clusters
from lidarflow.rgbd.odometry import rows34, step
from lidarflow.rgbd.pyramid import Level
from lidarflow.rgbd.segmentation import has_own_motion
from lidarflow.rgbd_config import RgbdConfig


def refine(
    source: tuple[Level, ...], target: tuple[Level, ...], clusters: Clusters, b: np.ndarray,
    robust: np.ndarray, config: RgbdConfig,
) -> tuple[np.ndarray, np.ndarray]:
    """ξ_O as target_from_source (4, 4) and the motions (K, 4, 4) of the clusters, coarse to fine.

    Clusters with b below `static_below` have the odometry's motion; those above `moving_above` do not help to
    find it; those between do both. The coarsest level knows the odometry alone. Where no cluster helps, the
    odometry stays the `robust` one (4, 4).
    """
    limits = config.segmentation
    own_motion, helps_odometry = has_own_motion(b, limits), b <= limits.moving_above
    static = np.clip(1.0 - b, 0.0, 1.0) ** config.refinement.doubt_power * helps_odometry
    static = np.append(static, 0.0).astype(np.float32)
    coarsest = len(source) - 1
    odometry = np.eye(4) if static.any() else robust
    motions = np.tile(odometry, (len(b), 1, 1))
    for level in reversed(range(len(source))):
        label = clusters.labels[level]
        images = source[level], target[level]
        for _ in range(config.refinement.warps):
            odometry = _odometry_step(*images, static[label], odometry, config) @ odometry
        motions[~own_motion if level < coarsest else slice(None)] = odometry
        if own_motion.any() and (level < coarsest or coarsest == 0):
            members = cluster_images.members(
                source[level].points, label, clusters.centres, clusters.touch,
                np.float32(config.clusters.blending_per_m2), config.clusters.min_membership, own_motion)
            for _ in range(config.refinement.warps):
                motions = _cluster_steps(*images, members, motions, config) @ motions
            if level > 0 and config.refinement.max_misfit_ratio > 0:
                motions = motions[_best_of_touching(*images, members, clusters.touch, motions, config)]
    return odometry, motions


def _odometry_step(
    source: Level, target: Level, static: np.ndarray, odometry: np.ndarray, config: RgbdConfig
) -> np.ndarray:
    weight = np.where(source.points[..., 2] > 0, static, np.float32(0.0))
    return pose.exp(step(source, target, odometry, weight, _noise(config), 1.0,
                         config.refinement.odometry_cauchy_scale, config.alignment))


def _cluster_steps(
    source: Level, target: Level, members: tuple[np.ndarray, np.ndarray], motions: np.ndarray,
    config: RgbdConfig,
) -> np.ndarray:
    """Steps (K, 4, 4) of the motions of the clusters that have members; identity for the others."""
    limits = config.alignment
    return pose.exp(alignment.solve_each(
        source.points, source.packed, target.packed, source.intrinsics, rows34(motions), *members,
        _noise(config), np.float32(limits.max_jump_m), limits.photometric_weight,
        config.refinement.cluster_cauchy_scale, limits.max_irls_rounds, limits.min_gain, limits.min_step,
        limits.damping))


def _best_of_touching(
    source: Level, target: Level, members: tuple[np.ndarray, np.ndarray], touch: np.ndarray,
    motions: np.ndarray, config: RgbdConfig,
) -> np.ndarray:
    """For each cluster (K,) the one, of itself and those it touches, whose motion explains it best.

    Small clusters with little to see go astray at coarse levels; what they are part of puts them right.
    """
    limits = config.segmentation
    misfits = cluster_images.misfits(
        source.points, source.packed, target.packed, source.intrinsics, *members, rows34(motions), touch,
        np.float32(config.alignment.max_jump_m), config.alignment.photometric_weight,
        np.float32(limits.max_intensity_residual), np.float32(limits.max_depth_residual_m))
    largest = config.refinement.max_misfit_ratio * np.diagonal(misfits)
    return np.where(misfits.min(axis=1) < largest, misfits.argmin(axis=1), np.arange(len(misfits)))


def _noise(config: RgbdConfig) -> np.ndarray:
    return np.array([config.refinement.intensity_noise, config.refinement.depth_noise], np.float32)
