"""The command `lidarflow export`, for cli.py."""

from pathlib import Path
from typing import Annotated

import typer

from lidarflow.terminal import working

_FORMATS = "av2-v1, av2-v2, av2-v3, opensceneflow, ply, kitti, kitti-camera, tum"


def export(
    run_dir: Annotated[Path, typer.Argument(metavar="RUN_DIR", help="A run folder.")],
    name: Annotated[str, typer.Option("--format", help=f"One of {_FORMATS}.")],
    out: Annotated[Path | None, typer.Option(
        "--out", help="Folder, for poses (kitti, kitti-camera, tum) also a .txt file; RUN_DIR-FORMAT if not "
        "given.")] = None,
    data: Annotated[Path | None, typer.Option(help="Where the run's data are now, if they moved.")] = None,
    masks: Annotated[Path | None, typer.Option(
        help="For av2-v1, the challenge's .zip of masks: write only what it counts.")] = None,
) -> None:
    """Write results in another program's format."""
    from lidarflow import export as exporting

    with working(f"{name} of {run_dir}"):
        files = list(exporting.export(run_dir, name, out, data, masks))
    print(f"results    {run_dir}")
    print(f"format     {name}")
    for file in files[:1]:
        print(f"written    {file}" + (f" and {len(files) - 1} more files" if files[1:] else ""))
