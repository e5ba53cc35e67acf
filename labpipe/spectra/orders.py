"""Order tracking over a run: amplitude and phase of orders, forward and backward, and cascade spectra."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import DataError
from labpipe.records.finding import Finding
from labpipe.records.recording import SampleSource
from labpipe.records.response import Port
from labpipe.records.rig import AXIS_ANGLES
from labpipe.spectra.channels import checked_blocks, columns_of
from labpipe.spectra.convert import FORWARD_BACKWARD, FROM_DIRECTIONAL, SMALLEST_ANGLE
from labpipe.spectra.ports import sensor_response
from labpipe.spectra.settings import ShaftLines
from labpipe.spectra.shaft import ShaftMotion, shaft_motion
from labpipe.spectra.synchronous import smooth_motion


@dataclass(frozen=True)
class Plane:
    """Two outputs of one plane: its *name* ("front" of front.x and front.y, empty for x and y), their
    *columns* and *angles* [rad].
    """

    name: str
    columns: tuple[int, int]
    angles: tuple[float, float]

    @property
    def directions(self) -> FloatArray:
        """Rows (cos, sin) of the two outputs, (2, 2) [1]."""
        return np.column_stack([np.cos(self.angles), np.sin(self.angles)])

    def label(self, what: str) -> str:
        """Label of a column of the plane: "front:f", or "f" for a plane without a name."""
        return f"{self.name}:{what}" if self.name else what


def planes_of(ports: Sequence[Port]) -> tuple[Plane, ...]:
    """The planes with two outputs in known, different directions, in the order of the outputs. A dof
    "bearing2.y" points at 90 deg in the plane "bearing2"; a dof without direction (z) is in no plane.
    """
    members_of: dict[str, list[tuple[int, float]]] = {}
    for column, port in enumerate(ports):
        name, _, axis = port.dof.rpartition(".") if port.angle is None else ("", "", "")
        angle = AXIS_ANGLES.get(axis) if port.angle is None else port.angle
        if angle is not None:
            members_of.setdefault(name, []).append((column, angle))
    pairs = {name: members for name, members in members_of.items() if len(members) == 2}
    planes = [
        Plane(name, (first[0], second[0]), (first[1], second[1])) for name, (first, second) in pairs.items()
    ]
    return tuple(plane for plane in planes if abs(np.linalg.det(plane.directions)) >= SMALLEST_ANGLE)


@dataclass(frozen=True, kw_only=True)
class OrderTrack:
    """One order of the outputs: x = Re X exp(j order theta), theta the shaft angle from the tacho pulse. time
    (n,) [s], speed (n,) [Hz] of the segments; amplitude (n, n_channel) complex, 0-to-peak [SI]; variance (n,
    n_channel) E|dX|^2 from the residual of the segment; ports: the columns. overall (n, n_channel): half the
    peak-to-peak value of the total motion [SI]; orbit (n, n_plane): largest distance of the total motion from
    its centre in each of `planes` [SI]. mean (n, n_channel): what does not turn [SI], of probes with their
    gap voltage where the shaft stands; of circles that in x and y. findings: on the tacho.
    """

    order: float
    time: FloatArray
    speed: FloatArray
    amplitude: ComplexArray
    variance: FloatArray
    ports: tuple[Port, ...]
    overall: FloatArray
    orbit: FloatArray
    mean: FloatArray
    planes: tuple[Plane, ...] = ()
    findings: tuple[Finding, ...] = ()


def track_order(
    source: SampleSource, lines: ShaftLines, *, order: float = 1.0, revolutions: int = 20
) -> OrderTrack:
    """The order's amplitude in segments of *revolutions*, by least squares of a constant and the harmonics,
    which change linearly in time over FEWEST_TURNS or more. *lines* gives the shaft's speed or tacho, and
    with `harmonics` the multiples fitted together with the order. With the noise variance s^2 over n samples
    E|dX|^2 = 4 s^2 / n, and more over few turns; s^2 is that of the lines beside the order where
    these show more. Delays, that of the tacho too, and
    frequency responses of the channels are taken out. DataError without a complete segment, without two
    samples for a turn of the order, or outside a channel's response. Equation (run-order).
    """
    motion = smooth_motion(shaft_motion(source, lines), source.sample_rate)
    orders = np.unique(np.append(np.arange(1.0, lines.harmonics + 1), order))
    outputs = columns_of(source.channels, "output")
    if not outputs:
        raise DataError(f"recording '{source.name}' has no response (role: output)", hint="see the rig file")
    sensors = [source.channels[number] for number in outputs]
    ports = tuple(Port(c.name, c.name, c.dof, c.angle, c.uncertainties) for c in sensors)
    planes = planes_of(ports)
    segments = []
    beside = _orders_beside(orders, order, revolutions)
    for time, angle, samples in _segments(source, motion, revolutions):
        fitted = _fit(time, angle, samples, outputs, orders, order, beside)
        segments.append((*fitted, *_total_motion(samples[:, outputs], planes)))
    if not segments:
        what = f"recording '{source.name}' is shorter than {revolutions} revolutions"
        raise DataError(what, hint="lower the number of revolutions")
    times, speed, courses, variances, mean, colour, overall, orbit = (
        np.array(column) for column in zip(*segments, strict=True)
    )
    top = order * float(speed.max())
    if top >= source.sample_rate / 2:
        raise DataError(
            f"order {order:g} of recording '{source.name}' reaches {top:.4g} Hz, beyond half its sample rate",
            hint="check speed and order",
        )
    amplitude, variance = at_middle(courses, variances * _whole_colour(colour, beside.size)[:, None])
    if motion.std_error is not None:
        turned = 2 * np.pi * order * np.interp(times, motion.times, motion.std_error)
        variance = variance + np.abs(turned[:, None] * amplitude) ** 2
    chains = np.stack([sensor_response(sensor, order * speed) for sensor in sensors], axis=1)
    late = sum(channel.delay for channel in source.channels if channel.name == lines.tacho)
    amplitude = amplitude / chains * np.exp(-2j * np.pi * order * speed * late)[:, None]
    return OrderTrack(
        order=order,
        time=times,
        speed=speed,
        amplitude=amplitude,
        variance=variance / np.abs(chains) ** 2,
        ports=ports,
        overall=overall,
        orbit=orbit,
        mean=mean,
        planes=planes,
        findings=motion.findings,
    )


def plane_track(track: OrderTrack, plane: Plane) -> OrderTrack:
    """The track of one plane as forward and backward circles, columns f and b with the plane's name: [f, b] =
    A^-1 [x, y], A = [[1, 1], [-j, j]]. The orbit is an ellipse with the half axes |f| + |b| and ||f| - |b||.
    Equation (run-circles).
    """
    to_xy = np.linalg.inv(plane.directions)
    turn = np.linalg.inv(FROM_DIRECTIONAL) @ to_xy
    columns, taken = list(plane.columns), {port.label for port in track.ports}
    # Probes may be called f and b as well.
    named = replace(plane, name=plane.name or "circle" * (not taken.isdisjoint(FORWARD_BACKWARD)))
    amplitude = track.amplitude[:, columns] @ turn.T
    return replace(
        track,
        amplitude=amplitude,
        variance=track.variance[:, columns] @ (np.abs(turn) ** 2).T,
        ports=tuple(Port(named.label(circle), circle, circle) for circle in FORWARD_BACKWARD),
        overall=np.abs(amplitude),
        orbit=track.orbit[:, [track.planes.index(plane)]],
        mean=track.mean[:, columns] @ to_xy.T,
        planes=(plane,),
    )


Segment = tuple[FloatArray, FloatArray, FloatArray]
# Of the lowest order in a segment [rad]: over fewer a change is hardly told from the phasors themselves.
FEWEST_TURNS = 2 * np.pi * 4.9


def _segments(source: SampleSource, motion: ShaftMotion, revolutions: int) -> Iterator[Segment]:
    """Times [s], angles [rad] and samples (n, n_channel) of consecutive segments of whole revolutions."""
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
    """Half the peak-to-peak value of every output, and the largest radius of every plane's orbit."""
    low, high = samples.min(axis=0), samples.max(axis=0)
    centred = samples - (low + high) / 2
    radii = [
        np.hypot(*(np.linalg.inv(plane.directions) @ centred[:, list(plane.columns)].T)) for plane in planes
    ]
    return (high - low) / 2, np.array([radius.max() for radius in radii])


