"""Mode shapes on the structure, drawn for print."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure as Canvas

from labpipe.arrays import FloatArray
from labpipe.document.charts import PALETTE, styled
from labpipe.report.shapes import REACH, VIEWS, ShapeSketch, projected

# Room about the structure for its motion.
ROOM = 1.2 * REACH


def shape_canvas(sketch: ShapeSketch, size: tuple[float, float]) -> Canvas:
    """One row of views for every mode on a canvas of *size* [in]."""
    with styled(grid=False):
        canvas = Canvas(figsize=size, layout="constrained")
        places = canvas.subplots(len(sketch.titles), len(VIEWS), squeeze=False)
        for mode, (row, title) in enumerate(zip(places, sketch.titles, strict=True)):
            for axes, (name, azimuth, elevation) in zip(row, VIEWS, strict=True):
                _view(axes, sketch, mode, (azimuth, elevation))
                if mode == len(sketch.titles) - 1:
                    axes.set_xlabel(name, fontsize=8)
            row[0].set_title(title, fontsize=9, loc="left")
    return canvas


def _view(axes: Axes, sketch: ShapeSketch, mode: int, eye: tuple[float, float]) -> None:
    there, back = sketch.extremes(mode)
    for points, colour, style in (
        (sketch.positions, "0.75", "-"),
        (back, PALETTE[0], ":"),
        (there, PALETTE[0], "-"),
    ):
        _draw(axes, sketch, projected(points, *eye), colour, style)
    half = (
        np.max([np.abs(projected(sketch.positions, *view)).max(axis=0) for _, *view in VIEWS], axis=0) + ROOM
    )
    axes.set_xlim(-half[0], half[0])
    axes.set_ylim(-half[1], half[1])
    axes.set_aspect("equal")
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_visible(False)


def _draw(axes: Axes, sketch: ShapeSketch, seen: FloatArray, colour: str, style: str) -> None:
    axes.add_collection(
        LineCollection(list(seen[sketch.lines]), colors=colour, linestyles=style, linewidths=1.2)
    )
    axes.plot(*seen.T, ".", color=colour, markersize=3)
