"""What a drawing shows, as numbers: its panels, their axes, and every series in them. Screens, tables and tests read this."""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure as Canvas
from matplotlib.ticker import FixedLocator
from numpy.typing import NDArray

Numbers = NDArray[np.float64]
Ticks = tuple[tuple[float, str], ...]
UNIT = re.compile(r"\s*\[([^\]]*)\]\s*$")


@dataclass(frozen=True, eq=False)
class Series:
    """One thing drawn. *kind*: 'line' (points, joined or not), 'area' (a closed outline), 'hline', 'vline', 'hspan', 'vspan', 'cells'.

    x, y: (n,) in the axes' units, NaN where nothing is drawn; low, high: (n,) ends of an interval around y, drawn as *interval*
    ('shaded' or 'bar'). cells: y is (n_row, n_column), *texts* what stands in each. *line*: matplotlib's style, '' without a line.
    """

    kind: str
    name: str
    x: Numbers
    y: Numbers
    colour: str
    low: Numbers | None = None
    high: Numbers | None = None
    interval: str = ""
    line: str = ""
    marker: str = ""
    size: float = 0.0
    width: float = 1.0
    opacity: float = 1.0
    labelled: bool = False
    hollow: bool = False
    texts: tuple[tuple[str, ...], ...] = ()
    fills: tuple[tuple[str, ...], ...] = ()


@dataclass(frozen=True)
class PlottedAxis:
    """An axis: *title* without its *unit*, the *limits* shown, *ticks* where they are names; axes of one *group* move together."""

    title: str
    unit: str
    limits: tuple[float, float]
    logarithmic: bool
    group: int
    ticks: Ticks = ()

    @property
    def label(self) -> str:
        """Title and unit as the drawing has them."""
        return f"{self.title} [{self.unit}]" if self.unit else self.title


@dataclass(frozen=True)
class Panel:
    """One pair of axes at (row, column) of the drawing, *share* of its height; *equal*: both axes have one scale."""

    title: str
    x: PlottedAxis
    y: PlottedAxis
    series: tuple[Series, ...]
    row: int = 0
    column: int = 0
    share: float = 1.0
    equal: bool = False


@dataclass(frozen=True)
class Plotted:
    """All panels of a drawing; not *complete* where it holds something that is not numbers over axes (a drawn rotor, a contour)."""

    panels: tuple[Panel, ...]
    complete: bool
    rows: int = 1
    columns: int = 1
    size: tuple[float, float] = (7.2, 3.2)
    names: tuple[str, ...] = field(default=())


def plotted(canvas: Canvas) -> Plotted:
    """Read a drawing back into numbers."""
    from labpipe.report.plotted_artists import series_of

    shown = [axes for axes in canvas.axes if axes.get_visible() and axes.get_label() != "<colorbar>"]
    panels, complete = [], bool(shown)
    for axes in shown:
        series, understood = series_of(axes)
        complete = complete and understood and not _is_twin(axes, shown)
        panels.append(_panel(canvas, axes, series, shown))
    rows, columns = _grid(shown[0]) if shown else (1, 1)
    named = _named(panels)
    names = tuple(dict.fromkeys(one.name for panel in named for one in panel.series if one.name))
    width, height = canvas.get_size_inches()
    return Plotted(tuple(named), complete, rows, columns, (float(width), float(height)), names)


def _is_twin(axes: Axes, shown: list[Axes]) -> bool:
    place = axes.get_subplotspec()
    return any(other is not axes and place is not None and other.get_subplotspec() == place for other in shown)


def _grid(axes: Axes) -> tuple[int, int]:
    place = axes.get_subplotspec()
    return (1, 1) if place is None else place.get_gridspec().get_geometry()


def _panel(canvas: Canvas, axes: Axes, series: list[Series], shown: list[Axes]) -> Panel:
    place = axes.get_subplotspec()
    row, column = (0, 0) if place is None else (place.rowspan.start, place.colspan.start)
    ratios = None if place is None else place.get_gridspec().get_height_ratios()
    share = 1.0 if not ratios else float(ratios[row]) / float(sum(ratios))
    x = _axis(axes, "x", _label(canvas, axes, "x", shown), shown)
    y = _axis(axes, "y", _label(canvas, axes, "y", shown), shown)
    return Panel(axes.get_title(), x, y, tuple(series), row, column, share, axes.get_aspect() != "auto" and not axes.images)


def _siblings(axes: Axes, which: str, shown: list[Axes]) -> list[Axes]:
    group = axes.get_shared_x_axes() if which == "x" else axes.get_shared_y_axes()
    return [other for other in shown if other is axes or group.joined(axes, other)]


def _label(canvas: Canvas, axes: Axes, which: str, shown: list[Axes]) -> str:
    """The label of an axis: its own, of the axes it is shared with, or of the whole drawing."""

    def own(one: Axes) -> str:
        return str(one.get_xlabel() if which == "x" else one.get_ylabel())

    whole = canvas.get_supxlabel() if which == "x" else canvas.get_supylabel()
    others = [own(other) for other in _siblings(axes, which, shown)] if which == "x" else []
    return own(axes) or next((text for text in others if text), "") or whole


def _axis(axes: Axes, which: str, label: str, shown: list[Axes]) -> PlottedAxis:
    low, high = axes.get_xlim() if which == "x" else axes.get_ylim()
    axis: Axis = axes.xaxis if which == "x" else axes.yaxis
    unit = UNIT.search(label)
    title = UNIT.sub("", label).replace("\n", " ")
    group = shown.index(_siblings(axes, which, shown)[0])
    return PlottedAxis(title, unit[1] if unit else "", (float(low), float(high)), axis.get_scale() == "log", group, _named_ticks(axis))


def _named_ticks(axis: Axis) -> Ticks:
    locator = axis.get_major_locator()
    if not isinstance(locator, FixedLocator):
        return ()
    formatter = axis.get_major_formatter()
    return tuple((float(place), str(formatter(place, number))) for number, place in enumerate(locator.locs))


def _named(panels: list[Panel]) -> list[Panel]:
    """Series without a label take that of one drawn alike in another panel, else what the axis says."""
    known: dict[tuple[str, ...], str] = {}
    for one in (one for panel in panels for one in panel.series if one.labelled):
        known.setdefault((one.colour, one.line, one.marker), one.name)
        known.setdefault((one.colour,), re.sub(r" (measured|fitted)$", "", one.name))
    return [replace(panel, series=tuple(_with_name(one, panel, known) for one in panel.series)) for panel in panels]


def _with_name(one: Series, panel: Panel, known: dict[tuple[str, ...], str]) -> Series:
    if one.name or one.kind not in ("line", "area"):
        return one
    plain = [other for other in panel.series if other.kind == "line" and not other.name]
    alone = panel.title or panel.y.title
    number = f" {plain.index(one) + 1}" if len(plain) > 1 and one in plain else ""
    name = known.get((one.colour, one.line, one.marker)) or known.get((one.colour,)) or f"{alone}{number}"
    return replace(one, name=name)
