"""A whole run: a data set in, a folder of results out."""

import contextlib
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from lidarflow import io, metrics, pipeline, pose, preview
from lidarflow.config import Config
from lidarflow.datasets import Dataset
from lidarflow.errors import DataError, LidarflowError
from lidarflow.types import FlowResult, ScanPair, SolveStats, Truth


@dataclass(frozen=True, slots=True)
class Viewing:
    """What a run shows and records.

    record     write recording.rrd
    visualize  open the viewer and show pairs as they are done
    arrows     log the total flow of all points as arrows
    """

    record: bool = True
    visualize: bool = False
    arrows: bool = False


@dataclass(frozen=True, slots=True)
class PairReport:
    """What is known of one pair once it is done: scores are None where there is no truth."""

    frame: str
    points: int
    graph_points: int
    moving_points: int
    objects: int
    matches: int
    alignment: metrics.Alignment
    scores: metrics.Scores | None
    truth: str
    stats: SolveStats
    seconds: dict[str, float]


def choose_frames(dataset: Dataset, jump: int, count: int | None, what: str = "scans") -> list[int]:
    """Indices of the scans (`what`) to process: `count` from `jump` on; DataError for fewer than two."""
    for option, value in (("--jump", jump), (f"--n-{what}", count)):
        if value is not None and value < 0:
            raise DataError(f"{option} {value}: must not be negative")
    last = len(dataset) if count is None else min(len(dataset), jump + count)
    frames = list(range(jump, last))
    if len(frames) < 2:
        raise DataError(
            f"{dataset.name}: {len(frames)} of {len(dataset)} {what} selected; flow needs at least two, "
            f"see --n-{what} and --jump")
    return frames


def process(
    dataset: Dataset, frames: list[int], config: Config, out: Path, viewing: Viewing,
    on_pair: Callable[[PairReport], None] = lambda report: None,
) -> list[PairReport]:
    """Process `frames` of a data set and write a run folder; `on_pair` hears of every finished pair.

    Flow files are complete as soon as they appear; poses, objects, metrics, recording and picture follow.
    Raises LidarflowError for input or output that cannot be used.
    """
    # The first pair is done before the folder is touched: a bad data set leaves no empty run behind.
    io.check_run_folder(out)
    reports: list[PairReport] = []
    results = _explained(pipeline.run(dataset, frames, config), dataset, frames, reports, out)
    first = next(results)
    io.new_run_folder(out)
    io.write_toml(out / io.CONFIG_FILE, config)
    world_from_sensor, times_ns, objects = [np.eye(4)], [], []
    with recording(out / io.RECORDING_FILE, viewing, _open_recording) as stream:
        for index, (pair, result) in zip(frames, _chained(first, results), strict=False):
            begin = time.perf_counter()
            io.save_flow(out / io.FLOW_FOLDER / f"{pair.source.name}.npz", pair.source.points, result, config)
            report = report_pair(dataset, index, pair, result, config)
            if stream is not None:
                from lidarflow import viewer

                score = (report.alignment.before, report.alignment.after)
                viewer.log_pair(stream, index, pair, result, score, world_from_sensor[-1], viewing.arrows)
            world_from_sensor.append(world_from_sensor[-1] @ pose.inverse(result.ego_motion))
            times_ns.append(pair.source.time_ns)
            objects += _object_rows(pair.source.name, result)
            with_output = {**report.seconds, "scores and output": time.perf_counter() - begin}
            reports.append(replace(report, seconds=with_output))
            on_pair(reports[-1])
    poses = np.stack(world_from_sensor)
    io.write_poses_kitti(out / "poses_kitti.txt", poses)
    io.write_poses_tum(out / "poses_tum.txt", poses, [*times_ns, pair.target.time_ns])
    io.write_objects(out / io.OBJECTS_FILE, objects)
    with io.written_aside(out / "preview.png") as aside:
        preview.write_preview(aside, pair, result)
    io.write_json(out / "metrics.json", metrics_of(reports, config))
    io.write_json(out / "timing.json", {r.frame: r.seconds for r in reports})
    io.link_latest(out)
    return reports


def metrics_of(reports: list[PairReport], config: Config) -> dict:
    """What metrics.json holds: the mean over pairs, and every pair; wall times are kept elsewhere."""
    pairs = []
    for report in reports:
        values = asdict(report)
        del values["seconds"]
        pairs.append(values)
    return {"crispness_sigma_m": config.crispness.sigma_m, "mean": mean_of(reports), "pairs": pairs}


