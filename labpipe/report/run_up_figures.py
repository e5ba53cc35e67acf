"""Run-ups as figures: Bode, polar and orbit plots with every method's curve, speeds over the load, cascades of recordings."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas
from numpy.typing import NDArray

from labpipe.records.run_up_result import HELD_OUT, TWO_SIDED, Cascade, MeasuredRun, Motion, RunPrediction, RunUpMethod, RunUpResult
from labpipe.report.document import Figure
from labpipe.report.drawing import COLOURS, STYLE
from labpipe.report.figures import WIDTH, stacked_axes

UM = 1e6
RPM = 30 / np.pi
# Colour and line of every method, the measurement in black.
LOOKS = {
    "start": (COLOURS[4], "--"),
    "amplitudes": (COLOURS[3], ":"),
    "points": (COLOURS[5], "-"),
    "joint": (COLOURS[0], "-"),
    "process": (COLOURS[1], "--"),
}
INK = COLOURS[6]
ORBITS = 4
# Height of the largest line of a cascade, in steps between its spectra.
TALL = 3.0

Array = NDArray[np.floating]


def panelled(rows: int, columns: int, height: float, **kwargs: Any) -> tuple[Canvas, NDArray[np.object_]]:
    """Many panels with room for labels in inches and a legend above: laying them out by measuring every label takes half a minute."""
    canvas = Canvas(figsize=(WIDTH, height))
    panels = canvas.subplots(rows, columns, squeeze=False, **kwargs)
    room = {"left": 0.62 / WIDTH, "right": 1 - 0.08 / WIDTH, "bottom": 0.48 / height, "top": 1 - 0.72 / height}
    wide, high = (WIDTH - 0.7) / columns, (height - 1.2) / rows
    canvas.subplots_adjust(**room, wspace=0.75 / (wide - 0.55), hspace=0.42 / max(high - 0.42, 0.3))
    return canvas, panels


def legend_above(canvas: Canvas, axes: Axes, columns: int) -> None:
    """The names of one panel above all of them."""
    handles, labels = axes.get_legend_handles_labels()
    canvas.legend(handles, labels, ncols=columns, fontsize=7 if len(labels) > 8 else 8, loc="upper center", bbox_to_anchor=(0.5, 1.0))


def look(method: RunUpMethod) -> dict[str, object]:
    colour, line = LOOKS.get(method.name, (COLOURS[2], "-"))
    return {"color": colour, "linestyle": line}


def short(method: RunUpMethod) -> str:
    """The name in a legend."""
    return method.title.split(",")[0]


def phasor(motion: Motion) -> NDArray[np.complexfloating]:
    return np.array(motion.real) + 1j * np.array(motion.imag)


def bode_figure(result: RunUpResult, run: MeasuredRun) -> Figure:
    """Amplitude and phase of every plane over speed: measured with 95 % bars, and each method's curve up to its threshold."""
    planes = list(dict.fromkeys(motion.plane for motion in run.motions))
    with mpl.rc_context(STYLE):
        canvas, panels = panelled(4, len(planes), 7.8, sharex=True)
        for number, motion in enumerate(run.motions):
            row, column = number % 2, planes.index(motion.plane)
            amplitude, phase = panels[2 * row, column], panels[2 * row + 1, column]
            _measured_bode(amplitude, phase, run, motion)
            for method in result.methods:
                _method_bode(amplitude, phase, method, run, number)
            amplitude.set_ylabel(f"{motion.direction} amplitude [um]")
            phase.set_ylabel(f"{motion.direction} phase [deg]")
            amplitude.set_ylim(bottom=0)
        for column, plane in enumerate(planes):
            panels[0, column].set_title(plane, fontsize=9)
            panels[3, column].set_xlabel("speed [rpm]")
        legend_above(canvas, panels[0, 0], 3)
    bars = "bars: 95 % of the measurement; upright line: measured critical speed"
    caption = f"{run.name}, {run.load:.4g} N, {run.role}: Bode plot, 0-to-peak, phase against the keyphasor; {bars}."
    return Figure(canvas, caption, f"Amplitude and phase of run {run.name} over speed, measured and by every method")


def _measured_bode(amplitude: Axes, phase: Axes, run: MeasuredRun, motion: Motion) -> None:
    speed, value = RPM * np.array(run.speed), phasor(motion)
    style = {"fmt": ".", "color": INK, "markersize": 3, "elinewidth": 0.8, "label": "measured"}
    for axes in (amplitude, phase):
        if run.critical_speed is not None:
            axes.axvline(RPM * run.critical_speed.value, color="0.5", linewidth=0.8)
    amplitude.errorbar(speed, UM * np.abs(value), yerr=UM * TWO_SIDED * np.array(motion.amplitude_error), **style)
    turned = np.degrees(np.unwrap(np.angle(value)))
    phase.errorbar(speed, turned, yerr=np.degrees(TWO_SIDED * np.array(motion.phase_error)), **style)


