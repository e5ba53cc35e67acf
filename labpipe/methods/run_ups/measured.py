"""Measured run-ups: order tracks, the peak of the response, critical and threshold speeds.

Near a critical speed all outputs have one common denominator, X_o(x) = (a_o + b_o x) / (1 + c x + d x^2), x
the speed about the peak: linear least squares, reweighted with the last denominator (Sanathanan & Koerner
1963).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray, IntArray
from labpipe.errors import DataError
from labpipe.methods.run_ups import records
from labpipe.methods.run_ups.rotor import largest_displacement
from labpipe.methods.run_ups.settings import RunSettings
from labpipe.quantities import to_display
from labpipe.records.recording import Channel
from labpipe.records.uncertain import COURSES, Uncertain
from labpipe.spectra.orders import OrderTrack

POINTS = 11
FEWEST_POINTS = 7
REWEIGHTED = 4
REFITS = 64
SEED = 20260101
# Range of the peak search relative to the fitted range, and number of its speeds.
INNER = 0.95
FINE = 1601


def measured_critical_speed(run: records.RunUp, plane: str = "") -> Uncertain:
    """Speed [rad/s] of the largest displacement at a plane (the last one unless named). DataError without
    a peak with measured speeds on both sides. Equation (run-peak).
    """
    number = run.planes.index(plane) if plane else len(run.planes) - 1
    top = int(np.argmax(largest_displacement(run.response)[:, number]))
    if run.n_speed < FEWEST_POINTS or not 2 <= top < run.n_speed - 2:
        hint = f"measure {FEWEST_POINTS} speeds or more on both sides of a peak"
        raise DataError(f"run '{run.name}' has no critical speed within its speeds", hint=hint)
    size = min(POINTS, run.n_speed)
    chosen, rng = _peak_region(run, top, size), np.random.default_rng(SEED)
    wide = _peak(run, number, chosen, run.response)
    narrow = _peak(run, number, _peak_region(run, top, size - 2), run.response)
    again = [_peak(run, number, chosen, _noisy(run, rng)) for _ in range(REFITS)]
    of_probes = [
        _peak(run, number, chosen, run.response + change) - wide for change in run.changes().values()
    ]
    variance = np.std(again) ** 2 + (wide - narrow) ** 2 + np.sum(np.square(of_probes))
    return Uncertain(wide, float(np.sqrt(variance)))


def _peak_region(run: records.RunUp, top: int, size: int) -> slice:
    first = max(0, min(top - size // 2, run.n_speed - size))
    return slice(first, first + size)


def _noisy(run: records.RunUp, rng: np.random.Generator) -> ComplexArray:
    relative = run.amplitude_error / np.abs(run.response)
    shape = run.response.shape
    turned = np.exp(1j * run.phase_error * rng.standard_normal(shape))
    return run.response * (1 + relative * rng.standard_normal(shape)) * turned


def _peak(run: records.RunUp, number: int, chosen: slice, response: ComplexArray) -> float:
    speed = run.speed[chosen]
    middle, half = float(np.mean(speed[[0, -1]])), float(np.ptp(speed)) / 2
    outputs = response[chosen].reshape(speed.size, -1)
    errors = run.amplitude_error[chosen].reshape(speed.size, -1)
    place = np.linspace(-INNER, INNER, FINE)
    fitted = rational_fit((speed - middle) / half, outputs, errors, place).reshape(FINE, -1, 2)
    return middle + half * float(place[np.argmax(largest_displacement(fitted)[:, number])])


def rational_fit(x: FloatArray, outputs: ComplexArray, errors: FloatArray, place: FloatArray) -> ComplexArray:
    """Fitted outputs (n_place, n_output) at *place* (n_place,) [1] from outputs and errors (n_point,
    n_output) [any unit] at *x* (n_point,) [1].
    """
    n, m = outputs.shape
    denominator = np.ones(n, np.complex128)
    for _ in range(REWEIGHTED):
        weight = 1 / (errors * np.abs(denominator)[:, None])
        rows = np.zeros((m, n, 2 * m + 2), np.complex128)
        for number in range(m):
            rows[number, :, 2 * number] = weight[:, number]
            rows[number, :, 2 * number + 1] = weight[:, number] * x
            rows[number, :, -2] = -weight[:, number] * outputs[:, number] * x
            rows[number, :, -1] = -weight[:, number] * outputs[:, number] * x**2
        solution = np.linalg.lstsq(rows.reshape(m * n, -1), (weight * outputs).T.ravel(), rcond=None)[0]
        denominator = 1 + solution[-2] * x + solution[-1] * x**2
    top = solution[0:-2:2] + solution[1:-2:2] * place[:, None]
    return top / (1 + solution[-2] * place + solution[-1] * place**2)[:, None]


GRAM_MM = 1e6


@dataclass(frozen=True)
class ReadRun:
    settings: RunSettings
    run: records.RunUp
    cascades: tuple[records.Cascade, ...] = ()


def measured_run(read: ReadRun, plane: str) -> tuple[records.MeasuredRun, str]:
    """The run as a record, and the reason of a missing critical speed."""
    run, settings = read.run, read.settings
    critical, threshold, reason = None, None, ""
    if run.threshold is not None:
        threshold = records.UncertainAmount(run.threshold.value, run.threshold.std_error)
    if run.shaker is None:
        try:
            peak = measured_critical_speed(run, plane)
            critical = records.UncertainAmount(peak.value, peak.std_error)
        except DataError as error:
            reason = str(error)
    record = records.MeasuredRun(
        run.name,
        run.load,
        settings.role,
        excitation=excitation_text(run.unbalance, run.shaker),
        speed=column(run.speed),
        motions=motions(run.planes, run.response, run.amplitude_error, run.phase_error),
        critical_speed=critical,
        threshold=threshold,
        subtracted="" if settings.subtracted is None else settings.subtracted.name,
        printed_critical_speed=settings.printed_critical_speed,
        printed_threshold=settings.printed_threshold,
        cascades=read.cascades,
    )
    return record, reason


def excitation_text(unbalance: Mapping[str, complex], shaker: records.Shaker | None) -> str:
    if shaker is not None:
        force = f"{shaker.x:g} N in x, {shaker.y:g} N in y at {shaker.plane}"
        return f"shaker: {force}, {shaker.frequency_ratio:g} of the speed"
    parts = []
    for plane, size in unbalance.items():
        angle = to_display(float(np.angle(size)), "deg")
        parts.append(f"{plane}: {GRAM_MM * abs(size):.4g} g mm at {angle:.4g} deg")
    return "; ".join(parts)


def motions(
    planes: tuple[str, ...],
    response: ComplexArray,
    amplitude_error: FloatArray | None = None,
    phase_error: FloatArray | None = None,
) -> tuple[records.Motion, ...]:
    """Phasors (n_speed, n_plane, 2) [m] with errors [m, rad] as one record per plane and direction."""
    return tuple(
        records.Motion(
            plane,
            direction,
            column(response[:, n, d].real),
            column(response[:, n, d].imag),
            () if amplitude_error is None else column(amplitude_error[:, n, d]),
            () if phase_error is None else column(phase_error[:, n, d]),
        )
        for n, plane in enumerate(planes)
        for d, direction in enumerate(records.DIRECTIONS)
    )


def column(values: FloatArray) -> tuple[float, ...]:
    """Values (n,) [any unit], rounded to eight digits for a file."""
    return tuple(float(f"{value:.8g}") for value in np.asarray(values, np.float64).tolist())


# Relative tolerance within which two speeds count as equal.
SAME_SPEED = 1e-3


def run_up_of(
    track: OrderTrack, channels: Iterable[Channel], name: str, load: float, unbalance: Mapping[str, complex]
) -> records.RunUp:
    """The run-up of a tracked order of *channels*, x along the load; standard errors sqrt(variance / 2) of
    the amplitude, over |X| of the phase. Segments of one speed (SAME_SPEED) are averaged. DataError without a
    plane of moving displacements, or where the speed does not change.
    """
    if not track.planes:
        hint = "name dofs in the rig file, for example disc1.x and disc1.y"
        raise DataError(f"recording '{name}' has no plane with two responses in known directions", hint=hint)
    in_planes = {track.ports[column].channel for plane in track.planes for column in plane.columns}
    for channel in channels:
        if channel.name in in_planes and channel.quantity != "displacement":
            what = f"channel '{channel.name}' of recording '{name}' reads {channel.quantity}"
            raise DataError(what, hint="a run-up is of displacements: leave its direction out")
    check_moving(track, name, [column for plane in track.planes for column in plane.columns])
    phasors, deviations = [], []
    for plane in track.planes:
        turn, columns = np.linalg.inv(plane.directions), list(plane.columns)
        phasors.append(track.amplitude[:, columns] @ turn.T)
        deviations.append(np.sqrt(track.variance[:, columns] / 2 @ (turn**2).T))
    response, deviation = np.stack(phasors, axis=1), np.stack(deviations, axis=1)
    speed, response, deviation = _sort_by_speed(2 * np.pi * np.asarray(track.speed), response, deviation)
    if speed.size < 2:
        hint = "a run-up needs a speed that changes"
        raise DataError(f"recording '{name}' has a constant speed", hint=hint)
    size = np.maximum(np.abs(response), np.finfo(float).tiny)
    return records.RunUp(
        name,
        load,
        speed,
        tuple(plane.name for plane in track.planes),
        response,
        amplitude_error=deviation,
        phase_error=deviation / size,
        unbalance=dict(unbalance),
        uncertainties=tuple(_probe_errors(track)),
        findings=track.findings,
    )


def check_moving(track: OrderTrack, name: str, columns: Sequence[int]) -> None:
    """DataError for a probe, of the *columns* of a run's track, that reads nothing."""
    for column in columns:
        if np.any(still := track.amplitude[:, column] == 0):
            at = f"{60 * track.speed[np.argmax(still)]:.4g} rpm"
            what = f"probe '{track.ports[column].label}' of run '{name}' does not move at {at}"
            raise DataError(f"{what}: it has no phase there", hint="look at the probe, or leave it out")


