"""The page, from what is known of the runs; a pure function."""

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import PurePath

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from rich.table import Table as RichTable

from lidarflow import __version__, score_tables
from lidarflow.config import Config
from lidarflow.metrics import Interval
from lidarflow.report import plots
from lidarflow.report.reading import Run, SeenObject
from lidarflow.settings import describe, to_dict
from lidarflow.tables import run_notes, run_table

_MOST_PAIR_ROWS, _MOST_OBJECT_ROWS = 60, 25
_LOW, _HIGH = -1, 1
_OF_WHOLE_GRAPH = {"t_e_m", "r_e_rad"}
# name in metrics.json: (what people call it, factor, digits, which way is better). All are means of the
# figures of pairs; "of a pair" tells them from what other tables have of the points of all pairs.
_FIGURES = {
    "epe_all_m": ("end-point error, all [m]", 1.0, 3, _LOW),
    "epe_static_m": ("end-point error, static [m]", 1.0, 3, _LOW),
    "epe_dynamic_m": ("end-point error, moving [m]", 1.0, 3, _LOW),
    "epe_dynamic_median_m": ("end-point error, moving, median [m]", 1.0, 3, _LOW),
    "dynamic_error_over_speed": ("error over speed, moving", 1.0, 3, _LOW),
    "epe_three_way_m": ("three-way error of a pair [m]", 1.0, 3, _LOW),
    "bucketed_static_m": ("bucketed error of a pair, static [m]", 1.0, 3, _LOW),
    "bucketed_dynamic": ("bucketed error of a pair, moving, of speed", 1.0, 3, _LOW),
    "dynamic_iou": ("dynamic IoU of a pair", 1.0, 3, _HIGH),
    "movers_found": ("moving points found [%]", 100.0, 2, _HIGH),
    "false_movers": ("static points called moving [%]", 100.0, 2, _LOW),
    "strict_accuracy": ("strict accuracy [%]", 100.0, 2, _HIGH),
    "relaxed_accuracy": ("relaxed accuracy [%]", 100.0, 2, _HIGH),
    "outliers": ("outliers [%]", 100.0, 2, _LOW),
    "angle_error_rad": ("angle [deg]", 180.0 / np.pi, 2, _LOW),
    "space_time_angle_error_rad": ("angle in space and time [deg]", 180.0 / np.pi, 2, _LOW),
    "t_e_m": ("t_e [m]", 1.0, 3, _LOW),
    "r_e_rad": ("r_e [rad]", 1.0, 4, _LOW),
    "ego_error_m": ("ego-motion error [m]", 1.0, 3, _LOW),
    "ego_error_deg": ("ego-motion error [deg]", 1.0, 3, _LOW),
    "crispness_before": ("crispness before any motion", 1.0, 3, 0),
    "crispness_by_ego": ("crispness by ego-motion", 1.0, 3, _HIGH),
    "crispness_after": ("crispness by the flow", 1.0, 3, _HIGH),
    "valid_share": ("points whose motion rests on evidence [%]", 100.0, 2, 0),
    "moving_points": ("points called moving", 1.0, 0, 0),
    "objects": ("moving objects", 1.0, 1, 0),
}
_TILES = {
    "epe_static_m": ("static points are off by", 100.0, "{:.1f} cm"),
    "epe_dynamic_m": ("moving points are off by", 100.0, "{:.1f} cm"),
    "movers_found": ("of the moving points found", 100.0, "{:.1f} %"),
    "false_movers": ("of the static called moving", 100.0, "{:.2f} %"),
    "objects": ("moving objects a pair", 1.0, "{:.1f}"),
    "crispness_after": ("crispness by the flow", 1.0, "{:.3f}"),
}


@dataclass(frozen=True, slots=True)
class Table:
    """Texts of a table; the first column names the rows, `marked` are (row, column) to stand out."""

    heading: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    marked: frozenset[tuple[int, int]] = frozenset()


def page_of(runs: Sequence[Run]) -> str:
    """One self-contained HTML page on the runs; the same runs give the same text."""
    environment = Environment(loader=PackageLoader("lidarflow.report"), autoescape=True, trim_blocks=True,
                              lstrip_blocks=True, undefined=StrictUndefined, keep_trailing_newline=True)
    names = names_of([run.place for run in runs])
    text = environment.get_template("page.html").render(
        version=__version__, names=names, same_data=_same_data(runs),
        comparison=comparison(runs, names) if len(runs) > 1 else None,
        sections=[_section(run, name) for run, name in zip(runs, names, strict=True)])
    # Names of folders may hold bytes that are no text.
    return text.encode("utf-8", errors="replace").decode("utf-8")


