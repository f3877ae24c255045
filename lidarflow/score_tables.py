"""Tables of scores for people, 80 characters wide; nothing here prints."""

from collections.abc import Sequence

import numpy as np
from rich import box
from rich.table import Table

from lidarflow import pair_reports
from lidarflow.evaluation import Evaluation
from lidarflow.metrics import (
    Accuracy,
    Bucketed,
    ErrorSummary,
    Interval,
    Pooled,
    Scores,
    ThreeWay,
    over_frames,
)

_PER_CENT, _DEGREES = 100.0, 180.0 / np.pi


def tables_of(done: Evaluation) -> list[Table]:
    """Every table that an evaluation fills."""
    scores = [report.scores for report in done.reports]
    whole = pair_reports.pooled(done.reports)
    return [error_table(scores), *([] if whole is None else _pooled_tables(whole)),
            frame_table(scores, all_points=not done.config.objects.enabled)]


def _pooled_tables(whole: Pooled) -> list[Table]:
    """The tables over the points of all pairs."""
    by_class = [] if whole.bucketed is None else [class_table(whole.bucketed)]
    return [three_way_table(whole.three_way), *by_class, interval_table("by range [m]", whole.by_range),
            interval_table("by speed [m a frame]", whole.by_speed)]


def error_table(scores: Sequence[Scores]) -> Table:
    """Errors of total flow of all, static and moving points; means over pairs."""
    table = _table("mean over pairs", "all", "static", "moving")

    def row(title: str, of_pair, factor: float = 1.0, digits: int = 3) -> None:
        values = [over_frames(of_pair(pair)[kind] for pair in scores)[0] * factor for kind in range(3)]
        table.add_row(title, *(_number(value, digits) for value in values))

    def summary(pair: Scores) -> tuple[ErrorSummary, ...]:
        return pair.all, pair.static, pair.dynamic

    def accuracy(pair: Scores) -> tuple[Accuracy, ...]:
        return pair.accuracy_all, pair.accuracy_static, pair.accuracy_dynamic

    row("points", lambda pair: [part.points for part in summary(pair)], digits=0)
    row("end-point error, mean [m]", lambda pair: [part.mean for part in summary(pair)])
    row("end-point error, median [m]", lambda pair: [part.median for part in summary(pair)])
    row("over speed", lambda pair: (np.nan, np.nan, pair.dynamic_error_over_speed))
    row("strict accuracy, 0.05 m or 5 % [%]", lambda pair: [part.strict for part in accuracy(pair)],
        _PER_CENT, 2)
    row("relaxed accuracy, 0.1 m or 10 % [%]", lambda pair: [part.relaxed for part in accuracy(pair)],
        _PER_CENT, 2)
    row("outliers, 0.3 m or 10 % [%]", lambda pair: [part.outliers for part in accuracy(pair)], _PER_CENT, 2)
    row("angle [deg]", lambda pair: [part.angle_rad for part in accuracy(pair)], _DEGREES, 2)
    row("angle in space and time [deg]", lambda pair: [part.space_time_angle_rad for part in accuracy(pair)],
        _DEGREES, 2)
    row("called moving [%]", lambda pair: (np.nan, pair.false_movers, pair.movers_found), _PER_CENT, 2)
    return table


def three_way_table(found: ThreeWay) -> Table:
    """Three-way error and dynamic IoU."""
    table = _table("three-way error, points of all pairs, |x|, |y| ≤ 50 m", "points", "[m]")
    for title, part in (("foreground dynamic", found.foreground_dynamic),
                        ("foreground static", found.foreground_static),
                        ("background static", found.background_static)):
        table.add_row(title, str(part.points), _number(part.mean))
    table.add_section()
    table.add_row("mean of the three", "", _number(found.mean_m))
    table.add_row("dynamic IoU", "", _number(found.dynamic_iou))
    return table


def class_table(found: Bucketed) -> Table:
    """Bucketed errors of the classes that occur."""
    table = _table("bucketed error, points of all pairs, |x|, |y| < 35 m", "static [m]", "moving, of speed")
    for name, errors in found.classes.items():
        if not (np.isnan(errors.static_m) and np.isnan(errors.dynamic)):
            table.add_row(name.lower().replace("_", " "), _number(errors.static_m), _number(errors.dynamic))
    table.add_section()
    table.add_row("mean over classes", _number(found.mean.static_m), _number(found.mean.dynamic))
    return table


def interval_table(title: str, intervals: Sequence[Interval]) -> Table:
    """Errors over the intervals that have points; `title` says of what they are."""
    table = _table(title, "points", "all [m]", "static [m]", "moving [m]")
    for part in intervals:
        if part.all.points:
            values = (part.all.mean, part.static.mean, part.dynamic.mean)
            table.add_row(_span(part), str(part.all.points), *map(_number, values))
    return table


def frame_table(scores: Sequence[Scores], all_points: bool) -> Table:
    """Mean ± standard deviation over pairs; the paper's errors where the graph held `all_points`."""
    table = _table("mean ± deviation over pairs", "")
    lines = [("ego-motion [m]", [pair.ego_error_m for pair in scores], 1.0, 3),
             ("ego-motion [deg]", [pair.ego_error_rad for pair in scores], _DEGREES, 3)]
    if all_points:
        lines += [("t_e [m]", [pair.t_e for pair in scores], 1.0, 3),
                  ("r_e [rad]", [pair.r_e_rad for pair in scores], 1.0, 3)]
    for title, values, factor, digits in lines:
        mean, deviation = over_frames(values)
        table.add_row(title, f"{_number(mean * factor, digits)} ± {_number(deviation * factor, digits)}")
    return table


def _table(first: str, *others: str) -> Table:
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1), show_edge=False, pad_edge=False)
    table.add_column(first, no_wrap=True)
    for name in others:
        table.add_column(name, justify="right", no_wrap=True)
    return table


def _span(part: Interval) -> str:
    return f"{part.low_m:g} and more" if np.isinf(part.high_m) else f"{part.low_m:g} to {part.high_m:g}"


def _number(value: float, digits: int = 3) -> str:
    return f"{value:.{digits}f}" if np.isfinite(value) else "-"