def _fit(
    time: FloatArray,
    angle: FloatArray,
    samples: FloatArray,
    outputs: list[int],
    orders: FloatArray,
    order: float,
    beside: FloatArray,
) -> tuple[float, float, ComplexArray, FloatArray, FloatArray, FloatArray]:
    # Beyond half the sampling rate a harmonic is a lower order: both would share its amplitude.
    step = (angle[-1] - angle[0]) / max(time.size - 1, 1)
    orders = orders[(orders * step < np.pi) | (orders == order)]
    turns = np.exp(1j * angle[:, None] * orders)
    columns = np.column_stack([np.ones(time.size), turns.real, -turns.imag])
    n, row = columns.shape[1], 1 + int(np.searchsorted(orders, order))
    parts = [row, row + orders.size]
    middle = float(time.mean())
    place = 2 * (time - middle)[:, None] / np.ptp(time)
    own = columns[:, parts]
    columns = np.hstack(
        [columns, columns * place, *(own * place**power for power in range(2, CURVED[-1] + 1))]
    )
    sizes = [n, *(2 * (n + power - 1) for power in CURVED)]
    if (angle[-1] - angle[0]) * orders[0] < FEWEST_TURNS:
        sizes = sizes[:1]
    sizes = [sizes[0], *(size for size in sizes[1:] if time.size > 4 * size)]
    basis, triangle = np.linalg.qr(columns[:, : sizes[-1]])
    shares = basis.T @ samples[:, outputs]
    residual = samples[:, outputs] - basis @ shares
    noise = np.sum(residual**2, axis=0) / max(time.size - sizes[-1], 1)
    speed = (angle[-1] - angle[0]) / (2 * np.pi * (time[-1] - time[0]))
    # Without more samples a course stands for the next ones, too; in the middle a constant is a linear one.
    sizes = (sizes[1:] or sizes)[: len(CURVED)]
    sizes += sizes[-1:] * (len(CURVED) - len(sizes))
    inverses = [np.linalg.pinv(triangle[:size, :size]) for size in sizes]
    solutions = [inverse @ shares[:size] for inverse, size in zip(inverses, sizes, strict=True)]
    courses = np.array([solution[parts[0]] + 1j * solution[parts[1]] for solution in solutions])
    variances = np.array([np.sum(inverse[parts] ** 2) * noise for inverse in inverses])
    turned = np.exp(-1j * angle[:, None] * beside)
    expected = np.sum(np.abs(turned) ** 2) - np.sum(np.abs(basis.T @ turned) ** 2)
    colour = np.sum(np.abs(turned.T @ residual) ** 2, axis=0) / np.maximum(expected * noise, 1e-300)
    return middle, float(speed), courses, variances, solutions[0][0], colour