def _probe_errors(track: OrderTrack) -> Iterator[records.ProbeError]:
    # A probe at theta + d reads d times what is across it.
    for at, plane in enumerate(track.planes):
        to_plane = np.linalg.inv(plane.directions)
        for row, column in enumerate(plane.columns):
            along = plane.directions[row]
            across = np.array([-along[1], along[0]])
            for calibration in track.ports[column].uncertainties:
                slope, power = COURSES.get(calibration.effect, (0.0, 0))
                read = -across if calibration.effect == "direction" else slope * along
                matrix = np.zeros((len(track.planes), 2, 2), np.complex128)
                matrix[at] = np.outer(to_plane[:, row], read)
                yield records.ProbeError(calibration.uncertainty, matrix, power)


def _sort_by_speed(
    speed: FloatArray, response: ComplexArray, deviation: FloatArray
) -> tuple[FloatArray, ComplexArray, FloatArray]:
    order = np.argsort(speed, kind="stable")
    group, first = np.zeros(speed.size, np.intp), speed[order[0]]
    for place, value in enumerate(speed[order]):
        new = value > first * (1 + SAME_SPEED)
        first = value if new else first
        group[place] = group[max(place - 1, 0)] + int(new)
    starts = np.flatnonzero(np.diff(group, prepend=-1))
    weight = deviation[order] ** -2.0
    total = np.add.reduceat(weight, starts)
    means = np.asarray(np.add.reduceat(weight * response[order], starts) / total, np.complex128)
    middle = np.add.reduceat(speed[order], starts) / np.diff([*starts, speed.size])
    return middle, means, total**-0.5


