"""Which clusters move by themselves: a convex energy with a closed-form minimum (Jaimez et al. 2017)."""

import numpy as np

from lidarflow import pose
from lidarflow.kernels import cluster_images
from lidarflow.rgbd.clusters import Clusters
from lidarflow.rgbd.odometry import rows34
from lidarflow.rgbd.pyramid import Level
from lidarflow.rgbd_config import RgbdConfig, SegmentationConfig

_FAR_M = 30.0   # from here on e^Z says static whatever else, and soon overflows


def segment(
    source: Level, target: Level, clusters: Clusters, odometry: np.ndarray, b_before: np.ndarray | None,
    config: RgbdConfig,
) -> np.ndarray:
    """b (K,) of the clusters: 0 = static, 1 = moves; from what odometry leaves unexplained."""
    delta = mean_residuals(source, target, clusters, odometry, config)
    lower, upper = thresholds(delta, float(np.linalg.norm(pose.log(odometry))), config.segmentation)
    return minimise(delta, lower, upper, clusters, b_before, config.segmentation)


def mean_residuals(
    source: Level, target: Level, clusters: Clusters, odometry: np.ndarray, config: RgbdConfig
) -> np.ndarray:
    """δ (K,): α_I mean |r_I| + mean |r_Z| / Z̄ of each cluster after the warp by `odometry`.

    Pixels that something nearer hides, that lie at edges or are not seen again are left out.
    """
    limits = config.segmentation
    sums = cluster_images.residuals(
        source.points, source.packed, target.packed, source.intrinsics, rows34(odometry), clusters.labels[0],
        len(clusters.centres), np.float32(config.alignment.max_jump_m),
        np.float32(limits.max_depth_residual_m), np.float32(limits.max_intensity_residual),
        np.float32(limits.occlusion_m), np.float32(limits.max_edge_m))
    weight = np.maximum(sums[:, 2], 1.0)
    return (config.alignment.photometric_weight * sums[:, 0] / weight
            + sums[:, 1] / weight / clusters.centres[:, 2])


def thresholds(delta: np.ndarray, twist_norm: float, config: SegmentationConfig) -> tuple[float, float]:
    """δ_L and δ_H: residuals below the first speak for static, above the second for moving.

    They grow by a factor with the motion, as in the authors' program; eq. 22 adds, which would leave nothing
    above them.
    """
    growth = config.threshold_per_motion * twist_norm
    typical = float(np.quantile(delta, config.quantile))
    base = max(config.min_threshold, min(config.max_threshold * (1.0 + growth), typical))
    return (1.0 + growth) * base, (2.0 + growth) * base


def minimise(
    delta: np.ndarray, lower: float, upper: float, clusters: Clusters, b_before: np.ndarray | None,
    config: SegmentationConfig,
) -> np.ndarray:
    """b (K,) that minimises E_D + E_R + E_T + E_Z (eqs. 9 to 15).

    E_D = Σ w_D (b − g(δ))², E_R = λ_R Σ (b_i − b_j)² over touching clusters, E_T = λ_T Σ (b − B^T)² unless
    `b_before` is None, E_Z = Σ λ_Z max(0, e^Z̄ − e^Zmin) b²: a positive definite linear system.
    """
    half_width = 0.5 * (upper - lower)
    g = np.clip((delta - lower) / (upper - lower), 0.0, config.ceiling)
    w_data = np.sqrt(((delta - 0.5 * (lower + upper)) / half_width) ** 2 + 1.0)
    z = clusters.centres[:, 2].astype(float)
    z_min = (1.0 - config.far_share) * z.min() + config.far_share * z.max()
    w_depth = config.depth * np.maximum(0.0, np.exp(np.minimum(z, _FAR_M)) - np.exp(min(z_min, _FAR_M)))

    edges = (clusters.touch & ~np.eye(len(z), dtype=bool)).astype(float)
    laplacian = np.diag(edges.sum(axis=1)) - edges
    matrix = np.diag(w_data + w_depth) + config.smoothness * laplacian
    right = w_data * g
    if b_before is not None:
        matrix += config.temporal * np.eye(len(z))
        right += config.temporal * b_before
    return np.linalg.solve(matrix, right)


def has_own_motion(b: np.ndarray, config: SegmentationConfig) -> np.ndarray:
    """The clusters (K,) bool of b (K,) that are not static for certain."""
    return b >= config.static_below
