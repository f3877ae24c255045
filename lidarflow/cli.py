"""The command line; it and its parts (`*_cli.py`) alone print and exit.

Heavy packages are imported inside the commands, so that --help answers at once.
"""

import contextlib
import os
import signal
import sys
from pathlib import Path
from shlex import quote
from typing import Annotated

import typer

from lidarflow import __version__, interrupts
from lidarflow.errors import DataError, LidarflowError
from lidarflow.eval_cli import evaluate
from lidarflow.export_cli import export
from lidarflow.rgbd_cli import app as rgbd_app
from lidarflow.run_cli import Spread, open_data, pairs_done, process, say_what_is_idle
from lidarflow.terminal import ConfigFile, Resume, Visualize
from lidarflow.terminal import announce_first_use as _announce_first_use
from lidarflow.terminal import check_arrows as _check_arrows
from lidarflow.terminal import check_exists as _check_exists
from lidarflow.terminal import check_live_view as _check_live_view
from lidarflow.terminal import check_words as _check_words
from lidarflow.terminal import notes_of as _notes_of
from lidarflow.terminal import show as _print
from lidarflow.terminal import working as _working

_INTERRUPTED = 130     # what typer makes of Ctrl-C
_TERMINATED = 143      # what shells make of SIGTERM

app = typer.Typer(
    help="Dense rigid scene flow: a rigid motion for every LiDAR point between consecutive scans.",
    no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)
app.add_typer(rgbd_app, name="rgbd")

Overrides = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Override a setting, e.g. mesh.max_edge_m=0.5.")]
Out = Annotated[Path, typer.Option("--out", help="Where the results go.")]
Data = Annotated[Path, typer.Argument(help="A folder of scans, a KITTI folder, or what KISS-ICP reads.")]
Loader = Annotated[str | None, typer.Option("--dataloader", help="Loader; guessed when not given.")]
Sequence = Annotated[
    str | None, typer.Option("--sequence", "-s", help="Sequence, where there are several.")]
Count = Annotated[int | None, typer.Option("--n-scans", "-n", help="How many scans; all if not given.")]
Jump = Annotated[int, typer.Option("--jump", "-j", help="First scan to process.")]
MethodName = Annotated[
    str, typer.Option("--method", help="ours, or a baseline: zero, ego, icp, ransac_icp.")]
Solver = Annotated[
    str | None, typer.Option("--solver", help="fast or gtsam, short for --set solver.method=NAME.")]
Arrows = Annotated[bool, typer.Option("--arrows", help="Also record the total flow as arrows.")]


def main() -> None:
    """Entry point: problems with data or settings become one line and exit code 1."""
    # A terminal that lacks a letter shows another one; that is no reason to lose the results.
    sys.stdout.reconfigure(errors="replace")
    signal.signal(signal.SIGTERM, interrupts.deferred(_terminate))
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:     # in the background it is ignored
        signal.signal(signal.SIGINT, interrupts.deferred(signal.default_int_handler))
    try:
        _check_words(sys.argv[1:])
        app(prog_name="lidarflow")
    except LidarflowError as error:
        print(f"lidarflow: {' '.join(str(error).split())}", file=sys.stderr)
        sys.exit(1)
    except (OSError, MemoryError) as error:
        print(f"lidarflow: {' '.join(str(error).split()) or 'out of memory'}", file=sys.stderr)
        sys.exit(1)
    except SystemExit as stop:
        if stop.code in (_INTERRUPTED, _TERMINATED):
            how = "interrupted" if stop.code == _INTERRUPTED else "terminated"
            print("; ".join([f"lidarflow: {how}", *_notes_of(stop)]), file=sys.stderr)
        raise
    finally:
        _leave_what_is_stalled()


def _terminate(number: int, frame: object) -> None:
    """End as after Ctrl-C, so that what is half-written is removed."""
    sys.exit(_TERMINATED)


