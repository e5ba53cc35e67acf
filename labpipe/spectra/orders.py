"""Order tracking: amplitude and phase of an order of the shaft speed, stretch by stretch of a run, forward and backward."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import DataError
from labpipe.records.recording import SampleSource
from labpipe.records.response import Port
from labpipe.spectra.directional import FORWARD_BACKWARD, FROM_DIRECTIONAL, directions
from labpipe.spectra.planes import Plane, planes_of
from labpipe.spectra.reading import checked_blocks
from labpipe.spectra.settings import ShaftLines
from labpipe.spectra.shaft import ShaftMotion, shaft_motion


@dataclass(frozen=True)
class OrderTrack:
    """One order of the responses: x = Re X exp(j order theta), theta the shaft's angle from the tacho's pulse.

    time (n,) [s], speed (n,) [Hz] of the stretches; amplitude (n, n_channel) complex, 0-to-peak [SI]; variance (n, n_channel)
    E|dX|^2 as the rest of the stretch shows it; ports: what the columns are. overall (n, n_channel): half of the whole motion's
    peak-to-peak value in the stretch [SI]; orbit (n, n_plane): its largest distance from its middle in every plane of `planes`.
    """

    order: float
    time: FloatArray
    speed: FloatArray
    amplitude: ComplexArray
    variance: FloatArray
    ports: tuple[Port, ...]
    overall: FloatArray
    orbit: FloatArray
    planes: tuple[Plane, ...] = ()


def track_order(source: SampleSource, lines: ShaftLines, *, order: float = 1.0, revolutions: int = 20) -> OrderTrack:
    """The order's amplitude in every stretch of *revolutions*, by least squares of a constant and all harmonics up to it.

    *lines* says how the shaft turned, and by `harmonics` which multiples are fitted along, so that they do not disturb. With the
    noise's variance s^2 over n samples E|dX|^2 = 4 s^2 / n. DataError when the recording holds no whole stretch.
    """
    motion = shaft_motion(source, lines)
    orders = np.unique(np.append(np.arange(1.0, lines.harmonics + 1), order))
    outputs = [number for number, channel in enumerate(source.channels) if channel.role == "output"]
    ports = tuple(Port(c.name, c.name, c.dof, c.angle) for c in (source.channels[number] for number in outputs))
    planes = planes_of(ports)
    found = []
    for time, angle, samples in _stretches(source, motion, revolutions):
        fitted = _fitted(time, angle, samples, outputs, orders, order)
        found.append((*fitted, *_whole(samples[:, outputs], planes)))
    if not found:
        raise DataError(f"recording '{source.name}' holds no {revolutions} revolutions", hint="shorten the stretch")
    times, speed, amplitude, variance, overall, orbit = (np.array(column) for column in zip(*found, strict=True))
    return OrderTrack(order, times, speed, amplitude, variance, ports, overall, orbit, planes)


def directional_track(track: OrderTrack) -> OrderTrack:
    """The track in forward and backward circles: [f, b] = A^-1 [x, y], A = [[1, 1], [-j, j]], columns f and b.

    The orbit is an ellipse with the half axes |f| + |b| and ||f| - |b||. DataError unless two responses stand in known directions.
    """
    directions(track.ports, "responses")
    return plane_track(track, track.planes[0])


def plane_track(track: OrderTrack, plane: Plane) -> OrderTrack:
    """The track of one plane in forward and backward circles, columns f and b with the plane's name."""
    turn = np.linalg.inv(FROM_DIRECTIONAL) @ np.linalg.inv(plane.directions)
    columns = list(plane.columns)
    amplitude = track.amplitude[:, columns] @ turn.T
    variance = track.variance[:, columns] @ (np.abs(turn) ** 2).T
    ports = tuple(Port(plane.labelled(circle), circle, circle) for circle in FORWARD_BACKWARD)
    orbit = track.orbit[:, [track.planes.index(plane)]]
    return OrderTrack(track.order, track.time, track.speed, amplitude, variance, ports, np.abs(amplitude), orbit, (plane,))


Stretch = tuple[FloatArray, FloatArray, FloatArray]


def _stretches(source: SampleSource, motion: ShaftMotion, revolutions: int) -> Iterator[Stretch]:
    """Times (n,), angles (n,) and samples (n, n_channel) of stretches of whole revolutions, one after the other."""
    rest, start = np.empty((0, len(source.channels))), 0
    for block in checked_blocks(source):
        samples = np.concatenate([rest, block])
        time = (start + np.arange(samples.shape[0])) / source.sample_rate
        angle = motion.angle(time)
        number = np.floor(angle / (2 * np.pi * revolutions) + 1e-9).astype(np.int64)
        ends = np.flatnonzero(np.diff(number)) + 1
        if start == 0 and abs(angle[0]) < 1e-9:
            ends = np.append(0, ends)
        for first, last in pairwise(ends):
            yield time[first:last], angle[first:last], samples[first:last]
        # One sample before the last end is kept, so that the end is seen again.
        kept = max(int(ends[-1]) - 1, 0) if ends.size else 0
        rest, start = samples[kept:], start + kept


def _whole(samples: FloatArray, planes: tuple[Plane, ...]) -> tuple[FloatArray, FloatArray]:
    """Half of peak-to-peak of every response (n_output,), and the largest distance from the middle of every plane's orbit (n_plane,)."""
    low, high = samples.min(axis=0), samples.max(axis=0)
    centred = samples - (low + high) / 2
    radii = [np.hypot(*(np.linalg.inv(plane.directions) @ centred[:, list(plane.columns)].T)) for plane in planes]
    return (high - low) / 2, np.array([radius.max() for radius in radii])


def _fitted(
    time: FloatArray,
    angle: FloatArray,
    samples: FloatArray,
    outputs: list[int],
    orders: FloatArray,
    order: float,
) -> tuple[float, float, ComplexArray, FloatArray]:
    """Mean time [s], speed [Hz], amplitude and its variance (n_output,) of one stretch."""
    turns = np.exp(1j * angle[:, None] * orders)
    columns = np.column_stack([np.ones(time.size), turns.real, -turns.imag])
    solution, *_ = np.linalg.lstsq(columns, samples[:, outputs])
    left = samples[:, outputs] - columns @ solution
    amplitude = solution[1 : orders.size + 1] + 1j * solution[orders.size + 1 :]
    noise = np.sum(left**2, axis=0) / max(time.size - columns.shape[1], 1)
    speed = (angle[-1] - angle[0]) / (2 * np.pi * (time[-1] - time[0]))
    at = int(np.searchsorted(orders, order))
    return float(time.mean()), float(speed), amplitude[at], 4 * noise / time.size
