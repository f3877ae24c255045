"""The command line: the only place that prints or exits.

Heavy packages are imported inside the commands, so that --help answers at once.
"""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lidarflow import __version__
from lidarflow.errors import LidarflowError

if TYPE_CHECKING:
    from lidarflow.config import Config
    from lidarflow.datasets import Dataset
    from lidarflow.runner import PairReport, Viewing

app = typer.Typer(
    help="Dense rigid scene flow: a rigid motion for every LiDAR point between consecutive scans.",
    no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)

ConfigFile = Annotated[
    Path | None, typer.Option("--config", help="TOML file with differences from the defaults.")]
Overrides = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Override a setting, e.g. mesh.max_edge_m=0.5.")]
Out = Annotated[Path, typer.Option("--out", help="Where the results go.")]
Visualize = Annotated[bool, typer.Option("--visualize", help="Open the viewer, show results as they come.")]
Arrows = Annotated[bool, typer.Option("--arrows", help="Also record the total flow as arrows.")]


def main() -> None:
    """Entry point: problems with data or settings become one line and exit code 1."""
    try:
        app()
    except LidarflowError as error:
        print(f"lidarflow: {' '.join(str(error).split())}", file=sys.stderr)
        sys.exit(1)
    except KeyboardInterrupt:
        print("lidarflow: interrupted", file=sys.stderr)
        sys.exit(130)


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
    visualize: Visualize = False,
    arrows: Arrows = False,
    config: ConfigFile = None,
    overrides: Overrides = None,
) -> None:
    """Flow between two clouds; nothing else is needed."""
    from lidarflow import datasets, io, metrics, pipeline, preview
    from lidarflow.config import load
    from lidarflow.types import ScanPair

    settings = load(config, tuple(overrides or ()))
    if out.suffix != ".npz":
        raise LidarflowError(f"--out {out}: expected a file name ending in .npz")
    correction = settings.preparation.kitti_correction
    scans = ScanPair(datasets.read_scan(source, correction), datasets.read_scan(target, correction))
    with _working(f"flow from {source.name} to {target.name}"):
        result = pipeline.estimate_flow(scans, settings)
        io.save_flow(out, scans.source.points, result, settings)
        alignment = metrics.alignment(scans.source, scans.target, result, settings.crispness.sigma_m)
        if picture is not None:
            with io.written_aside(picture) as aside:
                preview.write_preview(aside, scans, result)
        if recording is not None or visualize:
            _record_pair(recording, visualize, arrows, scans, result, alignment)
    from lidarflow.tables import pair_table

    _print(pair_table(scans, result, alignment))
    print(f"flow       {out}")
    print(f"look at it with: lidarflow view {out} --target {target}")


@app.command()
def run(
    data: Annotated[Path, typer.Argument(help="A folder of scans, a KITTI folder, or what KISS-ICP reads.")],
    out: Out,
    dataloader: Annotated[str | None, typer.Option(help="Loader; guessed when not given.")] = None,
    sequence: Annotated[
        str | None, typer.Option("--sequence", "-s", help="Sequence, where there are several.")] = None,
    n_scans: Annotated[
        int | None, typer.Option("--n-scans", "-n", help="How many scans; all if not given.")] = None,
    jump: Annotated[int, typer.Option("--jump", "-j", help="First scan to process.")] = 0,
    visualize: Visualize = False,
    arrows: Arrows = False,
    record: Annotated[bool, typer.Option(help="Write recording.rrd (about 5 MB a pair).")] = True,
    config: ConfigFile = None,
    overrides: Overrides = None,
) -> None:
    """Flow between all consecutive scans of a data set."""
    from lidarflow.config import load
    from lidarflow.datasets import open_dataset
    from lidarflow.runner import Viewing

    settings = load(config, tuple(overrides or ()))
    dataset = open_dataset(data, dataloader, sequence, settings.preparation.kitti_correction)
    guessed = "" if dataloader else " (guessed; --dataloader overrides)"
    print(f"reading {dataset.name}, {len(dataset)} scans, as {dataset.loader}{guessed}")
    if dataset.note:
        print(f"        {dataset.note}")
    _process(dataset, settings, out, Viewing(record, visualize, arrows), jump, n_scans)


