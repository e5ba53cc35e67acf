"""Journal coefficients as figures: over speed at one load, as surfaces over load and speed; convergence and spread of searches."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labpipe.arrays import FloatArray, IntArray
from labpipe.records.run_up_result import TWO_SIDED, Convergence, MeasuredRun, MetamodelResult, RunUpMethod, RunUpResult, StartSpread
from labpipe.report.chart import INK, WIDTH, Axis, Chart, Drawing, Panel, Series, curve, dots, level, named_ticks, stacked
from labpipe.report.document import Figure
from labpipe.report.run_up_figures import RPM, SPEED, look, short
from labpipe.report.run_up_tables import NAMES

# Half width of the group of starts of a search.
BESIDE = 0.28
# Largest spread of factors that counts as agreement.
ALIKE = 0.02
ITERATION = Axis("iteration")


@dataclass(frozen=True, eq=False)
class CoefficientSurfaces:
    """Surfaces of coefficients: *speed* (n_speed,) [rpm], *load* (n_load,) [N], *values* (n, n_load, n_speed) in the units of *titles*."""

    speed: FloatArray
    load: FloatArray
    values: FloatArray
    titles: tuple[str, ...]


def _scale(name: str) -> tuple[float, str]:
    return (1e-3, "kN/m") if name.startswith("k") else (1.0, "N s/m")


def coefficient_figure(result: RunUpResult, run: MeasuredRun) -> Figure:
    """The eight coefficients over speed at one run's load, by every method, with 95 % bands where a method has them."""
    # Stiffness stands in the left column, damping in the right one.
    order = [row + 4 * column for row in range(4) for column in range(2)]
    panels = [Panel(SPEED, Axis(NAMES[n], _scale(NAMES[n])[1]), _coefficient(result, run, n)) for n in order]
    chart = Chart(tuple(panels), 4, 2, (WIDTH, 7.8), "x", "above")
    caption = f"Coefficients at {run.load:.4g} N ({run.name}, {run.role}) by every method; shaded: 95 % intervals, where a method has any."
    return Figure(chart, caption, f"Eight journal coefficients over speed at {run.load:.4g} N by every method")


def _coefficient(result: RunUpResult, run: MeasuredRun, number: int) -> tuple[Series, ...]:
    """One coefficient over speed by every method that has it."""
    scale, series = _scale(NAMES[number])[0], []
    for method in result.methods:
        prediction = method.prediction(run.name)
        if prediction is None or not prediction.coefficients:
            continue
        speed, values = RPM * np.array(prediction.coefficient_speed), scale * np.array(prediction.coefficients)[:, number]
        band = None
        if prediction.std_errors:
            wide = TWO_SIDED * scale * np.array(prediction.std_errors)[:, number]
            band = values - wide, values + wide
        series.append(curve(short(method), speed, values, *look(method), width=1.1, band=band, opacity=0.18))
    return tuple(series)


def convergence_figure(method: RunUpMethod, search: Convergence) -> Figure:
    """Objective, mesh and evaluations of one search over its iterations, and its best point."""
    steps = np.arange(len(search.objective))
    meshed = bool(np.any(np.isfinite(search.mesh)))
    panels = (
        Panel(ITERATION, Axis("objective", "um²", logarithmic=True), (_steps("objective", steps, 1e12 * np.array(search.objective)),)),
        Panel(ITERATION, Axis("mesh size, part of the box", logarithmic=meshed), (_steps("mesh", steps, search.mesh),) if meshed else ()),
        Panel(ITERATION, Axis("evaluations"), (_steps("evaluations", steps, search.evaluations),)),
        _factors((dots("best", np.arange(8), search.best, marker="o", size=6.0),)),
    )
    end = "ended by the limit on evaluations" if search.capped else "ended at the smallest mesh"
    caption = (
        f"{method.title}: convergence at {search.where}; {int(sum(search.evaluations))} evaluations, {end}. "
        "A small objective does not mean that the factors are right."
    )
    chart = Chart(panels, 2, 2, (WIDTH, 5.2), legend="none")
    return Figure(chart, caption, f"Convergence of the search of {method.title} at {search.where}")


def _steps(name: str, steps: IntArray, values: tuple[float, ...] | FloatArray) -> Series:
    return curve(name, steps, values, marker=".")


def _factors(series: tuple[Series, ...]) -> Panel:
    """Factors on the start values of the eight coefficients."""
    return Panel(Axis(ticks=named_ticks(NAMES)), Axis("factor on the start value"), (*series, level(1.0)))


def spread_figure(method: RunUpMethod, spread: StartSpread) -> Figure:
    """Final factors of all starts of one search."""
    factors = np.array(spread.factors)
    shift = np.linspace(-BESIDE, BESIDE, len(factors))[:, None]
    starts = dots(f"{len(factors)} starts", (np.arange(8) + shift).reshape(-1), factors.reshape(-1), 3, marker="o")
    mean = dots("mean", np.arange(8), factors.mean(axis=0), INK, marker="s", size=4.0)
    caption = f"{method.title}: final factors of {len(factors)} starts at {spread.where}; {spread_text(spread)}."
    return Figure(stacked([_factors((starts, mean))], 2.9), caption, f"Spread of the factors over {len(factors)} starts at {spread.where}")


def spread_text(spread: StartSpread) -> str:
    """Statement on misfit and spread of the starts."""
    wide = float(np.median(np.ptp(np.array(spread.factors), axis=0)))
    reached = f"all meet the measured amplitudes within {100 * max(spread.objective):.2g} %"
    if wide < ALIKE:
        return f"{reached}, with factors that agree within {wide:.2f}"
    return f"{reached}, yet their factors spread over {wide:.2f} (median): the coefficients are not determined"


def surface_figures(model: MetamodelResult) -> list[Figure]:
    """Stiffness and damping over load and speed, four surfaces each."""
    return [_surfaces(model, first, quantity) for first, quantity in ((0, "stiffness"), (4, "damping"))]


def _surfaces(model: MetamodelResult, first: int, quantity: str) -> Figure:
    names = NAMES[first : first + 4]
    scales = [_scale(name) for name in names]
    values = np.array([scale * np.array(model.surface.values[first + n]) for n, (scale, _) in enumerate(scales)])
    load = np.array(model.surface.load)
    titles = tuple(f"{name} [{unit}]" for name, (_, unit) in zip(names, scales, strict=True))
    surfaces = CoefficientSurfaces(RPM * np.array(model.surface.speed), load, values, titles)
    fitted = [validation.load for validation in model.left_out]
    beyond = f"; beyond {min(fitted):.3g} to {max(fitted):.3g} N extrapolated" if fitted and max(fitted) < 0.99 * load.max() else ""
    caption = f"{model.title[:1].upper()}{model.title[1:]}: {quantity} coefficients over load and speed{beyond}."
    drawing = Drawing("surfaces", surfaces, (WIDTH, 6.2))
    return Figure(drawing, caption, f"Surfaces of the four {quantity} coefficients over load and speed by the {model.title}")
