"""The commands `lidarflow rgbd …`, for cli.py.

Heavy packages are imported inside the commands, so that --help answers at once.
"""

from dataclasses import replace
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated

import typer

from lidarflow.terminal import (
    ConfigFile,
    Resume,
    Visualize,
    announce_first_use,
    check_live_view,
    progress,
    resumable,
    show,
    working,
)

if TYPE_CHECKING:
    from lidarflow.datasets.rgbd_folders import RgbdFolder
    from lidarflow.rgbd_config import RgbdConfig
    from lidarflow.rgbd_runner import RgbdReport
    from lidarflow.runner import Going, Viewing
    from lidarflow.stepping import Skipped

app = typer.Typer(
    help="Odometry and scene flow from RGB-D images.",
    no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)

CameraFile = Annotated[Path | None, typer.Option(
    "--camera", help="TOML file with width, height, fx, fy, cx, cy; else a nominal PrimeSense.")]
Intrinsics = Annotated[tuple[float, float, float, float] | None, typer.Option(
    metavar="FX FY CX CY", help="The camera in pixels instead of --camera.")]
Method = Annotated[str, typer.Option(help="ours, or open3d: Open3D's RGB-D odometry.")]
Overrides = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Override a setting, e.g. clusters.count=24.")]


@app.command()
def pair(
    color0: Annotated[Path, typer.Argument(help="Colour image at time 0: PNG or JPEG.")],
    depth0: Annotated[Path, typer.Argument(help="16-bit depth PNG registered to it.")],
    color1: Annotated[Path, typer.Argument(help="Colour image at time 1.")],
    depth1: Annotated[Path, typer.Argument(help="16-bit depth PNG registered to it.")],
    out: Annotated[Path, typer.Option("--out", help="The flow file (.npz) to write.")],
    camera: CameraFile = None,
    intrinsics: Intrinsics = None,
    depth_scale: Annotated[float, typer.Option(help="Depth in metres is pixel / this.")] = 5000.0,
    method: Method = "ours",
    picture: Annotated[Path | None, typer.Option(help="Also write a picture (.png).")] = None,
    recording: Annotated[Path | None, typer.Option(help="Also write a recording (.rrd).")] = None,
    visualize: Visualize = False,
    config: ConfigFile = None,
    overrides: Overrides = None,
) -> None:
    """Odometry and scene flow between two RGB-D images."""
    from lidarflow import io, rgbd_io, rgbd_methods, rgbd_preview, rgbd_runner
    from lidarflow.rgbd_tables import pair_table

    settings = _settings(config, overrides)
    inputs = (color0, depth0, color1, depth1)
    for option, file, suffix in (("--out", out, ".npz"), ("--recording", recording, ".rrd"),
                                 ("--picture", picture, ".png")):
        if file is not None:
            io.check_output(option, file, suffix, inputs)
    rgbd_methods.check(method)
    check_live_view(visualize)
    frames, origin = _read_pair(inputs, camera, intrinsics, depth_scale)
    announce_first_use()
    with working(f"flow from {color0.name} to {color1.name}"):
        result = rgbd_methods.estimate_flow(method, frames, settings)
        report = rgbd_runner.report_pair(frames, result)
        if picture is not None:
            with io.written_aside(picture) as aside:
                rgbd_preview.write_preview(aside, frames.source, result)
        if recording is not None or visualize:
            _record_pair(recording, visualize, frames, result, report)
        rgbd_io.save_flow(out, frames.source, result, settings, rgbd_runner.stats_of(method, report))
    print(f"camera     {origin}")
    show(pair_table(frames, result, report))
    print(f"flow       {out}")
    print(f"look at it with: lidarflow view {quote(str(out))}")


@app.command()
def run(
    data: Annotated[Path, typer.Argument(
        metavar="TUM_FOLDER", help="A folder with rgb.txt and depth.txt, or color/ and depth/.")],
    out: Annotated[Path, typer.Option("--out", help="Where the results go.")],
    n_frames: Annotated[
        int | None, typer.Option("--n-frames", "-n", help="How many frames; all if not given.")] = None,
    jump: Annotated[int, typer.Option("--jump", "-j", help="First frame to process.")] = 0,
    camera: CameraFile = None,
    intrinsics: Intrinsics = None,
    depth_scale: Annotated[float | None, typer.Option(
        help="Depth in metres is pixel / this; 5000 for TUM, 1000 for color/ and depth/.")] = None,
    method: Method = "ours",
    visualize: Visualize = False,
    record: Annotated[bool, typer.Option(help="Write recording.rrd (about 2 MB a pair).")] = True,
    resume: Resume = False,
    skip_bad: Annotated[bool, typer.Option(
        "--skip-bad", help="Leave out frames that cannot be used, and say which.")] = False,
    config: ConfigFile = None,
    overrides: Overrides = None,
) -> None:
    """Odometry and scene flow along a sequence of RGB-D images."""
    from lidarflow import rgbd_methods
    from lidarflow.datasets.rgbd_folders import CameraChoice, open_rgbd
    from lidarflow.runner import Going, Viewing

    settings = _settings(config, overrides)
    rgbd_methods.check(method)
    folder = open_rgbd(data, CameraChoice(camera, intrinsics), depth_scale)
    print(f"reading    {data}: {len(folder)} frames")
    for note in folder.notes:
        print(f"note       {note}")
    _process(folder, method, settings, out, Viewing(record, visualize), jump, n_frames,
             Going(resume, skip_bad))


