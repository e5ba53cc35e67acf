"""Coefficients as surfaces over load and speed."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas
from mpl_toolkits.mplot3d import Axes3D

from labpipe.document.charts import style
from labpipe.methods.run_ups.figures import CoefficientSurfaces


def surface_canvas(surfaces: CoefficientSurfaces, size: tuple[float, float]) -> Canvas:
    """Four surfaces side by side on a canvas of *size* [in]."""
    with style():
        canvas = Canvas(figsize=size)
        for place, title in enumerate(surfaces.titles):
            axes = canvas.add_subplot(2, 2, place + 1, projection=Axes3D.name)
            _surface(axes, surfaces, place, title)
        canvas.subplots_adjust(left=0.02, right=0.95, bottom=0.05, top=0.95, wspace=0.12, hspace=0.16)
    return canvas


def _surface(axes: Axes, surfaces: CoefficientSurfaces, place: int, title: str) -> None:
    speed, load = np.meshgrid(surfaces.speed, surfaces.load)
    look = {"cmap": "viridis", "edgecolor": "0.3", "linewidth": 0.25}
    axes.plot_surface(speed, load, surfaces.values[place], **look)  # type: ignore[attr-defined]
    axes.set_xlabel("speed [rpm]", fontsize=8)
    axes.set_ylabel("load [N]", fontsize=8)
    axes.set_title(title, fontsize=9)
    axes.tick_params(labelsize=7, pad=1)
    axes.view_init(elev=24, azim=-125)  # type: ignore[attr-defined]
