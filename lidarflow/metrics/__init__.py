"""Scores of a flow: against the truth where there is one, by crispness where there is none.

Pure functions of arrays, one concept a module. Errors are metres, angles radians, shares between 0 and 1; a
score of no points is NaN.
"""

from lidarflow.metrics.crispness import Alignment, alignment, crispness
from lidarflow.metrics.epe import (
    Accuracy,
    ErrorSummary,
    accuracy,
    angle_error,
    end_point_error,
    error_over_speed,
    relative_error,
    space_time_angle_error,
    summarise,
)
from lidarflow.metrics.paper import pose_errors
from lidarflow.metrics.scores import Scores, score, static_truth
from lidarflow.metrics.three_way import ThreeWay, evaluated, three_way

__all__ = [
    "Accuracy", "Alignment", "ErrorSummary", "Scores", "ThreeWay", "accuracy", "alignment", "angle_error",
    "crispness", "end_point_error", "error_over_speed", "evaluated",
    "pose_errors", "relative_error", "score",
    "space_time_angle_error", "static_truth", "summarise", "three_way",
]
