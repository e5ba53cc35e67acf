"""The style of all drawings by matplotlib, and the axes that they have in common."""

from __future__ import annotations

from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas
from matplotlib.ticker import Formatter, Locator, NullLocator

from labpipe.document.chart_layout import POINTS_PER_INCH, most_numbers
from labpipe.document.ticks import plain, ticks_of
from labpipe.report.chart import Axis, Ticks

STYLE: Any = {
    "svg.hashsalt": "labpipe",
    "svg.fonttype": "none",
    # Names from files must not become mathematical markup.
    "text.parse_math": False,
    "font.family": "sans-serif",
    "font.size": 9,
    "axes.grid": True,
    "grid.alpha": 0.35,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
}


def styled(grid: bool = True) -> Any:
    """The style of the house as a context."""
    return mpl.rc_context({**STYLE, "axes.grid": grid})


def canvas_of_size(size: tuple[float, float], measured: bool = True) -> Canvas:
    """An empty canvas of *size* [in]; *measured*: its panels are laid out by the room that their labels need."""
    return Canvas(figsize=size, layout="constrained" if measured else None)


class Numbers(Locator):
    """The numbers of an axis by the rule of all drawings, at its present ends and size."""

    def __init__(self, axes: Axes, which: str, axis: Axis) -> None:
        self._axes, self._upright, self._axis = axes, which == "y", axis

    def __call__(self) -> list[float]:
        """Where the numbers stand."""
        return [at for at, _ in self.ticks()]

    def tick_values(self, vmin: float, vmax: float) -> list[float]:
        """The same for given ends."""
        return [at for at, _ in self._between((vmin, vmax))]

    def ticks(self) -> Ticks:
        """(place, text) of every number."""
        return self._between(self._axes.get_ylim() if self._upright else self._axes.get_xlim())

    def _between(self, limits: tuple[float, float]) -> Ticks:
        box = self._axes.bbox
        length = POINTS_PER_INCH / self._axes.figure.dpi * (box.height if self._upright else box.width)
        return ticks_of(self._axis, limits, most_numbers(self._upright, length))


class NumberTexts(Formatter):
    """The texts of these numbers."""

    def __init__(self, numbers: Numbers) -> None:
        self._numbers = numbers

    def __call__(self, x: float, pos: int | None = None) -> str:
        """The text of the number at *x*, which is one of them or (in a window) a place under the pointer."""
        near = min(self._numbers.ticks(), key=lambda tick: abs(tick[0] - x), default=None)
        return near[1] if near is not None and pos is not None else plain(x)


def numbered(axes: Axes, which: str, axis: Axis) -> None:
    """Numbers along an axis, 'x' or 'y', by the rule of all drawings."""
    drawn = axes.xaxis if which == "x" else axes.yaxis
    numbers = Numbers(axes, which, axis)
    drawn.set_major_locator(numbers)
    drawn.set_major_formatter(NumberTexts(numbers))
    drawn.set_minor_locator(NullLocator())
