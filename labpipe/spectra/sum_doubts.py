"""What the doubts of sums of channels do to an FRF: of the numbers in a sum, and of the calibration of its members.

An output y_o = sum a_m x_m changes by da x_m, and so does its row of H by da G_m, G_m = x_m / u the response of the member. A force
u_i = sum a_m x_m changes by da x_m = da G_m u, so that H changes by -H e_i da G_m. All to first order in the error.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.records.doubt import COURSES, Doubt, MatrixError
from labpipe.records.recording import Channel, SampleSource
from labpipe.records.response import Port
from labpipe.spectra.channel_doubts import turned_channels
from labpipe.spectra.parts import Parts
from labpipe.spectra.ports import Layout
from labpipe.spectra.settings import FrfSettings
from labpipe.spectra.with_roles import WithRoles

Estimate = Callable[[Sequence[SampleSource], FrfSettings, Layout], Parts]


@dataclass(frozen=True)
class _Effect:
    """An error by one standard uncertainty of *doubt* changes the sum at a port by *slope* w^power times its *member*."""

    doubt: Doubt
    port: int
    member: str
    slope: complex
    power: int


def sum_errors(
    sources: Sequence[SampleSource], settings: FrfSettings, layout: Layout, response: tuple[FloatArray, ComplexArray], estimate: Estimate
) -> tuple[MatrixError, ...]:
    """The errors of the FRF matrix by every source in its sums; none where no number in them has a doubt.

    response: frequency (n_line,) [Hz] and matrix (n_line, n_output, n_input) [unit of the form]. *estimate* measures the responses of the
    members to the same forces, in a second pass. Raises as that does. Equation (unc-sum).
    """
    of_outputs, of_inputs = (list(_effects(sensors, sources)) for sensors in (layout.output_sensors, layout.input_sensors))
    if not of_outputs and not of_inputs:
        return ()
    frequency, matrix = response
    members = list(dict.fromkeys(effect.member for effect in (*of_outputs, *of_inputs)))
    rows = _member_rows(sources, replace(settings, estimator="H1"), layout, members, frequency.size, estimate)
    omega = 2 * np.pi * frequency
    motion = (1j * omega) ** -layout.derivatives if layout.derivatives else np.ones(omega.size)
    changes: dict[str, ComplexArray] = {}
    doubts: dict[str, Doubt] = {}
    for effects, are_outputs in ((of_outputs, True), (of_inputs, False)):
        for effect in effects:
            source = effect.doubt.source
            doubts.setdefault(source, effect.doubt)
            change = changes.setdefault(source, np.zeros(matrix.shape, np.complex128))
            row = (effect.doubt.std_error * effect.slope * omega**effect.power)[:, None] * rows[effect.member]
            if are_outputs:
                change[:, effect.port, :] += row * motion[:, None]
            else:
                change -= matrix[:, :, effect.port, None] * row[:, None, :]
    return tuple(MatrixError(doubts[source], change) for source, change in changes.items())


def _effects(sensors: Sequence[Channel], sources: Sequence[SampleSource]) -> Iterator[_Effect]:
    """What the numbers and the members of the sums among the ports do to them."""
    by_name = {channel.name: channel for source in sources for channel in source.channels}
    for port, sensor in enumerate(sensors):
        yield from _of_directions(port, sensor, [recorded for recorded in by_name.values() if not recorded.terms])
        for term in sensor.terms:
            for number, slope in zip(term.numbers, term.derivatives, strict=True):
                named = number.source or f"{number.name}, {number.value:g} {number.unit}"
                yield _Effect(Doubt(named, number.std_error, number.unit), port, term.channel, complex(slope), 0)
            for doubted in by_name[term.channel].doubts:
                if doubted.effect in COURSES:
                    course, power = COURSES[doubted.effect]
                    yield _Effect(doubted.doubt, port, term.channel, term.factor * course, power)


def _of_directions(port: int, sensor: Channel, recorded: Sequence[Channel]) -> Iterator[_Effect]:
    """What the directions of recorded channels do to a sum at a port: a member reads something of the channel across it."""
    for number, channel in enumerate(recorded):
        directions = [doubted.doubt for doubted in channel.doubts if doubted.effect == "direction"]
        if not sensor.terms or not directions:
            continue
        changes = {sensor_channel.name: row for sensor_channel, row in zip(recorded, turned_channels(recorded, number), strict=True)}
        for term in sensor.terms:
            for read, change in zip(recorded, changes.get(term.channel, ()), strict=False):
                if change:
                    yield from (_Effect(doubt, port, read.name, complex(term.factor * change), 0) for doubt in directions)


def _member_rows(
    sources: Sequence[SampleSource], settings: FrfSettings, layout: Layout, members: Sequence[str], n_line: int, estimate: Estimate
) -> dict[str, ComplexArray]:
    """Response (n_line, n_input) [SI unit of the member per unit of the force] of every member; that of a force to itself is 1."""
    names = [sensor.name for sensor in layout.input_sensors]
    rows = {
        member: np.broadcast_to(np.eye(len(names), dtype=np.complex128)[names.index(member)], (n_line, len(names)))
        for member in members
        if member in names
    }
    others = tuple(member for member in members if member not in names)
    if others:
        places = [[channel.name for channel in source.channels] for source in sources]
        sensors = tuple(sources[0].channels[places[0].index(member)] for member in others)
        of_members = replace(
            layout,
            outputs=tuple(Port(member, member, member) for member in others),
            output_columns=tuple(tuple(names_here.index(member) for member in others) for names_here in places),
            output_sensors=sensors,
            form="other",
        )
        parts = estimate([WithRoles(source, others) for source in sources], settings, of_members)
        matrix = parts.matrix * of_members.sensor_factor(parts.frequency)
        rows |= {member: matrix[:, number] for number, member in enumerate(others)}
    return rows