def _method_bode(amplitude: Axes, phase: Axes, method: RunUpMethod, run: MeasuredRun, number: int) -> None:
    told = method.prediction(run.name)
    if told is None or not told.motions:
        return
    speed, value = RPM * np.array(told.speed), phasor(told.motions[number])
    amplitude.plot(speed, UM * np.abs(value), linewidth=1.1, label=short(method), **look(method))
    turned = np.degrees(np.unwrap(np.angle(value)))
    # The measured phase decides in which turn the curve is drawn.
    first = np.degrees(np.angle(phasor(run.motions[number])[0]))
    phase.plot(speed, turned - 360 * round((turned[0] - first) / 360), linewidth=1.1, **look(method))


def best_method(result: RunUpResult) -> RunUpMethod | None:
    """The method whose curves stand beside the measurement where one must do: (d) where chi-square rejects (c), else (c), (b), (a)."""
    joint = result.method("joint")
    order = ["process", "joint"] if joint is not None and joint.verdict == "rejected" else ["joint", "process"]
    return next((one for name in [*order, "points", "amplitudes"] if (one := result.method(name)) is not None), None)


def polar_figure(result: RunUpResult, method: RunUpMethod | None) -> Figure:
    """Every output in the complex plane, the runs side by side: dots measured, lines of one method."""
    motions = result.runs[0].motions
    rows = -(-len(motions) // 2)
    with mpl.rc_context(STYLE):
        canvas, grid = panelled(rows, 2, 3.3 * rows + 0.6)
        panels = grid.reshape(-1)
        for axes in grid[-1]:
            axes.set_xlabel("real part [um]")
        for number, (axes, motion) in enumerate(zip(panels, motions, strict=False)):
            for place, run in enumerate(result.runs):
                colour = COLOURS[place % len(COLOURS)]
                value = UM * phasor(run.motions[number])
                axes.plot(value.real, value.imag, ".", color=colour, markersize=4, label=f"{run.name} measured")
                told = None if method is None else method.prediction(run.name)
                if told is not None and told.motions:
                    curve = UM * phasor(told.motions[number])
                    axes.plot(curve.real, curve.imag, "-", color=colour, linewidth=0.9, label=f"{run.name} computed")
            axes.set_aspect("equal", adjustable="datalim")
            axes.set_title(f"{motion.plane}, {motion.direction}", fontsize=9)
            axes.set_ylabel("imaginary part [um]")
        legend_above(canvas, panels[0], 5)
    lines = "" if method is None else f"; lines: {method.title}"
    return Figure(canvas, f"Polar plots of all runs, 0-to-peak; dots: measured{lines}.", "Polar plots of every plane and direction")


def orbit_figure(result: RunUpResult, method: RunUpMethod | None) -> Figure:
    """Orbits at speeds spread about the critical one: solid measured, dashed by a method; a dot where the keyphasor passes."""
    with mpl.rc_context(STYLE):
        canvas, panels = panelled(len(result.runs), ORBITS, 1.75 * len(result.runs) + 1.0)
        for row, run in enumerate(result.runs):
            for axes, place in zip(panels[row], orbit_places(run), strict=True):
                _orbit(axes, run, place, method)
            panels[row, 0].set_ylabel(f"{run.name}\ny [um]")
        for axes in panels[-1]:
            axes.set_xlabel("x [um]")
        legend_above(canvas, panels[0, 0], 3)
    dashed = "" if method is None else f"; dashed: {method.title}"
    caption = f"Orbits of 1x below, about and above the critical speed; solid: measured{dashed}; the dot marks the keyphasor's pulse."
    return Figure(canvas, caption, "Orbits of every run at four speeds, measured and by one method")


def orbit_places(run: MeasuredRun) -> list[int]:
    """Rows of a run at three quarters, one, and beyond its critical speed, and its last; spread evenly without one."""
    n, speed = len(run.speed), np.array(run.speed)
    if run.critical_speed is None:
        return [int(place) for place in np.linspace(0, n - 1, ORBITS).round()]
    wanted = [0.75 * run.critical_speed.value, run.critical_speed.value, 1.2 * run.critical_speed.value, speed[-1]]
    return [int(np.argmin(np.abs(speed - one))) for one in wanted]


def _orbit(axes: Axes, run: MeasuredRun, place: int, method: RunUpMethod | None) -> None:
    told = None if method is None else method.prediction(run.name)
    for number in range(0, len(run.motions), 2):
        colour = COLOURS[(0, 1, 2, 3)[number // 2 % 4]]
        x, y = (phasor(motion)[place] for motion in run.motions[number : number + 2])
        name = run.motions[number].plane
        _ellipse(axes, x, y, colour, "-", f"{name} measured")
        if told is not None and told.motions and run.speed[place] <= told.speed[-1] * (1 + 1e-6):
            _ellipse(axes, *(_at(told, number + n, run.speed[place]) for n in (0, 1)), colour, "--", f"{name} computed")
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_title(f"{RPM * run.speed[place]:.0f} rpm", fontsize=8)
    axes.tick_params(labelsize=7)


def _at(told: RunPrediction, number: int, speed: float) -> complex:
    motion = told.motions[number]
    return complex(np.interp(speed, told.speed, motion.real) + 1j * np.interp(speed, told.speed, motion.imag))


def _ellipse(axes: Axes, x: complex, y: complex, colour: str, line: str, name: str) -> None:
    turn = np.exp(1j * np.linspace(0, 2 * np.pi, 73))
    across, along = UM * np.real(x * turn), UM * np.real(y * turn)
    axes.plot(across, along, line, color=colour, linewidth=1, label=name)
    if line == "-":
        axes.plot(across[:1], along[:1], "o", color=colour, markersize=3, label=f"{name.split(' measured')[0]} keyphasor")


def speeds_figure(result: RunUpResult) -> Figure:
    """Critical and threshold speed over the load: measured, and by every method with its 95 % bars."""
    with mpl.rc_context(STYLE):
        canvas, panels = stacked_axes(2, 5.4, sharex=True)
        for axes, item, label in zip(panels, ("critical_speed", "threshold"), ("critical speed [rpm]", "threshold [rpm]"), strict=True):
            measured = [(run.load, getattr(run, item)) for run in result.runs]
            _speeds(axes, measured, {"color": INK, "linestyle": "", "marker": "o"}, "measured")
            for method in result.methods:
                told = [(run.load, method.prediction(run.name)) for run in result.runs]
                known = [(load, None if one is None else getattr(one, item)) for load, one in told]
                _speeds(axes, known, {**look(method), "marker": "."}, short(method))
            axes.set_ylabel(label)
        panels[0].legend(ncols=3, fontsize=8)
        panels[1].set_xlabel("static load [N]")
    held = ", ".join(f"{run.load:.4g} N" for run in result.runs if run.role == HELD_OUT)
    seen = f" No fit has seen the run at {held}." if held else ""
    caption = f"Critical speed and threshold of instability over the load: measured and by every method; bars: 95 % intervals.{seen}"
    return Figure(canvas, caption, "Critical speed and threshold over the load, measured and by every method")


def _speeds(axes: Axes, known: Sequence[tuple[float, object]], style: dict[str, object], name: str) -> None:
    points = sorted((load, one.value, one.std_error or 0.0) for load, one in known if one is not None)  # type: ignore[attr-defined]
    if not points:
        return
    load, value, error = np.array(points).T
    axes.errorbar(load, RPM * value, yerr=RPM * TWO_SIDED * error, capsize=3, markersize=5, linewidth=1, label=name, **style)


def cascade_figure(run: MeasuredRun, cascade: Cascade) -> Figure:
    """Spectra of a recording over the speed, each raised by its own; dashed: one and two times the speed."""
    frequency, speed = np.array(cascade.frequency), 60 * np.array(cascade.speed)
    amplitude = UM * np.array(cascade.amplitude)
    step = float(np.ptp(speed)) / max(len(speed) - 1, 1)
    scale = TALL * step / float(amplitude.max())
    with mpl.rc_context(STYLE):
        canvas, (axes,) = stacked_axes(1, 5.0)
        for one, row in zip(speed, amplitude, strict=True):
            axes.plot(60 * frequency, one + scale * row, color=COLOURS[0], linewidth=0.7)
        ends = np.array([speed.min(), speed.max()])
        for order in (1, 2):
            axes.plot(order * ends, ends, "--", color=COLOURS[1], linewidth=0.9, label=f"{order}x")
        axes.set_xlim(0, min(60 * frequency[-1], 3 * speed.max()))
        axes.set_xlabel("frequency [cycles/min]")
        axes.set_ylabel("speed [rpm]")
        axes.legend(ncols=2, fontsize=8, loc="lower right")
    highest = f"the highest line is {amplitude.max():.3g} um, 0-to-peak"
    caption = f"{run.name}: cascade of {cascade.label}; {highest}. Lines below 1x warn of whirl."
    return Figure(canvas, caption, f"Cascade plot of {cascade.label} in run {run.name}: spectra over the speed")
