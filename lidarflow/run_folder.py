"""The folder of a run: what may be one, and how it is made ready, found and linked to."""

import os
import re
import shutil
from pathlib import Path

from lidarflow import io
from lidarflow.errors import DataError

LATEST = "latest"
_RESULT_FILES = ("poses_kitti.txt", "poses_tum.txt", io.METRICS_FILE, io.TIMING_FILE, io.SOURCE_FILE,
                 io.OBJECTS_FILE, io.RECORDING_FILE, "preview.png")


def check(out: Path) -> None:
    """Raise DataError unless `out` is missing, empty or an earlier run: a folder that a run may fill."""
    try:
        if out.exists() and not out.is_dir():
            raise DataError(f"{out}: is a file; expected a folder for the results, choose another --out")
        names = {entry.name for entry in out.iterdir()} if out.is_dir() else set()
    except OSError as error:
        raise DataError(f"cannot write {out}: {error.strerror or error}; choose another --out") from error
    if names and not _are_a_run(names):
        some = ", ".join(sorted(names)[:3])
        raise DataError(f"{out}: holds files that are not an earlier run's ({some}); "
                        "choose a new or an empty folder as --out")
    io.check_parents("--out", out)


def is_run(folder: Path) -> bool:
    """Whether a folder holds an earlier run, finished or cut short."""
    return folder.is_dir() and _are_a_run({entry.name for entry in folder.iterdir()})


def make(out: Path) -> Path:
    """`out`, made ready for the results of a run.

    It may be missing, empty, or an earlier run, whose results are removed. Raises DataError for any
    other folder, nothing that lidarflow did not write is touched, and for the link to the latest run, which
    would be lost under another's name.
    """
    out = Path(out)
    check(out)
    if out.name == LATEST and _links_to_a_run(out):
        raise DataError(f"{out}: is a link to the run in {os.readlink(out)}; choose another --out, or go on "
                        "with that run by --resume")
    try:
        (out / io.FLOW_FOLDER).mkdir(parents=True, exist_ok=True)
        # What a run could be resumed from goes first, so that no moment leaves it with another run's files.
        shutil.rmtree(out / io.RESUME_FOLDER, ignore_errors=True)
        for old in [*(out / io.FLOW_FOLDER).glob("*.npz"), *(out / name for name in _RESULT_FILES)]:
            old.unlink(missing_ok=True)
        remove_left_overs(out)
    except OSError as error:
        raise DataError(f"cannot write {out}: {error.strerror or error}; choose another --out") from error
    return out


def remove_left_overs(out: Path) -> None:
    """Remove what a killed run left half-written in its folder `out`."""
    for folder in (out, out / io.FLOW_FOLDER, out / io.RESUME_FOLDER):
        for left in folder.glob(".*.part"):
            if _is_left_over(left.name):
                left.unlink(missing_ok=True)


def _is_left_over(name: str) -> bool:
    """Whether a file of this name is one that `written_aside` had not finished."""
    return re.fullmatch(r"\..+\.\d+\.part", name) is not None


def find_recording(what: Path) -> Path:
    """The recording of a run folder, or `what` itself where it is no folder; DataError if there is none."""
    recording = what / io.RECORDING_FILE if what.is_dir() else what
    if recording.is_file():
        return recording
    if recording == what:
        raise DataError(f"{what}: no such recording")
    if (what / io.FLOW_FOLDER).is_dir():
        raise DataError(f"{what}: a run without {io.RECORDING_FILE} (cut short, or made with --no-record); "
                        f"run it again, or view one of its files in {io.FLOW_FOLDER}")
    raise DataError(f"{what}: no {io.RECORDING_FILE}; expected a folder that 'lidarflow run' wrote")


def link_latest(run_dir: Path) -> Path | None:
    """Let `latest` beside `run_dir` link to it, and return the link.

    None, and nothing changed, where `latest` is anything else than a link to a run beside it, where the run
    is the working folder or one above it (its neighbours are none of our business), or where links cannot
    be made.
    """
    run_dir = Path(os.path.abspath(run_dir))
    link = run_dir.parent / LATEST
    if run_dir == link or (os.path.lexists(link) and not _links_to_a_run(link)):
        return None
    if run_dir.resolve() in (Path.cwd(), *Path.cwd().parents):
        return None
    aside = link.with_name(f".{LATEST}.{os.getpid()}.part")
    try:
        aside.unlink(missing_ok=True)
        aside.symlink_to(run_dir.name, target_is_directory=True)
        os.replace(aside, link)
    except OSError:
        return None
    return link


def _links_to_a_run(link: Path) -> bool:
    """Whether `link` is one that `link_latest` made: to a run beside it, or to one that is gone."""
    if not link.is_symlink() or os.sep in os.readlink(link):
        return False
    return not link.exists() or is_run(link)


def _are_a_run(names: set[str]) -> bool:
    """Whether these are the entries of an earlier run's folder."""
    names = {name for name in names if not _is_left_over(name)}
    return io.FLOW_FOLDER in names and (io.CONFIG_FILE in names or names <= {io.FLOW_FOLDER, io.SOURCE_FILE})
