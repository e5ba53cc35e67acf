"""Figures of order tracking: amplitude and phase over the speed, and the orbits."""

from __future__ import annotations

from collections.abc import Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure as Canvas
from numpy.typing import NDArray

from labpipe.quantities import QUANTITIES, to_display
from labpipe.report.document import Figure
from labpipe.report.drawing import COLOURS, STYLE
from labpipe.report.figures import WIDTH, stacked_axes
from labpipe.spectra.orders import OrderTrack

MOST_ORBITS = 8


def _unit(quantity: str) -> tuple[str, float]:
    """(unit shown, factor from SI) of the responses; SI for mixed ones."""
    known = QUANTITIES.get(quantity)
    return (known.display_unit, to_display(1.0, known.display_unit)) if known else ("SI", 1.0)


def order_figure(name: str, track: OrderTrack, circles: Sequence[OrderTrack], quantity: str) -> Figure:
    """Amplitude with two standard deviations and phase of every response over the speed; forward and backward of every plane below.

    The whole motion stands beside the amplitudes, dashed. Over the time where the speed stays what it is.
    """
    across, along = _across(track)
    unit, factor = _unit(quantity)
    rows = [(f"amplitude [{unit}]", track), ("phase [deg]", track), *((f"circles [{unit}]", each) for each in circles)]
    with mpl.rc_context(STYLE):
        canvas, axes = stacked_axes(len(rows), 2.2 * len(rows), sharex=True)
        for own, (label, shown) in zip(axes, rows, strict=True):
            for number, port in enumerate(shown.ports):
                x, colour = shown.amplitude[:, number], COLOURS[number]
                if label.startswith("phase"):
                    own.plot(across, np.degrees(np.angle(x)), ".", color=colour, markersize=3)
                    continue
                size, spread = factor * np.abs(x), 2 * factor * np.sqrt(shown.variance[:, number] / 2)
                own.fill_between(across, np.maximum(size - spread, 0), size + spread, color=colour, alpha=0.2, linewidth=0)
                own.plot(across, size, ".-", color=colour, linewidth=1, markersize=3, label=port.label)
                if shown is track:
                    own.plot(across, factor * track.overall[:, number], "--", color=colour, linewidth=0.8)
            own.set_ylabel(label)
            if not label.startswith("phase"):
                own.set_ylim(0, 1.25 * own.get_ylim()[1])
                own.legend(ncols=5, fontsize=8, loc="upper left")
        axes[-1].set_xlabel(along)
    meaning = "shaded: two standard deviations; dashed: half of the whole motion's peak-to-peak value"
    caption = f"{name}: order {track.order:g}, 0-to-peak, and phase against the tacho; {meaning}."
    return Figure(canvas, caption, f"Amplitude and phase of order {track.order:g} of {name}")


def _across(track: OrderTrack) -> tuple[NDArray[np.floating], str]:
    """What the run is drawn over, and its label."""
    turning = bool(np.ptp(track.speed) > 1e-3 * np.max(track.speed))
    return (60 * track.speed, "speed [rpm]") if turning else (track.time, "time [s]")


def gap_figure(name: str, track: OrderTrack, circles: Sequence[OrderTrack], gap: float, limit: float) -> Figure:
    """Size of the orbit in every plane as share of the gap over the speed: the whole motion and, dashed, the order's larger half axis."""
    across, along = _across(track)
    with mpl.rc_context(STYLE):
        canvas, (axes,) = stacked_axes(1, 3.2)
        for number, each in enumerate(circles):
            (plane,) = each.planes
            label, colour = plane.name or "orbit", COLOURS[number % len(COLOURS)]
            axes.plot(across, 100 * each.orbit[:, 0] / gap, "-", color=colour, linewidth=1.2, label=f"{label}, whole motion")
            half_axis = np.abs(each.amplitude).sum(axis=1)
            axes.plot(across, 100 * half_axis / gap, "--", color=colour, linewidth=1, label=f"{label}, order {track.order:g}")
        axes.axhline(100 * limit, color="0.4", linewidth=0.8)
        axes.text(across[-1], 100 * limit, f"{100 * limit:g} % of the gap", fontsize=8, ha="right", va="bottom", color="0.3")
        axes.set_ylim(0, 1.1 * axes.get_ylim()[1])
        axes.set_ylabel("orbit / gap [%]")
        axes.set_xlabel(along)
        axes.legend(ncols=2, fontsize=8)
    caption = f"{name}: largest distance of the shaft from the middle of its orbit, against the gap of {to_display(gap, 'um'):g} um."
    return Figure(canvas, caption, f"Orbit size of {name} against the gap")


def orbit_series_figure(name: str, circles: OrderTrack, quantity: str) -> Figure:
    """Orbits at stretches spread over the run: the sum of a forward and a backward circle; a dot where the pulse comes."""
    chosen = np.unique(np.linspace(0, circles.time.size - 1, min(MOST_ORBITS, circles.time.size)).round().astype(int))
    unit, factor = _unit(quantity)
    turn = np.exp(1j * np.linspace(0, 2 * np.pi, 181))
    with mpl.rc_context(STYLE):
        columns = min(4, chosen.size)
        rows = -(-chosen.size // columns)
        canvas = Canvas(figsize=(WIDTH, 2.0 * rows + 0.4), layout="constrained")
        panels = canvas.subplots(rows, columns, squeeze=False, sharex=True, sharey=True).reshape(-1)
        for axes, row in zip(panels, chosen, strict=False):
            forward, backward = circles.amplitude[row]
            # x = Re (f + b) e, y = Re (-j f + j b) e: as one complex number f e + conj(b e).
            path = factor * (forward * turn + np.conj(backward * turn))
            axes.plot(path.real, path.imag, color=COLOURS[0], linewidth=1)
            axes.plot(path.real[0], path.imag[0], "o", color=COLOURS[1], markersize=3)
            axes.set_aspect("equal")
            axes.set_title(f"{60 * circles.speed[row]:.0f} rpm", fontsize=8)
        for axes in panels[chosen.size :]:
            axes.set_visible(False)
        canvas.supxlabel(f"x [{unit}]", fontsize=9)
        canvas.supylabel(f"y [{unit}]", fontsize=9)
    (plane,) = circles.planes
    where = f" at {plane.name}" if plane.name else ""
    return Figure(canvas, f"{name}: orbits of order {circles.order:g}{where}; the dot marks the tacho's pulse.", f"Orbits of {name}{where}")
