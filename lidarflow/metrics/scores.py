"""All scores of one pair against its truth."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lidarflow import pose
from lidarflow.metrics.bucketed import Bucketed, Buckets, bucketed, buckets, pooled_buckets
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
from lidarflow.metrics.ranges import Interval, by_range, by_speed, pooled_intervals
from lidarflow.metrics.three_way import ThreeWay, evaluated, pooled_three_way, three_way
from lidarflow.types import FlowResult, Truth

POSES_ONLY = "poses (every point taken as static)"


@dataclass(frozen=True, slots=True)
class Scores:
    """One pair against its truth; "graph" counts only points the graph solved, others had the ego-motion.

    dynamic_error_over_speed  mean error of moving points over their mean true residual flow
    buckets                   None where the classes of points are not known
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
    buckets: Buckets | None
    by_range: tuple[Interval, ...]
    by_speed: tuple[Interval, ...]
    dynamic_error_over_speed: float
    t_e: float
    r_e_rad: float
    movers_found: float
    false_movers: float
    ego_error_m: float
    ego_error_rad: float


def score(points: np.ndarray, result: FlowResult, truth: Truth) -> Scores:
    """Errors of `result` for the source scan's points (N, 3), over finite rows the truth is valid for.

    What moves is what the truth says does, but in the bucketed error and in that by speed, which go by the
    length of the true residual flow. Three-way and bucketed errors leave ground out, as both leaderboards do.
    """
    known = truth.valid & np.isfinite(result.flow).all(axis=1)
    moving, still = known & truth.is_dynamic, known & ~truth.is_dynamic
    graph = result.in_graph & result.valid
    # Poses alone do not know what moves: all that is called moving would count as wrong.
    knows_movers = truth.origin != POSES_ONLY
    error = np.full(len(known), np.nan)
    error[known] = end_point_error(result.flow[known], truth.flow[known])
    residual = truth.residual_flow(points)
    rows = still & graph
    t_e, r_e = pose_errors(points[rows], result.motions[rows], truth.ego_motion)
    ego = result.ego_motion[None], truth.ego_motion[None]
    counted, above = known & evaluated(points, truth.is_ground), known & ~truth.is_ground
    return Scores(
        all=summarise(error[known]),
        static=summarise(error[still]),
        dynamic=summarise(error[moving]),
        graph_static=summarise(error[still & graph]),
        graph_dynamic=summarise(error[moving & graph]),
        accuracy_all=accuracy(result.flow[known], truth.flow[known]),
        accuracy_static=accuracy(result.flow[still], truth.flow[still]),
        accuracy_dynamic=accuracy(result.flow[moving], truth.flow[moving]),
        three_way=three_way(error[counted], truth.is_dynamic[counted], truth.is_foreground[counted],
                            result.is_dynamic[counted] & knows_movers),
        buckets=None if truth.category is None else buckets(
            points[above], error[above], residual[above], truth.category[above]),
        by_range=by_range(points[known], error[known], truth.is_dynamic[known]),
        by_speed=by_speed(residual[known], error[known], truth.is_dynamic[known]),
        dynamic_error_over_speed=error_over_speed(error[moving], residual[moving]),
        t_e=t_e,
        r_e_rad=r_e,
        movers_found=mean_of(result.is_dynamic[moving]),
        false_movers=mean_of(result.is_dynamic[still & knows_movers]),
        ego_error_m=float(pose.translation_distance(*ego)[0]),
        ego_error_rad=float(pose.rotation_distance(*ego)[0]),
    )


@dataclass(frozen=True, slots=True)
class Pooled:
    """What is scored over the points of all pairs together, as the leaderboards do."""

    three_way: ThreeWay
    bucketed: Bucketed | None
    by_range: tuple[Interval, ...]
    by_speed: tuple[Interval, ...]


def pool(pairs: Sequence[Scores]) -> Pooled:
    """Scores of one pair or more, every point counting alike; classes where all pairs know them."""
    known = [pair.buckets for pair in pairs if pair.buckets is not None]
    return Pooled(
        pooled_three_way([pair.three_way for pair in pairs]),
        bucketed(pooled_buckets(known)) if len(known) == len(pairs) else None,
        pooled_intervals([pair.by_range for pair in pairs]),
        pooled_intervals([pair.by_speed for pair in pairs]),
    )


def figures(scores: Scores) -> dict[str, float]:
    """The figures of one pair that stand for themselves, by name, units in the name."""
    s, three = scores, scores.three_way
    accuracies = {"": s.accuracy_all, "_static": s.accuracy_static, "_dynamic": s.accuracy_dynamic}
    named = {
        "epe_all_m": s.all.mean, "epe_static_m": s.static.mean, "epe_dynamic_m": s.dynamic.mean,
        "epe_dynamic_median_m": s.dynamic.median, "dynamic_error_over_speed": s.dynamic_error_over_speed,
        "epe_three_way_m": three.mean_m, "epe_foreground_dynamic_m": three.foreground_dynamic.mean,
        "epe_foreground_static_m": three.foreground_static.mean,
        "epe_background_static_m": three.background_static.mean, "dynamic_iou": three.dynamic_iou,
        "graph_epe_static_m": s.graph_static.mean, "graph_epe_dynamic_m": s.graph_dynamic.mean,
        "graph_epe_dynamic_median_m": s.graph_dynamic.median, "t_e_m": s.t_e, "r_e_rad": s.r_e_rad,
        "movers_found": s.movers_found, "false_movers": s.false_movers, "ego_error_m": s.ego_error_m,
        "ego_error_deg": float(np.degrees(s.ego_error_rad)),
    }
    for points, found in accuracies.items():
        named |= {
            f"strict_accuracy{points}": found.strict, f"relaxed_accuracy{points}": found.relaxed,
            f"outliers{points}": found.outliers, f"angle_error{points}_rad": found.angle_rad,
            f"space_time_angle_error{points}_rad": found.space_time_angle_rad,
        }
    if s.buckets is not None:
        mean = bucketed(s.buckets).mean
        named |= {"bucketed_static_m": mean.static_m, "bucketed_dynamic": mean.dynamic}
    return named


def static_truth(points: np.ndarray, ego_motion: np.ndarray) -> Truth:
    """Truth of a static scene from poses alone: every point (N, 3) moves with the sensor."""
    n = len(points)
    return Truth(
        flow=pose.apply(ego_motion, points) - points,
        ego_motion=ego_motion,
        valid=np.isfinite(points).all(axis=1),
        is_dynamic=np.zeros(n, bool),
        object_id=np.full(n, -1),
        origin=POSES_ONLY,
    )