# Lines to either side of an order whose power is that of its noise, from the first that its change in time
# does not reach; segments over which that is averaged; standard deviations from white noise.
NEAREST, FARTHEST, TOGETHER, COLOURED = 3, 8, 21, 6.0


def _orders_beside(orders: FloatArray, order: float, revolutions: int) -> FloatArray:
    """Orders (n_line,) [1] that turn whole times in a segment, beside *order* and apart from all *orders*."""
    steps = np.arange(NEAREST, FARTHEST + 1)
    beside = order + np.concatenate([-steps[::-1], steps]) / revolutions
    apart = np.min(np.abs(beside[:, None] - np.append(orders, 0.0)), axis=1) * revolutions > NEAREST - 0.5
    return np.asarray(beside[apart])


def _whole_colour(colour: FloatArray, n_line: int) -> FloatArray:
    """Noise at the order over that of all frequencies (n_segment, n_output) [1], from the *colour* of every
    segment by *n_line* lines; 1 where it may be white. Less it does not count: the residual holds more than
    noise then, as another harmonic.
    """
    if not n_line:
        return np.ones_like(colour)
    window = np.ones(min(TOGETHER, len(colour)))
    count = np.convolve(np.ones(len(colour)), window, "same")
    smooth = np.stack([np.convolve(column, window, "same") / count for column in colour.T], axis=1)
    deviation = 1 / np.sqrt(n_line * count)[:, None]
    return np.where(np.any(smooth - 1 > COLOURED * deviation, axis=0), np.maximum(smooth, 1.0), 1.0)


