"""A whole run over RGB-D frames: a folder of images in, a folder of results out."""

import itertools
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from lidarflow import io, metrics, pose, rgbd_io, rgbd_methods, rgbd_metrics, rgbd_preview
from lidarflow.datasets.rgbd_folders import RgbdFolder
from lidarflow.errors import LidarflowError
from lidarflow.rgbd_config import RgbdConfig
from lidarflow.rgbd_metrics import DepthStatistics, Drift, RgbdScores, WarpScores
from lidarflow.rgbd_types import RgbdPair, RgbdResult, RgbdTruth
from lidarflow.runner import Viewing, recording

OUTPUT_STAGE = "scores and output"


@dataclass(frozen=True, slots=True)
class RgbdReport:
    """What is known of one pair once it is done.

    moving_share  float   of the pixels with depth
    depth         DepthStatistics of the source frame
    residuals     WarpScores
    scores        RgbdScores, None without a truth
    drift         Drift of this step against given poses, None without
    """

    frame: str
    moving_share: float
    depth: DepthStatistics
    residuals: WarpScores
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
    on_pair: Callable[[RgbdReport], None] = lambda report: None,
) -> RgbdRun:
    """Process `frames` of a folder and write a run folder; `on_pair` hears of every finished pair.

    Flow files are complete as soon as they appear; poses, metrics, recording and picture follow. Raises
    LidarflowError for input or output that cannot be used.
    """
    # The first pair is done before the folder is touched: bad data leaves no empty run behind.
    io.check_run_folder(out)
    reports: list[RgbdReport] = []
    results = _results(folder, frames, rgbd_methods.estimator(method, folder.camera, config), reports, out)
    first = next(results)
    io.new_run_folder(out)
    io.write_toml(out / io.CONFIG_FILE, config)
    poses, times_ns = [np.eye(4)], []
    given = folder.world_from_camera()
    with recording(out / io.RECORDING_FILE, viewing, _open_recording) as stream:
        for index, (pair, result) in zip(frames, itertools.chain([first], results), strict=False):
            begin = time.perf_counter()
            report = report_pair(pair, result, folder.truth(index), given, index)
            rgbd_io.save_flow(out / io.FLOW_FOLDER / f"{pair.source.name}.npz", pair.source, result, config,
                              stats_of(method, report))
            if stream is not None:
                from lidarflow import rgbd_viewer

                rgbd_viewer.log_pair(stream, index, pair, result, report.residuals, poses[-1])
            poses.append(poses[-1] @ pose.inverse(result.odometry))
            times_ns.append(pair.source.time_ns)
            with_output = {**report.seconds, OUTPUT_STAGE: time.perf_counter() - begin}
            reports.append(replace(report, seconds=with_output))
            on_pair(reports[-1])
    poses, times_ns = np.stack(poses), [*times_ns, pair.target.time_ns]
    drift = None if given is None else rgbd_metrics.drift(poses, given[frames], np.array(times_ns))
    run = RgbdRun(method, tuple(reports), drift)
    io.write_poses_tum(out / "poses_tum.txt", poses, times_ns)
    with io.written_aside(out / "preview.png") as aside:
        rgbd_preview.write_preview(aside, pair.source, result)
    io.write_json(out / "metrics.json", metrics_of(run))
    io.write_json(out / "timing.json", {report.frame: report.seconds for report in reports})
    io.link_latest(out)
    return run


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
        scores=None if truth is None else rgbd_metrics.score(result, truth),
        drift=drift,
        seconds=result.seconds,
    )


def stats_of(method: str, report: RgbdReport) -> dict:
    """What a flow file says of its pair."""
    return {"method": method, "moving_share": report.moving_share, "residuals": asdict(report.residuals)}


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


def _results(folder: RgbdFolder, frames: list[int], estimator: rgbd_methods.Estimator,
             reports: list[RgbdReport], out: Path) -> Iterator[tuple[RgbdPair, RgbdResult]]:
    """Pairs and results; an error on the way also says at which frame, and what is kept of the run."""
    source = None
    for index in frames:
        try:
            target = folder.frame(index)
            result = estimator.step(target)
        except LidarflowError as error:
            kept = f"; the flow of {len(reports)} before is kept in {out / io.FLOW_FOLDER}" if reports else ""
            raise type(error)(f"{error} (frame {index} of {folder.name}{kept})") from error
        if result is not None:
            yield RgbdPair(source, target, folder.camera), result
        source = target


def _open_recording(path: Path | None, spawn: bool):
    from lidarflow import rgbd_viewer

    return rgbd_viewer.open_recording(path, spawn)
