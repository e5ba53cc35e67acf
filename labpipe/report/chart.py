"""Figures as numbers: panels of series over axes. Pages, prints, tables and tests read the same numbers.

Nothing here draws.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from labpipe.arrays import FloatArray

Ends = tuple[ArrayLike, ArrayLike]
Ticks = tuple[tuple[float, str], ...]

KINDS = ("line", "area", "hline", "vline", "hspan", "cells", "arrow", "text")
# Numbers of the palette for series; INK is that of the text, GREY that of reference values.
PALETTE_SIZE, INK, GREY = 7, 6, -1
LINES = ("-", "--", ":")
# Width of a figure [in]: that of a page's text.
WIDTH = 7.2
# Room beyond the outermost values, as part of their range.
MARGIN = 0.05


@dataclass(frozen=True, eq=False)
class Series:
    """One entry of a panel. *kind*: 'line' (points, joined or not), 'area' (a closed outline), 'hline',
    'vline', 'hspan', 'cells' (a matrix of values between -1 and 1 with a text in each), 'arrow'
    (from the first point to the second) or 'text' (words at points).

    x, y: (n,) [units of the axes], NaN where nothing is shown; of a line or span across the panel one of them
    is empty. cells: y is (n_row, n_column), texts the same; of 'text' texts is one row (n,), size that of its
    letters [pt]. low, high: (n,) ends of an interval around y, shown as *interval* ('shaded' or 'bar'). line:
    '-', '--', ':' or '-.', '' for none; marker: '.', 'o', 's' or 'v', '' for none; size, width: diameter and
    line [pt]. entry: the name in the legend, where it is not *name*: series of one entry share it.
    """

    kind: str
    name: str
    _: KW_ONLY
    x: FloatArray
    y: FloatArray
    colour: int = 0
    low: FloatArray | None = None
    high: FloatArray | None = None
    interval: str = ""
    line: str = ""
    marker: str = ""
    size: float = 0.0
    width: float = 1.0
    opacity: float = 1.0
    hollow: bool = False
    texts: tuple[tuple[str, ...], ...] = ()
    entry: str = ""

    @property
    def listed(self) -> str:
        """The name in the legend, '' for none."""
        return self.entry or self.name

    def __post_init__(self) -> None:
        for name in ("x", "y", "low", "high"):
            values = getattr(self, name)
            if values is not None:
                plain = np.array(values, np.float64)
                plain.setflags(write=False)
                object.__setattr__(self, name, plain)
        if self.kind not in KINDS:
            raise ValueError(f"no series of kind '{self.kind}'")
        if self.kind in ("line", "area", "arrow", "text") and self.x.shape != self.y.shape:
            raise ValueError(f"series '{self.name}': {self.x.shape} over {self.y.shape}")
        if (self.low is None) != (self.high is None) or any(
            end is not None and end.shape != self.y.shape for end in (self.low, self.high)
        ):
            raise ValueError(f"series '{self.name}': both ends of its interval must be as long as its values")


def _series(kind: str, name: str, x: ArrayLike, y: ArrayLike, **look: Any) -> Series:
    return Series(kind, name, x=np.asarray(x, float), y=np.asarray(y, float), **look)


def curve(
    name: str,
    x: ArrayLike,
    y: ArrayLike,
    colour: int = 0,
    line: str = "-",
    *,
    marker: str = "",
    size: float = 3.0,
    band: Ends | None = None,
    bars: Ends | None = None,
    opacity: float = 0.15,
    **look: Any,
) -> Series:
    """Points (n,) joined by a *line*; *band* and *bars*: the two ends (n,) of an interval, shaded (with
    *opacity*) or as bars. *look*: width, hollow and entry of a series.
    """
    low, high = band or bars or (None, None)
    look |= {"low": low, "high": high, "interval": "shaded" if band else "bar" if bars else ""}
    look |= {"line": line, "marker": marker, "size": size if marker else 0.0, "opacity": opacity}
    return _series("line", name, x, y, colour=colour, **look)


def dots(name: str, x: ArrayLike, y: ArrayLike, colour: int = 0, *, marker: str = ".", **look: Any) -> Series:
    """Points (n,) that are not joined; *look* as of a curve."""
    return curve(name, x, y, colour, "", marker=marker, **look)


def level(y: float, colour: int = GREY, line: str = "-", *, width: float = 0.8, name: str = "") -> Series:
    """A line across the panel at *y*; its name, if any, is written at its end."""
    return _series("hline", name, (), [y], colour=colour, line=line, width=width)


# The lines of a control chart, in words.
CONTROL = "full line: mean, dashed: control limits"


def control_lines(centre: float, low: float, high: float) -> tuple[Series, ...]:
    """Centre and limits of a control chart."""
    return (level(centre, width=0.9), *(level(end, 1, "--", width=1.0) for end in (low, high)))


def upright(x: float, colour: int = GREY, line: str = "-", *, width: float = 0.8) -> Series:
    """A line from the foot of the panel to its head at *x*."""
    return _series("vline", "", [x], (), colour=colour, line=line, width=width)


def span(low: float, high: float, colour: int, opacity: float = 0.15) -> Series:
    """A shade across the panel between two values."""
    return _series("hspan", "", (), [low, high], colour=colour, opacity=opacity)


def outline(
    name: str, x: ArrayLike, y: ArrayLike, colour: int = 0, opacity: float = 0.15, *, width: float = 0.0
) -> Series:
    """The shaded inside of a closed path (n,), which itself is drawn in grey where it has a *width* [pt]."""
    return _series("area", name, x, y, colour=colour, opacity=opacity, width=width)


def cells(values: ArrayLike, texts: Sequence[Sequence[str]], name: str = "") -> Series:
    """A matrix (n_row, n_column) of values between -1 and 1, which *name* says, as colours with a text in
    each; row 0 is above.
    """
    n_column = np.shape(values)[1]
    return _series("cells", name, range(n_column), values, colour=INK, texts=tuple(map(tuple, texts)))


def arrow(tail: ArrayLike, head: ArrayLike, colour: int) -> Series:
    """An arrow from one point (2,) to another, for the sense of a motion."""
    return _series("arrow", "", *np.transpose([tail, head]), colour=colour)


def labels(
    x: ArrayLike, y: ArrayLike, texts: Sequence[str], colour: int = INK, *, size: float = 8.0
) -> Series:
    """Words (n,) in letters of *size* [pt] with their middle at points (n,)."""
    return _series("text", "", x, y, colour=colour, size=size, texts=(tuple(texts),))


def look(number: int) -> tuple[int, str]:
    """Colour and line of a curve by its number: where colours begin anew the lines are dashed."""
    return number % PALETTE_SIZE, LINES[number // PALETTE_SIZE % len(LINES)]


@dataclass(frozen=True)
class Axis:
    """An axis with its *title* and *unit*; *low*, *high*: ends that do not follow from the series.

    *ticks* where places have names.
    """

    title: str = ""
    unit: str = ""
    low: float | None = None
    high: float | None = None
    logarithmic: bool = False
    ticks: Ticks = ()

    @property
    def label(self) -> str:
        """Title and unit as people read them."""
        return f"{self.title} [{self.unit}]" if self.unit else self.title


def named_ticks(names: Sequence[str], first: float = 0.0) -> Ticks:
    """Names at whole numbers from *first* on."""
    return tuple((first + number, name) for number, name in enumerate(names))


@dataclass(frozen=True)
class Panel:
    """One pair of axes; *equal*: both have one scale; *share* of the height among the rows.

    pick: key of a pipeline for which values of x can be chosen on a page with a click, '' for none.
    """

    x: Axis
    y: Axis
    series: tuple[Series, ...]
    title: str = ""
    equal: bool = False
    share: float = 1.0
    pick: str = ""


@dataclass(frozen=True)
class Chart:
    """Panels row by row in a grid of *rows* and *columns*; *size* (width, height) [in]; *shared*: the axes
    that move together, 'x' or 'xy'.

    legend: 'panels' (the names that are new in each panel), 'above' (all of them above the panels) or 'none'.
    """

    panels: tuple[Panel, ...]
    rows: int = 1
    columns: int = 1
    size: tuple[float, float] = (WIDTH, 3.2)
    shared: str = ""
    legend: str = "panels"

    def __post_init__(self) -> None:
        if len(self.panels) > self.rows * self.columns:
            raise ValueError(f"{len(self.panels)} panels in {self.rows} x {self.columns}")

    @property
    def names(self) -> tuple[str, ...]:
        """The names of all series, each once."""
        names = (series.name for panel in self.panels for series in panel.series)
        return tuple(dict.fromkeys(name for name in names if name))

    @property
    def heights(self) -> tuple[float, ...]:
        """(n_row,) height of every row as part of the whole."""
        shares = [self.panels[row * self.columns].share for row in range(self.rows)]
        return tuple(share / sum(shares) for share in shares)

    def group(self, number: int, which: str) -> int:
        """The panel whose axis *which* ('x' or 'y') the panel of this number moves with, or its own."""
        return 0 if which in self.shared else number

    def limits(self, number: int, which: str) -> tuple[float, float]:
        """Both ends of an axis: as stated, else from all series of the panels that it moves with."""
        panels = self.panels if which in self.shared else (self.panels[number],)
        axis = getattr(self.panels[number], which)
        drawn = [series for panel in panels for series in panel.series]
        for series in drawn:
            if series.kind == "cells":
                # The outer edges of a matrix, its first row above.
                rows, columns = series.y.shape
                return (-0.5, columns - 0.5) if which == "x" else (rows - 0.5, -0.5)
        values = np.concatenate([np.empty(0), *(part for series in drawn for part in _extent(series, which))])
        low, high = _with_margin(values, axis.logarithmic)
        return low if axis.low is None else axis.low, high if axis.high is None else axis.high


def stack(panels: Sequence[Panel], height: float, legend: str = "panels") -> Chart:
    """Panels below each other over one abscissa, *height* [in] in all."""
    return Chart(tuple(panels), len(panels), 1, (WIDTH, height), "x" if len(panels) > 1 else "", legend)


@dataclass(frozen=True, eq=False)
class Drawing:
    """A drawing without axes: *kind* selects the drawing function in the tables of `document`, *subject* is
    its data.

    size: (width, height) [in].
    """

    kind: str
    subject: Any
    size: tuple[float, float]


Graphic = Chart | Drawing


def _extent(series: Series, which: str) -> list[FloatArray]:
    parts = [series.x] if which == "x" else [series.y, series.low, series.high]
    return [part.reshape(-1) for part in parts if part is not None]


def _with_margin(values: FloatArray, logarithmic: bool) -> tuple[float, float]:
    """Least and largest of the values with some room beyond; 0 to 1 (1 to 10) where there is none."""
    there = values[np.isfinite(values) & ((values > 0) | (not logarithmic))]
    if not there.size:
        return (1.0, 10.0) if logarithmic else (0.0, 1.0)
    least, most = float(there.min()), float(there.max())
    if logarithmic and most > least:
        low, high = _with_margin(np.log10([least, most]), False)
        return float(10**low), float(10**high)
    if logarithmic:
        return least / 10, 10 * least
    room = MARGIN * (most - least) or MARGIN * abs(least) or MARGIN
    return least - room, most + room
