"""The sketch of a rotor: shaft elements, sleeves, discs, bearings, and where it is excited and measured."""

from __future__ import annotations

from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas
from matplotlib.patches import Rectangle

from labpipe.document.matplotlib_style import canvas_of_size, styled
from labpipe.document.palette import PALETTE
from labpipe.report.rotor_figure import Ring, RotorSketch

LOOKS: dict[str, dict[str, Any]] = {
    "shaft": {"facecolor": "0.85"},
    "sleeve": {"facecolor": PALETTE[5]},
    "disc": {"facecolor": PALETTE[4]},
    "bearing": {"facecolor": PALETTE[0], "alpha": 0.55, "hatch": "///"},
}


def rotor_canvas(sketch: RotorSketch, size: tuple[float, float]) -> Canvas:
    """The sketch on a canvas of *size* [in], lengths in mm."""
    with styled(grid=False):
        canvas = canvas_of_size(size)
        axes = canvas.subplots()
        for ring in sketch.rings:
            _ring(axes, ring)
        _stations(axes, sketch)
    return canvas


def _ring(axes: Axes, ring: Ring) -> None:
    """The section of a tube: above and below its bore, or one rectangle where it has none."""
    for bottom, height in ring.boxes:
        box = Rectangle((ring.left, bottom), ring.length, height, edgecolor="0.25", linewidth=0.8, label=ring.part, **LOOKS[ring.part])
        axes.add_patch(box)


def _stations(axes: Axes, sketch: RotorSketch) -> None:
    """Bearings with their names, nodes with their numbers, force and response."""
    reach, length = sketch.reach, sketch.stations[-1]
    for name, centre in sketch.bearings:
        axes.annotate(name, (centre, -1.12 * reach), ha="center", va="top", fontsize=8)
    for number, x in enumerate(sketch.stations, 1):
        axes.plot([x], [0.0], ".", color="black", markersize=3)
        axes.annotate(str(number), (x, -1.75 * reach if number % 2 else -2.05 * reach), ha="center", va="center", fontsize=6)
    for name, x in sketch.places:
        _arrow(axes, name, x, reach)
    axes.axhline(0.0, color="0.4", linewidth=0.6, linestyle="-.")
    axes.set_ylim(-2.3 * reach, 2.1 * reach)
    axes.set_xlim(-0.03 * length, 1.03 * length)
    axes.set_xlabel("along the shaft [mm]")
    axes.set_ylabel("radius [mm]")
    handles = {str(patch.get_label()): patch for patch in axes.patches}
    axes.legend(list(handles.values()), list(handles), ncols=4, fontsize=8, loc="upper left")


def _arrow(axes: Axes, name: str, x: float, reach: float) -> None:
    """An arrow from above to the shaft with its name."""
    look = {"arrowstyle": "->", "color": PALETTE[1]}
    axes.annotate(name, (x, 1.02 * reach), (x, 1.45 * reach), ha="center", fontsize=8, color=PALETTE[1], arrowprops=look)
