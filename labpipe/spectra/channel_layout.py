"""Which channels of several recordings stand in the spectra, how sums are made of them, and what their
uncertainties (numbers in a sum, calibrations of its members) do to an FRF, to first order.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import DataError
from labpipe.records.recording import Channel, SampleSource
from labpipe.records.response import Port, element_of
from labpipe.records.spectra import UncertainFactor
from labpipe.records.uncertain import COURSES, MatrixError, Uncertainty
from labpipe.spectra.channels import (
    DerivedRecording,
    calibration_factors,
    columns_of,
    turned_channels,
    uncertain_numbers,
)
from labpipe.spectra.ports import Layout, Parts, at_columns, sensor_response
from labpipe.spectra.settings import FrfSettings


class WithRoles(DerivedRecording):
    """The source with the named channels as its only outputs; its forces stay. Satisfies SampleSource."""

    def __init__(self, source: SampleSource, outputs: Collection[str]) -> None:
        super().__init__(source)
        self.channels = tuple(
            channel
            if channel.role == "input"
            else replace(channel, role="output" if channel.name in outputs else "reference")
            for channel in source.channels
        )

    def blocks(self, n_sample: int) -> Iterator[FloatArray]:
        """Consecutive blocks (n, n_channel) [SI] of at most *n_sample* samples."""
        return self.source.blocks(n_sample)


Estimate = Callable[[Sequence[SampleSource], FrfSettings, Layout], Parts]


@dataclass(frozen=True)
class _Effect:
    """A standard uncertainty changes the sum at a *port* by *slope* w^power times its *member*."""

    uncertainty: Uncertainty
    port: int
    member: str
    slope: complex
    power: int


def sum_errors(
    sources: Sequence[SampleSource],
    settings: FrfSettings,
    layout: Layout,
    response: tuple[FloatArray, ComplexArray],
    estimate: Estimate,
) -> tuple[MatrixError, ...]:
    """The errors of the FRF matrix by every source in its sums; none where no number in them has an
    uncertainty. response: frequency (n_line,) [Hz] and matrix (n_line, n_output, n_input) [unit of the form].
    *estimate* measures the responses of the members to the same forces, in a second pass. Raises as that
    does. Equation (unc-sum).
    """
    of_outputs, of_inputs = (
        list(_effects(sensors, sources)) for sensors in (layout.output_sensors, layout.input_sensors)
    )
    if not of_outputs and not of_inputs:
        return ()
    frequency, matrix = response
    members = list(dict.fromkeys(effect.member for effect in (*of_outputs, *of_inputs)))
    once = replace(settings, estimator="H1")
    rows, following = _member_rows(sources, once, layout, members, frequency, estimate)
    omega = 2 * np.pi * frequency
    motion = layout.motion_factor(frequency)
    parts: dict[str, ComplexArray] = {}
    uncertainties: dict[str, Uncertainty] = {}
    for effects, are_outputs in ((of_outputs, True), (of_inputs, False)):
        for effect in effects:
            source = effect.uncertainty.source
            uncertainties.setdefault(source, effect.uncertainty)
            size = effect.uncertainty.std_error * effect.slope * omega**effect.power
            size = (size / motion[:, effect.port] if are_outputs else size)[:, None, None]
            row = size * rows[effect.member][:, None, :]
            with_noise = size * following[effect.member] * matrix
            change = parts.setdefault(source, np.zeros((3, *matrix.shape), np.complex128))
            change += _parts_of_change(row, with_noise, matrix, effect.port, are_outputs)
    return tuple(
        MatrixError(uncertainties[source], change.sum(axis=0), parts=tuple(change))
        for source, change in parts.items()
    )


def _parts_of_change(
    row: ComplexArray, with_noise: ComplexArray, matrix: ComplexArray, port: int, is_output: bool
) -> ComplexArray:
    """What a *row* (n_line, 1, n_input) [1 or unit of H] more of an output, or less of a force, makes of the
    *matrix* H, (3, n_line, n_output, n_input) [unit of H]: parts that go with the powers 0, 1 and 2 of its
    elements. *with_noise* (n_line, n_output, n_input): part of the row whose noise is that of H.
    """
    parts = np.zeros((3, *matrix.shape), np.complex128)
    if is_output:
        parts[0, :, port], parts[1, :, port] = (row - with_noise)[:, port], with_noise[:, port]
        return parts
    driven = matrix[:, :, port, None]
    parts[0], parts[2] = driven * (with_noise - row), -driven * with_noise
    parts[1, :, :, port] = parts[0, :, :, port]
    parts[0, :, :, port] = 0.0
    return parts


def _effects(sensors: Sequence[Channel], sources: Sequence[SampleSource]) -> Iterator[_Effect]:
    by_name = {channel.name: channel for source in sources for channel in source.channels}
    recorded = [channel for channel in by_name.values() if not channel.terms]
    for port, sensor in enumerate(sensors):
        yield from _direction_effects(port, sensor, recorded)
        for term in sensor.terms:
            for number, slope in zip(term.numbers, term.derivatives, strict=True):
                named = number.source or f"{number.name}, {number.value:g} {number.unit}"
                uncertainty = Uncertainty(named, number.std_error, number.unit)
                yield _Effect(uncertainty, port, term.channel, complex(slope), 0)
            for calibration in by_name[term.channel].uncertainties:
                if calibration.effect in COURSES:
                    course, power = COURSES[calibration.effect]
                    yield _Effect(calibration.uncertainty, port, term.channel, term.factor * course, power)


def _direction_effects(port: int, sensor: Channel, recorded: Sequence[Channel]) -> Iterator[_Effect]:
    """What the directions of recorded channels do to a sum: a member reads some of the channel across."""
    for number, channel in enumerate(recorded):
        directions = [c.uncertainty for c in channel.uncertainties if c.effect == "direction"]
        if not sensor.terms or not directions:
            continue
        names = [other.name for other in recorded]
        changes = dict(zip(names, turned_channels(recorded, number), strict=True))
        for term in sensor.terms:
            for read, change in zip(recorded, changes.get(term.channel, ()), strict=False):
                if change:
                    yield from (
                        _Effect(uncertainty, port, read.name, complex(term.factor * change), 0)
                        for uncertainty in directions
                    )


def _member_rows(
    sources: Sequence[SampleSource],
    settings: FrfSettings,
    layout: Layout,
    members: Sequence[str],
    frequency: FloatArray,
    estimate: Estimate,
) -> tuple[dict[str, ComplexArray], dict[str, ComplexArray]]:
    """By member its response G (n_line, n_input) [unit/N], and what noise of H makes of it, cov(G_i, H_oi) /
    var H_oi (n_line, n_output, n_input) [unit of G / unit of H].
    """
    names = [sensor.name for sensor in layout.input_sensors]
    unrelated = np.zeros((frequency.size, len(layout.outputs), len(names)), np.complex128)
    unit = np.eye(len(names), dtype=np.complex128)
    rows = {
        name: np.broadcast_to(unit[names.index(name)], unrelated[:, 0].shape)
        for name in members
        if name in names
    }
    following: dict[str, ComplexArray] = dict.fromkeys(rows, unrelated)
    if len(rows) < len(members):
        measured = [sensor.name for sensor in layout.output_sensors]
        others = [name for name in members if name not in (*names, *measured)]
        measured += others
        channels = {channel.name: channel for channel in sources[0].channels}
        places = [[channel.name for channel in source.channels] for source in sources]
        of_members = replace(
            layout,
            outputs=tuple(Port(str(number), name, name) for number, name in enumerate(measured)),
            output_columns=tuple(
                (*columns, *(place.index(name) for name in others))
                for columns, place in zip(layout.output_columns, places, strict=True)
            ),
            output_sensors=(*layout.output_sensors, *(channels[name] for name in others)),
            form="other",
        )
        parts = estimate([WithRoles(source, measured) for source in sources], settings, of_members)
        factor, of_matrix = (of.sensor_factor(parts.frequency) for of in (of_members, layout))
        for name in set(members) - set(names):
            number = measured.index(name)
            rows[name] = (parts.matrix * factor)[:, number]
            slope = _following(parts, number, unrelated.shape[1])
            following[name] = slope * factor[:, None, number] / of_matrix
    return rows, following


def _following(parts: Parts, number: int, n_output: int) -> ComplexArray:
    """cov(G_i, H_oi) / var H_oi (n_line, n_output, n_input) [1] of response *number* with the first
    *n_output*; 0 where no noise is known.
    """
    n_line, _, n_input = parts.matrix.shape
    slope = np.zeros((n_line, n_output, n_input), np.complex128)
    if parts.covariance is not None:
        for o, i in np.ndindex(n_output, n_input):
            of_member, of_matrix = number * n_input + i, o * n_input + i
            variance = element_of(parts.covariance, of_matrix, of_matrix)
            shared = element_of(parts.covariance, of_member, of_matrix)
            np.divide(shared, variance, out=slope[:, o, i], where=variance != 0)
    return slope


@dataclass(frozen=True)
class ChannelLayout:
    """*recorded*: channels whose lines are measured, sums left out; *channels*: those, then the sums.
    columns: per recording the column of every recorded channel, or -1 where a force does not act in it.
    """

    recorded: tuple[Channel, ...]
    channels: tuple[Channel, ...]
    columns: tuple[tuple[int, ...], ...]

    @property
    def inputs(self) -> list[int]:
        """Numbers of the forces among the channels."""
        return columns_of(self.channels, "input")

    def transform(self, frequency: FloatArray) -> ComplexArray:
        """T (n_line, n_channel, n_recorded) [SI] at *frequency* (n_line,) [Hz]: the vector of all channels is
        T times the measured one. Every recorded channel is divided by its sensor's response, then the sums
        are made. DataError outside a sensor's table.
        """
        response = np.column_stack([sensor_response(channel, frequency) for channel in self.recorded])
        return self.sums[None, :, :] / response[:, None, :]

    @property
    def sums(self) -> FloatArray:
        """Factors (n_channel, n_recorded) [SI] of all channels in the recorded ones."""
        combined = np.zeros((len(self.channels), len(self.recorded)))
        combined[: len(self.recorded)] = np.eye(len(self.recorded))
        names = [channel.name for channel in self.recorded]
        for row, channel in enumerate(self.channels):
            for term in channel.terms:
                combined[row, names.index(term.channel)] = term.factor
        return combined

    def pick(self, recording: int, values: ComplexArray, axes: int) -> ComplexArray:
        """*values* (..., n_channel) [any unit] of a recording, its last *axes* axes as the recorded channels;
        zero for an absent force.
        """
        return at_columns(values, self.columns[recording], axes)

    def factors(self) -> tuple[UncertainFactor, ...]:
        """The numbers with an uncertainty in the sums and the calibrations of channels, with their effect on
        the vector of all channels.
        """
        names = [channel.name for channel in self.channels]
        factors = list(calibration_factors(self.channels, self.sums.astype(np.complex128)))
        for number, sums in uncertain_numbers(self.channels).items():
            derivative = np.zeros((len(names), len(names)))
            for channel in sums:
                for term in channel.terms:
                    slopes = dict(zip(term.numbers, term.derivatives, strict=True))
                    derivative[names.index(channel.name), names.index(term.channel)] = slopes.get(number, 0.0)
            slopes_of = derivative.astype(np.complex128)
            factors.append(
                UncertainFactor(
                    number.name, number.value, number.std_error, number.unit, slopes_of, source=number.source
                )
            )
        return tuple(factors)


def find_channel_layout(sources: Sequence[SampleSource]) -> ChannelLayout:
    """The channels of recordings side by side: forces, responses, and references that stand in sums; tacho
    and drives are left out. DataError for a recording without a force, or without a channel other than a
    force that another one has.
    """
    chosen = [_choose(source) for source in sources]
    distinct = list(dict.fromkeys(channel for members in chosen for channel in members))
    for source, members in zip(sources, chosen, strict=True):
        lacking = [
            channel.name
            for channel in distinct
            if channel not in members and (channel.role != "input" or channel.terms)
        ]
        if lacking:
            what = f"recording '{source.name}' lacks the channel {', '.join(lacking)} of another recording"
            raise DataError(what)
    recorded = [channel for channel in distinct if not channel.terms]
    columns = tuple(
        tuple(source.channels.index(sensor) if sensor in source.channels else -1 for sensor in recorded)
        for source in sources
    )
    names = [sensor.name for sensor in recorded]
    # A force that moved between recordings is name@dof.
    named = tuple(
        replace(sensor, name=f"{sensor.name}@{sensor.dof}") if names.count(sensor.name) > 1 else sensor
        for sensor in recorded
    )
    return ChannelLayout(named, (*named, *(channel for channel in distinct if channel.terms)), columns)


def _choose(source: SampleSource) -> list[Channel]:
    used = [channel for channel in source.channels if channel.role != "reference"]
    if not any(channel.role == "input" for channel in used):
        what = f"recording '{source.name}' has no force (role: input)"
        raise DataError(what, hint="see the channels of the rig file")
    members = {term.channel for channel in used for term in channel.terms}
    missing = members - {channel.name for channel in source.channels}
    if missing:
        raise DataError(
            f"recording '{source.name}' lacks the channel {', '.join(sorted(missing))} that stands in a sum"
        )
    return [channel for channel in source.channels if channel.role != "reference" or channel.name in members]
