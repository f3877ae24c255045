"""Every setting of the RGB-D method (Jaimez et al. 2017), frozen, with its unit and effect.

Read, overridden and described as the LiDAR settings are: `config.load(kind=RgbdConfig)`.
"""

from dataclasses import dataclass, field

from lidarflow.settings import setting


@dataclass(frozen=True, slots=True)
class ImagesConfig:
    width: int = setting(
        320, "larger images are worked at this width in pixels, their height in proportion",
        low=16, high=1280)
    levels: int = setting(
        5, "levels of the pyramid, each half the size of the one below; 5 = 20x15 to 320x240", low=1, high=8)
    max_depth_jump_m: float = setting(
        0.1, "depths this far from a pixel's middle one are another surface's and not averaged with it",
        low=1e-3)
    max_exposure_change: float = setting(
        0.01, "a gain and offset that change the second image's intensity (0 .. 1) by more on average are "
        "undone; 1 = never", low=0, high=1)


@dataclass(frozen=True, slots=True)
class ClustersConfig:
    count: int = setting(64, "N: geometric clusters of K-Means; 24 in the paper", low=1, high=200)
    max_rounds: int = setting(20, "rounds of K-Means at most", low=1)
    tolerance_m: float = setting(0.01, "K-Means stops when no centre moves farther", low=0)
    touching_m: float = setting(
        0.015, "clusters touch where neighbouring pixels of a 320 wide image are this near; in proportion at "
        "other sizes", low=1e-4)
    blending_per_m2: float = setting(
        100.0, "motions of touching clusters are blended by exp(−this |d_own² − d_other²|), d to centres",
        low=0)
    min_membership: float = setting(
        0.2, "pixels with this blending weight in a cluster help to estimate its motion", low=0.01, high=0.49)


@dataclass(frozen=True, slots=True)
class AlignmentConfig:
    photometric_weight: float = setting(
        0.15, "α_I: weight of intensity residuals (0 .. 1) against depth residuals in metres", low=0)
    max_jump_m: float = setting(
        0.1, "between depths farther apart than this the nearest pixel is taken, not their mixture", low=1e-3)
    max_irls_rounds: int = setting(11, "reweighted least-squares rounds per warp at most", low=1)
    min_gain: float = setting(
        0.02, "the rounds stop when the weighted residuals sink by less than this share", low=0, high=1)
    min_step: float = setting(1e-6, "or when no part of the twist (metres, radians) changes by more", low=0)
    damping: float = setting(
        1e-4, "share of the normal equations' mean diagonal added to it, against motions that no pixel sees",
        low=1e-6)


@dataclass(frozen=True, slots=True)
class RobustConfig:
    depth_power: float = setting(
        2.0, "pixels weigh their depth to this power: what is far moves less often; 1 in the paper", low=0)
    cauchy_scale: float = setting(
        0.5, "c of the Cauchy loss in mean absolute residuals; ¼ in the authors' program", low=1e-3)
    max_warps: int = setting(3, "warps per pyramid level at most", low=1)
    small_step: float = setting(
        0.04, "no further warp after a twist (metres, radians) whose norm is below this", low=0)


@dataclass(frozen=True, slots=True)
class SegmentationConfig:
    enabled: bool = setting(True, "off = plain robust odometry, everything static")
    quantile: float = setting(
        0.25, "the base threshold t is this quantile of the clusters' residuals; ½ in the authors' program",
        low=0, high=1)
    min_threshold: float = setting(0.007, "but never lower than this", low=1e-5)
    max_threshold: float = setting(0.015, "nor higher than this times (1 + 10 ‖ξ‖)", low=0)
    threshold_per_motion: float = setting(
        10.0, "how the thresholds grow with the norm of the odometry's twist (metres, radians)", low=0)
    ceiling: float = setting(2.0, "g(δ) rises from 0 at δ_L to 1 at δ_H and on to this", low=1)
    smoothness: float = setting(0.5, "λ_R: weight that touching clusters agree", low=0)
    temporal: float = setting(1.5, "λ_T: weight of the previous pair's segmentation", low=0)
    depth: float = setting(0.15, "λ_Z: weight of 0 for far clusters, times exp(Z) − exp(Z_min)", low=0)
    far_share: float = setting(
        0.25, "Z_min lies at this share of the way from the nearest cluster's depth to the farthest's",
        low=0, high=1)
    max_depth_residual_m: float = setting(0.2, "depth residuals count up to this", low=1e-3)
    max_intensity_residual: float = setting(0.5, "intensity residuals count up to this", low=1e-3)
    occlusion_m: float = setting(
        0.1, "pixels that something nearer hides count less from here on, and not at all at twice this",
        low=1e-3)
    max_edge_m: float = setting(
        0.3, "pixels whose four neighbours' depths differ by more in sum are left out", low=1e-3)
    static_below: float = setting(1 / 3, "clusters with smaller b are static", low=0, high=1)
    moving_above: float = setting(2 / 3, "clusters with greater b move by themselves", low=0, high=1)


@dataclass(frozen=True, slots=True)
class RefinementConfig:
    doubt_power: float = setting(
        4.0, "odometry pixels weigh 1 − b to this power; ½ in the authors' program", low=0)
    depth_noise: float = setting(
        5e-5, "K_Z in the pre-weights of depth residuals, m²; 1e-4 in the paper", low=1e-12)
    intensity_noise: float = setting(
        0.01, "K_I in the pre-weights of intensity residuals; 0.1 in the paper", low=1e-12)
    odometry_cauchy_scale: float = setting(2.0, "c for the odometry in mean absolute residuals", low=1e-3)
    cluster_cauchy_scale: float = setting(1.0, "c for a moving cluster in mean absolute residuals", low=1e-3)
    warps: int = setting(1, "warps per pyramid level", low=1)
    max_misfit_ratio: float = setting(
        0.7, "a cluster takes the motion of one it touches where its misfit sinks to this share; 0 = never",
        low=0, high=1)
    max_rounds: int = setting(
        2, "refined this often at most, while segmenting again changes which clusters are static",
        low=1)


@dataclass(frozen=True, slots=True)
class RgbdConfig:
    """All settings of the RGB-D pipeline."""

    images: ImagesConfig = field(default_factory=ImagesConfig)
    clusters: ClustersConfig = field(default_factory=ClustersConfig)
    alignment: AlignmentConfig = field(default_factory=AlignmentConfig)
    robust: RobustConfig = field(default_factory=RobustConfig)
    segmentation: SegmentationConfig = field(default_factory=SegmentationConfig)
    refinement: RefinementConfig = field(default_factory=RefinementConfig)
