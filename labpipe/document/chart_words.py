"""Which words stand at the axes of a chart, and how: the rules that all its drawings follow."""

from __future__ import annotations

from dataclasses import dataclass

from labpipe.report.chart import Chart

# Letters that fit into an inch of an ordinate.
LETTERS_UPWARDS = 13
# Names of places with more letters than this to the inch of the whole figure are turned.
MOST_LEVEL = 9
UPRIGHT, SLANTED = 90.0, 25.0


@dataclass(frozen=True)
class AxisTitles:
    """*below* and *beside* every panel its titles, '' for none; *common_x*, *common_y*: a title that is written once for all panels."""

    below: tuple[str, ...]
    beside: tuple[str, ...]
    common_x: str = ""
    common_y: str = ""


def axis_titles(chart: Chart) -> AxisTitles:
    """Along a shared abscissa the lowest panel has the title; one that is common to all panels of a grid is written once."""
    across, upwards = ([getattr(panel, which).label for panel in chart.panels] for which in ("x", "y"))
    wide = chart.columns > 1
    once_x = wide and chart.rows > 1 and len(set(across)) == 1
    once_y = wide and len(set(upwards)) == 1
    below = ["" if once_x or not is_lowest(chart, number) else label for number, label in enumerate(across)]
    beside = ["" if once_y else _wrapped(label, chart, number) for number, label in enumerate(upwards)]
    return AxisTitles(tuple(below), tuple(beside), across[0] if once_x else "", upwards[0] if once_y else "")


def is_lowest(chart: Chart, number: int) -> bool:
    """Whether the abscissa of a panel has its numbers: it moves alone, or no panel of the chart stands below."""
    return "x" not in chart.shared or number + chart.columns >= len(chart.panels)


def is_leftmost(chart: Chart, number: int) -> bool:
    """Whether the ordinate of a panel has its numbers: it moves alone, or no panel stands to its left."""
    return "y" not in chart.shared or number % chart.columns == 0


def turn_of_names(chart: Chart, number: int) -> float:
    """By how much the names of places along the abscissa of a panel are turned, so that they fit [deg]."""
    panel = chart.panels[number]
    if sum(len(name) + 1 for _, name in panel.x.ticks) <= MOST_LEVEL * chart.size[0]:
        return 0.0
    return UPRIGHT if any(series.kind == "cells" for series in panel.series) else SLANTED


def _wrapped(label: str, chart: Chart, number: int) -> str:
    """A title of an ordinate that is longer than its panel is high has its unit on a second line."""
    room = LETTERS_UPWARDS * chart.size[1] * chart.heights[number // chart.columns]
    return label.replace(" [", "\n[") if len(label) > room else label
