"""A whole run over RGB-D frames: a folder of images in, a folder of results out."""

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from lidarflow import io, metrics, pose, rgbd_io, rgbd_methods, rgbd_metrics, rgbd_preview
from lidarflow.aside import ahead
from lidarflow.datasets.rgbd_folders import RgbdFolder
from lidarflow.resuming import Plan
from lidarflow.rgbd_checkpoints import RgbdCheckpoints
from lidarflow.rgbd_config import RgbdConfig
from lidarflow.rgbd_metrics import DepthStatistics, Drift, RgbdScores, WarpScores
from lidarflow.rgbd_types import Exposure, RgbdPair, RgbdResult, RgbdTruth
from lidarflow.runner import OUTPUT_STAGE, Going, Viewing, begun_steps, finish, plan_of, recording
from lidarflow.stepping import Step, Walk
from lidarflow.trajectory import Trajectory


@dataclass(frozen=True, slots=True)
class RgbdReport:
    """What is known of one pair once it is done.

    moving_share  float   of the pixels with depth
    depth         DepthStatistics of the source frame
    residuals     WarpScores
    exposure      Exposure, the change that was undone before images were compared
    scores        RgbdScores, None without a truth
    drift         Drift of this step against given poses, None without
    """

    frame: str
    moving_share: float
    depth: DepthStatistics
    residuals: WarpScores
    exposure: Exposure
    scores: RgbdScores | None
    drift: Drift | None
    seconds: dict[str, float]


@dataclass(frozen=True, slots=True)
class RgbdRun:
    """What a run reports: its pairs, and the drift over all of them where poses are given."""

    method: str
    reports: tuple[RgbdReport, ...]
    drift: Drift | None


def process(
    folder: RgbdFolder, frames: list[int], method: str, config: RgbdConfig, out: Path, viewing: Viewing,
    on_pair: Callable[[RgbdReport], None] = lambda report: None, going: Going | None = None,
) -> RgbdRun:
    """Process `frames` of a folder and write a run folder; `on_pair` hears of every finished pair.

    Flow files are complete as soon as they appear; poses, metrics, recording and picture follow. Until then
    every pair is kept as a checkpoint too, from which `going.resume` goes on. Raises LidarflowError for input
    or output that cannot be used.
    """
    going = going or Going()
    plan, kept = plan_of(folder, frames, config, method, going), RgbdCheckpoints(out)
    walk = Walk.of_frames(folder, rgbd_methods.estimator(method, folder.camera, config))
    done, skipped = begun_steps(walk, plan, kept, out, going)
    reports, way = [], Trajectory(frames)
    with recording(out / io.RECORDING_FILE, viewing, _open_recording) as stream, ahead(done) as computed:
        for step in computed:
            reports.append(_write_pair(folder, step, plan, out, stream, way))
            if not step.restored:
                kept.save(step.index, step.pair, step.result, step.stretch)
            on_pair(reports[-1])
    run = RgbdRun(method, tuple(reports), _drift_along(way, folder.world_from_camera()))
    way.write_tum(out)
    with io.written_aside(out / "preview.png") as aside:
        rgbd_preview.write_preview(aside, step.pair.source, step.result)
    finish(out, plan, kept, skipped, metrics_of(run), {report.frame: report.seconds for report in reports})
    return run


def _write_pair(folder: RgbdFolder, step: Step, plan: Plan, out: Path, stream, way: Trajectory) -> RgbdReport:
    """Write the flow file of a pair, log it, lengthen the way by it, and report it."""
    begin, pair, result = time.perf_counter(), step.pair, step.result
    report = report_pair(pair, result, folder.truth(step.index), folder.world_from_camera(), step.index)
    file = out / io.FLOW_FOLDER / f"{pair.source.name}.npz"
    if not step.is_written(file):
        rgbd_io.save_flow(file, pair.source, result, plan.config, stats_of(plan.method, report))
    world_from_source = way.add(step.index, pair, result.odometry)
    if stream is not None:
        from lidarflow import rgbd_viewer

        rgbd_viewer.log_pair(stream, step.index, pair, result, report.residuals, world_from_source)
    return replace(report, seconds={**report.seconds, OUTPUT_STAGE: time.perf_counter() - begin})


def _drift_along(way: Trajectory, given: np.ndarray | None) -> Drift | None:
    """The drift of a way against given poses (N, 4, 4), not over frames that were left out; None without."""
    if given is None:
        return None
    indices, poses, times_ns = way.timed()
    stretch = np.cumsum(np.diff(indices, prepend=indices[0]) > 1)
    return rgbd_metrics.drift(poses, given[indices], np.array(times_ns), stretch)


def report_pair(pair: RgbdPair, result: RgbdResult, truth: RgbdTruth | None = None,
                given: np.ndarray | None = None, index: int = 0) -> RgbdReport:
    """Scores of a finished pair; `given` (N, 4, 4) are poses, those at `index` and the next the pair's."""
    drift = None
    if given is not None:
        times_ns = np.array([pair.source.time_ns, pair.target.time_ns])
        drift = rgbd_metrics.drift(pose.trajectory(result.odometry[None]), given[index: index + 2], times_ns)
    return RgbdReport(
        frame=pair.source.name,
        moving_share=float(result.is_dynamic[result.valid].mean()) if result.valid.any() else 0.0,
        depth=rgbd_metrics.depth_statistics(pair.source.depth),
        residuals=rgbd_metrics.warp_scores(pair, result),
        exposure=result.exposure,
        scores=None if truth is None else rgbd_metrics.score(result, truth),
        drift=drift,
        seconds=result.seconds,
    )


def stats_of(method: str, report: RgbdReport) -> dict:
    """What a flow file says of its pair."""
    return {"method": method, "moving_share": report.moving_share, "exposure": asdict(report.exposure),
            "residuals": asdict(report.residuals)}


def metrics_of(run: RgbdRun) -> dict:
    """What metrics.json holds: means over pairs, the drift, and every pair; wall times are kept elsewhere."""
    pairs = [asdict(report) for report in run.reports]
    for values in pairs:
        del values["seconds"]
    return {"method": run.method, "mean": mean_of(run.reports),
            "drift": None if run.drift is None else asdict(run.drift), "pairs": pairs}


def mean_of(reports: tuple[RgbdReport, ...]) -> dict[str, float]:
    """Means of the main figures over the pairs that have them."""
    over_pairs = metrics.figures_over_frames(figures_of(report) for report in reports)
    return {name: mean for name, (mean, _) in over_pairs.items()}


def figures_of(report: RgbdReport) -> dict[str, float]:
    """The main figures of one pair by name, units in the name."""
    figures = {
        "photometric_before": report.residuals.before.photometric,
        "photometric": report.residuals.after.photometric,
        "geometric_before_m": report.residuals.before.geometric_m,
        "geometric_m": report.residuals.after.geometric_m,
        "moving_share": report.moving_share,
        "depth_share": report.depth.valid,
    }
    if report.drift is not None:
        figures |= {"drift_m": report.drift.per_frame_m, "drift_deg": report.drift.per_frame_deg}
    return figures | ({} if report.scores is None else asdict(report.scores))


def _open_recording(path: Path | None, spawn: bool):
    from lidarflow import rgbd_viewer

    return rgbd_viewer.open_recording(path, spawn)
