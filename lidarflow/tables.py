"""Tables for people, from reports; nothing here prints."""

from collections.abc import Sequence
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING

import numpy as np
from rich import box
from rich.table import Table

from lidarflow import pose, provenance, run_folder
from lidarflow.compare import Comparison
from lidarflow.config import Config
from lidarflow.metrics import Alignment
from lidarflow.pair_reports import NO_TRUTH, PairReport, figures_of, mean_of, truth_of
from lidarflow.resuming import damaged_files
from lidarflow.runner import Going, is_complete
from lidarflow.settings import describe
from lidarflow.stepping import Skipped
from lidarflow.types import FlowResult, ScanPair

if TYPE_CHECKING:
    from lidarflow.datasets import Dataset
    from lidarflow.datasets.rgbd_folders import RgbdFolder
    from lidarflow.rgbd_config import RgbdConfig

_COLUMNS = {
    "epe_static_m": "EPE\nstatic\n[m]", "epe_dynamic_m": "EPE\nmoving\n[m]",
    "graph_epe_static_m": "graph\nstatic\n[m]", "graph_epe_dynamic_m": "graph\nmoving\n[m]",
    "movers_found": "movers\nfound\n[%]", "false_movers": "false\nmovers\n[%]",
    "crispness_before": "crisp\nbefore", "crispness_after": "crisp\nafter",
    "moving_points": "moving\npoints", "objects": "moving\nobjects",
}
_COMPARED = {
    "crispness": "crisp", "epe_static_m": "EPE\nstatic\n[m]", "epe_dynamic_m": "EPE\nmoving\n[m]",
    "t_e_m": "t_e\n[m]", "r_e_rad": "r_e\n[rad]", "movers_found": "movers\nfound\n[%]",
    "false_movers": "false\nmovers\n[%]",
}
_COUNTS = {"moving_points", "objects"}
_SHARES = {"movers_found", "false_movers"}
_POOR_CRISPNESS = 0.5
_ODD_SIZE_RATIO = 2.0
_DEFAULT_CHARS = 12


def run_table(reports: list[PairReport], config: Config) -> Table:
    """One row per pair and their mean, 80 characters wide; columns without a value anywhere are left out.

    Columns of the graph are for a graph of all points; of objects, where they are looked for.
    """
    rows = [figures_of(report) for report in reports]
    columns = [name for name in _COLUMNS if name != "objects" or config.objects.enabled]
    columns = [name for name in columns if not (name.startswith("graph") and config.objects.enabled)]
    shown = [name for name in columns if any(np.isfinite(row.get(name, np.nan)) for row in rows)]
    table = Table(box=box.SIMPLE_HEAD, padding=0, show_edge=False, pad_edge=False)
    table.add_column("scan", overflow="fold")
    for name in shown:
        table.add_column(_COLUMNS[name], justify="right", no_wrap=True)
    seconds = [sum(report.seconds.values()) for report in reports]
    timed = any(seconds)     # results that were read from files are not
    if timed:
        table.add_column("time\n[s]", justify="right", no_wrap=True)
    for report, row, spent in zip(reports, rows, seconds, strict=True):
        table.add_row(report.frame, *(_text(name, row.get(name)) for name in shown),
                      *([f"{spent:.1f}"] if timed else []))
    mean = mean_of(reports)
    table.add_section()
    table.add_row("mean", *(_text(name, mean.get(name)) for name in shown),
                  *([f"{np.mean(seconds):.1f}"] if timed else []))
    return table


def run_notes(reports: list[PairReport], config: Config) -> list[str]:
    """What the figures of `run_table` mean, and which pairs look wrong."""
    notes = [f"crisp: crispness with σ = {config.crispness.sigma_m:g} m, 1 = aligned, of points above ground"]
    origins = [report.truth for report in reports]
    if set(origins) == {NO_TRUTH}:
        notes.insert(0, "truth: none found")
    else:
        graph = [] if config.objects.enabled else [
            "graph: the same of the points the graph solved; others have the ego-motion"]
        notes = [f"truth: {truth_of(origins)}", "EPE: mean end-point error of all points", *graph, *notes]
    for report in reports:
        doubt = _doubt(report.matches, report.seconds, report.alignment)
        notes += [f"{report.frame}: {doubt}"] if doubt else []
    return notes + _of_scans(reports)


def _of_scans(reports: list[PairReport]) -> list[str]:
    """What makes the scans themselves doubtful, as said of the first; no line where none are."""
    doubtful = [report for report in reports if report.doubt]
    others = f" and {len(doubtful) - 1} more of {len(reports)} scans" if doubtful[1:] else ""
    return [f"{report.frame}{others}: {report.doubt}" for report in doubtful[:1]]


def compare_table(found: Comparison) -> Table:
    """One row per method, means over pairs, 80 characters wide; columns without any value are left out."""
    rows = {run.name: run.mean() for run in found.runs}
    shown = [name for name in _COMPARED if any(name in row for row in rows.values())]
    table = Table(box=box.SIMPLE_HEAD, padding=0, show_edge=False, pad_edge=False)
    table.add_column("method", no_wrap=True)
    for name in shown:
        table.add_column(_COMPARED[name], justify="right", no_wrap=True)
    table.add_column("time\n[s]", justify="right", no_wrap=True)
    for run in found.runs:
        row = rows[run.name]
        table.add_row(run.name, *(_text(name, row.get(name)) for name in shown),
                      f"{run.median_seconds():.2f}")
    return table


