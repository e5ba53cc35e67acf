"""Drawings that are no charts: an oil film, coefficients as surfaces over load and speed, mode shapes on the structure."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure as Canvas
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d import Axes3D

from labpipe.arrays import FloatArray, IntArray
from labpipe.bearings.coefficients import PressureField
from labpipe.document.charts import PALETTE, styled
from labpipe.report.run_up_coefficients import CoefficientSurfaces
from labpipe.report.shape_figure import REACH, VIEWS, ShapeSketch, projected

BAR, MM, UM = 1e-5, 1e3, 1e6
N_CONTOUR = 14
# In the cavitated film the pressure is constant except for rounding; contours must not leave it blank.
TORN = 1e-6
BOTTOM = 270.0
# Room about the structure for its motion.
ROOM = 1.2 * REACH


def film_canvas(film: PressureField, size: tuple[float, float]) -> Canvas:
    """Pressure over angle and width as filled contours; below, pressure at mid width and the film's thickness. *size* [in]."""
    order = np.argsort(np.mod(film.theta, 2 * np.pi))
    angle, pressure = np.degrees(np.mod(film.theta[order], 2 * np.pi)), BAR * film.pressure[order]
    with styled(grid=False):
        canvas = Canvas(figsize=size, layout="constrained")
        field, middle = canvas.subplots(2, 1, sharex=True, height_ratios=(3, 2))
        filled = field.contourf(angle, MM * film.axial, pressure.T, contour_levels(pressure), cmap="cividis")
        canvas.colorbar(filled, ax=field, shrink=0.9, ticks=MaxNLocator(7), format="%g").set_label("pressure [bar]")
        field.set_ylabel("from mid width [mm]")
        _mid_width(middle, film, angle, pressure, order)
        for axes in (field, middle):
            axes.axvline(BOTTOM, color="0.5", linewidth=0.8, linestyle=":")
        middle.set_xlabel("angle from +y to +z, with the spin [deg]; dotted: the bottom")
        middle.set_xlim(0, 360)
        middle.set_xticks(range(0, 361, 45))
    return canvas


def _mid_width(axes: Axes, film: PressureField, angle: FloatArray, pressure: FloatArray, order: IntArray) -> None:
    """Pressure at mid width [bar] and, on a second ordinate, the thickness [um] over the angle [deg]."""
    axes.plot(angle, mid_width_pressure(film, pressure), color=PALETTE[0])
    axes.set_ylabel("pressure at mid width [bar]", color=PALETTE[0])
    beside = axes.twinx()
    beside.plot(angle, UM * film.thickness[order], "--", color=PALETTE[1])
    beside.set_ylabel("film thickness [um]", color=PALETTE[1])
    beside.set_ylim(bottom=0)


def contour_levels(pressure: FloatArray) -> FloatArray:
    """Rising levels (n_level,) [Pa] at round pressures around all of *pressure* (n_theta, n_axial) [Pa], which leave no cell blank."""
    range_of_pressure = float(np.ptp(pressure)) or 1.0
    low, high = float(pressure.min()) - TORN * range_of_pressure, float(pressure.max()) + TORN * range_of_pressure
    levels = np.asarray(MaxNLocator(N_CONTOUR).tick_values(low + 2 * TORN * range_of_pressure, high))
    inner = levels[(levels > low + 2 * TORN * range_of_pressure) & (levels < high)]
    return np.concatenate([[low], inner, [high]])


def mid_width_pressure(film: PressureField, pressure: FloatArray) -> FloatArray:
    """(n_theta,) [Pa] mean of the cells (n_theta, n_axial) [Pa] nearest to mid width: the middle ones, or the two beside it."""
    nearest = np.isclose(np.abs(film.axial), np.abs(film.axial).min(), atol=1e-12)
    return np.asarray(pressure[:, nearest].mean(axis=1))


def surface_canvas(surfaces: CoefficientSurfaces, size: tuple[float, float]) -> Canvas:
    """Four surfaces side by side on a canvas of *size* [in]."""
    with styled():
        canvas = Canvas(figsize=size)
        for place, title in enumerate(surfaces.titles):
            axes = canvas.add_subplot(2, 2, place + 1, projection=Axes3D.name)
            _surface(axes, surfaces, place, title)
        canvas.subplots_adjust(left=0.02, right=0.95, bottom=0.05, top=0.95, wspace=0.12, hspace=0.16)
    return canvas


def _surface(axes: Axes, surfaces: CoefficientSurfaces, place: int, title: str) -> None:
    speed, load = np.meshgrid(surfaces.speed, surfaces.load)
    axes.plot_surface(speed, load, surfaces.values[place], cmap="viridis", edgecolor="0.3", linewidth=0.25)  # type: ignore[attr-defined]
    axes.set_xlabel("speed [rpm]", fontsize=8)
    axes.set_ylabel("load [N]", fontsize=8)
    axes.set_title(title, fontsize=9)
    axes.tick_params(labelsize=7, pad=1)
    axes.view_init(elev=24, azim=-125)  # type: ignore[attr-defined]


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
    for points, colour, style in ((sketch.positions, "0.75", "-"), (back, PALETTE[0], ":"), (there, PALETTE[0], "-")):
        _draw(axes, sketch, projected(points, *eye), colour, style)
    half = np.max([np.abs(projected(sketch.positions, *view)).max(axis=0) for _, *view in VIEWS], axis=0) + ROOM
    axes.set_xlim(-half[0], half[0])
    axes.set_ylim(-half[1], half[1])
    axes.set_aspect("equal")
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_visible(False)


def _draw(axes: Axes, sketch: ShapeSketch, seen: FloatArray, colour: str, style: str) -> None:
    axes.add_collection(LineCollection(list(seen[sketch.lines]), colors=colour, linestyles=style, linewidths=1.2))
    axes.plot(*seen.T, ".", color=colour, markersize=3)
