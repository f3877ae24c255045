"""Odometry from what is static and a motion for every cluster that is not (section IV-C)."""

import numpy as np

from lidarflow import pose
from lidarflow.kernels import alignment, cluster_images
from lidarflow.rgbd.clusters import Clusters
from lidarflow.rgbd.odometry import rows34, solve
from lidarflow.rgbd.pyramid import Level
from lidarflow.rgbd_config import RgbdConfig


def refine(
    source: tuple[Level, ...], target: tuple[Level, ...], clusters: Clusters, b: np.ndarray,
    config: RgbdConfig,
) -> tuple[np.ndarray, np.ndarray]:
    """ξ_O as target_from_source (4, 4) and the motions (K, 4, 4) of the clusters, coarse to fine.

    Clusters with b below `static_below` have the odometry's motion; those above `moving_above` do not help to
    find it; those between do both. The coarsest level knows the odometry alone.
    """
    limits = config.segmentation
    own_motion, helps_odometry = b >= limits.static_below, b <= limits.moving_above
    static = np.clip(1.0 - b, 0.0, 1.0) ** config.refinement.doubt_power * helps_odometry
    static = np.append(static, 0.0).astype(np.float32)
    odometry, motions = np.eye(4), None
    for level in reversed(range(len(source))):
        for _ in range(config.refinement.warps):
            odometry = _odometry_step(
                source[level], target[level], static[clusters.labels[level]], odometry, config) @ odometry
            if level == len(source) - 1 > 0:
                continue
            if motions is None:
                motions = np.tile(odometry, (len(b), 1, 1))
            motions = _cluster_steps(
                source[level], target[level], clusters, clusters.labels[level], own_motion, motions, config
            ) @ motions
    motions[~own_motion] = odometry
    return odometry, motions


def _odometry_step(
    source: Level, target: Level, static: np.ndarray, odometry: np.ndarray, config: RgbdConfig
) -> np.ndarray:
    system = alignment.linearise(
        source.packed, target.packed, source.intrinsics, rows34(odometry), static, _noise(config),
        np.float32(1.0), np.float32(config.alignment.max_jump_m))
    return pose.exp(solve(*system, config.refinement.odometry_cauchy_scale, config.alignment))


def _cluster_steps(
    source: Level, target: Level, clusters: Clusters, label: np.ndarray, own_motion: np.ndarray,
    motions: np.ndarray, config: RgbdConfig,
) -> np.ndarray:
    """Steps (K, 4, 4) of the motions of the clusters that have their own; identity for the others."""
    pixels, starts = cluster_images.members(
        source.points, label, clusters.centres, clusters.touch, np.float32(config.clusters.blending_per_m2),
        config.clusters.min_membership, own_motion)
    limits = config.alignment
    return pose.exp(alignment.solve_each(
        source.packed, target.packed, source.intrinsics, rows34(motions), pixels, starts, _noise(config),
        np.float32(limits.max_jump_m), limits.photometric_weight, config.refinement.cluster_cauchy_scale,
        limits.max_irls_rounds, limits.min_gain, limits.min_step, limits.damping))


def _noise(config: RgbdConfig) -> np.ndarray:
    return np.array([config.refinement.intensity_noise, config.refinement.depth_noise], np.float32)
