"""Results in the formats of others: a module for each family of formats, and all of them in FORMATS.

A format is a function of (FinishedRun, out) that yields the files it has written; those of MASKED_FORMATS
take an archive of masks too.
"""

import difflib
import functools
import importlib
from collections.abc import Callable, Iterator
from pathlib import Path

from lidarflow.errors import DataError
from lidarflow.export.finished_run import FinishedRun
from lidarflow.io import check_output

FORMATS = {
    "av2-v1": "lidarflow.export.argoverse2:write_v1",
    "av2-v2": "lidarflow.export.argoverse2:write_v2",
    "av2-v3": "lidarflow.export.argoverse2:write_v3",
    "opensceneflow": "lidarflow.export.opensceneflow:write",
    "ply": "lidarflow.export.ply:write",
    "kitti": "lidarflow.export.poses:write_kitti",
    "kitti-camera": "lidarflow.export.poses:write_kitti_camera",
    "tum": "lidarflow.export.poses:write_tum",
}
# one text file, called so in a folder; all others fill a folder
POSE_FILES = {"kitti": "poses_kitti.txt", "kitti-camera": "poses_kitti_camera.txt", "tum": "poses_tum.txt"}
MASKED_FORMATS = ("av2-v1",)                       # what may be limited to the points that a challenge counts


def export(
    run_dir: Path, name: str, out: Path | None = None, data: Path | None = None, masks: Path | None = None,
) -> Iterator[Path]:
    """Write a run in the format called `name`; yields every file once all of its kind are complete.

    out    a folder, made where there is none; for poses also a .txt file; beside the run if not given
    data   where the run's data set is now, if not where it was
    masks  for MASKED_FORMATS, the archive that says which sweeps and points to write

    Files of the same name are replaced, other files in `out` stay. Raises DataError for an unknown format, a
    run that is not finished and data that are not at hand; InstallError where a format's package is missing.
    """
    write = find(name)
    if masks is not None:
        if name not in MASKED_FORMATS:
            raise DataError(f"--masks {masks}: {name} takes none, it has every point; only "
                            f"{', '.join(MASKED_FORMATS)} does")
        write = functools.partial(write, masks=Path(masks))
    run_dir = Path(run_dir)
    out = default_out(run_dir, name) if out is None else Path(out)
    is_poses = name in POSE_FILES
    if out.exists() and run_dir.exists() and out.samefile(run_dir):
        raise DataError(f"--out {out}: is the run itself; choose another folder")
    if is_poses and not out.is_file() and (out.is_dir() or out.suffix != ".txt"):
        out = out / POSE_FILES[name]
    if is_poses and out.suffix == ".txt":
        check_output("--out", out, ".txt")
    elif out.exists() and not out.is_dir():
        also = ", or a file name ending in .txt" if is_poses else ""
        raise DataError(f"--out {out}: is a file; expected a folder{also}")
    yield from write(FinishedRun.read(run_dir, data), out)


def find(name: str) -> Callable[..., Iterator[Path]]:
    """The format called `name`; DataError, which names the nearest, where there is none."""
    if name not in FORMATS:
        close = difflib.get_close_matches(name, FORMATS, n=1, cutoff=0.4)
        hint = f" - did you mean '{close[0]}'?" if close else f"; known are {', '.join(FORMATS)}"
        raise DataError(f"unknown format '{name}'{hint}")
    module, _, function = FORMATS[name].partition(":")
    return getattr(importlib.import_module(module), function)


def default_out(run_dir: Path, name: str) -> Path:
    """Where an export goes that was given no place: beside the run, RUN_DIR-FORMAT."""
    place = run_dir.resolve()
    if place.parent == place:
        raise DataError(f"{run_dir}: is no run folder; expected a folder that 'lidarflow run' wrote")
    return run_dir.parent / f"{place.name}-{name}{'.txt' if name in POSE_FILES else ''}"
