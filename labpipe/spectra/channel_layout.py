"""Channels of several recordings side by side: which of them stand in the spectra, and how sums are made of them line by line."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import DataError
from labpipe.records.channel_spectra import UncertainFactor
from labpipe.records.recording import Channel, SampleSource
from labpipe.spectra.channel_doubts import calibration_factors
from labpipe.spectra.ports import sensor_response
from labpipe.spectra.sums import doubtful_numbers


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
        return [number for number, channel in enumerate(self.channels) if channel.role == "input"]

    def transform(self, frequency: FloatArray) -> ComplexArray:
        """T (n_line, n_channel, n_recorded) [SI] at *frequency* (n_line,) [Hz]: the vector of all channels is T times the measured one.

        Every recorded channel is divided by its sensor's response, then the sums are made. DataError outside a sensor's table.
        """
        response = np.column_stack([sensor_response(channel, frequency) for channel in self.recorded])
        return np.asarray(self.sums[None, :, :] / response[:, None, :])

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

    def picked(self, recording: int, values: ComplexArray, axes: int) -> ComplexArray:
        """*values* (..., n_channel) [any unit] of a recording, its last *axes* axes as the recorded channels; zero for an absent force."""
        columns = np.array(self.columns[recording])
        for axis in range(values.ndim - axes, values.ndim):
            values = np.take(values, np.maximum(columns, 0), axis=axis)
            shape = [1] * values.ndim
            shape[axis] = columns.size
            values = values * (columns >= 0).reshape(shape)
        return values

    def factors(self) -> tuple[UncertainFactor, ...]:
        """The numbers with a doubt in the sums and the calibrations of channels, with their effect on the vector of all channels."""
        names = [channel.name for channel in self.channels]
        factors = list(calibration_factors(self.channels, self.sums.astype(np.complex128)))
        for number, sums in doubtful_numbers(self.channels).items():
            derivative = np.zeros((len(names), len(names)))
            for channel in sums:
                for term in channel.terms:
                    slopes = dict(zip(term.numbers, term.derivatives, strict=True))
                    derivative[names.index(channel.name), names.index(term.channel)] = slopes.get(number, 0.0)
            slopes_of = derivative.astype(np.complex128)
            factors.append(UncertainFactor(number.name, number.value, number.std_error, number.unit, slopes_of, source=number.source))
        return tuple(factors)


def find_channel_layout(sources: Sequence[SampleSource]) -> ChannelLayout:
    """The channels of recordings side by side: forces, responses, and references that stand in sums; tacho and drives are left out.

    DataError for a recording without a force, or without a channel other than a force that another one has.
    """
    chosen = [_chosen(source) for source in sources]
    distinct = list(dict.fromkeys(channel for members in chosen for channel in members))
    for source, members in zip(sources, chosen, strict=True):
        lacking = [channel.name for channel in distinct if channel not in members and (channel.role != "input" or channel.terms)]
        if lacking:
            raise DataError(f"recording '{source.name}' lacks the channel {', '.join(lacking)} of another recording")
    recorded = [channel for channel in distinct if not channel.terms]
    columns = tuple(tuple(source.channels.index(sensor) if sensor in source.channels else -1 for sensor in recorded) for source in sources)
    named = _unique_names(recorded)
    return ChannelLayout(named, (*named, *(channel for channel in distinct if channel.terms)), columns)


def _chosen(source: SampleSource) -> list[Channel]:
    """Forces, responses, and what stands in a sum of these."""
    used = [channel for channel in source.channels if channel.role != "reference"]
    if not any(channel.role == "input" for channel in used):
        raise DataError(f"recording '{source.name}' has no force (role: input)", hint="see the channels of the rig file")
    members = {term.channel for channel in used for term in channel.terms}
    missing = members - {channel.name for channel in source.channels}
    if missing:
        raise DataError(f"recording '{source.name}' lacks the channel {', '.join(sorted(missing))} that stands in a sum")
    return [channel for channel in source.channels if channel.role != "reference" or channel.name in members]


def _unique_names(channels: Iterable[Channel]) -> tuple[Channel, ...]:
    """Channels under their names, or name@dof where a force moved between recordings."""
    channels = tuple(channels)
    names = [channel.name for channel in channels]
    return tuple(replace(sensor, name=f"{sensor.name}@{sensor.dof}") if names.count(sensor.name) > 1 else sensor for sensor in channels)
