"""A whole run: a data set in, a folder of results out."""

import contextlib
import itertools
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lidarflow import flow_files, io, methods, pose, preview, provenance, resuming, run_folder
from lidarflow.aside import Aside, ahead, there
from lidarflow.checkpoints import CheckpointFiles, Checkpoints
from lidarflow.config import Config
from lidarflow.datasets import Dataset
from lidarflow.errors import DataError
from lidarflow.pair_reports import PairReport, metrics_of, report_pair, without_poorer_truth
from lidarflow.provenance import RunSource
from lidarflow.resuming import Plan, State, state_of
from lidarflow.stepping import Kept, Skipped, Step, Walk, saying_what_is_kept, steps
from lidarflow.trajectory import Trajectory
from lidarflow.types import FlowResult

if TYPE_CHECKING:
    from lidarflow.datasets.rgbd_folders import RgbdFolder
    from lidarflow.rgbd_config import RgbdConfig

OUTPUT_STAGE = "scores and output"     # the stage after those of the method itself


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


@dataclass(frozen=True, slots=True)
class Going:
    """How a run goes on where not everything is as it should be.

    resume    take over what an interrupted run of the same data, settings and method has done
    skip_bad  leave out scans that cannot be used
    chunk     pairs that were computed on their own by several processes, 0 = none
    on_skip   hears of every scan that is left out
    """

    resume: bool = False
    skip_bad: bool = False
    chunk: int = 0
    on_skip: Callable[[Skipped], None] = lambda skipped: None


def process(
    dataset: Dataset, frames: list[int], config: Config, out: Path, viewing: Viewing,
    on_pair: Callable[[PairReport], None] = lambda report: None, method: str = methods.OURS,
    going: Going | None = None,
) -> list[PairReport]:
    """Process `frames` of a data set and write a run folder; `on_pair` hears of every finished pair.

    `method` is one of methods.METHODS. Flow files are complete as soon as they appear; poses, objects,
    metrics, recording and picture follow. Until then every pair is kept as a checkpoint too, from which
    `going.resume` goes on. Whether a pair's truth is as good as that of the others is known at the end: what
    is returned and written may lack scores that `on_pair` heard of (`without_poorer_truth`). Raises
    LidarflowError for input or output that cannot be used.
    """
    going = going or Going()
    plan, kept = plan_of(dataset, frames, config, method, going), Checkpoints(out)
    walk = Walk.of_scans(dataset, methods.find(method).along(config))
    done, skipped = begun_steps(walk, plan, kept, out, going)
    reports, way, objects = [], Trajectory(frames), []
    with recording(out / io.RECORDING_FILE, viewing, _open_recording) as stream, ahead(done) as computed:
        for step in computed:
            reports.append(_write_pair(dataset, step, config, out, stream, way, viewing.arrows))
            if not step.restored:
                kept.save(step.index, step.pair, step.result, step.tracks, step.stretch)
            objects += _object_rows(step.pair.source.name, step.result)
            on_pair(reports[-1])
    reports = without_poorer_truth(reports)
    way.write(out)
    io.write_objects(out / io.OBJECTS_FILE, objects)
    with io.written_aside(out / "preview.png") as aside:
        preview.write_preview(aside, step.pair, step.result)
    finish(out, plan, kept, skipped, metrics_of(reports, config), {r.frame: r.seconds for r in reports})
    return reports


def plan_of(data: "Dataset | RgbdFolder", frames: list[int], config: "Config | RgbdConfig", method: str,
            going: Going) -> Plan:
    """What decides the bytes of a run."""
    return Plan(RunSource(data.source, tuple(frames)), config, method, going.chunk)


def begun_steps(walk: Walk, plan: Plan, kept: Kept, out: Path, going: Going
                ) -> tuple[Iterator[Step], list[Skipped]]:
    """The pairs of a run, whose folder `out` is ready for results, and the scans that are left out.

    Those come to the list as the pairs are gone through. The first pair is done before the folder is touched:
    bad data leave no empty run behind. Raises LidarflowError where nothing can be used or `out` holds another
    run.
    """
    skipped: list[Skipped] = []

    def on_skip(scan: Skipped) -> None:
        skipped.append(scan)
        going.on_skip(scan)

    run_folder.check(out)
    begun = going.resume and state_of(out, plan) is State.BEGUN
    found = steps(walk, list(plan.source.scans), kept if begun else None, on_skip if going.skip_bad else None)
    done = saying_what_is_kept(found, out)
    first = next(done, None)
    if first is None:
        raise DataError(f"{walk.name}: no two neighbouring {walk.what} can be used; the first that cannot: "
                        f"{skipped[0].reason}")
    if begun:
        run_folder.remove_left_overs(out)
    else:
        resuming.begin(out, plan)
    return itertools.chain([first], done), skipped


