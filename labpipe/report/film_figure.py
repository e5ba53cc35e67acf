"""The oil film of a journal bearing: its pressure unrolled, and over it the thickness."""

from __future__ import annotations

import matplotlib as mpl
import numpy as np
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from labpipe.bearings.coefficients import PressureField
from labpipe.report.document import Figure
from labpipe.report.drawing import COLOURS, STYLE
from labpipe.report.figures import stacked_axes

BAR, MM, UM = 1e-5, 1e3, 1e6
N_CONTOUR = 14
# Where the film is torn its pressure is one level, but for rounding; contours must not leave it blank.
TORN = 1e-6
BOTTOM = 270.0


def film_figure(name: str, film: PressureField) -> Figure:
    """Pressure over angle and width as filled contours; below, pressure at mid width and the film's thickness."""
    order = np.argsort(np.mod(film.theta, 2 * np.pi))
    angle, pressure = np.degrees(np.mod(film.theta[order], 2 * np.pi)), BAR * film.pressure[order]
    with mpl.rc_context({**STYLE, "axes.grid": False}):
        canvas, (field, middle) = stacked_axes(2, 5.2, sharex=True, height_ratios=(3, 2))
        filled = field.contourf(angle, MM * film.axial, pressure.T, contour_levels(pressure), cmap="cividis")
        canvas.colorbar(filled, ax=field, shrink=0.9, ticks=MaxNLocator(7), format="%g").set_label("pressure [bar]")
        field.set_ylabel("from mid width [mm]")
        middle.plot(angle, _mid_width(film, pressure), color=COLOURS[0])
        middle.set_ylabel("pressure at mid width [bar]", color=COLOURS[0])
        beside = middle.twinx()
        beside.plot(angle, UM * film.thickness[order], "--", color=COLOURS[1])
        beside.set_ylabel("film thickness [um]", color=COLOURS[1])
        beside.set_ylim(bottom=0)
        for axes in (field, middle):
            axes.axvline(BOTTOM, color="0.5", linewidth=0.8, linestyle=":")
        middle.set_xlabel("angle from +y to +z, with the spin [deg]; dotted: the bottom")
        middle.set_xlim(0, 360)
        middle.set_xticks(range(0, 361, 45))
    caption = f"{name}: pressure of the oil film against ambient, unrolled; below, at mid width (full) with the film's thickness (dashed)."
    return Figure(canvas, caption, f"Pressure of the oil film of {name} over angle and width")


def contour_levels(pressure: NDArray[np.floating]) -> NDArray[np.floating]:
    """Rising levels at round pressures from below the least to above the largest, which leave no cell blank."""
    span = float(np.ptp(pressure)) or 1.0
    low, high = float(pressure.min()) - TORN * span, float(pressure.max()) + TORN * span
    levels = np.asarray(MaxNLocator(N_CONTOUR).tick_values(low + 2 * TORN * span, high))
    inner = levels[(levels > low + 2 * TORN * span) & (levels < high)]
    return np.concatenate([[low], inner, [high]])


def _mid_width(film: PressureField, pressure: NDArray[np.floating]) -> NDArray[np.floating]:
    """The mean of the cells nearest to mid width: one, or the two beside it."""
    nearest = np.isclose(np.abs(film.axial), np.abs(film.axial).min(), atol=1e-12)
    return np.asarray(pressure[:, nearest].mean(axis=1))