def names_of(places: Sequence[str]) -> list[str]:
    """What the runs are called: their folders' names where these differ, else the places as given."""
    names = [PurePath(place).name or place for place in places]
    return names if len(set(names)) == len(names) else list(places)


def comparison(runs: Sequence[Run], names: Sequence[str]) -> Table:
    """Means of all runs side by side; the best stand out where all are of the same points and truth."""
    lines = [("data", *(_data_text(run) for run in runs)), ("truth", *(run.truth for run in runs)),
             ("pairs", *(str(len(run.pairs)) for run in runs))]
    marked = set()
    for figure, (title, factor, digits, better) in _FIGURES.items():
        values = np.array([_mean(run, figure) for run in runs])
        if not np.isfinite(values).any():
            continue
        texts = [_number(value * factor, digits) for value in values]
        if better and _ranked(runs, figure) and len(set(texts)) > 1 and np.isfinite(values).sum() > 1:
            best = texts[int(np.nanargmax(better * values))]
            marked |= {(len(lines), k + 1) for k, text in enumerate(texts) if text == best}
        lines.append((title, *texts))
    return Table(("mean over pairs", *names), tuple(lines), frozenset(marked))


def figure_table(run: Run) -> Table:
    """Mean ± standard deviation over pairs of the figures that the run has; one pair has no deviation."""
    several = len(run.pairs) > 1
    lines = []
    for name, (title, factor, digits, _) in _FIGURES.items():
        if np.isfinite(_mean(run, name)):
            deviation = f" ± {_number(run.std.get(name, np.nan) * factor, digits)}" if several else ""
            lines.append((title, _number(run.mean[name] * factor, digits) + deviation))
    return Table(("mean ± deviation over pairs" if several else "of the only pair", ""), tuple(lines))


def _mean(run: Run, figure: str) -> float:
    """A figure's mean over pairs; NaN where it is not known, or would mislead.

    The paper's errors are of the points in the graph, so they mean little where the graph holds only what is
    near moving objects.
    """
    unfit = figure in _OF_WHOLE_GRAPH and run.config.objects.enabled
    return np.nan if unfit else run.mean.get(figure, np.nan)


def _section(run: Run, name: str) -> dict:
    """What the template shows of one run."""
    changed, kept = settings_tables(run.config)
    scored = [report.scores for report in run.pairs if report.scores is not None]
    tables = [_of_rich(score_tables.error_table(scored))] if scored else []
    if run.three_way is not None:
        tables.append(_of_rich(score_tables.three_way_table(run.three_way)))
    if run.bucketed is not None:
        tables.append(_of_rich(score_tables.class_table(run.bucketed)))
    for title, intervals in (("by range [m]", run.by_range), ("by speed [m a frame]", run.by_speed)):
        if intervals:
            tables.append(_of_rich(score_tables.interval_table(title, intervals)))
    return {
        "name": name, "place": run.place, "data": _data_text(run), "truth": run.truth,
        "scans": f"{run.source.scans[0]} to {run.source.scans[-1]}, {len(run.pairs)} pairs",
        "method": method_of(run), "note": run.note, "notes": run_notes(list(run.pairs), run.config),
        "tiles": [(text.format(run.mean[key] * factor), title)
                  for key, (title, factor, text) in _TILES.items() if np.isfinite(_mean(run, key))],
        "pictures": [(picture.frame, _data_uri(picture.motion),
                      None if picture.errors is None else _data_uri(picture.errors))
                     for picture in run.pictures],
        "plots": [Markup(svg) for svg in _plots(run)],
        "figures": figure_table(run), "tables": tables,
        "objects": object_table(run.objects),
        "objects_left_out": max(0, len(run.objects) - _MOST_OBJECT_ROWS),
        "pairs": _pair_table(run), "left_out": max(0, len(run.pairs) - _MOST_PAIR_ROWS),
        "changed": changed, "kept": kept,
    }