def _leave_what_is_stalled() -> None:
    """End the program at once where the usual way waits for ever for a recording that cannot be written."""
    streams = sys.modules.get("lidarflow.rerun_streams")
    if streams is not None and streams.stalled:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(1)


def _show_version(wanted: bool) -> None:
    if wanted:
        print(f"lidarflow {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[bool, typer.Option(
        "--version", callback=_show_version, is_eager=True, help="Show the version and exit.")] = False,
) -> None:
    pass


@app.command()
def pair(
    source: Annotated[Path, typer.Argument(help="Cloud at time t-1: .bin .pcd .ply .npy .npz …")],
    target: Annotated[Path, typer.Argument(help="Cloud at time t.")],
    out: Annotated[Path, typer.Option("--out", help="The flow file (.npz) to write.")],
    recording: Annotated[Path | None, typer.Option(help="Also write a recording (.rrd).")] = None,
    picture: Annotated[Path | None, typer.Option(help="Also write a bird's-eye picture (.png).")] = None,
    method: MethodName = "ours",
    solver: Solver = None,
    visualize: Visualize = False,
    arrows: Arrows = False,
    config: ConfigFile = None,
    overrides: Overrides = None,
) -> None:
    """Flow between two clouds; nothing else is needed."""
    from lidarflow import datasets, flow_files, io, methods, metrics, preview
    from lidarflow.config import load
    from lidarflow.types import ScanPair

    settings, chosen = load(config, _with_solver(overrides, solver)), methods.find(method)
    for option, file, suffix in (("--out", out, ".npz"), ("--recording", recording, ".rrd"),
                                 ("--picture", picture, ".png")):
        if file is not None:
            io.check_output(option, file, suffix, inputs=(source, target))
    _check_arrows(arrows, visualize or recording is not None, "give --recording FILE.rrd or --visualize")
    _check_live_view(visualize)
    correction = settings.preparation.kitti_correction
    scans = ScanPair(datasets.read_scan(source, correction), datasets.read_scan(target, correction))
    _announce_first_use()
    with _working(f"flow from {source.name} to {target.name}"):
        result = chosen.estimate(scans, settings)
        alignment = metrics.alignment(scans.source, scans.target, result, settings.crispness.sigma_m)
        if picture is not None:
            with io.written_aside(picture) as aside:
                preview.write_preview(aside, scans, result)
        if recording is not None or visualize:
            _record_pair(recording, visualize, arrows, scans, result, alignment)
        flow_files.save_flow(out, scans.source.points, result, settings)
    from lidarflow.tables import pair_table

    _print(pair_table(scans, result, alignment))
    print(f"assumed    {_assumed(source, target, correction)}")
    print(f"method     {method}")
    say_what_is_idle((method,), settings, along=False)
    print(f"flow       {out}")
    print(f"look at it with: lidarflow view {quote(str(out))} --target {quote(str(target))}")


@app.command()
def run(
    data: Data,
    out: Out,
    dataloader: Loader = None,
    sequence: Sequence = None,
    n_scans: Count = None,
    jump: Jump = 0,
    method: MethodName = "ours",
    solver: Solver = None,
    visualize: Visualize = False,
    arrows: Arrows = False,
    record: Annotated[bool, typer.Option(help="Write recording.rrd (about 5 MB a pair).")] = True,
    resume: Resume = False,
    skip_bad: Annotated[bool, typer.Option(
        "--skip-bad", help="Leave out scans that cannot be used, and say which.")] = False,
    workers: Annotated[int | None, typer.Option(
        min=1, help="So many processes, one core each (needs Dask distributed).")] = None,
    scheduler: Annotated[str | None, typer.Option(
        metavar="ADDRESS", help="The workers of a Dask scheduler, e.g. tcp://HOST:8786.")] = None,
    chunk: Annotated[int | None, typer.Option(
        min=1, help="Pairs that a worker computes in one go; 20 if not given.")] = None,
    config: ConfigFile = None,
    overrides: Overrides = None,
) -> None:
    """Flow between all consecutive scans of a data set."""
    from lidarflow import methods
    from lidarflow.config import load
    from lidarflow.runner import Going, Viewing

    settings = load(config, _with_solver(overrides, solver))
    methods.find(method)
    _check_arrows(arrows, visualize or record, "leave --no-record out, or give --visualize")
    dataset = open_data(data, dataloader, sequence, settings)
    print(f"method     {method}")
    say_what_is_idle((method,), settings)
    process(dataset, settings, out, Viewing(record, visualize, arrows), jump, n_scans, method,
             Going(resume, skip_bad), Spread.wanted(workers, scheduler, chunk))


