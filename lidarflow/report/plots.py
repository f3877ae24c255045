"""Plots as SVG text: grouped bars and lines over a row of labels. Text in them is escaped."""

import itertools
import math
from collections.abc import Mapping, Sequence
from xml.etree import ElementTree

import numpy as np

COLOURS = {"static": "#3b76b5", "moving": "#e0533d",
           "before": "#aaaaaa", "by ego-motion": "#3b76b5", "by the flow": "#2d9a5f"}
_WIDTH, _HEIGHT = 560.0, 270.0
_LEFT, _RIGHT, _TOP, _BOTTOM = 54.0, 12.0, 46.0, 44.0
_INNER_WIDTH, _INNER_HEIGHT = _WIDTH - _LEFT - _RIGHT, _HEIGHT - _TOP - _BOTTOM
_MOST_LABELS = 12
_TICKS = 4


def bars(title: str, labels: Sequence[str], series: Mapping[str, Sequence[float]]) -> str:
    """Bars side by side at every label; values that are not finite have none.

    Series are named in COLOURS; those without a finite value are left out.
    """
    series = _with_values(series)
    svg, top = _frame(title, labels, series)
    slot = _INNER_WIDTH / max(1, len(labels))
    width = 0.8 * slot / max(1, len(series))
    for k, (name, values) in enumerate(series.items()):
        for index, value in enumerate(values):
            if math.isfinite(value):
                left = _LEFT + slot * (index + 0.1) + k * width
                y = _y(value, top)
                _add(svg, "rect", x=left, y=y, width=width * 0.94, height=_TOP + _INNER_HEIGHT - y,
                     fill=COLOURS[name])
                text = _add(svg, "text", x=left + width / 2, y=y - 3, **{"text-anchor": "middle",
                                                                         "font-size": "9"})
                text.text = _short(value)
    return ElementTree.tostring(svg, encoding="unicode")


def lines(title: str, labels: Sequence[str], series: Mapping[str, Sequence[float]],
          top: float | None = None) -> str:
    """A line with dots for each series, broken where values are not finite; the axis ends at `top`.

    Series are named in COLOURS; those without a finite value are left out.
    """
    series = _with_values(series)
    svg, top = _frame(title, labels, series, top)
    slot = _INNER_WIDTH / max(1, len(labels))
    dot = 3.0 if len(labels) <= 60 else 1.5
    for name, values in series.items():
        places = [(_LEFT + slot * (k + 0.5), _y(value, top)) if math.isfinite(value) else None
                  for k, value in enumerate(values)]
        for run in _unbroken(places):
            _add(svg, "polyline", points=" ".join(f"{x:.1f},{y:.1f}" for x, y in run), fill="none",
                 stroke=COLOURS[name], **{"stroke-width": "2"})
            for x, y in run:
                _add(svg, "circle", cx=x, cy=y, r=dot, fill=COLOURS[name])
    return ElementTree.tostring(svg, encoding="unicode")


def _frame(title: str, labels: Sequence[str], series: Mapping[str, Sequence[float]],
           top: float | None = None) -> tuple[ElementTree.Element, float]:
    """Title, axes, labels and legend of a plot, and the value at the upper end of its axis."""
    svg = ElementTree.Element("svg", viewBox=f"0 0 {_WIDTH:g} {_HEIGHT:g}", role="img",
                              **{"font-size": "11", "aria-label": title})
    _add(svg, "text", x=0, y=14, **{"font-weight": "bold", "font-size": "13"}).text = title
    if top is None:
        shown = (value for values in series.values() for value in values if math.isfinite(value))
        top = _round_up(max(shown, default=1.0))
    for k in range(_TICKS + 1):
        value = top * k / _TICKS
        y = _y(value, top)
        _add(svg, "line", x1=_LEFT, x2=_WIDTH - _RIGHT, y1=y, y2=y, stroke="#888" if k == 0 else "#e2e2e2")
        _add(svg, "text", x=_LEFT - 6, y=y + 4, **{"text-anchor": "end"}).text = f"{value:.3g}"
    slot, every = _INNER_WIDTH / max(1, len(labels)), -(-len(labels) // _MOST_LABELS)
    for k in range(0, len(labels), max(1, every)):
        label = _add(svg, "text", x=_LEFT + slot * (k + 0.5), y=_HEIGHT - _BOTTOM + 16,
                     **{"text-anchor": "middle"})
        label.text = labels[k] if len(labels[k]) <= 18 else "…" + labels[k][-7:]
        if len(labels) > 6 and len(labels[k]) > 4:
            label.set("font-size", "9")
    left = _LEFT
    for name in series:
        _add(svg, "rect", x=left, y=24, width=10, height=10, fill=COLOURS[name])
        _add(svg, "text", x=left + 14, y=33).text = name
        left += 32 + 6.5 * len(name)
    return svg, top


def _with_values(series: Mapping[str, Sequence[float]]) -> dict[str, Sequence[float]]:
    return {name: values for name, values in series.items() if np.isfinite(values).any()}


def _y(value: float, top: float) -> float:
    return _TOP + _INNER_HEIGHT * (1.0 - min(max(value / top, 0.0), 1.0))


def _round_up(value: float) -> float:
    """The next value up that is a short number, so that the ticks of an axis are too."""
    if value <= 0:
        return 1.0
    power = 10.0 ** math.floor(math.log10(value))
    return next(step * power for step in (1.0, 2.0, 2.5, 4.0, 5.0, 8.0, 10.0) if step * power >= value)


def _unbroken(places: Sequence[tuple[float, float] | None]) -> list[list[tuple[float, float]]]:
    """The places in a row between those that are missing."""
    gaps = [-1, *(k for k, place in enumerate(places) if place is None), len(places)]
    runs = [list(places[a + 1:b]) for a, b in itertools.pairwise(gaps)]
    return [run for run in runs if run]


def _short(value: float) -> str:
    return np.format_float_positional(value, precision=2, fractional=False, trim="-")


def _add(parent: ElementTree.Element, tag: str, **attributes: float | str) -> ElementTree.Element:
    """A new element in `parent`; numbers are written with one decimal."""
    texts = {key: value if isinstance(value, str) else f"{value:.1f}" for key, value in attributes.items()}
    return ElementTree.SubElement(parent, tag, texts)
