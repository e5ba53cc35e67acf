"""Figures of order tracking: amplitude and phase over the speed, and the orbits."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.quantities import QUANTITIES, to_display
from labpipe.report.chart import PALETTE_SIZE, WIDTH, Axis, Chart, Panel, Series, curve, dots, level, stacked
from labpipe.report.document import Figure
from labpipe.report.figures import PHASE, phase_degrees
from labpipe.spectra.orders import OrderTrack

MOST_ORBITS = 8
MOST_COLUMNS = 4
# Room above the amplitudes for their names, and above the limit of a gap.
LEGEND_ROOM, LIMIT_ROOM = 1.3, 1.15
# Relative change below which a speed counts as constant.
STEADY = 1e-3


def _unit(quantity: str) -> tuple[str, float]:
    """(unit shown, factor from SI) of the responses; SI for mixed ones."""
    entry = QUANTITIES.get(quantity)
    return (entry.display_unit, to_display(1.0, entry.display_unit)) if entry else ("SI", 1.0)


def order_figure(name: str, track: OrderTrack, circles: Sequence[OrderTrack], quantity: str) -> Figure:
    """Amplitude with two standard deviations and phase of every response over the speed; forward and backward of every plane below.

    The whole motion stands beside the amplitudes, dashed. Over the time where the speed stays what it is.
    """
    across, along = _across(track)
    unit, factor = _unit(quantity)
    phases = [
        dots(port.label, across, phase_degrees(track.amplitude[:, n]), n % PALETTE_SIZE, size=1.5) for n, port in enumerate(track.ports)
    ]
    whole = [
        curve(f"{port.label}, whole motion", across, factor * track.overall[:, n], n % PALETTE_SIZE, "--", width=0.8)
        for n, port in enumerate(track.ports)
    ]
    amplitudes = [*_amplitudes(track, across, factor), *whole]
    panels = [Panel(along, _amplitude_axis("amplitude", unit, amplitudes), tuple(amplitudes)), Panel(along, PHASE, tuple(phases))]
    for plane in circles:
        radii = _amplitudes(plane, across, factor)
        panels.append(Panel(along, _amplitude_axis("circles", unit, radii), tuple(radii)))
    meaning = "shaded: two standard deviations; dashed: half of the whole motion's peak-to-peak value"
    caption = f"{name}: order {track.order:g}, 0-to-peak, and phase against the tacho; {meaning}."
    return Figure(stacked(panels, 2.2 * len(panels)), caption, f"Amplitude and phase of order {track.order:g} of {name}")


def _amplitudes(track: OrderTrack, across: FloatArray, factor: float) -> list[Series]:
    """The amplitude of every response with two standard deviations."""
    series = []
    for number, port in enumerate(track.ports):
        size = factor * np.abs(track.amplitude[:, number])
        spread = 2 * factor * np.sqrt(track.variance[:, number] / 2)
        band = np.maximum(size - spread, 0), size + spread
        series.append(curve(port.label, across, size, number % PALETTE_SIZE, marker=".", size=1.5, band=band, opacity=0.2))
    return series


def _amplitude_axis(title: str, unit: str, series: Sequence[Series]) -> Axis:
    """From zero to above the largest value, with room for the names."""
    return Axis(title, unit, low=0.0, high=LEGEND_ROOM * _largest(series))


def _largest(series: Sequence[Series]) -> float:
    parts = [part for entry in series for part in (entry.y, entry.high) if part is not None]
    return float(np.nanmax(np.concatenate(parts)))


def _across(track: OrderTrack) -> tuple[FloatArray, Axis]:
    """What the run is drawn over, and its axis."""
    turning = bool(np.ptp(track.speed) > STEADY * np.max(track.speed))
    return (60 * track.speed, Axis("speed", "rpm")) if turning else (track.time, Axis("time", "s"))


def gap_figure(name: str, track: OrderTrack, circles: Sequence[OrderTrack], gap: float, limit: float) -> Figure:
    """Size of the orbit in every plane as share of the gap over the speed: the whole motion and, dashed, the order's larger half axis."""
    across, along = _across(track)
    series: list[Series] = []
    for number, circle in enumerate(circles):
        (plane,) = circle.planes
        label, colour = plane.name or "orbit", number % PALETTE_SIZE
        half_axis = np.abs(circle.amplitude).sum(axis=1)
        series.append(curve(f"{label}, whole motion", across, 100 * circle.orbit[:, 0] / gap, colour, width=1.2))
        series.append(curve(f"{label}, order {track.order:g}", across, 100 * half_axis / gap, colour, "--"))
    bound = level(100 * limit, name=f"{100 * limit:g} % of the gap")
    panel = Panel(along, Axis("orbit / gap", "%", 0.0, LIMIT_ROOM * _largest([*series, bound])), (*series, bound))
    caption = f"{name}: largest distance of the shaft from the middle of its orbit, against the gap of {to_display(gap, 'um'):g} um."
    return Figure(stacked([panel], 3.2), caption, f"Orbit size of {name} against the gap")


def orbit_series_figure(name: str, circles: OrderTrack, quantity: str) -> Figure:
    """Orbits at stretches spread over the run: the sum of a forward and a backward circle; a dot where the pulse comes."""
    chosen = np.unique(np.linspace(0, circles.time.size - 1, min(MOST_ORBITS, circles.time.size)).round().astype(int))
    panels = tuple(_orbit(circles, row, *_unit(quantity)) for row in chosen.tolist())
    columns = min(MOST_COLUMNS, chosen.size)
    rows = -(-chosen.size // columns)
    (plane,) = circles.planes
    where = f" at {plane.name}" if plane.name else ""
    chart = Chart(panels, rows, columns, (WIDTH, 2.0 * rows + 0.4), "xy", "none")
    return Figure(chart, f"{name}: orbits of order {circles.order:g}{where}; the dot marks the tacho's pulse.", f"Orbits of {name}{where}")


def _orbit(circles: OrderTrack, row: int, unit: str, factor: float) -> Panel:
    """One orbit: x = Re (f + b) e, y = Re (-j f + j b) e, as one complex number f e + conj(b e)."""
    forward, backward = circles.amplitude[row]
    turn = np.exp(1j * np.linspace(0, 2 * np.pi, 181))
    path = factor * (forward * turn + np.conj(backward * turn))
    series = (curve("orbit", path.real, path.imag), dots("pulse", path.real[:1], path.imag[:1], 1, marker="o"))
    return Panel(Axis("x", unit), Axis("y", unit), series, f"{60 * circles.speed[row]:.0f} rpm", equal=True)