@app.command()
def view(
    what: Annotated[Path, typer.Argument(help="A run folder, a recording (.rrd) or a flow file (.npz).")],
    target: Annotated[Path | None, typer.Option(help="For a flow file: the cloud it leads to.")] = None,
    save: Annotated[Path | None, typer.Option(help="Write a recording, open no viewer.")] = None,
) -> None:
    """Look at results in the rerun viewer."""
    import tempfile

    from lidarflow import viewer

    if what.is_dir() or what.suffix == ".rrd":
        viewer.open_in_viewer(what / "recording.rrd" if what.is_dir() else what)
    elif save is not None:
        _record_flow_file(what, target, save)
        print(f"recording  {save}")
    else:
        with tempfile.TemporaryDirectory() as folder:
            recording = Path(folder) / "flow.rrd"
            _record_flow_file(what, target, recording)
            viewer.open_in_viewer(recording)


@app.command()
def demo(
    out: Out = Path("demo"),
    visualize: Visualize = False,
) -> None:
    """A generated drive through a street: ray-cast, processed, scored against its truth, pictured."""
    from lidarflow import demo as generated
    from lidarflow.config import load
    from lidarflow.datasets import open_dataset
    from lidarflow.runner import Viewing

    with _working("ray-casting a street"):
        folder = generated.generate(out / "data")
    # Generated scans have no calibration error to correct.
    settings = load(overrides=("preparation.kitti_correction=off",))
    dataset = open_dataset(folder, kitti_correction=settings.preparation.kitti_correction)
    print(f"generated  {folder} ({len(dataset)} scans with truth, KITTI's layout)")
    _process(dataset, settings, out / "run", Viewing(visualize=visualize), 0, None)


@app.command(name="config")
def show_config() -> None:
    """Every setting with its default, the values it takes, and its effect."""
    from lidarflow.tables import config_table

    _print(config_table())


def _process(
    dataset: "Dataset", settings: "Config", out: Path, viewing: "Viewing", jump: int, n_scans: int | None
) -> None:
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    from lidarflow import runner
    from lidarflow.tables import run_table

    frames = runner.choose_frames(dataset, jump, n_scans)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=_console(sys.stderr)) as progress:
        task = progress.add_task("scan pairs", total=len(frames) - 1)

        def on_pair(report: "PairReport") -> None:
            progress.update(task, advance=1, description=f"scan pairs, {report.frame} done")

        reports = runner.process(dataset, frames, settings, out, viewing, on_pair)
    _print(run_table(reports, settings))
    print(f"results    {out}")
    if viewing.record:
        print(f"recording  {out / 'recording.rrd'}   (lidarflow view {out})")
    print(f"picture    {out / 'preview.png'}")


def _record_pair(recording, visualize, arrows, scans, result, alignment) -> None:
    """Log one pair to a file, the live viewer, or both."""
    import contextlib

    import numpy as np

    from lidarflow import io, viewer

    with contextlib.ExitStack() as stack:
        aside = None if recording is None else stack.enter_context(io.written_aside(recording))
        stream = viewer.open_recording(aside, spawn=visualize)
        stack.callback(viewer.close, stream)
        viewer.log_pair(stream, 0, scans, result, (alignment.before, alignment.after), np.eye(4), arrows)


def _record_flow_file(file: Path, target: Path | None, recording: Path) -> None:
    from lidarflow import datasets, io, viewer

    found = io.load_flow(file)
    correction = found.config.get("preparation", {}).get("kitti_correction", "auto")
    points = None if target is None else datasets.read_scan(target, correction).points
    with io.written_aside(recording) as aside:
        stream = viewer.open_recording(aside)
        viewer.log_flow(stream, found.points, found.flow, found.is_dynamic, found.ego_motion, 0.1, points)
        viewer.close(stream)


def _working(what: str):
    """A spinner on standard error while something long goes on."""
    return _console(sys.stderr).status(what)


def _console(file):
    from rich.console import Console

    return Console(file=file)


def _print(table) -> None:
    _console(sys.stdout).print(table)
