"""Figures as files: CSV tables that hold every point of every series, drawings beside them."""

from __future__ import annotations

import csv
import io
from pathlib import Path

from labpipe.document.charts import figure_files
from labpipe.document.figure_numbers import COLUMNS, figure_csv
from labpipe.report.chart import Chart, Drawing
from labpipe.report.document import Document, Figure, Section


def rows_of(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(text.partition("\n")[2])))


def test_every_point_of_every_series_is_a_row(every_kind: Chart) -> None:
    text = figure_csv(every_kind, "Stiffness\nover speed")
    rows = rows_of(text)
    assert text.startswith("# Stiffness over speed\n") and tuple(rows[0]) == COLUMNS
    assert rows[0] == {
        "panel": "stiffness", "series": "k", "x axis": "speed [rpm]", "x": "1", "y axis": "k [kN/m]",
        "y": "1",
        "low": "0.5", "high": "2", "interval": "shaded",
    }  # fmt: skip
    points = sum(
        max(series.x.size, series.y.size)
        for panel in every_kind.panels
        for series in panel.series
        if series.kind != "arrow"
    )
    assert len(rows) == points and not any(row["series"] == "arrow" for row in rows)
    gap = [row["y"] for row in rows if row["series"] == "gap"]
    assert gap == ["1", "", "100"]
    assert [(row["x"], row["y"]) for row in rows if row["series"] == "limit"] == [("", "10")]
    assert [(row["x"], row["y"]) for row in rows if row["series"] == "vline"] == [("3", "")]
    assert {row["panel"] for row in rows} == {"stiffness", "2"}


def test_cells_are_named_by_row_and_column(heat_map: Chart) -> None:
    rows = rows_of(figure_csv(heat_map, "Correlation"))
    assert [(row["series"], row["x"], row["y"]) for row in rows] == [
        ("k", "k", "1"),
        ("k", "c", "0.5"),
        ("c", "k", "-0.5"),
        ("c", "c", "1"),
    ]


def test_a_chart_comes_as_svg_png_and_csv_and_a_drawing_without_numbers(
    every_kind: Chart, drawings: dict[str, Drawing]
) -> None:
    blocks = (
        Figure(every_kind, "Stiffness (over) speed: " + 60 * "x", "k"),
        Figure(drawings["film"], "The film", "film"),
    )
    files = figure_files(Document("T", "", (Section("All", blocks),)))
    assert [Path(name).suffix for name in files] == [".svg", ".png", ".csv", ".svg", ".png"]
    assert (
        next(iter(files)).startswith("figure-01-stiffness-over-speed.") and "figure-02-the-film.png" in files
    )
    assert files["figure-02-the-film.svg"].startswith(b'<?xml version="1.0" encoding="utf-8"?>\n<svg')
