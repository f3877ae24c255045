"""Scores of a flow: against the truth where there is one, by crispness where there is none.

Pure functions of arrays, one concept a module. Errors are metres, angles radians, shares between 0 and 1; a
score of no points is NaN.
"""

from lidarflow.metrics.bucketed import Bucketed, Buckets, ClassErrors, bucketed, buckets, pooled_buckets
from lidarflow.metrics.crispness import Alignment, alignment, crispness
from lidarflow.metrics.epe import (
    Accuracy,
    ErrorSummary,
    MeanError,
    accuracy,
    angle_error,
    end_point_error,
    error_over_speed,
    mean_error,
    mean_of,
    pooled,
    relative_error,
    space_time_angle_error,
    summarise,
)
from lidarflow.metrics.paper import figures_over_frames, over_frames, pose_errors
from lidarflow.metrics.ranges import Interval, by_range, by_speed, pooled_intervals
from lidarflow.metrics.scores import POSES_ONLY, Pooled, Scores, figures, pool, score, static_truth
from lidarflow.metrics.three_way import ThreeWay, evaluated, pooled_three_way, three_way

__all__ = [
    "POSES_ONLY", "Accuracy", "Alignment", "Bucketed", "Buckets", "ClassErrors", "ErrorSummary", "Interval",
    "MeanError", "Pooled", "Scores", "ThreeWay", "accuracy", "alignment", "angle_error", "bucketed",
    "buckets", "by_range", "by_speed", "crispness", "end_point_error", "error_over_speed", "evaluated",
    "figures", "figures_over_frames", "mean_error", "mean_of", "over_frames", "pool", "pooled",
    "pooled_buckets", "pooled_intervals", "pooled_three_way", "pose_errors", "relative_error", "score",
    "space_time_angle_error", "static_truth", "summarise", "three_way",
]
