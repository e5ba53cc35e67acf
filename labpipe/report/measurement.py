"""The section on measurements: every response and all spectra with their quality and figures."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import DataError
from labpipe.quantities import QUANTITIES
from labpipe.records.identification import Identification
from labpipe.records.response import FrequencyResponse, Port
from labpipe.records.spectra import ChannelSpectra
from labpipe.report import chart, figures
from labpipe.report.document import Block, Figure, Paragraph, Section, Table
from labpipe.report.figures import (
    PHASE,
    element_names,
    form_axis,
    form_unit,
    over_frequency,
    phase_degrees,
    scale_of,
)
from labpipe.report.wording import unit_text
from labpipe.spectra.convert import FORWARD_BACKWARD, FROM_DIRECTIONAL, is_directional, two_sided_response
from labpipe.spectra.damping import HalfPower, half_power
from labpipe.spectra.orders import planes_of

PANEL_HEIGHT = 1.9
# Of an amplitude, what sums of doubles leave of numbers that repeat exactly.
ROUNDING = 1e-12


def channel_blocks(spectra: ChannelSpectra) -> tuple[Block, ...]:
    """A sentence, a table of the channels, their amplitudes and noise, and orbits of planes."""
    name = spectra.name or "Measurement"
    low, high = spectra.frequency[[0, -1]]
    runs = ", ".join(spectra.runs)
    facts = (
        f"{name}: spectra of {len(spectra.channels)} channels, {spectra.frequency.size} lines, "
        f"{low:g}-{high:g} Hz, runs: {runs}."
    )
    if np.isfinite(spectra.covariance_dof):
        facts += f" Their noise is known with {spectra.covariance_dof:.4g} degrees of freedom."
    return (Paragraph(facts), _table(spectra), amplitude_figure(spectra), *_orbit_figures(spectra))


def _of(measured: FrequencyResponse | ChannelSpectra) -> str:
    return measured.name or "the measurement"


def noise_of(spectra: ChannelSpectra) -> FloatArray:
    """Standard deviation (n_line, n_run, n_channel) [SI units of the channels] of the complex amplitudes;
    none of a channel that repeats to the rounding of its numbers, as a generator's log.
    """
    noise = np.sqrt(np.maximum(np.einsum("lrcc->lrc", spectra.covariance).real, 0.0))
    largest = np.max(np.abs(spectra.vectors), axis=(0, 1))
    return np.where(np.max(noise, axis=(0, 1)) > ROUNDING * largest, noise, 0.0)


def _table(spectra: ChannelSpectra) -> Table:
    noise = noise_of(spectra)
    rows = []
    for number, channel in enumerate(spectra.channels):
        factor, power = scale_of(channel.unit), np.abs(spectra.vectors[:, :, number]) ** 2 / 2
        rms = np.sqrt(np.sum(power, axis=0)).max()
        # Of amplitudes from 0 to peak, like them.
        deviation = float(np.sqrt(np.mean(noise[:, :, number] ** 2) / 2))
        ratio = f"{float(np.sqrt(np.mean(power))) / deviation:.3g}" if deviation > 0 else "-"
        of = ", ".join(term.channel for term in channel.terms)
        made = f"{channel.role}, sum of {of}" if of else channel.role
        sizes = f"{factor * rms:.4g}", f"{factor * deviation:.3g}", ratio
        rows.append((channel.name, made, channel.dof, *sizes, unit_text(channel.unit)))
    header = ("channel", "role", "direction", "rms", "noise of a line", "signal over noise", "unit")
    caption = f"Channels of {_of(spectra)}: rms over the lines of the strongest run, noise as rms too"
    return Table(header, tuple(rows), caption, (3, 4, 5))


def amplitude_figure(spectra: ChannelSpectra) -> Figure:
    """|z| of every channel and run as points, its noise as lines, one panel per quantity."""
    noise = noise_of(spectra)
    panels = []
    for quantity in dict.fromkeys(channel.quantity for channel in spectra.channels):
        unit = QUANTITIES[quantity].si_unit
        series = [
            row
            for column, number in enumerate(spectra.columns(quantity))
            for row in _series(spectra, noise, number, column)
        ]
        panels.append(over_frequency(chart.Axis(quantity, unit_text(unit), logarithmic=True), series))
    name = _of(spectra)
    what = "at the excited lines, every run as points, and their noise as lines"
    caption = f"Amplitudes of all channels of {name} {what}."
    graphic = chart.stack(panels, PANEL_HEIGHT * len(panels) + 0.6)
    return Figure(graphic, caption, f"Amplitudes and noise of the channels of {name}")


def _series(spectra: ChannelSpectra, noise: FloatArray, number: int, column: int) -> Iterator[chart.Series]:
    channel, colour = spectra.channels[number], column % chart.PALETTE_SIZE
    factor = scale_of(channel.unit)
    size = np.abs(spectra.vectors[:, :, number])
    for amplitude in (factor * np.where(size > noise[:, :, number], size, np.nan)).T:
        yield chart.dots(channel.name, spectra.frequency, amplitude, colour, size=2.0)
    typical = factor * _positive(np.sqrt(np.mean(noise[:, :, number] ** 2, axis=1)))
    yield chart.curve(f"{channel.name} noise", spectra.frequency, typical, colour, ":", width=0.8)


def _orbit_figures(spectra: ChannelSpectra) -> Iterator[Figure]:
    outputs = spectra.columns("displacement", "output")
    ports = [
        Port(channel.name, channel.name, channel.dof, channel.angle)
        for channel in (spectra.channels[number] for number in outputs)
    ]
    for plane in planes_of(ports):
        pair = [outputs[column] for column in plane.columns]
        motion = np.einsum("ij,lrj->lri", np.linalg.inv(plane.directions), spectra.vectors[:, :, pair])
        major, minor = half_axes(motion)
        factor, unit, x = scale_of("m"), unit_text("m"), spectra.frequency
        series = []
        for run, label in enumerate(spectra.runs):
            colour = run % chart.PALETTE_SIZE
            turned = factor * minor[:, run]
            series.append(chart.dots(f"{label} major", x, factor * major[:, run], colour, size=2.5))
            series.append(chart.dots(f"{label} minor", x, turned, colour, marker="v", size=2.0))
        names = " and ".join(spectra.channels[number].name for number in pair)
        sense = "a negative minor axis turns backward, from y to x"
        caption = f"Half axes of the orbits of {names} in every run at each line; {sense}."
        graphic = chart.stack([over_frequency(chart.Axis("half axis", unit), series)], 2.8)
        yield Figure(graphic, caption, f"Half axes of the orbits of {names} of {_of(spectra)}")


def half_axes(motion: ComplexArray) -> tuple[FloatArray, FloatArray]:
    """Major and signed minor half axis (...) [m] of the ellipse Re(m e^{jwt}), *motion* (..., 2) [m] along x
    and y.

    With forward f = (x + j y) / 2 and backward b = (x - j y) / 2: |f| + |b| and |f| - |b|, which is negative
    for backward orbits.
    """
    forward, backward = np.moveaxis(np.abs(motion @ np.linalg.inv(FROM_DIRECTIONAL).T), -1, 0)
    return forward + backward, forward - backward


TURNS = {"f": "forward", "b": "backward"}
TWO_SIDED = chart.Axis("frequency: backward < 0 < forward", "Hz")
# The arrow on an orbit lies between these of its points.
ARROW = (8, 12)


def spectral_blocks(response: FrequencyResponse) -> tuple[Block, ...]:
    """What is shown below an FRF: two sides and orbits of a directional one, loops, distortion."""
    blocks: list[Block] = []
    if is_directional(response):
        peaks = resonances(response)
        blocks += [two_sided_figure(response, peaks), *_half_power_table(response, peaks)]
        blocks += [orbit_figure(response, peaks)] if peaks else []
    if response.open_loop is not None:
        blocks.append(open_loop_figure(response, response.open_loop))
    if response.distortion is not None and response.variance is not None:
        blocks.append(distortion_figure(response))
    return tuple(blocks)


def resonances(response: FrequencyResponse) -> dict[str, HalfPower]:
    """The highest resonance of H_ff and of H_bb with its half-power points, where the response has one."""
    band = float(response.frequency[0]), float(response.frequency[-1])
    peaks = {}
    for number, label in enumerate(FORWARD_BACKWARD):
        try:
            peaks[label] = half_power(response.frequency, response.matrix[:, number, number], band)
        except DataError:
            continue
    return peaks


def two_sided_figure(response: FrequencyResponse, peaks: dict[str, HalfPower]) -> Figure:
    """H_ff and H_fb over negative (backward) and positive (forward) frequencies, half-power points marked."""
    factor = form_unit(response.form)[1]
    frequency, both = two_sided_response(response)
    # Between the two sides nothing was measured: a row of NaN interrupts the curves.
    x = np.insert(frequency, response.n_frequency, np.nan)
    sides = np.insert(both, response.n_frequency, np.nan, axis=0)
    amplitude, phase = [], []
    for column, name in enumerate(("f/f", "f/b")):
        amplitude.append(chart.curve(name, x, factor * np.abs(sides[:, column]), column))
        phase.append(chart.dots(name, x, phase_degrees(sides[:, column]), column, size=1.0))
    marks = [_mark(peak, factor, 1 if label == "f" else -1) for label, peak in peaks.items()]
    panels = (
        chart.Panel(TWO_SIDED, form_axis(response.form), (*amplitude, *marks), share=3.0),
        chart.Panel(TWO_SIDED, PHASE, tuple(phase), share=2.0),
    )
    marked = "; circles: resonance and half-power points" if peaks else ""
    name = _of(response)
    caption = (
        f"Two-sided {response.form} of {name}: forward response to forward (f/f) and backward (f/b) "
        f"force{marked}."
    )
    alternative = f"Directional {response.form} of {name} over negative and positive frequencies"
    return Figure(chart.stack(panels, 4.8), caption, alternative)


def _mark(peak: HalfPower, factor: float, sign: int) -> chart.Series:
    frequency = sign * np.array([peak.low, peak.frequency, peak.high])
    amplitude = factor * peak.amplitude * np.array([1, np.sqrt(2), 1]) / np.sqrt(2)
    return chart.dots(
        "resonance and half power", frequency, amplitude, chart.INK, marker="o", size=5.0, hollow=True
    )


def _half_power_table(response: FrequencyResponse, peaks: dict[str, HalfPower]) -> tuple[Block, ...]:
    unit, factor = form_unit(response.form)
    size = f"{response.form} [{unit}]"
    header = ("term", "resonance [Hz]", size, "half power from [Hz]", "to [Hz]", "damping ratio [%]")
    rows = tuple(
        (
            f"H_{label}{label} ({TURNS[label]})",
            f"{peak.frequency:.2f}",
            f"{factor * peak.amplitude:.4g}",
            *(f"{number:.2f}" for number in (peak.low, peak.high, 100 * peak.damping_ratio)),
        )
        for label, peak in peaks.items()
    )
    none = "No resonance with both half-power points lies in the band of the directional response."
    table = Table(header, rows, "Resonances and half-power points", (1, 2, 3, 4, 5))
    return (table if rows else Paragraph(none),)


def orbit_figure(response: FrequencyResponse, peaks: dict[str, HalfPower]) -> Figure:
    """Orbits (x, y) under a force of 1 N turning either way, at resonance and half power."""
    panels = tuple(_orbits(response, label, peak) for label, peak in peaks.items())
    name = _of(response)
    caption = (
        f"Orbits of {name} under a turning force of 1 N; the dot is where the force points along x, "
        "the arrow the sense of rotation."
    )
    graphic = chart.Chart(panels, 1, 2, (chart.WIDTH, 0.5 * chart.WIDTH))
    return Figure(graphic, caption, f"Orbits of {name} at resonance and half-power points")


def _orbits(response: FrequencyResponse, label: str, peak: HalfPower) -> chart.Panel:
    unit, factor = form_unit(response.form)
    column, series = FORWARD_BACKWARD.index(label), []
    for number, frequency in enumerate((peak.low, peak.frequency, peak.high)):
        line = int(np.argmin(np.abs(response.frequency - frequency)))
        path = factor * orbit(response.matrix[line, :, column])
        series += _orbit(path, f"{response.frequency[line]:.4g} Hz", number)
    x, y = (chart.Axis(name, unit) for name in "xy")
    return chart.Panel(x, y, tuple(series), f"force turning {TURNS[label]}", equal=True)


def orbit(amplitude: ComplexArray, n_point: int = 181) -> FloatArray:
    """x and y over one revolution, (2, n_point), from forward and backward amplitudes (2,) [m]: [x, y] = Re(A
    [f, b] e^{j theta}).
    """
    turn = np.exp(1j * np.linspace(0, 2 * np.pi, n_point))
    return ((FROM_DIRECTIONAL @ amplitude)[:, None] * turn).real


def _orbit(path: FloatArray, name: str, colour: int) -> list[chart.Series]:
    tail, head = path[:, ARROW[0]], path[:, ARROW[1]]
    first = chart.dots(name, path[0, :1], path[1, :1], colour, marker="o", size=4.0)
    return [chart.curve(name, path[0], path[1], colour, width=1.2), first, chart.arrow(tail, head, colour)]


def open_loop_figure(response: FrequencyResponse, open_loop: ComplexArray) -> Figure:
    """|H| and phase by the reference of a closed loop, and H1, *open_loop* (n_frequency, n_output, n_input)
    [unit of H], beside it.
    """
    factor = form_unit(response.form)[1]
    amplitude, phase = [], []
    for number, (o, i, name) in enumerate(element_names(response)):
        x, colour = response.frequency, number % chart.PALETTE_SIZE
        for title, line, h in ((name, "-", response.matrix), (f"{name} H1, biased", ":", open_loop)):
            amplitude.append(chart.curve(title, x, factor * np.abs(h[:, o, i]), colour, line))
            # Lines would jump from -180 to 180 deg and hide each other.
            turned = phase_degrees(h[:, o, i])
            phase.append(chart.dots(title, x, turned, colour, size=1.5, hollow=line == ":"))
    name = _of(response)
    caption = (
        f"{response.form.capitalize()} of {name} by what is injected into the loop (lines), and H1 (dotted), "
        "which takes the loop as open: a biased estimate, shown as what it is and used for nothing."
    )
    panels = (over_frequency(form_axis(response.form), amplitude, 3.0), over_frequency(PHASE, phase, 2.0))
    alternative = f"FRF by the reference and H1 of {name} over frequency"
    return Figure(chart.stack(panels, 4.8), caption, alternative)


def distortion_figure(response: FrequencyResponse) -> Figure:
    """|H| with the two parts of its standard deviation: noise, and what nonlinearity scatters."""
    assert response.distortion is not None and response.variance is not None
    factor = form_unit(response.form)[1]
    noise = np.sqrt(np.maximum(response.variance - response.distortion**2, 0.0))
    size, x = np.abs(response.matrix), response.frequency
    parts = ((size, "-", ""), (response.distortion, "--", " distortion"), (noise, ":", " noise"))
    series = [
        chart.curve(
            f"{name}{what}", x, factor * _positive(values[:, o, i]), number % chart.PALETTE_SIZE, line
        )
        for number, (o, i, name) in enumerate(element_names(response))
        for values, line, what in parts
    ]
    name = _of(response)
    caption = (
        f"{response.form.capitalize()} of {name} averaged over realisations of the phases, and the two parts "
        "of its standard deviation: distortion above noise means that the rig left its linear range."
    )
    graphic = chart.stack([over_frequency(form_axis(response.form), series)], 3.4)
    return Figure(graphic, caption, f"Distortion and noise of {name} over frequency")


def _positive(values: FloatArray) -> FloatArray:
    """Nothing where a value is zero: a logarithmic axis has no place for it."""
    return np.where(values > 0, values, np.nan)


def measurement_sections(identification: Identification) -> tuple[Section, ...]:
    """One section with all measured responses and spectra, if there are any."""
    measured = identification.responses or identification.spectra
    return (Section("Measurement", _measurement(identification)),) if measured else ()


def _measurement(identification: Identification) -> tuple[Block, ...]:
    blocks: list[Block] = []
    for response in identification.responses:
        sides = "responses x bases" if response.form == "transmissibility" else "responses x forces"
        size = f"{len(response.outputs)} x {len(response.inputs)} ({sides}), {response.n_frequency} lines"
        # One is also that of a file that states none.
        averages = f", {response.averages:.4g} effective averages" if response.averages > 1 else ""
        blocks.append(Paragraph(f"{response.name or 'Measurement'}: {response.form}, {size}{averages}."))
        blocks.append(figures.response_figure(response))
        blocks.extend(spectral_blocks(response))
    for spectra in identification.spectra:
        blocks.extend(channel_blocks(spectra))
    return tuple(blocks)
