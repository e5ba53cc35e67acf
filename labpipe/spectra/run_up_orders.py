"""Run-ups from order tracks, and the vector difference of two runs: the response to a known added unbalance."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray, IntArray
from labpipe.errors import DataError
from labpipe.records.doubt import COURSES
from labpipe.records.run_up import ProbeError, RunUp
from labpipe.spectra.orders import OrderTrack

# Relative tolerance within which two speeds count as equal.
SAME_SPEED = 1e-3


def run_up_of(track: OrderTrack, name: str, load: float, unbalance: Mapping[str, complex], planes: tuple[str, ...] = ()) -> RunUp:
    """The run-up of a tracked order; standard errors sqrt(variance / 2) of the amplitude, divided by |X| for the phase.

    x and y are those of the rig file; x must point along the load. *planes*: the rotor's names of the track's planes, in order.
    Segments whose speeds agree to SAME_SPEED are averaged to one point (stepped run). DataError without a plane, or where the speed
    does not change.
    """
    if not track.planes:
        hint = "name dofs in the rig file, for example disc1.x and disc1.y"
        raise DataError(f"recording '{name}' has no plane with two responses in known directions", hint=hint)
    names = planes or tuple(plane.name for plane in track.planes)
    if len(names) != len(track.planes):
        raise DataError(f"recording '{name}' has {len(track.planes)} planes, {len(names)} are named", hint=", ".join(names))
    response, deviation = _in_planes(track)
    speed, response, deviation = _by_speed(2 * np.pi * np.asarray(track.speed), response, deviation)
    if speed.size < 2:
        raise DataError(f"recording '{name}' has a constant speed", hint="a run-up needs a speed that changes")
    size = np.maximum(np.abs(response), np.finfo(float).tiny)
    return RunUp(
        name,
        load,
        speed,
        names,
        response,
        amplitude_error=deviation,
        phase_error=deviation / size,
        unbalance=dict(unbalance),
        doubts=tuple(_probe_errors(track)),
    )


def _probe_errors(track: OrderTrack) -> Iterator[ProbeError]:
    """The doubts of the probes of all planes: a probe at theta + d reads what one at theta does and d times what is across it."""
    for at, plane in enumerate(track.planes):
        to_plane = np.linalg.inv(plane.directions)
        for row, column in enumerate(plane.columns):
            along = plane.directions[row]
            across = np.array([-along[1], along[0]])
            for doubted in track.ports[column].doubts:
                slope, power = COURSES.get(doubted.effect, (0.0, 0))
                read = -across if doubted.effect == "direction" else slope * along
                matrix = np.zeros((len(track.planes), 2, 2), np.complex128)
                matrix[at] = np.outer(to_plane[:, row], read)
                yield ProbeError(doubted.doubt, matrix, power)


def _by_speed(speed: FloatArray, response: ComplexArray, deviation: FloatArray) -> tuple[FloatArray, ComplexArray, FloatArray]:
    """Segments in ascending order of speed, those of equal speed averaged with the inverse of their variances."""
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
    middle: FloatArray = np.add.reduceat(speed[order], starts) / np.diff([*starts, speed.size])
    return middle, means, np.asarray(total**-0.5)


def _in_planes(track: OrderTrack) -> tuple[ComplexArray, FloatArray]:
    """Phasors and their standard deviations (n_segment, n_plane, 2) in x and y."""
    phasors, deviations = [], []
    for plane in track.planes:
        turn, columns = np.linalg.inv(plane.directions), list(plane.columns)
        phasors.append(track.amplitude[:, columns] @ turn.T)
        deviations.append(np.sqrt(track.variance[:, columns] / 2 @ (turn**2).T))
    return np.stack(phasors, axis=1), np.stack(deviations, axis=1)


def difference(run: RunUp, residual: RunUp) -> RunUp:
    """Vector difference *run* - *residual* at common speeds: the response to the difference of their known unbalances.

    Variances are added, each resolved along and across the difference phasor. DataError where planes or loads differ, a shaker acts,
    or the runs have no common speed. Equation (run-difference).
    """
    if run.planes != residual.planes:
        raise DataError(f"runs '{run.name}' and '{residual.name}' were measured at other planes", hint="subtract runs of one rig")
    if abs(residual.load / run.load - 1) > 0.01:
        raise DataError(f"runs '{run.name}' and '{residual.name}' have loads of {run.load:.4g} and {residual.load:.4g} N")
    if run.shaker is not None or residual.shaker is not None:
        raise DataError(f"a run under a shaker is not subtracted ('{run.name}', '{residual.name}')")
    near = np.abs(run.speed[:, None] / residual.speed - 1)
    common, partner = np.flatnonzero(near.min(axis=1) < SAME_SPEED), near.argmin(axis=1)
    if common.size == 0:
        raise DataError(f"runs '{run.name}' and '{residual.name}' share no speed", hint="measure them at the same speeds")
    return _vector_difference(run, residual, common, partner[common])


def at_speeds(run: RunUp, speed: FloatArray) -> RunUp:
    """A densely tracked run at *speed* (n,) [rad/s], linearly interpolated; speeds outside its range are dropped.

    DataError when none is inside.
    """
    inside = speed[(speed >= run.speed[0]) & (speed <= run.speed[-1])]
    if inside.size == 0:
        raise DataError(f"run '{run.name}' does not reach the speeds of the run that it is subtracted from")

    def between(values: FloatArray) -> FloatArray:
        flat = values.reshape(run.n_speed, -1)
        return np.stack([np.interp(inside, run.speed, column) for column in flat.T], axis=-1).reshape(-1, *values.shape[1:])

    response = between(run.response.real) + 1j * between(run.response.imag)
    errors = between(run.amplitude_error), between(run.phase_error)
    return replace(run, speed=inside, response=response, amplitude_error=errors[0], phase_error=errors[1])


def _vector_difference(run: RunUp, residual: RunUp, common: IntArray, partner: IntArray) -> RunUp:
    first, second = run.response[common], residual.response[partner]
    net = first - second
    if np.any(net == 0):
        raise DataError(f"runs '{run.name}' and '{residual.name}' do not differ", hint="subtract another run")
    along, across = np.zeros(net.shape), np.zeros(net.shape)
    for phasor, source, chosen in ((first, run, common), (second, residual, partner)):
        radial, tangential = source.amplitude_error[chosen] ** 2, (np.abs(phasor) * source.phase_error[chosen]) ** 2
        turn = np.angle(phasor) - np.angle(net)
        along += radial * np.cos(turn) ** 2 + tangential * np.sin(turn) ** 2
        across += radial * np.sin(turn) ** 2 + tangential * np.cos(turn) ** 2
    planes = dict.fromkeys([*run.unbalance, *residual.unbalance])
    unbalance = {plane: run.unbalance.get(plane, 0j) - residual.unbalance.get(plane, 0j) for plane in planes}
    if not any(abs(size) > 0 for size in unbalance.values()):
        raise DataError(f"runs '{run.name}' and '{residual.name}' have the same known unbalance", hint="state what was added in between")
    turned: FloatArray = np.sqrt(across) / np.abs(net)
    return replace(run, speed=run.speed[common], response=net, unbalance=unbalance, amplitude_error=np.sqrt(along), phase_error=turned)
