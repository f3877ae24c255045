"""What `lidarflow run` and `lidarflow demo` do and say; with cli.py and rgbd_cli.py all that prints."""

import contextlib
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from lidarflow.terminal import check_live_view, progress, show

if TYPE_CHECKING:
    from lidarflow.config import Config
    from lidarflow.datasets import Dataset
    from lidarflow.runner import Going, Viewing
    from lidarflow.stepping import Skipped


@contextlib.contextmanager
def pairs_done(pairs: int):
    """A bar on standard error; yields what to call with the name of every finished pair."""
    with progress("scan pairs", pairs) as bar:
        yield lambda frame: bar.update(0, advance=1, description=f"scan pairs, {frame} done")


def process(
    dataset: "Dataset", settings: "Config", out: Path, viewing: "Viewing", jump: int, n_scans: int | None,
    method: str = "ours", going: "Going | None" = None,
) -> None:
    """Run over a data set and say what was found."""
    from lidarflow import runner
    from lidarflow.tables import run_notes, run_table

    check_live_view(viewing.visualize)
    frames = runner.choose_frames(dataset, jump, n_scans)
    skipped: list[Skipped] = []
    going = replace(going or runner.Going(), on_skip=skipped.append)
    if going.resume and runner.is_complete(dataset, frames, settings, out, method, going):
        print(f"complete   {out}: nothing is left to do")
        return
    with pairs_done(len(frames) - 1) as on_pair:
        reports = runner.process(
            dataset, frames, settings, out, viewing, lambda report: on_pair(report.frame), method, going)
    print()
    for scan in skipped:
        print(f"skipped    scan {scan.index}: {scan.reason}")
    if skipped:
        print(f"skipped    {len(skipped)} of {len(frames)} scans; {len(reports)} pairs are left\n")
    show(run_table(reports, settings))
    print()
    for note in run_notes(reports, settings):
        print(note)
    print()
    print(f"results    {out}")
    print(f"metrics    {out / 'metrics.json'}")
    print(f"picture    {out / 'preview.png'}   (the last pair)")
    if viewing.record:
        print(f"recording  {out / 'recording.rrd'}")
        print(f"look at it with: lidarflow view {out}")
