"""Order tracking: amplitude and phase of an order of the shaft speed per segment of a run, forward and backward."""

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


@dataclass(frozen=True, kw_only=True)
class OrderTrack:
    """One order of the outputs: x = Re X exp(j order theta), theta the shaft angle from the tacho pulse.

    time (n,) [s], speed (n,) [Hz] of the segments; amplitude (n, n_channel) complex, 0-to-peak [SI]; variance (n, n_channel)
    E|dX|^2 from the residual of the segment; ports: the columns. overall (n, n_channel): half the peak-to-peak value of the total
    motion [SI]; orbit (n, n_plane): largest distance of the total motion from its centre in each of `planes` [SI].
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
    """The order's amplitude in segments of *revolutions*, by least squares of a constant and the harmonics.

    *lines* gives the shaft's speed or tacho, and with `harmonics` the multiples fitted together with the order. With the noise variance
    s^2 over n samples E|dX|^2 = 4 s^2 / n. DataError when the recording holds no complete segment. Equation (run-order).
    """
    motion = shaft_motion(source, lines)
    orders = np.unique(np.append(np.arange(1.0, lines.harmonics + 1), order))
    outputs = [number for number, channel in enumerate(source.channels) if channel.role == "output"]
    ports = tuple(Port(c.name, c.name, c.dof, c.angle, c.doubts) for c in (source.channels[number] for number in outputs))
    planes = planes_of(ports)
    segments = []
    for time, angle, samples in _segments(source, motion, revolutions):
        fitted = _fitted(time, angle, samples, outputs, orders, order)
        segments.append((*fitted, *_total_motion(samples[:, outputs], planes)))
    if not segments:
        raise DataError(f"recording '{source.name}' is shorter than {revolutions} revolutions", hint="lower the number of revolutions")
    times, speed, amplitude, variance, overall, orbit = (np.array(column) for column in zip(*segments, strict=True))
    return OrderTrack(
        order=order,
        time=times,
        speed=speed,
        amplitude=amplitude,
        variance=variance,
        ports=ports,
        overall=overall,
        orbit=orbit,
        planes=planes,
    )


def directional_track(track: OrderTrack) -> OrderTrack:
    """The track as forward and backward circles: [f, b] = A^-1 [x, y], A = [[1, 1], [-j, j]], columns f and b.

    The orbit is an ellipse with the half axes |f| + |b| and ||f| - |b||. DataError unless two outputs have known directions.
    """
    directions(track.ports, "responses")
    return plane_track(track, track.planes[0])


def plane_track(track: OrderTrack, plane: Plane) -> OrderTrack:
    """The track of one plane as forward and backward circles, columns f and b with the plane's name. Equation (run-circles)."""
    turn = np.linalg.inv(FROM_DIRECTIONAL) @ np.linalg.inv(plane.directions)
    columns = list(plane.columns)
    amplitude = track.amplitude[:, columns] @ turn.T
    variance = track.variance[:, columns] @ (np.abs(turn) ** 2).T
    ports = tuple(Port(plane.labelled(circle), circle, circle) for circle in FORWARD_BACKWARD)
    orbit = track.orbit[:, [track.planes.index(plane)]]
    return OrderTrack(
        order=track.order,
        time=track.time,
        speed=track.speed,
        amplitude=amplitude,
        variance=variance,
        ports=ports,
        overall=np.abs(amplitude),
        orbit=orbit,
        planes=(plane,),
    )


Segment = tuple[FloatArray, FloatArray, FloatArray]


def _segments(source: SampleSource, motion: ShaftMotion, revolutions: int) -> Iterator[Segment]:
    """Times (n,) [s], angles (n,) [rad] and samples (n, n_channel) [SI] of consecutive segments of whole revolutions."""
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
        # The sample before the last end is kept, so that the end is detected in the next block.
        first_kept = max(int(ends[-1]) - 1, 0) if ends.size else 0
        rest, start = samples[first_kept:], start + first_kept


def _total_motion(samples: FloatArray, planes: tuple[Plane, ...]) -> tuple[FloatArray, FloatArray]:
    """Half the peak-to-peak value of every output (n_output,), and the largest radius of every plane's orbit (n_plane,)."""
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
    """Mean time [s], speed [Hz], amplitude and its variance (n_output,) of one segment."""
    turns = np.exp(1j * angle[:, None] * orders)
    columns = np.column_stack([np.ones(time.size), turns.real, -turns.imag])
    solution, *_ = np.linalg.lstsq(columns, samples[:, outputs])
    residual = samples[:, outputs] - columns @ solution
    amplitude = solution[1 : orders.size + 1] + 1j * solution[orders.size + 1 :]
    noise = np.sum(residual**2, axis=0) / max(time.size - columns.shape[1], 1)
    speed = (angle[-1] - angle[0]) / (2 * np.pi * (time[-1] - time[0]))
    row = int(np.searchsorted(orders, order))
    return float(time.mean()), float(speed), amplitude[row], 4 * noise / time.size
