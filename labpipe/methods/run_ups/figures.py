"""Run-ups as figures: Bode, polar and orbit plots, speeds over the load, cascades, searches, surfaces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.methods.run_ups import records
from labpipe.methods.run_ups.rotor import COEFFICIENTS
from labpipe.report import chart
from labpipe.report.document import Figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

UM = 1e6
RPM = 30 / np.pi
SPEED = chart.Axis("speed", "rpm")
LOOKS = {
    "start": (4, "--"),
    "amplitudes": (3, ":"),
    "points": (5, "-"),
    "joint": (0, "-"),
    "process": (1, "--"),
}
ANY_LOOK = (2, "-")
ORBITS = 4
# Height of the largest line of a cascade, in steps between its spectra.
TALL = 3.0
# A cascade shows frequencies up to so many times the highest speed.
HIGHEST_ORDER = 3.0


def look(method: records.RunUpMethod) -> tuple[int, str]:
    return LOOKS.get(method.name, ANY_LOOK)


def short(method: records.RunUpMethod) -> str:
    return method.title.split(",")[0]


def phasor(motion: records.Motion) -> ComplexArray:
    """The motion (n_speed,) as complex amplitudes [m]."""
    return np.array(motion.real) + 1j * np.array(motion.imag)


def bode_figure(result: records.RunUpResult, run: records.MeasuredRun) -> Figure:
    planes = list(dict.fromkeys(motion.plane for motion in run.motions))
    panels: dict[tuple[int, int], chart.Panel] = {}
    for number, motion in enumerate(run.motions):
        row, column = 2 * (number % 2), planes.index(motion.plane)
        critical = () if run.critical_speed is None else (chart.upright(RPM * run.critical_speed.value),)
        measured = _measured_bode(run, run.motions[number])
        methods = [
            pair for method in result.methods if (pair := _method_bode(method, run, number)) is not None
        ]
        amplitude, phase = ((*critical, *series) for series in zip(measured, *methods, strict=True))
        title = motion.plane if row == 0 else ""
        panels[row, column] = chart.Panel(
            SPEED, chart.Axis(f"{motion.direction} amplitude", "um", low=0.0), amplitude, title
        )
        panels[row + 1, column] = chart.Panel(SPEED, chart.Axis(f"{motion.direction} phase", "deg"), phase)
    graphic = chart.Chart(
        tuple(panels[place] for place in sorted(panels)), 4, len(planes), (chart.WIDTH, 7.8), "x", "above"
    )
    bars = "bars: 95 % of the measurement; upright line: measured critical speed"
    plot = f"Bode plot, 0-to-peak, phase against the keyphasor; {bars}."
    alternative = f"Amplitude and phase of run {run.name} over speed, measured and by every method"
    return Figure(graphic, f"{run.name}, {run.load:.4g} N, {run.role}: {plot}", alternative)


def _measured_bode(run: records.MeasuredRun, motion: records.Motion) -> tuple[chart.Series, chart.Series]:
    speed, value = RPM * np.array(run.speed), phasor(motion)
    size, turned = UM * np.abs(value), np.degrees(np.unwrap(np.angle(value)))
    wide = UM * records.TWO_SIDED * np.array(motion.amplitude_error)
    apart = np.degrees(records.TWO_SIDED * np.array(motion.phase_error))
    return (
        chart.dots("measured", speed, size, chart.INK, size=1.5, bars=(size - wide, size + wide)),
        chart.dots("measured", speed, turned, chart.INK, size=1.5, bars=(turned - apart, turned + apart)),
    )


def _method_bode(
    method: records.RunUpMethod, run: records.MeasuredRun, number: int
) -> tuple[chart.Series, chart.Series] | None:
    if (prediction := _motions(method, run)) is None:
        return None
    speed, value = RPM * np.array(prediction.speed), phasor(prediction.motions[number])
    turned = np.degrees(np.unwrap(np.angle(value)))
    # The measured phase decides in which turn the curve is drawn.
    first = np.degrees(np.angle(phasor(run.motions[number])[0]))
    phase = turned - 360 * round((turned[0] - first) / 360)
    colour, line = look(method)
    amplitude = chart.curve(short(method), speed, UM * np.abs(value), colour, line, width=1.1)
    return amplitude, chart.curve(short(method), speed, phase, colour, line, width=1.1)


def best_method(result: records.RunUpResult) -> records.RunUpMethod | None:
    """The one of figures of one method: (d) where chi-square rejects (c), else (c), (b), (a)."""
    joint = result.method("joint")
    order = ["joint", "process", "points", "amplitudes"]
    if joint is not None and joint.verdict == "rejected":
        order[:2] = ["process", "joint"]
    return next((method for name in order if (method := result.method(name)) is not None), None)


def _motions(method: records.RunUpMethod | None, run: records.MeasuredRun) -> records.RunPrediction | None:
    prediction = None if method is None else method.prediction(run.name)
    return prediction if prediction is not None and prediction.motions else None


def polar_figure(result: records.RunUpResult, method: records.RunUpMethod | None) -> Figure:
    motions = result.runs[0].motions
    rows = -(-len(motions) // 2)
    panels = tuple(_polar(result, method, number, motion) for number, motion in enumerate(motions))
    lines = "" if method is None else f"; lines: {method.title}"
    graphic = chart.Chart(panels, rows, 2, (chart.WIDTH, 3.3 * rows + 0.6), legend="above")
    angles = f"angles from the keyphasor's pulse, a lag clockwise; numbers: rpm of {result.runs[0].name}"
    caption = f"Polar plots of all runs, 0-to-peak, {angles}; dots: measured{lines}."
    return Figure(graphic, caption, "Polar plots of every plane and direction")


def _polar(
    result: records.RunUpResult, method: records.RunUpMethod | None, number: int, motion: records.Motion
) -> chart.Panel:
    series = []
    for place, run in enumerate(result.runs):
        colour, value = place % chart.PALETTE_SIZE, UM * phasor(run.motions[number])
        series.append(chart.dots(f"{run.name} measured", value.real, value.imag, colour, size=2.0))
        prediction = _motions(method, run)
        if prediction is not None:
            path = UM * phasor(prediction.motions[number])
            series.append(chart.curve(f"{run.name} computed", path.real, path.imag, colour, width=0.9))
    run, value = result.runs[0], UM * phasor(result.runs[0].motions[number])
    places = orbit_places(run)
    at = 1.12 * value[places]
    speeds = [f"{RPM * run.speed[place]:.0f}" for place in places]
    series.append(chart.labels(at.real, at.imag, speeds, size=6.0))
    x, y = chart.Axis("real part", "um"), chart.Axis("imaginary part", "um")
    return chart.Panel(x, y, tuple(series), f"{motion.plane}, {motion.direction}", equal=True)


def orbit_figure(result: records.RunUpResult, method: records.RunUpMethod | None) -> Figure:
    panels = tuple(_orbits(run, place, method) for run in result.runs for place in orbit_places(run))
    graphic = chart.Chart(
        panels, len(result.runs), ORBITS, (chart.WIDTH, 1.75 * len(result.runs) + 1.0), legend="above"
    )
    dashed = "" if method is None else f"; dashed: {method.title}"
    caption = (
        f"Orbits of 1x below, about and above the critical speed; solid: measured{dashed}; the dot "
        "marks the keyphasor's pulse, the arrow the sense of the motion."
    )
    return Figure(graphic, caption, "Orbits of every run at four speeds, measured and by one method")


def orbit_places(run: records.MeasuredRun) -> list[int]:
    """Rows of a run below, at and beyond its critical speed, and the last; spread evenly without one."""
    n, speed = len(run.speed), np.array(run.speed)
    if run.critical_speed is None:
        return [int(place) for place in np.linspace(0, n - 1, ORBITS).round()]
    speeds = [*(part * run.critical_speed.value for part in (0.75, 1.0, 1.2)), speed[-1]]
    return [int(np.argmin(np.abs(speed - target))) for target in speeds]


def _orbits(run: records.MeasuredRun, place: int, method: records.RunUpMethod | None) -> chart.Panel:
    prediction, series = _motions(method, run), []
    for number in range(0, len(run.motions), 2):
        colour, name = number // 2 % ORBITS, run.motions[number].plane
        x, y = (complex(phasor(motion)[place]) for motion in run.motions[number : number + 2])
        series += _ellipse(x, y, colour, "-", f"{name} measured")
        if prediction is not None and run.speed[place] <= prediction.speed[-1] * (1 + 1e-6):
            x, y = (_at(prediction, number + n, run.speed[place]) for n in (0, 1))
            series += _ellipse(x, y, colour, "--", f"{name} computed")
    title = f"{run.name}, {RPM * run.speed[place]:.0f} rpm"
    return chart.Panel(chart.Axis("x", "um"), chart.Axis("y", "um"), tuple(series), title, equal=True)


def _at(prediction: records.RunPrediction, number: int, speed: float) -> complex:
    motion = prediction.motions[number]
    real, imag = (np.interp(speed, prediction.speed, part) for part in (motion.real, motion.imag))
    return complex(real + 1j * imag)


def _ellipse(x: complex, y: complex, colour: int, line: str, name: str) -> list[chart.Series]:
    turn = np.exp(1j * np.linspace(0, 2 * np.pi, 73))
    across, along = UM * np.real(x * turn), UM * np.real(y * turn)
    path = chart.curve(name, across, along, colour, line)
    if line != "-":
        return [path]
    pulse = f"{name.removesuffix(' measured')} keyphasor"
    sense = chart.arrow((across[6], along[6]), (across[9], along[9]), colour)
    return [path, chart.dots(pulse, across[:1], along[:1], colour, marker="o"), sense]


def speeds_figure(result: records.RunUpResult) -> Figure:
    load = chart.Axis("static load", "N")
    panels = [
        chart.Panel(load, chart.Axis(item.replace("_", " "), "rpm"), _speed_series(result, item))
        for item in ("critical_speed", "threshold")
    ]
    held_out_loads = ", ".join(f"{run.load:.4g} N" for run in result.runs if run.role == records.HELD_OUT)
    remark = f" The run at {held_out_loads} is in no fit." if held_out_loads else ""
    what = "Critical speed and threshold of instability over the load: measured and by every method"
    alternative = "Critical speed and threshold over the load, measured and by every method"
    return Figure(chart.stack(panels, 5.4), f"{what}; bars: 95 % intervals.{remark}", alternative)


def _speed_series(result: records.RunUpResult, item: str) -> tuple[chart.Series, ...]:
    measured = [(run.load, getattr(run, item)) for run in result.runs]
    series = _speeds(measured, "measured", chart.INK, "", marker="o", size=5.0)
    for method in result.methods:
        predictions = [(run.load, method.prediction(run.name)) for run in result.runs]
        amounts = [(load, getattr(prediction, item, None)) for load, prediction in predictions]
        series += _speeds(amounts, short(method), *look(method), marker=".", size=2.5)
    return tuple(series)


def _speeds(
    amounts: Sequence[tuple[float, records.UncertainAmount | None]],
    name: str,
    colour: int,
    line: str,
    **style: Any,
) -> list[chart.Series]:
    points = sorted((load, one.value, one.std_error or 0.0) for load, one in amounts if one is not None)
    if not points:
        return []
    load, value, error = np.array(points).T
    ends = RPM * (value - records.TWO_SIDED * error), RPM * (value + records.TWO_SIDED * error)
    return [chart.curve(name, load, RPM * value, colour, line, bars=ends, **style)]


def cascade_figure(run: records.MeasuredRun, cascade: records.Cascade) -> Figure:
    frequency, speed = 60 * np.array(cascade.frequency), 60 * np.array(cascade.speed)
    amplitude = UM * np.array(cascade.amplitude)
    step = float(np.ptp(speed)) / max(len(speed) - 1, 1)
    scale = TALL * step / (float(amplitude.max()) or 1.0)
    rows = zip(speed, amplitude, strict=True)
    spectra = [
        chart.curve("spectra", frequency, height + scale * spectrum, width=0.7) for height, spectrum in rows
    ]
    ends = np.array([speed.min(), speed.max()])
    orders = [chart.curve(f"{order}x", order * ends, ends, 1, "--", width=0.9) for order in (1, 2)]
    x = chart.Axis("frequency", "cycles/min", 0.0, float(min(frequency[-1], HIGHEST_ORDER * speed.max())))
    graphic = chart.stack([chart.Panel(x, SPEED, (*spectra, *orders))], 5.0)
    highest = f"the highest line is {amplitude.max():.3g} um, 0-to-peak"
    caption = f"{run.name}: cascade of {cascade.label}; {highest}. Lines below 1x warn of whirl."
    alternative = f"Cascade plot of {cascade.label} in run {run.name}: spectra over the speed"
    return Figure(graphic, caption, alternative)


# Half width of the group of starts of a search; largest spread of factors that counts as agreement.
BESIDE, ALIKE = 0.28, 0.02
ITERATION = chart.Axis("iteration")


@dataclass(frozen=True, eq=False)
class CoefficientSurfaces:
    """Over *speed* (n_speed,) [rpm] and *load* (n_load,) [N], *values* (n, n_load, n_speed) of *titles*."""

    speed: FloatArray
    load: FloatArray
    values: FloatArray
    titles: tuple[str, ...]


def scale(name: str) -> tuple[float, str]:
    return (1e-3, "kN/m") if name.startswith("k") else (1.0, "N s/m")


def coefficient_figure(result: records.RunUpResult, run: records.MeasuredRun) -> Figure:
    # Stiffness stands in the left column, damping in the right one.
    order = [row + 4 * column for row in range(4) for column in range(2)]
    panels = [
        chart.Panel(
            SPEED, chart.Axis(COEFFICIENTS[n], scale(COEFFICIENTS[n])[1]), _coefficient(result, run, n)
        )
        for n in order
    ]
    graphic = chart.Chart(tuple(panels), 4, 2, (chart.WIDTH, 7.8), "x", "above")
    place = f"Coefficients at {run.load:.4g} N ({run.name}, {run.role}) by every method"
    caption = f"{place}; shaded: 95 % intervals, where a method has any."
    alternative = f"Eight journal coefficients over speed at {run.load:.4g} N by every method"
    return Figure(graphic, caption, alternative)


def _coefficient(
    result: records.RunUpResult, run: records.MeasuredRun, number: int
) -> tuple[chart.Series, ...]:
    factor, series = scale(COEFFICIENTS[number])[0], []
    for method in result.methods:
        prediction = method.prediction(run.name)
        if prediction is None or not prediction.coefficients:
            continue
        speed = RPM * np.array(prediction.coefficient_speed)
        values = factor * np.array(prediction.coefficients)[:, number]
        band = None
        if prediction.std_errors:
            wide = records.TWO_SIDED * factor * np.array(prediction.std_errors)[:, number]
            band = values - wide, values + wide
        series.append(
            chart.curve(short(method), speed, values, *look(method), width=1.1, band=band, opacity=0.18)
        )
    return tuple(series)


def convergence_figure(method: records.RunUpMethod, search: records.Convergence) -> Figure:
    meshed = bool(np.any(np.isfinite(search.mesh)))

    def step_panel(name: str, values: FloatArray | records.Column, axis: chart.Axis) -> chart.Panel:
        shown = np.any(np.isfinite(values))
        curve = chart.curve(name, np.arange(len(values)), values, marker=".")
        return chart.Panel(ITERATION, axis, (curve,) if shown else ())

    objective = chart.Axis("objective", "um²", logarithmic=True)
    panels = (
        step_panel("objective", 1e12 * np.array(search.objective), objective),
        step_panel("mesh", search.mesh, chart.Axis("mesh size, part of the box", logarithmic=meshed)),
        step_panel("evaluations", search.evaluations, chart.Axis("evaluations")),
        _factors((chart.dots("best", np.arange(8), search.best, marker="o", size=6.0),)),
    )
    end = "ended by the limit on evaluations" if search.capped else "ended at its tolerance"
    caption = (
        f"{method.title}: convergence at {search.where}; {int(sum(search.evaluations))} evaluations, {end}. "
        "A small objective does not mean that the factors are right."
    )
    graphic = chart.Chart(panels, 2, 2, (chart.WIDTH, 5.2), legend="none")
    return Figure(graphic, caption, f"Convergence of the search of {method.title} at {search.where}")


def _factors(series: tuple[chart.Series, ...]) -> chart.Panel:
    return chart.Panel(
        chart.Axis(ticks=chart.named_ticks(COEFFICIENTS)),
        chart.Axis("factor on the start value"),
        (*series, chart.level(1.0)),
    )


def spread_figure(method: records.RunUpMethod, spread: records.StartSpread) -> Figure:
    factors = np.array(spread.factors)
    shift = np.linspace(-BESIDE, BESIDE, len(factors))[:, None]
    starts = chart.dots(
        f"{len(factors)} starts", (np.arange(8) + shift).reshape(-1), factors.reshape(-1), 3, marker="o"
    )
    mean = chart.dots("mean", np.arange(8), factors.mean(axis=0), chart.INK, marker="s", size=4.0)
    place = f"{len(factors)} starts at {spread.where}"
    caption = f"{method.title}: final factors of {place}; {spread_text(spread)}."
    graphic = chart.stack([_factors((starts, mean))], 2.9)
    return Figure(graphic, caption, f"Spread of the factors over {place}")


def spread_text(spread: records.StartSpread) -> str:
    wide = float(np.median(np.ptp(np.array(spread.factors), axis=0)))
    reached = f"all meet the measured amplitudes within {100 * max(spread.objective):.2g} %"
    if wide < ALIKE:
        return f"{reached}, with factors that agree within {wide:.2f}"
    spread_wide = f"yet their factors spread over {wide:.2f} (median)"
    return f"{reached}, {spread_wide}: the coefficients are not determined"


def surface_figures(model: records.MetamodelResult) -> list[Figure]:
    return [_surfaces(model, first, quantity) for first, quantity in ((0, "stiffness"), (4, "damping"))]


def _surfaces(model: records.MetamodelResult, first: int, quantity: str) -> Figure:
    names, load = COEFFICIENTS[first : first + 4], np.array(model.surface.load)
    factor, unit = scale(names[0])
    values = factor * np.array(model.surface.values[first : first + 4])
    titles = tuple(f"{name} [{unit}]" for name in names)
    surfaces = CoefficientSurfaces(RPM * np.array(model.surface.speed), load, values, titles)
    fitted = [validation.load for validation in model.left_out]
    beyond, over = "", f"{quantity} coefficients over load and speed"
    if fitted and max(fitted) < 0.99 * load.max():
        beyond = f"; beyond {min(fitted):.3g} to {max(fitted):.3g} N extrapolated"
    caption = f"{model.title[:1].upper()}{model.title[1:]}: {over}{beyond}."
    graphic = chart.Drawing("surfaces", surfaces, (chart.WIDTH, 6.2))
    return Figure(graphic, caption, f"Surfaces of the four {over} by the {model.title}")


def surface_canvas(surfaces: CoefficientSurfaces, size: tuple[float, float]) -> Canvas:
    """Four surfaces side by side on a canvas of *size* [in]."""
    from matplotlib.figure import Figure as Canvas
    from mpl_toolkits.mplot3d import Axes3D

    from labpipe.document.charts import style

    with style():
        canvas = Canvas(figsize=size)
        for place, title in enumerate(surfaces.titles):
            axes = canvas.add_subplot(2, 2, place + 1, projection=Axes3D.name)
            speed, load = np.meshgrid(surfaces.speed, surfaces.load)
            look = {"cmap": "viridis", "edgecolor": "0.3", "linewidth": 0.25}
            axes.plot_surface(speed, load, surfaces.values[place], **look)
            axes.set_xlabel("speed [rpm]", fontsize=8)
            axes.set_ylabel("load [N]", fontsize=8)
            axes.set_title(title, fontsize=9)
            axes.tick_params(labelsize=7, pad=1)
            axes.view_init(elev=24, azim=-125)
        canvas.subplots_adjust(left=0.02, right=0.95, bottom=0.05, top=0.95, wspace=0.12, hspace=0.16)
    return canvas
