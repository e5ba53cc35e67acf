"""The style of all drawings by matplotlib, and the axes that they have in common."""

from __future__ import annotations

from typing import Any

import matplotlib as mpl
from matplotlib.axis import Axis as DrawnAxis
from matplotlib.figure import Figure as Canvas
from matplotlib.ticker import LogFormatter, NullFormatter

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
# An axis from a value to less than so many times it has numbers between the decades.
NARROW = 20.0


def styled(grid: bool = True) -> Any:
    """The style of the house as a context."""
    return mpl.rc_context({**STYLE, "axes.grid": grid})


def canvas_of_size(size: tuple[float, float], measured: bool = True) -> Canvas:
    """An empty canvas of *size* [in]; *measured*: its panels are laid out by the room that their labels need."""
    return Canvas(figsize=size, layout="constrained" if measured else None)


class PlainLog(LogFormatter):
    """Labels such as 0.01, 20 or 3e-05."""

    def _num_to_string(self, x: float, vmin: float, vmax: float) -> str:  # noqa: ARG002 (matplotlib's signature)
        return f"{x:g}"


def plain_logarithmic(axis: DrawnAxis, low: float, high: float) -> None:
    """Plain numbers on a logarithmic axis between two values."""
    axis.set_major_formatter(PlainLog())
    axis.set_minor_formatter(PlainLog(minor_thresholds=(1.5, 0.4)) if high < NARROW * low else NullFormatter())
