"""Tables of RGB-D results for people; nothing here prints."""

import numpy as np
from rich import box
from rich.table import Table

from lidarflow import pose
from lidarflow.rgbd_runner import RgbdReport, RgbdRun, figures_of, mean_of
from lidarflow.rgbd_types import RgbdPair, RgbdResult
from lidarflow.runner import OUTPUT_STAGE

# name: (heading, factor, decimals)
_COLUMNS = {
    "depth_share": ("depth\n[%]", 100, 0), "moving_share": ("moving\n[%]", 100, 1),
    "photometric_before": ("photo\nbefore", 1, 4), "photometric": ("photo\nafter", 1, 4),
    "geometric_before_m": ("geom\nbefore\n[mm]", 1000, 1), "geometric_m": ("geom\nafter\n[mm]", 1000, 1),
    "drift_m": ("drift\n[mm]", 1000, 1), "drift_deg": ("drift\n[deg]", 1, 2),
    "epe_m": ("EPE\n[mm]", 1000, 1), "iou": ("IoU\n[%]", 100, 0),
}
_NEAREST_M, _FARTHEST_M = 0.25, 15.0     # medians outside are unusual indoors


def run_table(run: RgbdRun) -> Table:
    """One row per pair and their mean; columns without a value anywhere are left out."""
    rows = [figures_of(report) for report in run.reports]
    shown = [name for name in _COLUMNS if any(np.isfinite(row.get(name, np.nan)) for row in rows)]
    table = Table(box=box.SIMPLE_HEAD, padding=0, show_edge=False, pad_edge=False)
    table.add_column("frame", overflow="fold")
    for heading in [*(_COLUMNS[name][0] for name in shown), "time\n[ms]"]:
        table.add_column(heading, justify="right", no_wrap=True)
    for report, row in zip(run.reports, rows, strict=True):
        table.add_row(report.frame, *(_text(name, row.get(name)) for name in shown), _milliseconds([report]))
    mean = mean_of(run.reports)
    table.add_section()
    table.add_row("mean", *(_text(name, mean.get(name)) for name in shown), _milliseconds(run.reports))
    return table


def run_notes(run: RgbdRun) -> list[str]:
    """What the figures of `run_table` mean, and the drift over the whole run."""
    notes = ["photo, geom: root mean square of intensity (0..1) and depth left after warping",
             "time: of the method, without reading images, scores and output"]
    drift = run.drift
    if drift is not None and drift.frames:
        notes.append(f"drift: against the given poses, {drift.frames} steps: RMSE "
                     f"{1000 * drift.per_frame_m:.1f} mm, {drift.per_frame_deg:.2f} deg a frame")
        if np.isfinite(drift.per_second_m):
            notes.append(f"relative pose error: RMSE {100 * drift.per_second_m:.2f} cm/s, "
                         f"{drift.per_second_deg:.2f} deg/s")
    if run.reports[0].scores is not None:
        notes.append("EPE: mean end-point error; IoU: of the moving pixels; both against the truth")
    return notes


def pair_table(pair: RgbdPair, result: RgbdResult, report: RgbdReport) -> Table:
    """What was found between two frames."""
    x, y, z = result.odometry[:3, 3]
    turn_deg = np.degrees(np.linalg.norm(pose.log(result.odometry)[:3]))
    table = Table(box=None, show_header=False, pad_edge=False)
    table.add_column()
    table.add_column()
    given, worked, depth = pair.camera, result.camera, report.depth
    table.add_row("images", f"{given.width}x{given.height}, worked at {worked.width}x{worked.height}, "
                            f"fx {given.fx:.1f} fy {given.fy:.1f} cx {given.cx:.1f} cy {given.cy:.1f}")
    table.add_row("depth", f"{100 * depth.valid:.0f} % of the pixels, median {depth.median_m:.2f} m")
    table.add_row("moving", f"{100 * report.moving_share:.1f} % of the pixels with depth")
    table.add_row("odometry", f"translation {x:.4f} {y:.4f} {z:.4f} m, rotation {turn_deg:.2f} deg, "
                              "target_from_source")
    found = report.residuals
    stages = {"before": found.before, "by the odometry": found.by_odometry, "by the flow": found.after}
    table.add_row("photometric", ", ".join(f"{r.photometric:.4f} {name}" for name, r in stages.items()))
    metres = ", ".join(f"{r.geometric_m:.4f} {name}" for name, r in stages.items())
    table.add_row("geometric", f"{metres} [m]")
    if not _NEAREST_M < depth.median_m < _FARTHEST_M:
        table.add_row("note", "such depths are unusual for an RGB-D camera; is --depth-scale right?")
    table.add_row("seconds", ", ".join(f"{stage} {s:.3f}" for stage, s in result.seconds.items()))
    return table


def _milliseconds(reports) -> str:
    """Mean time of the method itself."""
    method_s = [sum(report.seconds.values()) - report.seconds.get(OUTPUT_STAGE, 0.0) for report in reports]
    return f"{1000 * np.mean(method_s):.0f}"


def _text(name: str, value: float | None) -> str:
    _, factor, decimals = _COLUMNS[name]
    return "-" if value is None or not np.isfinite(value) else f"{factor * value:.{decimals}f}"
