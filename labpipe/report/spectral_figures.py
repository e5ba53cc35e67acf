"""What a measured response shows beyond its curves: forward and backward, resonances and orbits, distortion beside noise."""

from __future__ import annotations

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas
from numpy.typing import NDArray

from labpipe.errors import DataError
from labpipe.records.response import FrequencyResponse
from labpipe.report.document import Block, Figure, Paragraph, Table
from labpipe.report.drawing import COLOURS, STYLE
from labpipe.report.figures import WIDTH, form_unit, logarithmic, stacked_axes
from labpipe.spectra.directional import FORWARD_BACKWARD, FROM_DIRECTIONAL, two_sided
from labpipe.spectra.peaks import HalfPower, half_power

TURNS = {"f": "forward", "b": "backward"}


def spectral_blocks(response: FrequencyResponse) -> tuple[Block, ...]:
    """What is shown below the FRF itself: of a directional response its two sides and orbits; distortion where it was measured."""
    blocks: list[Block] = []
    if tuple(port.label for port in (*response.outputs, *response.inputs)) == 2 * FORWARD_BACKWARD:
        found = resonances(response)
        blocks += [two_sided_figure(response, found), *_half_power_table(response, found)]
        blocks += [orbit_figure(response, found)] if found else []
    if response.distortion is not None and response.variance is not None:
        blocks.append(distortion_figure(response))
    return tuple(blocks)


def resonances(response: FrequencyResponse) -> dict[str, HalfPower]:
    """The highest resonance of H_ff and of H_bb with its half-power points, where the response has one."""
    band = float(response.frequency[0]), float(response.frequency[-1])
    found = {}
    for number, label in enumerate(FORWARD_BACKWARD):
        try:
            found[label] = half_power(response.frequency, response.matrix[:, number, number], band)
        except DataError:
            continue
    return found


def two_sided_figure(response: FrequencyResponse, found: dict[str, HalfPower]) -> Figure:
    """H_ff and H_fb over negative (backward) and positive (forward) frequencies, half-power points marked."""
    label_of_form, factor = form_unit(response.form)
    frequency, both = two_sided(response)
    half = response.n_frequency
    with mpl.rc_context(STYLE):
        canvas, (amplitude, phase) = stacked_axes(2, 4.8, sharex=True, height_ratios=(3, 2))
        for column, name in enumerate(("f/f", "f/b")):
            for side in (slice(0, half), slice(half, None)):
                label = name if side.start == 0 else None
                amplitude.plot(frequency[side], factor * np.abs(both[side, column]), color=COLOURS[column], linewidth=1, label=label)
                phase.plot(frequency[side], np.degrees(np.angle(both[side, column])), ".", color=COLOURS[column], markersize=2)
        for label, peak in found.items():
            _mark(amplitude, peak, factor, 1 if label == "f" else -1)
        logarithmic(amplitude)
        amplitude.set_ylabel(label_of_form)
        amplitude.legend(ncols=3, fontsize=8)
        phase.set_ylabel("phase [deg]")
        phase.set_xlabel("frequency [Hz]: backward < 0 < forward")
    marked = "; circles: resonance and half-power points" if found else ""
    name = response.name or "the measurement"
    caption = f"Two-sided {response.form} of {name}: forward response to forward (f/f) and backward (f/b) force{marked}."
    return Figure(canvas, caption, f"Directional {response.form} of {name} over negative and positive frequencies")


def _mark(axes: Axes, peak: HalfPower, factor: float, sign: int) -> None:
    frequency = sign * np.array([peak.low, peak.frequency, peak.high])
    level = factor * peak.amplitude * np.array([1, np.sqrt(2), 1]) / np.sqrt(2)
    axes.plot(frequency, level, "o", color="black", markerfacecolor="none", markersize=5)


def _half_power_table(response: FrequencyResponse, found: dict[str, HalfPower]) -> tuple[Block, ...]:
    label_of_form, factor = form_unit(response.form)
    header = ("term", "resonance [Hz]", label_of_form, "half power from [Hz]", "to [Hz]", "damping ratio [%]")
    rows = tuple(
        (
            f"H_{label}{label} ({TURNS[label]})",
            f"{peak.frequency:.2f}",
            f"{factor * peak.amplitude:.4g}",
            f"{peak.low:.2f}",
            f"{peak.high:.2f}",
            f"{100 * peak.damping_ratio:.2f}",
        )
        for label, peak in found.items()
    )
    if not rows:
        return (Paragraph("No resonance with both half-power points lies in the band of the directional response."),)
    return (Table(header, rows, "Resonances and half-power points", (1, 2, 3, 4, 5)),)


