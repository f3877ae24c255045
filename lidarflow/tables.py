"""Tables for people, from reports; nothing here prints."""

import numpy as np
from rich import box
from rich.table import Table

from lidarflow.config import Config, describe
from lidarflow.metrics import Alignment
from lidarflow.runner import PairReport, figures_of, mean_of
from lidarflow.types import FlowResult, ScanPair

_COLUMNS = {
    "epe_static_m": "EPE [m]\nstatic", "epe_dynamic_m": "\nmoving",
    "graph_epe_static_m": "of graph\nstatic", "graph_epe_dynamic_m": "\nmoving",
    "movers_found": "movers\nfound %", "false_movers": "\nfalse %",
    "crispness_before": "crisp\nbefore", "crispness_after": "\nafter",
    "moving_points": "points\nmoving",
}
_SHARES = {"movers_found", "false_movers"}


def run_table(reports: list[PairReport], config: Config) -> Table:
    """One row per pair and their mean; columns without a value anywhere are left out."""
    rows = [figures_of(report) for report in reports]
    shown = [name for name in _COLUMNS if any(np.isfinite(row.get(name, np.nan)) for row in rows)]
    caption = _caption(reports, config)
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), caption=caption, caption_justify="left")
    table.add_column("scan", no_wrap=True, overflow="fold")
    for name in shown:
        table.add_column(_COLUMNS[name], justify="right", no_wrap=True)
    table.add_column("time\n[s]", justify="right")
    for report, row in zip(reports, rows, strict=True):
        table.add_row(report.frame, *(_text(name, row.get(name)) for name in shown),
                      f"{sum(report.seconds.values()):.1f}")
    mean = mean_of(reports)
    seconds = np.mean([sum(report.seconds.values()) for report in reports])
    table.add_section()
    table.add_row("mean", *(_text(name, mean.get(name)) for name in shown), f"{seconds:.1f}")
    return table


def _caption(reports: list[PairReport], config: Config) -> str:
    sigma = f"crispness with σ = {config.crispness.sigma_m:g} m, over the graph's own points"
    if reports[0].scores is None:
        return f"no truth found; {sigma}"
    return (f"truth: {reports[0].truth}; graph = points the factor graph solved, the others have the "
            f"ego-motion; {sigma}")


def _text(name: str, value: float | None) -> str:
    if value is None or not np.isfinite(value):
        return "-"
    if name == "moving_points":
        return f"{value:.0f}"
    return f"{100 * value:.2f}" if name in _SHARES else f"{value:.3f}"


def pair_table(pair: ScanPair, result: FlowResult, alignment: Alignment) -> Table:
    """What was found between two scans."""
    x, y, z = result.ego_motion[:3, 3]
    table = Table(box=None, show_header=False, pad_edge=False)
    table.add_column()
    table.add_column()
    graph = result.in_graph & result.valid
    table.add_row("points", f"{len(pair.source)}, {graph.sum()} of them solved by the graph, "
                            f"{result.is_dynamic.sum()} moving by themselves")
    table.add_row("ego-motion", f"target_from_source translation {x:.3f} {y:.3f} {z:.3f} m")
    table.add_row("crispness", f"{alignment.before:.3f} before, {alignment.by_ego:.3f} by ego-motion, "
                               f"{alignment.after:.3f} by the flow (σ = {alignment.sigma_m:g} m)")
    table.add_row("seconds", ", ".join(f"{stage} {s:.1f}" for stage, s in result.seconds.items()))
    return table


def config_table() -> Table:
    """Every setting with its default, range and effect."""
    table = Table("setting", "default", "allowed", "effect", box=box.SIMPLE_HEAD)
    for row in describe():
        table.add_row(*row)
    return table
