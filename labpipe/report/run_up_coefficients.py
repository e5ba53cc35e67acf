"""Journal coefficients as figures: over speed at one load, as surfaces over load and speed; convergence and spread of searches."""

from __future__ import annotations

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure as Canvas

from labpipe.records.run_up_result import TWO_SIDED, Convergence, MeasuredRun, MetamodelResult, RunUpMethod, RunUpResult, StartSpread
from labpipe.report.document import Figure
from labpipe.report.drawing import COLOURS, STYLE
from labpipe.report.figures import WIDTH, logarithmic, stacked_axes
from labpipe.report.run_up_figures import legend_above, look, panelled, short
from labpipe.report.run_up_tables import NAMES

RPM = 30 / np.pi


def _scale(name: str) -> tuple[float, str]:
    return (1e-3, "kN/m") if name.startswith("k") else (1.0, "N s/m")


def coefficient_figure(result: RunUpResult, run: MeasuredRun) -> Figure:
    """The eight coefficients over speed at one run's load, by every method, with 95 % bands where a method has them."""
    with mpl.rc_context(STYLE):
        canvas, panels = panelled(4, 2, 7.8, sharex=True)
        for number, name in enumerate(NAMES):
            axes, (scale, unit) = panels[number % 4, number // 4], _scale(name)
            for method in result.methods:
                told = method.prediction(run.name)
                if told is None or not told.coefficients:
                    continue
                speed, value = RPM * np.array(told.coefficient_speed), scale * np.array(told.coefficients)[:, number]
                axes.plot(speed, value, linewidth=1.1, label=short(method), **look(method))
                if told.std_errors:
                    wide = TWO_SIDED * scale * np.array(told.std_errors)[:, number]
                    axes.fill_between(speed, value - wide, value + wide, color=str(look(method)["color"]), alpha=0.18, linewidth=0)
            axes.set_ylabel(f"{name} [{unit}]")
        for axes in panels[-1]:
            axes.set_xlabel("speed [rpm]")
        legend_above(canvas, panels[0, 0], 3)
    caption = f"Coefficients at {run.load:.4g} N ({run.name}, {run.role}) by every method; shaded: 95 % intervals, where a method has any."
    return Figure(canvas, caption, f"Eight journal coefficients over speed at {run.load:.4g} N by every method")


def convergence_figure(method: RunUpMethod, search: Convergence) -> Figure:
    """Objective, mesh and evaluations of one search over its iterations, and its best point."""
    steps = np.arange(len(search.objective))
    with mpl.rc_context(STYLE):
        canvas, panels = panelled(2, 2, 5.2)
        objective, mesh, evaluations, best = panels.reshape(-1)
        objective.plot(steps, 1e12 * np.array(search.objective), ".-", color=COLOURS[0], linewidth=1)
        objective.set_ylabel("objective [um²]")
        logarithmic(objective)
        if np.any(np.isfinite(search.mesh)):
            mesh.plot(steps, search.mesh, ".-", color=COLOURS[0], linewidth=1)
            logarithmic(mesh)
        mesh.set_ylabel("mesh size, part of the box")
        evaluations.plot(steps, search.evaluations, ".-", color=COLOURS[0], linewidth=1)
        evaluations.set_ylabel("evaluations")
        for axes in (objective, mesh, evaluations):
            axes.set_xlabel("iteration")
        best.plot(np.arange(8), search.best, "o", color=COLOURS[0])
        best.axhline(1.0, color="0.5", linewidth=0.8)
        best.set_xticks(range(8), NAMES, rotation=45)
        best.set_ylabel("factor on the start value")
    end = "a cap on the evaluations ended it" if search.capped else "the mesh ended it"
    caption = (
        f"{method.title}: convergence at {search.where}; {int(sum(search.evaluations))} evaluations, {end}. "
        "A small objective is no sign that the factors are right."
    )
    return Figure(canvas, caption, f"Convergence of the search of {method.title} at {search.where}")


def spread_figure(method: RunUpMethod, spread: StartSpread) -> Figure:
    """Where all starts of one search ended: factors on the start values."""
    factors = np.array(spread.factors)
    with mpl.rc_context(STYLE):
        canvas, (axes,) = stacked_axes(1, 2.9)
        shift = np.linspace(-0.28, 0.28, len(factors))
        for number, row in enumerate(factors):
            label = {"label": f"{len(factors)} starts"} if number == 0 else {}
            axes.plot(np.arange(8) + shift[number], row, "o", color=COLOURS[3], markersize=3, **label)
        axes.plot(np.arange(8), factors.mean(axis=0), "s", color=COLOURS[6], markersize=4, label="mean")
        axes.axhline(1.0, color="0.5", linewidth=0.8)
        axes.set_xticks(range(8), NAMES)
        axes.set_ylabel("factor on the start value")
        low, high = axes.get_ylim()
        axes.set_ylim(low, high + 0.15 * (high - low))
        axes.legend(ncols=2, fontsize=8, loc="upper left")
    caption = f"{method.title}: where {len(factors)} starts end at {spread.where}; {spread_words(spread)}."
    return Figure(canvas, caption, f"Spread of the factors over {len(factors)} starts at {spread.where}")


def spread_words(spread: StartSpread) -> str:
    """What the starts say: all meet the data, and lie how far apart."""
    wide = float(np.median(np.ptp(np.array(spread.factors), axis=0)))
    reached = f"all meet the measured amplitudes within {100 * max(spread.objective):.2g} %"
    if wide < 0.02:
        return f"{reached}, with factors that agree within {wide:.2f}"
    return f"{reached}, yet their factors spread over {wide:.2f} (median): the coefficients are not determined"


def surface_figures(model: MetamodelResult) -> list[Figure]:
    """Stiffness and damping over load and speed, four surfaces each."""
    return [_surfaces(model, first, what) for first, what in ((0, "stiffness"), (4, "damping"))]


def _surfaces(model: MetamodelResult, first: int, what: str) -> Figure:
    # Registers the projection; the package does so only once it is asked for.
    from mpl_toolkits.mplot3d import Axes3D

    speed, load = np.meshgrid(RPM * np.array(model.surface.speed), np.array(model.surface.load))
    with mpl.rc_context({**STYLE, "font.size": 8}):
        canvas = Canvas(figsize=(WIDTH, 6.2))
        for place, name in enumerate(NAMES[first : first + 4]):
            axes = canvas.add_subplot(2, 2, place + 1, projection=Axes3D.name)
            scale, unit = _scale(name)
            axes.plot_surface(
                speed, load, scale * np.array(model.surface.values[first + place]), cmap="viridis", edgecolor="0.3", linewidth=0.25
            )
            axes.set_xlabel("speed [rpm]")
            axes.set_ylabel("load [N]")
            axes.set_title(f"{name} [{unit}]", fontsize=9)
            axes.tick_params(labelsize=7, pad=1)
            axes.view_init(elev=24, azim=-125)
        canvas.subplots_adjust(left=0.02, right=0.95, bottom=0.05, top=0.95, wspace=0.12, hspace=0.16)
    fitted = [left.load for left in model.left_out]
    beyond = f"; beyond {min(fitted):.3g} to {max(fitted):.3g} N carried on" if fitted and max(fitted) < 0.99 * load.max() else ""
    caption = f"{model.title[:1].upper()}{model.title[1:]}: {what} coefficients over load and speed{beyond}."
    return Figure(canvas, caption, f"Surfaces of the four {what} coefficients over load and speed by the {model.title}")
