"""All scores of one pair against its truth."""

from dataclasses import dataclass

import numpy as np

from lidarflow import pose
from lidarflow.metrics.epe import (
    Accuracy,
    ErrorSummary,
    accuracy,
    end_point_error,
    error_over_speed,
    mean_of,
    summarise,
)
from lidarflow.metrics.paper import pose_errors
from lidarflow.metrics.three_way import ThreeWay, evaluated, three_way
from lidarflow.types import FlowResult, Truth


@dataclass(frozen=True, slots=True)
class Scores:
    """One pair against its truth; "graph" counts only points the graph solved, others had the ego-motion.

    dynamic_error_over_speed  mean error of moving points over their mean residual flow
    """

    all: ErrorSummary
    static: ErrorSummary
    dynamic: ErrorSummary
    graph_static: ErrorSummary
    graph_dynamic: ErrorSummary
    accuracy_all: Accuracy
    accuracy_static: Accuracy
    accuracy_dynamic: Accuracy
    three_way: ThreeWay
    dynamic_error_over_speed: float
    t_e: float
    r_e_rad: float
    movers_found: float
    false_movers: float
    ego_error_m: float
    ego_error_rad: float


def score(points: np.ndarray, result: FlowResult, truth: Truth) -> Scores:
    """Errors of `result` for the source scan's points (N, 3), over finite rows the truth is valid for."""
    known = truth.valid & np.isfinite(result.flow).all(axis=1)
    moving, still = known & truth.is_dynamic, known & ~truth.is_dynamic
    graph = result.in_graph & result.valid
    error = np.full(len(known), np.nan)
    error[known] = end_point_error(result.flow[known], truth.flow[known])
    residual = truth.residual_flow(points)
    rows = still & graph
    t_e, r_e = pose_errors(points[rows], result.motions[rows], truth.ego_motion)
    ego = result.ego_motion[None], truth.ego_motion[None]
    counted = known & evaluated(points, truth.is_ground)
    return Scores(
        all=summarise(error[known]),
        static=summarise(error[still]),
        dynamic=summarise(error[moving]),
        graph_static=summarise(error[still & graph]),
        graph_dynamic=summarise(error[moving & graph]),
        accuracy_all=accuracy(result.flow[known], truth.flow[known]),
        accuracy_static=accuracy(result.flow[still], truth.flow[still]),
        accuracy_dynamic=accuracy(result.flow[moving], truth.flow[moving]),
        three_way=three_way(error[counted], residual[counted], truth.is_foreground[counted],
                            result.is_dynamic[counted]),
        dynamic_error_over_speed=error_over_speed(error[moving], residual[moving]),
        t_e=t_e,
        r_e_rad=r_e,
        movers_found=mean_of(result.is_dynamic[moving]),
        false_movers=mean_of(result.is_dynamic[still]),
        ego_error_m=float(pose.translation_distance(*ego)[0]),
        ego_error_rad=float(pose.rotation_distance(*ego)[0]),
    )


def static_truth(points: np.ndarray, ego_motion: np.ndarray) -> Truth:
    """Truth of a static scene from poses alone: every point (N, 3) moves with the sensor."""
    n = len(points)
    return Truth(
        flow=pose.apply(ego_motion, points) - points,
        ego_motion=ego_motion,
        valid=np.isfinite(points).all(axis=1),
        is_dynamic=np.zeros(n, bool),
        object_id=np.full(n, -1),
    )
