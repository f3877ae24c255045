"""Joint odometry and piecewise-rigid scene flow of RGB-D pairs (Jaimez, Kerl et al., ICRA 2017)."""

from lidarflow.rgbd.pipeline import RgbdEstimator, estimate_flow

__all__ = ["RgbdEstimator", "estimate_flow"]