def difference(
    run: records.RunUp, residual: records.RunUp, baseline: records.RunUp | None = None
) -> records.RunUp:
    """*run* - *residual* at common speeds, the response to the difference of their known unbalances,
    variances resolved along and across it; *baseline*: a residual run that is read between its speeds.
    DataError where planes or loads differ, a shaker acts, or no speed is common. Equation (run-difference).
    """
    if run.planes != residual.planes:
        hint = "subtract runs of one rig"
        raise DataError(f"runs '{run.name}' and '{residual.name}' were measured at other planes", hint=hint)
    if abs(residual.load / run.load - 1) > 0.01:
        raise DataError(
            f"runs '{run.name}' and '{residual.name}' have loads of {run.load:.4g} and {residual.load:.4g} N"
        )
    if run.shaker is not None or residual.shaker is not None:
        raise DataError(f"a run under a shaker is not subtracted ('{run.name}', '{residual.name}')")
    near = np.abs(run.speed[:, None] / residual.speed - 1)
    common, partner = np.flatnonzero(near.min(axis=1) < SAME_SPEED), near.argmin(axis=1)
    if common.size == 0:
        hint = "measure them at the same speeds"
        raise DataError(f"runs '{run.name}' and '{residual.name}' share no speed", hint=hint)
    net = _vector_difference(run, residual, common, partner[common])
    return replace(net, baseline=baseline or residual)