def orbit_figure(response: FrequencyResponse, found: dict[str, HalfPower]) -> Figure:
    """Orbits (x, y) under a force of 1 N turning forward, and backward, at resonance and at the half-power points."""
    label_of_form, factor = form_unit(response.form)
    unit = label_of_form.partition("[")[2].rstrip("]")
    with mpl.rc_context(STYLE):
        canvas = Canvas(figsize=(WIDTH, 0.5 * WIDTH), layout="constrained")
        for place, (label, peak) in enumerate(found.items(), 1):
            axes = canvas.add_subplot(1, 2, place)
            column = FORWARD_BACKWARD.index(label)
            for number, frequency in enumerate((peak.low, peak.frequency, peak.high)):
                line = int(np.argmin(np.abs(response.frequency - frequency)))
                _orbit(axes, factor * orbit(response.matrix[line, :, column]), f"{response.frequency[line]:.4g} Hz", COLOURS[number])
            axes.set_aspect("equal", adjustable="datalim")
            axes.set_title(f"force turning {TURNS[label]}", fontsize=9)
            axes.set_xlabel(f"x [{unit}]")
            axes.set_ylabel(f"y [{unit}]")
            axes.legend(fontsize=8)
    name = response.name or "the measurement"
    caption = f"Orbits of {name} under a turning force of 1 N; the dot is where the force points along x, the arrow the sense of rotation."
    return Figure(canvas, caption, f"Orbits of {name} at resonance and half-power points")


def orbit(amplitude: NDArray[np.complexfloating], n_point: int = 181) -> NDArray[np.floating]:
    """x and y over one revolution from forward and backward amplitudes (2,), (2, n_point): [x, y] = Re(A [f, b] e^{j theta})."""
    turn = np.exp(1j * np.linspace(0, 2 * np.pi, n_point))
    return np.asarray(((FROM_DIRECTIONAL @ amplitude)[:, None] * turn).real)


def _orbit(axes: Axes, path: NDArray[np.floating], label: str, colour: str) -> None:
    axes.plot(*path, color=colour, linewidth=1.2, label=label)
    axes.plot(*path[:, 0], "o", color=colour, markersize=4)
    axes.annotate("", path[:, 12], path[:, 8], arrowprops={"arrowstyle": "-|>", "color": colour})


def distortion_figure(response: FrequencyResponse) -> Figure:
    """|H| with the two parts of its standard deviation: noise, and what nonlinearity scatters."""
    assert response.distortion is not None and response.variance is not None
    label_of_form, factor = form_unit(response.form)
    noise = np.sqrt(np.maximum(response.variance - response.distortion**2, 0.0))
    pairs = [(o, i) for o in range(len(response.outputs)) for i in range(len(response.inputs))]
    with mpl.rc_context(STYLE):
        canvas, (axes,) = stacked_axes(1, 3.4)
        for number, (o, i) in enumerate(pairs):
            colour = COLOURS[number % len(COLOURS)]
            name = f"{response.outputs[o].label}/{response.inputs[i].label}"
            axes.plot(response.frequency, factor * np.abs(response.matrix[:, o, i]), "-", color=colour, linewidth=1, label=name)
            for level, style, what in ((response.distortion, "--", "distortion"), (noise, ":", "noise")):
                axes.plot(response.frequency, factor * _shown(level[:, o, i]), style, color=colour, linewidth=1, label=f"{name} {what}")
        logarithmic(axes)
        axes.set_ylabel(label_of_form)
        axes.set_xlabel("frequency [Hz]")
        axes.legend(ncols=3, fontsize=8)
    name = response.name or "the measurement"
    caption = (
        f"{response.form} of {name} averaged over realisations of the phases, and the two parts of its standard deviation: "
        "distortion above noise means that the rig left its linear range."
    )
    return Figure(canvas, caption[0].upper() + caption[1:], f"Distortion and noise of {name} over frequency")


def _shown(level: NDArray[np.floating]) -> NDArray[np.floating]:
    """Nothing where the level is zero: a logarithmic axis has no place for it."""
    return np.where(level > 0, level, np.nan)
