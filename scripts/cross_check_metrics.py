"""Our scores beside those of the official packages, on the same arrays, as Markdown tables.

    pip install av2 bucketed-scene-flow-eval
    python scripts/cross_check_metrics.py [RUN_DIR…]

av2 gives end-point error, accuracies, the angle in space and time, three-way error and dynamic IoU;
bucketed-scene-flow-eval the bucketed errors. Random flows are always compared, runs (folders of
`lidarflow run`) against the truth of their data. av2 also tells ground from a random map of heights.
"""

import argparse
import contextlib
import json
import tempfile
import warnings
from collections import defaultdict
from collections.abc import Iterable
from io import StringIO
from pathlib import Path

import numpy as np
import pandas as pd
from av2.evaluation.scene_flow import eval as av2_eval
from av2.evaluation.scene_flow.constants import FOREGROUND_BACKGROUND_BREAKDOWN, SceneFlowMetricType
from av2.map.map_api import GroundHeightLayer
from bucketed_scene_flow_eval.datastructures import (
    SE3,
    EgoLidarFlow,
    PointCloud,
    PoseInfo,
    RGBFrameLookup,
    SupervisedPointCloudFrame,
    TimeSyncedSceneFlowFrame,
)
from bucketed_scene_flow_eval.eval.bucketed_epe import BucketedEPEEvaluator
from evaluate import table

from lidarflow import flow_files, io, metrics, pose, provenance
from lidarflow.datasets import argoverse2_map, open_dataset
from lidarflow.metrics.bucketed import CLASSES
from lidarflow.types import Category, FlowResult, SolveStats, Truth

A_CLASS = 19     # any number of Argoverse 2 that is not the background's: its regular vehicle
STATS = SolveStats("none", 0, 0, 0, 0, 0, 0, 0, 0.0, 0.0, 0.0, 0.0, 0, {})
Pair = tuple[np.ndarray, FlowResult, Truth]


def random_pairs(rng: np.random.Generator, pairs: int = 3, count: int = 20_000) -> list[Pair]:
    """Points of all classes up to 120 m away, with flows of 0 to 5 m a frame and errors of 0.1 mm to 1 m."""
    made = []
    for _ in range(pairs):
        points = rng.uniform(-85, 85, (count, 3))
        ego_motion = pose.exp(np.array([0.001, -0.002, 0.02, 0.8, 0.05, -0.01]))
        ego_flow = pose.apply(ego_motion, points) - points
        direction = rng.normal(size=(2, count, 3))
        direction /= np.linalg.norm(direction, axis=2, keepdims=True)
        speed_m = np.where(rng.random(count) < 0.5, 0.0, 5.0 * rng.random(count) ** 3)
        error_m = 10.0 ** rng.uniform(-4, 0, count)
        residual = direction[0] * speed_m[:, None]
        flow = ego_flow + residual + direction[1] * error_m[:, None]
        moves = speed_m >= 0.05
        category = rng.choice(list(Category), count).astype(np.int8)
        truth = Truth(ego_flow + residual, ego_motion, rng.random(count) < 0.9, moves,
                      np.where(category > 0, 1, -1), category, rng.random(count) < 0.2)
        called = np.where(rng.random(count) < 0.1, ~moves, moves)
        everywhere = np.ones(count, bool)
        made.append((points, FlowResult(flow, pose.from_translation(flow), everywhere, everywhere, called,
                                        ego_motion, STATS), truth))
    return made


def pairs_of_run(run_dir: Path) -> Iterable[Pair]:
    """Points, flow and truth of the pairs of a run."""
    source = provenance.read(run_dir)
    opened = source.dataset
    dataset = open_dataset(opened.folder, opened.loader, opened.sequence, opened.kitti_correction)
    for index, _ in source.pairs:
        scan, truth = dataset.scan(index), dataset.truth(index)
        if truth is None or truth.category is None:
            raise SystemExit(f"{run_dir}: no flow with classes is known of scan {scan.name}")
        yield scan.points, flow_files.load_flow(run_dir / io.FLOW_FOLDER / f"{scan.name}.npz").result(), truth


def known_rows(result: FlowResult, truth: Truth) -> np.ndarray:
    return truth.valid & np.isfinite(result.flow).all(axis=1)


def rows_above_ground(result: FlowResult, truth: Truth) -> np.ndarray:
    """What the bucketed score counts: the challenge reads data `with_ground=False`, which masks ground."""
    return known_rows(result, truth) & ~truth.is_ground


def of_av2(pairs: list[Pair]) -> dict[str, float]:
    """What av2 makes of the pairs: means over points, then pairs, and the figures of its leaderboard."""
    columns, whole = defaultdict(list), defaultdict(list)
    kinds = {"strict_accuracy": SceneFlowMetricType.ACCURACY_STRICT, "epe_all_m": SceneFlowMetricType.EPE,
             "relaxed_accuracy": SceneFlowMetricType.ACCURACY_RELAX,
             "space_time_angle_error_rad": SceneFlowMetricType.ANGLE_ERROR}
    for number, (points, result, truth) in enumerate(pairs):
        known = known_rows(result, truth)
        for name, kind in kinds.items():
            whole[name].append(av2_eval.compute_scene_flow_metrics(
                result.flow[known], truth.flow[known], kind).mean())
        found = av2_eval.compute_metrics(
            result.flow, result.is_dynamic, truth.flow, np.where(truth.is_foreground, A_CLASS, 0),
            truth.is_dynamic, (np.abs(points[:, :2]) <= 35).all(axis=1),
            known & metrics.evaluated(points, truth.is_ground), FOREGROUND_BACKGROUND_BREAKDOWN)
        columns["Example"] += [str(number)] * len(found["Class"])
        for name, values in found.items():
            columns[name] += values
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")     # of pandas, about the way av2 groups rows
        frame = pd.DataFrame({getattr(name, "value", name): values for name, values in columns.items()})
        # Empty sets have no error; their NaN would spoil the weighted means of the others.
        board = av2_eval.results_to_dict(frame.fillna(0.0))
    return {**{name: float(np.mean(values)) for name, values in whole.items()},
            "foreground dynamic [m]": board["EPE/Foreground/Dynamic"],
            "foreground static [m]": board["EPE/Foreground/Static"],
            "background static [m]": board["EPE/Background/Static"],
            "three-way [m]": board["EPE 3-Way Average"], "dynamic IoU": board["Dynamic IoU"]}