# Segments to either side that tell whether a track bends, by so many standard deviations from noise alone;
# segments to either side of those where it does, too; degrees of the courses.
NEAR, BENT, FAR, CURVED = 2, 6.0, 5, (1, 3, 5)


def at_middle(courses: ComplexArray, variances: FloatArray) -> tuple[ComplexArray, FloatArray]:
    """The amplitude (n_segment, n_output) [any unit] in the middle of every segment, with its variance, from
    *courses* (n_segment, n_degree, n_output) that bend more and more: the one of least variance, what it
    misses of the last course included. Equation (run-bend).
    """
    more = variances[:, -1:] - variances
    missed = np.abs(courses - courses[:, -1:]) ** 2 - more
    number = np.arange(len(missed))
    size = min(2 * NEAR + 1, len(missed))
    near = np.clip(number - NEAR, 0, len(missed) - size)[:, None] + np.arange(size)
    missed = np.mean(missed[near], axis=1)
    bent = missed > BENT / np.sqrt(size) * more
    bent = np.stack([np.any(bent[max(at - FAR, 0) : at + FAR + 1], axis=0) for at in number])
    whole = variances + np.where(bent, np.maximum(missed, 0.0), 0.0)
    best = np.argmin(whole, axis=1)[:, None]
    return np.take_along_axis(courses, best, 1)[:, 0], np.take_along_axis(whole, best, 1)[:, 0]


MOST_BLOCKS = 40


@dataclass(frozen=True)
class CascadeSpectra:
    """speed (n_block,) [Hz], frequency (n_line,) [Hz], amplitude (n_block, n_line, n_output) 0-to-peak [SI],
    labels (n_output,).
    """

    speed: FloatArray
    frequency: FloatArray
    amplitude: FloatArray
    labels: tuple[str, ...]


def cascade_spectra(source: SampleSource, lines: ShaftLines, *, resolution: float = 1.0) -> CascadeSpectra:
    """Amplitude spectra of blocks of 1 / *resolution* [s], at most MOST_BLOCKS of them (Hann window, scaled
    to a sine's amplitude). Frequencies up to four times the highest speed. DataError when the recording
    is shorter than two blocks. Equation (spec-cascade).
    """
    length = round(source.sample_rate / resolution)
    motion = shaft_motion(source, lines)
    outputs = columns_of(source.channels, "output")
    samples = np.concatenate(list(checked_blocks(source)))[:, outputs]
    count = samples.shape[0] // length
    if count < 2:
        what = f"recording '{source.name}' is shorter than two blocks of {1 / resolution:g} s"
        raise DataError(what, hint="a cascade needs a run")
    window = np.hanning(length + 1)[:-1]
    starts = [int(start) for start in np.linspace(0, samples.shape[0] - length, min(count, MOST_BLOCKS))]
    blocks = np.stack([samples[start : start + length] for start in starts])
    centred = (blocks - blocks.mean(axis=1, keepdims=True)) * window[:, None]
    amplitude = 2 * np.abs(np.fft.rfft(centred, axis=1)) / window.sum()
    ends = [motion.angle(np.array([start, start + length]) / source.sample_rate) for start in starts]
    speed = np.array([float(np.diff(pair)[0]) for pair in ends]) * source.sample_rate / (2 * np.pi * length)
    frequency = np.arange(amplitude.shape[1]) * source.sample_rate / length
    inside = frequency <= 4 * speed.max()
    labels = tuple(source.channels[number].name for number in outputs)
    return CascadeSpectra(speed, frequency[inside], amplitude[:, inside], labels)