@app.command()
def compare(
    data: Data,
    names: Annotated[
        str, typer.Option("--methods", help="What to compare: ours, zero, ego, icp, ransac_icp.")
    ] = "ours,ego,icp,ransac_icp",
    dataloader: Loader = None,
    sequence: Sequence = None,
    n_scans: Count = None,
    jump: Jump = 0,
    out: Annotated[Path | None, typer.Option("--out", help="Also write all figures (.json).")] = None,
    config: ConfigFile = None,
    overrides: Overrides = None,
) -> None:
    """Run several methods on the same scans, one table."""
    from lidarflow import compare as comparing
    from lidarflow import io, runner, tables
    from lidarflow.config import load

    settings, chosen = load(config, tuple(overrides or ())), comparing.names_of(names)
    if out is not None:
        io.check_output("--out", out, ".json", inputs=(data,))
    dataset = open_data(data, dataloader, sequence, settings)
    say_what_is_idle(chosen, settings)
    frames = runner.choose_frames(dataset, jump, n_scans)
    with pairs_done(len(frames) - 1) as on_pair:
        found = comparing.compare(dataset, frames, chosen, settings, on_pair)
    print()
    _print(tables.compare_table(found))
    print()
    for note in tables.compare_notes(found):
        print(note)
    if out is not None:
        io.write_json(out, found.to_dict())
        print(f"figures    {out}")


app.command(name="eval")(evaluate)


@app.command(name="report")
def write_report(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN_DIR...", help="One run folder or several.")],
    out: Annotated[Path, typer.Option("--out", help="The page (.html) to write.")] = Path("report.html"),
) -> None:
    """Write one HTML page on runs: scores, pictures, settings."""
    from lidarflow import io, report

    io.check_output("--out", out, ".html")
    with _working("reading runs"):
        read = [report.read_run(run, report.shown_per_run(len(runs))) for run in runs]
        io.write_text(out, report.page_of(read))
    print(f"report     {out}")


app.command()(export)


@app.command()
def view(
    what: Annotated[Path, typer.Argument(help="A run folder, a recording (.rrd) or a flow file (.npz).")],
    target: Annotated[Path | None, typer.Option(help="For a flow file: the cloud it leads to.")] = None,
    save: Annotated[Path | None, typer.Option(help="Write a recording, open no viewer.")] = None,
) -> None:
    """Look at results in the rerun viewer."""
    import shutil
    import tempfile

    from lidarflow import flow_files, io, rerun_streams, rgbd_io, run_folder

    _check_exists(what, "a run folder, a recording (.rrd) or a flow file (.npz)")
    if save is not None:
        io.check_output("--save", save, ".rrd", inputs=(what,))
    if what.is_dir() or what.suffix == ".rrd":
        if target is not None:
            raise DataError(f"--target {target}: is for a flow file; {what} holds its clouds already")
        recording = run_folder.find_recording(what)
        rerun_streams.check_recording(recording)
        if save is None:
            rerun_streams.open_in_viewer(recording)
        else:
            with io.written_aside(save) as aside:
                shutil.copyfile(recording, aside)
            print(f"recording  {save}")
    elif save is not None:
        _record_flow_file(what, target, save)
        print(f"recording  {save}")
    else:
        rgbd_io.load_flow(what) if rgbd_io.is_rgbd_flow(what) else flow_files.load_flow(what)
        instead = f"lidarflow view {quote(str(what))} --save FILE.rrd"
        rerun_streams.require_display(f"make a recording with: {instead}")
        with tempfile.TemporaryDirectory() as folder:
            recording = Path(folder) / "flow.rrd"
            _record_flow_file(what, target, recording)
            rerun_streams.open_in_viewer(recording)