def interpolate_run(run: records.RunUp, speed: FloatArray) -> records.RunUp:
    """A densely tracked run at those of *speed* (n,) [rad/s] within its own, linearly interpolated; DataError
    for none.
    """
    inside = speed[(speed >= run.speed[0]) & (speed <= run.speed[-1])]
    if inside.size == 0:
        raise DataError(f"run '{run.name}' does not reach the speeds of the run that it is subtracted from")
    between: dict[str, Any] = {}
    for name in ("response", "amplitude_error", "phase_error"):
        columns = getattr(run, name).reshape(run.n_speed, -1).T
        values = np.stack([np.interp(inside, run.speed, column) for column in columns], axis=-1)
        between[name] = values.reshape(-1, *run.response.shape[1:])
    return replace(run, speed=inside, **between)


def weight_effect(residual: records.RunUp, run: records.RunUp) -> records.RunUp:
    """What a recorded *run* with weights adds to its *residual* run without; DataError as `difference`."""
    weightless = replace(residual, unbalance=dict.fromkeys(run.unbalance, 0j))
    return difference(run, interpolate_run(weightless, run.speed), weightless)


def _vector_difference(
    run: records.RunUp, residual: records.RunUp, common: IntArray, partner: IntArray
) -> records.RunUp:
    first, second = run.response[common], residual.response[partner]
    net = first - second
    if np.any(net == 0):
        raise DataError(f"runs '{run.name}' and '{residual.name}' do not differ", hint="subtract another run")
    along, across = np.zeros(net.shape), np.zeros(net.shape)
    for phasor, source, chosen in ((first, run, common), (second, residual, partner)):
        radial = source.amplitude_error[chosen] ** 2
        tangential = (np.abs(phasor) * source.phase_error[chosen]) ** 2
        turn = np.angle(phasor) - np.angle(net)
        along += radial * np.cos(turn) ** 2 + tangential * np.sin(turn) ** 2
        across += radial * np.sin(turn) ** 2 + tangential * np.cos(turn) ** 2
    planes = dict.fromkeys([*run.unbalance, *residual.unbalance])
    unbalance = {plane: run.unbalance.get(plane, 0j) - residual.unbalance.get(plane, 0j) for plane in planes}
    if not any(abs(size) > 0 for size in unbalance.values()):
        hint = "state what was added in between"
        raise DataError(f"runs '{run.name}' and '{residual.name}' have the same known unbalance", hint=hint)
    return replace(
        run,
        speed=run.speed[common],
        response=net,
        unbalance=unbalance,
        amplitude_error=np.sqrt(along),
        phase_error=np.sqrt(across) / np.abs(net),
    )