def finish(
    out: Path, plan: Plan, kept: CheckpointFiles, skipped: list[Skipped], figures: dict,
    seconds: dict[str, dict[str, float]],
) -> None:
    """Make a run complete whose results are in `out`: its checkpoints go, and it becomes the latest.

    figures  what metrics.json holds, but for the scans that are left out
    seconds  by frame and stage
    """
    # What an interrupted run found of a scan that is left out now is no part of this one.
    for file in (out / io.FLOW_FOLDER).glob("*.npz"):
        if file.stem not in seconds:
            file.unlink()
    provenance.write(out, replace(plan.source, skipped=tuple(scan.index for scan in skipped)))
    io.write_json(out / io.METRICS_FILE, {**figures, **_plain_skipped(skipped)})
    io.write_json(out / io.TIMING_FILE, seconds)
    kept.remove()
    run_folder.link_latest(out)


def begin(dataset: Dataset, frames: list[int], config: Config, out: Path, method: str, going: Going
          ) -> Checkpoints:
    """Make `out` ready for checkpoints that others compute; those of an interrupted run stay."""
    run_folder.check(out)
    plan = plan_of(dataset, frames, config, method, going)
    if not (going.resume and state_of(out, plan) is State.BEGUN):
        resuming.begin(out, plan)
    return Checkpoints(out)


def is_complete(data: "Dataset | RgbdFolder", frames: list[int], config: "Config | RgbdConfig", out: Path,
                method: str, going: Going) -> bool:
    """Whether `out` holds all that this run would write; DataError where it holds another run."""
    return state_of(out, plan_of(data, frames, config, method, going)) is State.COMPLETE


def _write_pair(
    dataset: Dataset, step: Step, config: Config, out: Path, stream, way: Trajectory, arrows: bool
) -> PairReport:
    """Write the flow file of a pair, log it, lengthen the way by it, and report it."""
    begin, pair, result = time.perf_counter(), step.pair, step.result
    file = out / io.FLOW_FOLDER / f"{pair.source.name}.npz"
    with Aside() as beside:
        saved = there(None) if step.is_written(file) else beside.begin(
            flow_files.save_flow, file, pair.source.points, result, config)
        report = report_pair(dataset, step.index, pair, result, config)
        saved.result()
    world_from_source = way.add(step.index, pair, result.ego_motion)
    if stream is not None:
        from lidarflow import viewer

        score = (report.alignment.before, report.alignment.after)
        viewer.log_pair(stream, step.index, pair, result, score, world_from_source, arrows)
    return replace(report, seconds={**report.seconds, OUTPUT_STAGE: time.perf_counter() - begin})


def _plain_skipped(skipped: list[Skipped]) -> dict:
    """What metrics.json says of scans that were left out; nothing where there are none."""
    return {"skipped": [{"scan": scan.index, "reason": scan.reason} for scan in skipped]} if skipped else {}


def _object_rows(frame: str, result: FlowResult) -> list[tuple]:
    """A row of io.OBJECT_COLUMNS for every moving object, all in the source frame."""
    source_from_target = pose.inverse(result.ego_motion)
    return [
        (frame, found.id, found.points, *found.box_centre, *found.box_size, found.box_yaw,
         *pose.turn(source_from_target, found.velocity), np.linalg.norm(found.velocity))
        for found in result.objects]


def _open_recording(path: Path | None, spawn: bool):
    from lidarflow import viewer

    return viewer.open_recording(path, spawn)


@contextlib.contextmanager
def recording(path: Path, viewing: Viewing, open_recording: Callable):
    """The viewer's stream, its file moved into place once complete; None when nothing is to be shown.

    open_recording  (path or None, whether to start a viewer) -> the stream
    """
    if not (viewing.record or viewing.visualize):
        yield None
        return
    from lidarflow import rerun_streams

    with contextlib.ExitStack() as stack:
        aside = stack.enter_context(io.written_aside(path)) if viewing.record else None
        stream = open_recording(aside, viewing.visualize)
        stack.callback(rerun_streams.close, stream, aside)
        yield stream
