"""The figures of a report as separate files: drawing as SVG and PNG, numbers as CSV."""

from __future__ import annotations

import csv
import io
import math

from labpipe.document.names import short_name
from labpipe.document.saving import canvas_of, png_bytes
from labpipe.document.svg_file import svg_file
from labpipe.report.chart import Chart, Panel, Series
from labpipe.report.document import Document, Figure
from labpipe.spreadsheet_cells import cell

COLUMNS = ("panel", "series", "x axis", "x", "y axis", "y", "low", "high", "interval")


def figure_files(document: Document) -> dict[str, bytes]:
    """name -> content: figure-01-... .svg, .png and .csv of every figure, numbered as in the report; the same for the same result."""
    figures = [block for section in document.sections for block in section.blocks if isinstance(block, Figure)]
    contents: dict[str, bytes] = {}
    for number, figure in enumerate(figures, 1):
        stem = f"figure-{number:02d}-{short_name(figure.caption)}".rstrip("-")
        contents[f"{stem}.svg"] = svg_file(figure).encode()
        contents[f"{stem}.png"] = png_bytes(canvas_of(figure.graphic))
        if isinstance(figure.graphic, Chart):
            contents[f"{stem}.csv"] = figure_csv(figure.graphic, figure.caption).encode()
    return contents


def figure_csv(chart: Chart, caption: str) -> str:
    """One row per point with the units of the axes; low and high: ends of its interval."""
    stream = io.StringIO()
    stream.write("# " + caption.replace("\n", " ") + "\n")
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(COLUMNS)
    for number, panel in enumerate(chart.panels, 1):
        for series in panel.series:
            writer.writerows(map(cell, row) for row in _rows(panel, panel.title or str(number), series))
    return stream.getvalue()


def _rows(panel: Panel, name: str, series: Series) -> list[list[str]]:
    """The rows of one series; none for an arrow, which shows a sense of rotation only."""
    if series.kind == "arrow":
        return []
    return _cell_rows(panel, name, series) if series.kind == "cells" else _point_rows(panel, name, series)


def _cell_rows(panel: Panel, name: str, series: Series) -> list[list[str]]:
    """One row per cell, named by the row and column it stands in."""
    columns, rows = ([label for _, label in axis.ticks] or [str(n) for n in range(max(series.y.shape))] for axis in (panel.x, panel.y))
    n_row, n_column = series.y.shape
    return [[name, rows[r], "", columns[c], "", _number(float(series.y[r, c])), "", "", ""] for r in range(n_row) for c in range(n_column)]


def _point_rows(panel: Panel, name: str, series: Series) -> list[list[str]]:
    return [
        [
            name,
            series.texts[0][n] if series.kind == "text" else series.name or series.kind,
            panel.x.label,
            _number(float(series.x[n])) if n < series.x.size else "",
            panel.y.label,
            _number(float(series.y[n])) if n < series.y.size else "",
            *("" if end is None else _number(float(end[n])) for end in (series.low, series.high)),
            series.interval,
        ]
        for n in range(max(series.x.size, series.y.size))
    ]


def _number(value: float) -> str:
    return f"{value:.12g}" if math.isfinite(value) else ""
