"""The figures of a report as files of their own: drawing as SVG and PNG, numbers as CSV."""

from __future__ import annotations

import csv
import io
import math
import re

from labpipe.report.document import Document, Figure
from labpipe.report.drawing import png_bytes, svg_text
from labpipe.report.plotted import Panel, Plotted, Series, plotted

COLUMNS = ("panel", "series", "x axis", "x", "y axis", "y", "low", "high", "interval")
MOST_LETTERS = 48


def figure_files(document: Document) -> dict[str, bytes]:
    """name -> content: figure-01-... .svg, .png and .csv of every figure, numbered as in the report; the same for the same result."""
    figures = [block for section in document.sections for block in section.blocks if isinstance(block, Figure)]
    found: dict[str, bytes] = {}
    for number, figure in enumerate(figures, 1):
        stem = f"figure-{number:02d}-{_short(figure.caption)}".rstrip("-")
        found[f"{stem}.svg"] = ('<?xml version="1.0" encoding="utf-8"?>\n' + svg_text(figure.drawing)).encode()
        found[f"{stem}.png"] = png_bytes(figure.drawing).getvalue()
        drawn = plotted(figure.drawing)
        if drawn.complete:
            found[f"{stem}.csv"] = figure_csv(drawn, figure.caption).encode()
    return found


def _short(caption: str) -> str:
    plain = re.sub(r"[^a-z0-9]+", "-", caption.lower()).strip("-")
    return plain[:MOST_LETTERS].rpartition("-")[0] if len(plain) > MOST_LETTERS else plain


def figure_csv(drawn: Plotted, caption: str) -> str:
    """One row per point, in the units of the axes, which stand beside it; low and high are the ends of its interval."""
    stream = io.StringIO()
    stream.write("# " + caption.replace("\n", " ") + "\n")
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(COLUMNS)
    for number, panel in enumerate(drawn.panels, 1):
        for one in panel.series:
            writer.writerows(_rows(panel, panel.title or str(number), one))
    return stream.getvalue()


def _rows(panel: Panel, name: str, one: Series) -> list[list[str]]:
    if one.kind == "cells":
        columns, rows = ([label for _, label in axis.ticks] or [str(n) for n in range(max(one.y.shape))] for axis in (panel.x, panel.y))
        return [
            [name, rows[r], "", columns[c], "", _number(float(one.y[r, c])), "", "", ""]
            for r in range(one.y.shape[0])
            for c in range(one.y.shape[1])
        ]
    kept = range(max(one.x.size, one.y.size))
    between = [one.low, one.high]
    return [
        [
            name,
            one.name or one.kind,
            panel.x.label,
            _number(float(one.x[n])) if n < one.x.size else "",
            panel.y.label,
            _number(float(one.y[n])) if n < one.y.size else "",
            *("" if end is None else _number(float(end[n])) for end in between),
            one.interval,
        ]
        for n in kept
    ]


def _number(value: float) -> str:
    return f"{value:.12g}" if math.isfinite(value) else ""