def of_bucketed(pairs: list[Pair]) -> dict[str, float]:
    """What bucketed-scene-flow-eval makes of the pairs."""
    names = {kind.name: [kind.name] for kind in CLASSES}
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)     # means of empty buckets
        judge = BucketedEPEEvaluator({int(kind): kind.name for kind in Category}, output_path=Path(folder),
                                     meta_class_lookup=names)
        for number, (points, result, truth) in enumerate(pairs):
            known, ego_flow = rows_above_ground(result, truth), truth.flow - truth.residual_flow(points)
            still = PoseInfo(SE3.identity(), SE3.identity())
            cloud = SupervisedPointCloudFrame(PointCloud(np.nan_to_num(points)), still, known,
                                              truth.category.astype(np.int8))
            frame = TimeSyncedSceneFlowFrame(
                pc=cloud, auxillary_pc=None, rgbs=RGBFrameLookup.empty(), log_id="pairs", log_idx=number,
                log_timestamp=number, flow=EgoLidarFlow(truth.residual_flow(points), known))
            judge.eval(EgoLidarFlow(result.flow - ego_flow, known), frame)
        with contextlib.redirect_stdout(StringIO()):     # it tells of every file it writes
            by_class = judge.compute_results(save_results=False)
    found = {}
    for name, (static_m, dynamic) in by_class.items():
        found |= {f"{name} static [m]": static_m, f"{name} moving": dynamic}
    static_m, dynamic = np.array(list(by_class.values())).T
    return found | {"bucketed static [m]": np.nanmean(static_m), "bucketed moving": np.nanmean(dynamic)}


def of_ours(pairs: list[Pair]) -> dict[str, float]:
    """What lidarflow makes of the pairs, under the same names."""
    scores = [metrics.score(*pair) for pair in pairs]
    rows = [metrics.figures(pair) for pair in scores]
    whole = metrics.pool(scores)
    three, mean = whole.three_way, whole.bucketed.mean
    found = {name: float(np.mean([row[name] for row in rows]))
             for name in ("epe_all_m", "strict_accuracy", "relaxed_accuracy", "space_time_angle_error_rad")}
    found |= {"foreground dynamic [m]": three.foreground_dynamic.mean,
              "foreground static [m]": three.foreground_static.mean,
              "background static [m]": three.background_static.mean,
              "three-way [m]": three.mean_m, "dynamic IoU": three.dynamic_iou}
    for name, errors in whole.bucketed.classes.items():
        found |= {f"{name} static [m]": errors.static_m, f"{name} moving": errors.dynamic}
    return found | {"bucketed static [m]": mean.static_m, "bucketed moving": mean.dynamic}


def comparison(pairs: list[Pair]) -> str:
    """One row per figure that all sides have a value of."""
    official, ours = of_av2(pairs) | of_bucketed(pairs), of_ours(pairs)
    rows = [[name, f"{official[name]:.6f}", f"{ours[name]:.6f}", f"{abs(official[name] - ours[name]):.1e}"]
            for name in ours if np.isfinite(ours[name]) or np.isfinite(official.get(name, np.nan))]
    return table(["", "official", "ours", "difference"], rows)


def ground_differences(rng: np.random.Generator, count: int = 200_000) -> str:
    """How many points on and off a random map of heights are ground to one side only."""
    with tempfile.TemporaryDirectory() as folder:
        height_m = rng.normal(size=(200, 300)).astype(np.float16)
        height_m[rng.random(height_m.shape) < 0.1] = np.nan
        np.save(Path(folder) / "log_ground_height_surface____PIT.npy", height_m)
        turn = pose.from_yaw(0.3)[:2, :2]
        (Path(folder) / "log___img_Sim2_city.json").write_text(
            json.dumps({"R": turn.ravel().tolist(), "t": [20.5, 11.25], "s": 10 / 3}))
        points = np.column_stack([rng.uniform(-30, 90, (count, 2)), rng.normal(size=count)])
        official = GroundHeightLayer.from_file(Path(folder)).get_ground_points_boolean(points)
        ours = argoverse2_map.is_ground(Path(folder), points)
    return f"{official.sum()} of {count} points are ground, {(official != ours).sum()} differ"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="*", metavar="RUN_DIR")
    options = parser.parse_args()
    rng = np.random.default_rng(0)
    print("random flows\n")
    print(comparison(random_pairs(rng)))
    print(f"\nrandom map: {ground_differences(rng)}")
    for run_dir in options.runs:
        print(f"\n{run_dir.name}\n")
        print(comparison(list(pairs_of_run(run_dir))))


if __name__ == "__main__":
    main()
