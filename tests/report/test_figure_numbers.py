"""The numbers of a page are those of its charts, each list once, and no text of them can end the script they
stand in.
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from labpipe.document.figure_numbers import MOST_ROWS, RULE, figure_json, figure_table
from labpipe.report.chart import Axis, Chart, Panel, curve, stack

X = np.array([1.0, 2.0, 4.0])


def entry_of(chart: Chart) -> dict[str, Any]:
    return json.loads(figure_json(chart))


def test_every_series_has_its_numbers_and_its_look(every_kind: Chart) -> None:
    entry = entry_of(every_kind)
    numbers = entry["numbers"]
    for panel, written in zip(every_kind.panels, entry["panels"], strict=True):
        for series, part in zip(panel.series, written["series"], strict=True):
            assert [series.kind, series.name, series.line, series.marker, series.size] == [
                part[key] for key in ("kind", "name", "line", "marker", "size")
            ]
            for name in ("x", "y", "low", "high"):
                values = getattr(series, name)
                shown = (
                    [None if np.isnan(value) else value for value in values] if values is not None else None
                )
                assert (numbers[part[name]] if name in part else None) == shown
    colours = [part["colour"] for part in entry["panels"][0]["series"]]
    assert colours == [0, 1, RULE, RULE, 2]


def test_numbers_are_the_decimals_that_python_prints() -> None:
    """Over the range of doubles; python's own rounding to digits is the reference."""
    rng = np.random.default_rng(7)
    size = np.concatenate([np.linspace(-300, 300, 400), np.linspace(-25, 25, 400)])
    values = rng.choice([-1, 1], size.size) * 10.0 ** (size + rng.uniform(size=size.size))
    some = np.concatenate([values, [0.0, -0.0, 5.0, 123456789.0, np.nan, np.inf]])
    panel = Panel(Axis("t", "s", 0.0, 1.0), Axis("x", "mm", 0.0, 1.0), (curve("x", some, some),))
    shown = [float(f"{value:.7g}") if np.isfinite(value) else None for value in some.tolist()]
    assert entry_of(stack((panel,), 4.0))["numbers"][0] == shown


def test_axes_say_what_they_are_and_move_together(every_kind: Chart) -> None:
    entry = entry_of(every_kind)
    above, below = entry["panels"]
    assert above["x"] == {
        "title": "speed",
        "unit": "rpm",
        "label": "speed [rpm]",
        "limits": above["x"]["limits"],
        "log": False,
        "group": 0,
        "ticks": [],
    }
    assert (
        above["x"]["limits"] == pytest.approx(every_kind.limits(0, "x"))
        and below["x"]["group"] == 0
        and below["y"]["group"] == 1
    )
    assert above["y"]["log"] and not below["y"]["log"] and (above["share"], below["share"]) == (0.75, 0.25)
    assert (entry["rows"], entry["columns"], entry["height"], above["title"]) == (2, 1, 4.0, "stiffness")


def test_a_heat_map_has_texts_and_values(heat_map: Chart) -> None:
    (panel,) = entry_of(heat_map)["panels"]
    (cells,) = panel["series"]
    assert cells["texts"] == [["1", "half"], ["-half", "1"]] and cells["values"] == [[1, 0.5], [-0.5, 1]]
    # A scale beside it is not a series that could be hidden.
    assert (cells["name"], cells["scale"]) == ("", "correlation") and panel["x"]["ticks"] == [
        [0, "k"],
        [1, "c"],
    ]


def test_no_text_of_a_figure_ends_the_element_it_stands_in() -> None:
    text = figure_json(stack([Panel(Axis("x"), Axis("y"), (curve("</script><b>&", X, X),))], 3.0))
    assert (
        not set("<>&") & set(text) and json.loads(text)["panels"][0]["series"][0]["name"] == "</script><b>&"
    )


def test_curves_of_one_figure_share_their_abscissa_and_digits_end_where_nothing_more_is_told() -> None:
    near = curve("c", X / 3, 1000 / 3 + 1e-3 * X)
    entry = entry_of(
        stack([Panel(Axis("x"), Axis("y"), (curve("a", X, X / 3), curve("b", X, X**3), near))], 3.0)
    )
    # Five digits of what is read, seven of places, and of what differs little from a constant.
    assert len(entry["numbers"]) == 5 and entry["numbers"][1][0] == 0.33333
    assert entry["numbers"][3][0] == 0.3333333 and entry["numbers"][4][0] == 333.3343
    assert entry_of(Chart(()))["panels"] == []


def test_the_table_for_pages_without_script_has_all_points_or_says_how_many(every_kind: Chart) -> None:
    whole = figure_table(every_kind)
    assert whole.header[:4] == ("panel", "series", "x axis", "x") and whole.caption == ""
    assert [row[3:6] for row in whole.rows if row[1] == "gap"] == [
        ("1", "k [kN/m]", "1"),
        ("2", "k [kN/m]", ""),
        ("4", "k [kN/m]", "100"),
    ]
    x = np.arange(1000.0)
    long = figure_table(stack([Panel(Axis("x"), Axis("y"), (curve("a", x, x**2), curve("b", x, x)))], 3.0))
    assert len(long.rows) == MOST_ROWS and long.caption == f"{MOST_ROWS} of 2000 points"
    rows = [row for row in long.rows if row[1] == "a"]
    assert (rows[0][3], rows[-1][3], rows[-1][5]) == ("0", "999", "9.98e+05")