@app.command()
def demo(
    out: Out = Path("demo"),
    visualize: Visualize = False,
) -> None:
    """Generate a drive, process it, score it and picture it."""
    from lidarflow import demo as generated
    from lidarflow.config import load
    from lidarflow.datasets import open_dataset
    from lidarflow.runner import Viewing

    generated.check_folder(out)
    with _working("ray-casting a street"):
        folder = generated.generate(out / generated.DATA_FOLDER)
    # Generated scans have no calibration error to correct.
    settings = load(overrides=("preparation.kitti_correction=off",))
    dataset = open_dataset(folder, kitti_correction=settings.preparation.kitti_correction)
    print(f"generated  {folder}: {len(dataset)} scans with truth, in KITTI's layout")
    process(dataset, settings, out / generated.RUN_FOLDER, Viewing(visualize=visualize), 0, None)


@app.command(name="config")
def show_config() -> None:
    """List every setting with its default, effect and allowed values."""
    from lidarflow.tables import config_table

    _print(config_table())


def _with_solver(overrides: list[str] | None, solver: str | None) -> tuple[str, ...]:
    """The overrides of settings, and the one that --solver stands for."""
    from lidarflow.config import Config
    from lidarflow.settings import updated

    if solver is not None:
        updated(Config(), {"solver": {"method": solver}}, "--solver")     # names the option that was given
    return (*(overrides or ()), *(() if solver is None else (f"solver.method={solver}",)))


def _record_pair(recording, visualize, arrows, scans, result, alignment) -> None:
    """Log one pair to a file, the live viewer, or both."""
    import numpy as np

    from lidarflow import io, rerun_streams, viewer

    with contextlib.ExitStack() as stack:
        aside = None if recording is None else stack.enter_context(io.written_aside(recording))
        stream = viewer.open_recording(aside, spawn=visualize)
        stack.callback(rerun_streams.close, stream, aside)
        viewer.log_pair(stream, 0, scans, result, (alignment.before, alignment.after), np.eye(4), arrows)


def _record_flow_file(file: Path, target: Path | None, recording: Path) -> None:
    from lidarflow import datasets, flow_files, io, rerun_streams, rgbd_io, viewer

    if rgbd_io.is_rgbd_flow(file):
        _record_rgbd_file(file, target, recording)
        return
    found = flow_files.load_flow(file)
    correction = found.config.get("preparation", {}).get("kitti_correction", "auto")
    points = None if target is None else datasets.read_scan(target, correction).points
    with io.written_aside(recording) as aside:
        stream = viewer.open_recording(aside)
        viewer.log_flow(stream, found.points, found.flow, found.is_dynamic, found.ego_motion, 0.1, points)
        rerun_streams.close(stream, aside)


def _assumed(source: Path, target: Path, kitti_correction: str) -> str:
    """What was taken for granted of the scans in two files."""
    from lidarflow.datasets import clouds

    corrected = any(clouds.is_corrected(path, kitti_correction) for path in (source, target))
    return "0.1 s between the scans" + ("; KITTI vertical-angle correction on" if corrected else "")


def _record_rgbd_file(file: Path, target: Path | None, recording: Path) -> None:
    from lidarflow import io, rerun_streams, rgbd_io, rgbd_viewer

    if target is not None:
        raise DataError(f"--target {target}: {file} is of RGB-D images, which need no target to be shown")
    found = rgbd_io.load_flow(file)
    with io.written_aside(recording) as aside:
        stream = rgbd_viewer.open_recording(aside)
        rgbd_viewer.log_file(stream, found)
        rerun_streams.close(stream, aside)
