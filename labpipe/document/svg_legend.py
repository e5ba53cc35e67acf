"""The legend of a chart in SVG."""

from __future__ import annotations

import numpy as np

from labpipe.document.chart_legend import APART, GAP, LETTERS, LINE, SAMPLE, Entries, legend_size, place_inside
from labpipe.document.chart_place import Place
from labpipe.document.svg_elements import PER_POINT, path, rectangle, words
from labpipe.document.svg_series import ink, marks, stroke
from labpipe.report.chart import Panel, Series


def legend_above(entries: Entries, width: float) -> str:
    """The legend over panels of a drawing of this width [pt], in the middle."""
    if not entries:
        return ""
    columns, column_width, _ = legend_size(entries, width)
    return _drawn(entries, columns, column_width, (width - columns * column_width + APART) / 2, GAP)


def legend_inside(entries: Entries, panel: Panel, place: Place) -> str:
    """The legend within a panel."""
    return _drawn(entries, *place_inside(entries, panel, place)) if entries else ""


def _drawn(entries: Entries, columns: int, each: float, left: float, top: float) -> str:
    """Entries column by column, each a sample and its name."""
    rows = -(-len(entries) // columns)
    parts = []
    for number, ((name, colour), series) in enumerate(entries.items()):
        column, row = divmod(number, rows)
        x, y = left + column * each, top + (row + 0.5) * LINE
        sample = f'<g style="color:{ink(colour)}">{_sample(series, x, y)}</g>'
        parts.append(sample + words(name, x + SAMPLE + GAP, y + 0.36 * LETTERS, LETTERS, "start"))
    return "".join(parts)


def _sample(series: list[Series], x: float, y: float) -> str:
    """A piece of the line and one mark of an entry, or of its shade."""
    lined = next((curve for curve in series if curve.line), None)
    marked = next((curve for curve in series if curve.marker), None)
    if lined is None and marked is None:
        return rectangle(x, y - 3, SAMPLE, 6, f'class="shade" style="fill-opacity:{series[0].opacity:g}"')
    parts = []
    if lined is not None:
        left, right, down = (round(PER_POINT * value) for value in (x, x + SAMPLE, y))
        parts.append(path(f"M{left} {down}H{right}", stroke(lined.width, lined.line)))
    if marked is not None:
        parts.append(marks(marked, np.rint(PER_POINT * np.array([[x + SAMPLE / 2, y]]))))
    return "".join(parts)