@app.command()
def demo(
    out: Annotated[Path, typer.Option("--out", help="Where the results go.")] = Path("rgbd_demo"),
    visualize: Visualize = False,
) -> None:
    """Render a room, process it, score it and picture it."""
    from lidarflow import demo as generated
    from lidarflow.datasets.rgbd_folders import open_rgbd
    from lidarflow.runner import Viewing

    generated.check_folder(out)
    with working("rendering a room"):
        data = generated.generate_room(out / generated.DATA_FOLDER)
    folder = open_rgbd(data)
    print(f"generated  {data}: {len(folder)} frames with truth, in TUM's layout")
    _process(folder, "ours", _settings(None, None), out / generated.RUN_FOLDER, Viewing(visualize=visualize))


@app.command(name="config")
def show_config() -> None:
    """List every RGB-D setting, its default and effect."""
    from lidarflow.rgbd_config import RgbdConfig
    from lidarflow.tables import config_table

    show(config_table(RgbdConfig))


def _process(folder: "RgbdFolder", method: str, settings: "RgbdConfig", out: Path, viewing: "Viewing",
             jump: int = 0, n_frames: int | None = None, going: "Going | None" = None) -> None:
    """Run over a folder and say what was found."""
    from lidarflow import rgbd_runner, runner
    from lidarflow.rgbd_tables import run_notes, run_table
    from lidarflow.tables import earlier_run, skipped_lines, where_results_are

    check_live_view(viewing.visualize)
    frames = runner.choose_frames(folder, jump, n_frames, "frames")
    skipped: list[Skipped] = []
    going = replace(going or runner.Going(), on_skip=skipped.append)
    said, is_done = earlier_run(folder, frames, settings, out, method, going)
    if said is not None:
        print(said)
    if is_done:
        return
    announce_first_use()
    with resumable(out), progress("frame pairs", len(frames) - 1) as bar:

        def on_pair(report: "RgbdReport") -> None:
            bar.update(0, advance=1, description=f"frame pairs, {report.frame} done")

        done = rgbd_runner.process(folder, frames, method, settings, out, viewing, on_pair, going)
    print()
    for line in skipped_lines(skipped, len(frames), len(done.reports), "frame"):
        print(line)
    show(run_table(done))
    print()
    for note in run_notes(done):
        print(note)
    print()
    for line in where_results_are(out, viewing.record):
        print(line)


def _settings(file: Path | None, overrides: list[str] | None) -> "RgbdConfig":
    from lidarflow import config
    from lidarflow.rgbd_config import RgbdConfig

    return config.load(file, tuple(overrides or ()), RgbdConfig)


def _read_pair(inputs: tuple[Path, ...], camera: Path | None, intrinsics: tuple | None, depth_scale: float):
    """The pair in four files, and where its camera is from."""
    from lidarflow.datasets.rgbd_folders import CameraChoice, choose_camera
    from lidarflow.datasets.rgbd_images import read_frame
    from lidarflow.errors import DataError
    from lidarflow.rgbd_types import RgbdPair

    source, target = (read_frame(*inputs[k:k + 2], depth_scale) for k in (0, 2))
    if source.shape != target.shape:
        sizes = [f"{frame.shape[1]}x{frame.shape[0]}" for frame in (source, target)]
        raise DataError(f"{inputs[2]}: {sizes[1]} pixels, but {inputs[0]} has {sizes[0]}; "
                        "expected images of one camera")
    chosen, origin = choose_camera(inputs[0], CameraChoice(camera, intrinsics))
    return RgbdPair(source, target, chosen), origin


def _record_pair(recording: Path | None, visualize: bool, pair, result, report) -> None:
    """Log one pair to a file, the live viewer, or both."""
    import numpy as np

    from lidarflow import rgbd_viewer, runner

    viewing = runner.Viewing(recording is not None, visualize)
    with runner.recording(recording, viewing, rgbd_viewer.open_recording) as stream:
        rgbd_viewer.log_pair(stream, 0, pair, result, report.residuals, np.eye(4))