def object_table(objects: Sequence[SeenObject]) -> Table:
    """A row for each of the first objects."""
    lines = [(str(seen.id), str(seen.pairs), seen.first_frame, _number(seen.speed_m_per_s, 1),
              " × ".join(_number(metres, 1) for metres in seen.size_m), _number(seen.points, 0),
              _number(seen.nearest_m, 1)) for seen in objects[:_MOST_OBJECT_ROWS]]
    return Table(("object", "pairs", "first scan", "speed [m/s]", "length × width × height [m]", "points",
                  "nearest [m]"), tuple(lines))


def _pair_table(run: Run) -> Table:
    """A row for each of the first pairs, and one for the mean of all."""
    whole = _of_rich(run_table(list(run.pairs), run.config))
    return Table(whole.heading, (*whole.rows[:-1][:_MOST_PAIR_ROWS], whole.rows[-1]))


def settings_tables(config: Config) -> tuple[Table, Table]:
    """The settings that differ from the defaults, with both values, and those that do not."""
    used, default = to_dict(config), to_dict(Config())
    changed, kept = [], []
    for key, _, _, effect in describe(Config):
        section, _, name = key.partition(".")
        value, usual = used[section][name], default[section][name]
        if value == usual:
            kept.append((key, _setting(value), effect))
        else:
            changed.append((key, _setting(value), _setting(usual), effect))
    return (Table(("setting", "used", "default", "effect"), tuple(changed)),
            Table(("setting", "value", "effect"), tuple(kept)))


def method_of(run: Run) -> str:
    """The method in words, from its settings."""
    graph = ("one rigid motion per point by a factor graph, tied to moving objects and to the world"
             if run.config.objects.enabled else "one rigid motion per point by a factor graph")
    solvers = ", ".join(sorted({report.stats.solver for report in run.pairs}))
    return f"{graph} (solver: {solvers}; ego-motion: {run.config.ego.method})"


def _plots(run: Run) -> list[str]:
    """Crispness and error over time, error by range and by speed."""
    frames = [report.frame for report in run.pairs]
    crisp = [report.alignment for report in run.pairs]
    made = [plots.lines("Crispness over time", frames, {
        "before": [found.before for found in crisp], "by ego-motion": [found.by_ego for found in crisp],
        "by the flow": [found.after for found in crisp]}, top=1.0)]
    scores = [report.scores for report in run.pairs]
    if any(scores):
        made.append(plots.lines("Mean end-point error [m] over time", frames, {
            "static": [np.nan if found is None else found.static.mean for found in scores],
            "moving": [np.nan if found is None else found.dynamic.mean for found in scores]}))
    for title, intervals in (("Mean end-point error [m] by range [m]", run.by_range),
                             ("Mean end-point error [m] by speed [m a frame]", run.by_speed)):
        held = [part for part in intervals if part.all.points]
        if held:
            made.append(plots.bars(title, [_span(part) for part in held], {
                "static": [part.static.mean for part in held],
                "moving": [part.dynamic.mean for part in held]}))
    return made


def _of_rich(table: RichTable) -> Table:
    """The texts of a table for terminals."""
    heading = tuple(str(column.header).replace("\n", " ") for column in table.columns)
    rows = zip(*(map(str, column.cells) for column in table.columns), strict=True)
    return Table(heading, tuple(rows))


def _same_data(runs: Sequence[Run]) -> bool:
    return len({(run.source.dataset, run.source.scans, run.truth) for run in runs}) == 1


def _ranked(runs: Sequence[Run], figure: str) -> bool:
    """Whether a better figure is a better run; crispness is of points above the ground that a run found."""
    if figure.startswith("crispness"):
        return len({round(_mean(run, "crispness_before"), 3) for run in runs}) == 1 and _same_data(runs)
    return _same_data(runs)


def _data_text(run: Run) -> str:
    source = run.source.dataset
    if source is None:
        return "not from a data folder"
    sequence = f", sequence {source.sequence}" if source.sequence is not None else ""
    return f"{source.folder} ({source.loader}{sequence})"


def _data_uri(png: bytes) -> str:
    return "data:image/png;base64," + base64.b64encode(png).decode("ascii")


def _span(part: Interval) -> str:
    return f"≥ {part.low_m:g}" if np.isinf(part.high_m) else f"{part.low_m:g}–{part.high_m:g}"


def _setting(value: object) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if np.isfinite(value) else "-"
