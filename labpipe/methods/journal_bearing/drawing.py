"""The oil film as a drawing: its pressure unrolled, and over it the thickness."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas
from matplotlib.ticker import MaxNLocator

from labpipe.arrays import FloatArray, IntArray
from labpipe.bearings.kinds import PressureField
from labpipe.document.charts import PALETTE, style

BAR, MM, UM = 1e-5, 1e3, 1e6
N_CONTOUR = 14
# In the cavitated film the pressure is constant except for rounding; contours must not leave it blank.
TORN = 1e-6
BOTTOM = 270.0


def film_canvas(film: PressureField, size: tuple[float, float]) -> Canvas:
    """Pressure over angle and width; below, pressure at mid width and the film's thickness. *size* [in]."""
    order = np.argsort(np.mod(film.theta, 2 * np.pi))
    angle, pressure = np.degrees(np.mod(film.theta[order], 2 * np.pi)), BAR * film.pressure[order]
    with style(grid=False):
        canvas = Canvas(figsize=size, layout="constrained")
        field, middle = canvas.subplots(2, 1, sharex=True, height_ratios=(3, 2))
        filled = field.contourf(angle, MM * film.axial, pressure.T, contour_levels(pressure), cmap="cividis")
        canvas.colorbar(filled, ax=field, shrink=0.9, ticks=MaxNLocator(7), format="%g").set_label(
            "pressure [bar]"
        )
        field.set_ylabel("from mid width [mm]")
        _mid_width(middle, film, angle, pressure, order)
        for axes in (field, middle):
            axes.axvline(BOTTOM, color="0.5", linewidth=0.8, linestyle=":")
        middle.set_xlabel("angle from +y to +z, with the spin [deg]; dotted: the bottom")
        middle.set_xlim(0, 360)
        middle.set_xticks(range(0, 361, 45))
    return canvas


def _mid_width(
    axes: Axes, film: PressureField, angle: FloatArray, pressure: FloatArray, order: IntArray
) -> None:
    nearest = np.isclose(np.abs(film.axial), np.abs(film.axial).min(), atol=1e-12)
    axes.plot(angle, pressure[:, nearest].mean(axis=1), color=PALETTE[0])
    axes.set_ylabel("pressure at mid width [bar]", color=PALETTE[0])
    beside = axes.twinx()
    beside.plot(angle, UM * film.thickness[order], "--", color=PALETTE[1])
    beside.set_ylabel("film thickness [um]", color=PALETTE[1])
    beside.set_ylim(bottom=0)


def contour_levels(pressure: FloatArray) -> FloatArray:
    """Rising round levels (n_level,) around *pressure* (n_theta, n_axial) [unit of the pressure]."""
    margin = TORN * (float(np.ptp(pressure)) or 1.0)
    low, high = float(pressure.min()) + margin, float(pressure.max()) + margin
    levels = np.asarray(MaxNLocator(N_CONTOUR).tick_values(low, high))
    return np.concatenate([[low - 2 * margin], levels[(levels > low) & (levels < high)], [high]])