def mean_of(reports: list[PairReport]) -> dict[str, float]:
    """Means over pairs of the main figures; figures without a value in a pair leave that pair out."""
    rows = [figures_of(report) for report in reports]
    names = dict.fromkeys(name for row in rows for name in row)
    means = {}
    for name in names:
        values = np.array([row[name] for row in rows if name in row and np.isfinite(row[name])])
        if len(values):
            means[name] = float(values.mean())
    return means


def figures_of(report: PairReport) -> dict[str, float]:
    """The main figures of one pair by name, units in the name."""
    figures = {
        "crispness_before": report.alignment.before,
        "crispness_by_ego": report.alignment.by_ego,
        "crispness_after": report.alignment.after,
        "moving_points": float(report.moving_points),
        "objects": float(report.objects),
    }
    if report.scores is not None:
        s = report.scores
        figures |= {
            "epe_all_m": s.all.mean, "epe_static_m": s.static.mean, "epe_dynamic_m": s.dynamic.mean,
            "epe_dynamic_median_m": s.dynamic.median, "graph_epe_static_m": s.graph_static.mean,
            "graph_epe_dynamic_m": s.graph_dynamic.mean,
            "graph_epe_dynamic_median_m": s.graph_dynamic.median, "t_e_m": s.t_e, "r_e_rad": s.r_e_rad,
            "movers_found": s.movers_found, "false_movers": s.false_movers, "ego_error_m": s.ego_error_m,
            "ego_error_deg": float(np.degrees(s.ego_error_rad)),
        }
    return figures


def find_truth(dataset: Dataset, index: int, pair: ScanPair) -> tuple[Truth | None, str]:
    """Truth of the pair at `index`, and where it comes from: "flow", "poses" or "none"."""
    truth = dataset.truth(index)
    if truth is not None:
        return truth, "flow"
    world_from_sensor = dataset.world_from_sensor()
    if world_from_sensor is None:
        return None, "none"
    ego_motion = pose.inverse(world_from_sensor[index + 1]) @ world_from_sensor[index]
    return metrics.static_truth(pair.source.points, ego_motion), "poses (every point taken as static)"


def report_pair(
    dataset: Dataset, index: int, pair: ScanPair, result: FlowResult, config: Config
) -> PairReport:
    """Scores of a finished pair, the one from the data set's scan `index` to the next."""
    truth, origin = find_truth(dataset, index, pair)
    return PairReport(
        frame=pair.source.name,
        points=len(pair.source),
        graph_points=int((result.in_graph & result.valid).sum()),
        moving_points=int(result.is_dynamic.sum()),
        objects=len(result.objects),
        matches=len(result.match_source),
        alignment=metrics.alignment(pair.source, pair.target, result, config.crispness.sigma_m),
        scores=None if truth is None else metrics.score(pair.source.points, result, truth),
        truth=origin,
        stats=result.stats,
        seconds=result.seconds,
    )


def _object_rows(frame: str, result: FlowResult) -> list[tuple]:
    """A row of io.OBJECT_COLUMNS for every moving object, all in the source frame."""
    source_from_target = pose.inverse(result.ego_motion)
    return [
        (frame, found.id, found.points, *found.box_centre, *found.box_size, found.box_yaw,
         *pose.turn(source_from_target, found.velocity), np.linalg.norm(found.velocity))
        for found in result.objects]


def _chained(first, rest) -> Iterator[tuple[ScanPair, FlowResult]]:
    yield first
    yield from rest


def _explained(
    results: Iterator, dataset: Dataset, frames: list[int], reports: list[PairReport], out: Path
) -> Iterator:
    """`results`; an error on the way also says where in the data set it is, and what is kept of the run."""
    try:
        yield from results
    except LidarflowError as error:
        index = frames[len(reports)]
        kept = f"; the flow of {len(reports)} before is kept in {out / io.FLOW_FOLDER}" if reports else ""
        raise type(error)(f"{error} (scans {index} and {index + 1} of {dataset.name}{kept})") from error


def _open_recording(path: Path | None, spawn: bool):
    from lidarflow import viewer

    return viewer.open_recording(path, spawn=spawn)


@contextlib.contextmanager
def recording(path: Path, viewing: Viewing, open_recording: Callable):
    """The viewer's stream, its file moved into place once complete; None when nothing is to be shown.

    open_recording  (path or None, whether to start a viewer) -> the stream
    """
    if not (viewing.record or viewing.visualize):
        yield None
        return
    from lidarflow import viewer

    with contextlib.ExitStack() as stack:
        aside = stack.enter_context(io.written_aside(path)) if viewing.record else None
        stream = open_recording(aside, viewing.visualize)
        stack.callback(viewer.close, stream)
        yield stream
