"""What is shown of spectra side by side: amplitude and noise of every channel, and the orbits of pairs of displacements."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.quantities import QUANTITIES
from labpipe.records.channel_spectra import ChannelSpectra
from labpipe.records.response import Port
from labpipe.report.chart import PALETTE_SIZE, Axis, Series, curve, dots, stacked
from labpipe.report.document import Block, Figure, Paragraph, Table
from labpipe.report.figures import over_frequency, scale_of
from labpipe.report.wording import unit_text
from labpipe.spectra.planes import planes_of

PANEL_HEIGHT = 1.9


def channel_blocks(spectra: ChannelSpectra) -> tuple[Block, ...]:
    """A sentence, a table of the channels, their amplitudes and noise over frequency, and orbits where a plane has two displacements."""
    name = spectra.name or "Measurement"
    low, high = spectra.frequency[[0, -1]]
    runs = ", ".join(spectra.runs)
    facts = f"{name}: spectra of {len(spectra.channels)} channels, {spectra.frequency.size} lines, {low:g}-{high:g} Hz, runs: {runs}."
    dof = "" if np.isinf(spectra.covariance_dof) else f" Their noise is known with {spectra.covariance_dof:.4g} degrees of freedom."
    return (Paragraph(facts + dof), _table(spectra), amplitude_figure(spectra), *_orbit_figures(spectra))


def noise_of(spectra: ChannelSpectra) -> FloatArray:
    """Standard deviation (n_line, n_run, n_channel) [SI units of the channels] of the complex amplitudes."""
    return np.sqrt(np.maximum(np.einsum("lrcc->lrc", spectra.covariance).real, 0.0))


def _table(spectra: ChannelSpectra) -> Table:
    noise = noise_of(spectra)
    rows = []
    for number, channel in enumerate(spectra.channels):
        factor = scale_of(channel.unit)
        rms = np.sqrt(np.sum(np.abs(spectra.vectors[:, :, number]) ** 2, axis=0) / 2).max()
        deviation = float(np.sqrt(np.mean(noise[:, :, number] ** 2)))
        size = float(np.sqrt(np.mean(np.abs(spectra.vectors[:, :, number]) ** 2)))
        ratio = f"{size / deviation:.3g}" if deviation > 0 else "-"
        of = ", ".join(term.channel for term in channel.terms)
        made = f"{channel.role}, sum of {of}" if of else channel.role
        rows.append((channel.name, made, channel.dof, f"{factor * rms:.4g}", f"{factor * deviation:.3g}", ratio, unit_text(channel.unit)))
    header = ("channel", "role", "direction", "rms", "noise of a line", "signal over noise", "unit")
    return Table(
        header, tuple(rows), f"Channels of {spectra.name or 'the measurement'}: rms over the lines of the strongest run", (3, 4, 5)
    )


def _excited(vectors: ComplexArray, noise: FloatArray) -> FloatArray:
    """Amplitudes (n_line,) above their noise, nothing elsewhere."""
    size = np.abs(vectors)
    return np.where(size > noise, size, np.nan)


def amplitude_figure(spectra: ChannelSpectra) -> Figure:
    """|z| of every channel and run as points, its noise as lines, one panel per quantity."""
    noise = noise_of(spectra)
    panels = []
    for quantity in dict.fromkeys(channel.quantity for channel in spectra.channels):
        unit = QUANTITIES[quantity].si_unit
        series = [curve for column, number in enumerate(spectra.columns(quantity)) for curve in _series(spectra, noise, number, column)]
        panels.append(over_frequency(Axis(quantity, unit_text(unit), logarithmic=True), series))
    name = spectra.name or "the measurement"
    caption = f"Amplitudes of all channels of {name} at the excited lines, every run as points, and their noise as lines."
    return Figure(stacked(tuple(panels), PANEL_HEIGHT * len(panels) + 0.6), caption, f"Amplitudes and noise of the channels of {name}")


def _series(spectra: ChannelSpectra, noise: FloatArray, number: int, column: int) -> Iterator[Series]:
    channel, colour = spectra.channels[number], column % PALETTE_SIZE
    factor = scale_of(channel.unit)
    for run in range(len(spectra.runs)):
        amplitude = _excited(spectra.vectors[:, run, number], noise[:, run, number])
        yield dots(channel.name, spectra.frequency, factor * amplitude, colour, size=2.0)
    typical = np.sqrt(np.mean(noise[:, :, number] ** 2, axis=1))
    yield curve(f"{channel.name} noise", spectra.frequency, factor * np.where(typical > 0, typical, np.nan), colour, ":", width=0.8)


def _orbit_figures(spectra: ChannelSpectra) -> Iterator[Figure]:
    """Half axes of the orbits of displacements in two directions of one plane."""
    outputs = spectra.columns("displacement", "output")
    ports = [Port(channel.name, channel.name, channel.dof, channel.angle) for channel in (spectra.channels[number] for number in outputs)]
    for plane in planes_of(ports):
        pair = [outputs[column] for column in plane.columns]
        motion = np.einsum("ij,lrj->lri", np.linalg.inv(plane.directions), spectra.vectors[:, :, pair])
        major, minor = half_axes(motion)
        factor, unit = scale_of("m"), unit_text("m")
        series = []
        for run, label in enumerate(spectra.runs):
            colour = run % PALETTE_SIZE
            series.append(dots(f"{label} major", spectra.frequency, factor * major[:, run], colour, size=2.5))
            series.append(dots(f"{label} minor", spectra.frequency, factor * minor[:, run], colour, marker="v", size=2.0))
        names = " and ".join(spectra.channels[number].name for number in pair)
        caption = f"Half axes of the orbits of {names} in every run at each line; a negative minor axis turns backward, from y to x."
        chart = stacked((over_frequency(Axis("half axis", unit), series),), 2.8)
        yield Figure(chart, caption, f"Half axes of the orbits of {names} of {spectra.name or 'the measurement'}")


def half_axes(motion: ComplexArray) -> tuple[FloatArray, FloatArray]:
    """Major and signed minor half axis (...) [m] of the ellipse Re(m e^{jwt}), *motion* (..., 2) [m] along x and y.

    With forward f = (x - j y) / 2 and backward b = (x + j y) / 2: |f| + |b| and |f| - |b|, which is negative for backward orbits.
    """
    forward, backward = np.abs(motion[..., 0] + 1j * motion[..., 1]) / 2, np.abs(motion[..., 0] - 1j * motion[..., 1]) / 2
    return forward + backward, backward - forward