def compare_notes(found: Comparison) -> list[str]:
    """What the figures of `compare_table` mean."""
    truth = truth_of(found.truth)
    notes = [f"pairs: {len(found.frames)}; means over pairs, time: median after one unmeasured pair",
             f"crisp: crispness with σ = {found.config.crispness.sigma_m:g} m, 1 = aligned, of all points "
             "above ground"]
    if truth == NO_TRUTH:
        return ["truth: none found", *notes]
    return [f"truth: {truth}", *notes, "EPE: mean end-point error of all points with a known truth",
            "t_e, r_e: error of the motion at a point, of static points above ground"]


def _doubt(matches: int | None, seconds: dict[str, float], alignment: Alignment) -> str:
    """What makes a result doubtful, "" for nothing; `seconds` say whether matches were looked for."""
    if matches == 0 and "matching" in seconds:
        return "no point found a match, so all of them have the ego-motion"
    if alignment.after < _POOR_CRISPNESS:
        return (f"crispness is only {alignment.after:.3f} after the flow; are these consecutive scans of one "
                "sensor, in metres?")
    return ""


def _text(name: str, value: float | None) -> str:
    if value is None or not np.isfinite(value):
        return "-"
    if name in _COUNTS:
        return f"{value:.0f}"
    if name in _SHARES:
        return f"{100 * value:.2f}"
    return f"{value:.4f}" if name.endswith("_rad") else f"{value:.3f}"


def pair_table(pair: ScanPair, result: FlowResult, alignment: Alignment) -> Table:
    """What was found between two scans."""
    x, y, z = result.ego_motion[:3, 3]
    turn_deg = np.degrees(np.linalg.norm(pose.log(result.ego_motion)[:3]))
    table = Table(box=None, show_header=False, pad_edge=False)
    table.add_column()
    table.add_column()
    graph = result.in_graph & result.valid
    table.add_row("points", f"{len(pair.source)}, {graph.sum()} of them solved by the graph, "
                            f"{result.is_dynamic.sum()} moving by themselves")
    for found in result.objects:
        x_m, y_m, _ = found.box_centre
        table.add_row(f"object {found.id}", f"{found.points} points at x {x_m:.1f} y {y_m:.1f} m, "
                                            f"{np.linalg.norm(found.velocity):.1f} m/s")
    table.add_row("ego-motion", f"translation {x:.3f} {y:.3f} {z:.3f} m, rotation {turn_deg:.2f} deg, "
                                "target_from_source")
    if np.isfinite(alignment.after):
        table.add_row("crispness", f"{alignment.before:.3f} before, {alignment.by_ego:.3f} by ego-motion, "
                                   f"{alignment.after:.3f} by the flow (σ = {alignment.sigma_m:g} m)")
    counts = len(pair.source), len(pair.target)
    odd_sizes = max(counts) > _ODD_SIZE_RATIO * min(counts)
    if odd_sizes:
        table.add_row("note", f"the scans have {counts[0]} and {counts[1]} points; are both of one sensor?")
    doubt = _doubt(len(result.match_source), result.seconds, alignment)
    for line in filter(None, (doubt, result.doubt)):
        table.add_row("note", line)
    table.add_row("seconds", ", ".join(f"{stage} {s:.1f}" for stage, s in result.seconds.items()))
    return table


def skipped_lines(skipped: list[Skipped], count: int, pairs: int, what: str = "scan") -> list[str]:
    """What is said of scans that were left out of `count`, with `pairs` left; nothing where none are."""
    if not skipped:
        return []
    return [*(f"skipped    {what} {left_out.index}: {left_out.reason}" for left_out in skipped),
            f"skipped    {len(skipped)} of {count} {what}s; {pairs} pairs are left\n"]


def earlier_run(
    data: "Dataset | RgbdFolder", frames: list[int], config: "Config | RgbdConfig", out: Path, method: str,
    going: Going,
) -> tuple[str | None, bool]:
    """What is said of an earlier run in `out`, None where there is none, and whether nothing is left to do.

    Raises DataError for a folder that the run may not fill, or not go on with.
    """
    if going.resume and is_complete(data, frames, config, out, method, going):
        damaged = damaged_files(out)
        return _complete_lines(out, damaged, provenance.read_any(out).skipped), not damaged
    run_folder.check(out)
    if going.resume or not run_folder.is_run(out):
        return None, False
    return f"replacing  {out}: holds an earlier run, which the results of this one replace", False


def _complete_lines(out: Path, damaged: list[str], left_out: Sequence[int]) -> str:
    """What is said of a complete run, of its files that are `damaged` by now, and of scans left out of it."""
    if damaged:
        others = f" and {len(damaged) - 1} more files are" if damaged[1:] else " is"
        return f"damaged    {out}: {damaged[0]}{others} missing or cut off; all pairs are computed anew"
    told = f"complete   {out}: nothing is left to do"
    if left_out:
        others = f" and {len(left_out) - 1} more" if left_out[1:] else ""
        told += f"\nleft out   {left_out[0]}{others}: if usable by now, run again without --resume"
    return told


def where_results_are(out: Path, is_recorded: bool) -> list[str]:
    """What a run over a sequence says at its end, a line each."""
    told = [f"results    {out}", f"metrics    {out / 'metrics.json'}",
            f"picture    {out / 'preview.png'}   (the last pair)"]
    if is_recorded:
        told += [f"recording  {out / 'recording.rrd'}", f"look at it with: lidarflow view {quote(str(out))}"]
    return told


def config_table(kind: type = Config) -> Table:
    """Every setting of a `kind` with its default, its effect and what it may be."""
    table = Table(box=box.SIMPLE_HEAD, padding=0, show_edge=False, pad_edge=False)
    for name in ("setting", "default"):
        table.add_column(name, no_wrap=True)
    table.add_column("effect (allowed values)")
    for name, default, allowed, effect in describe(kind):
        shown = default if len(default) <= _DEFAULT_CHARS else f"{float(default):.4g}"
        table.add_row(name, shown, f"{effect} ({allowed})" if allowed else effect)
    return table
