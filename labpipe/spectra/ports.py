"""Inputs and outputs of several recordings: the rows and columns of their common FRF matrix."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import DataError
from labpipe.records.finding import Finding
from labpipe.records.recording import Channel, SampleSource
from labpipe.records.response import Port
from labpipe.spectra.bands import EDGE
from labpipe.spectra.convert import TRANSMISSIBILITY
from labpipe.spectra.sums import check_in_time

# Time derivatives of a motion.
ORDER_OF = {"displacement": 0, "velocity": 1, "acceleration": 2}
FORM_OF = {"displacement": "receptance", "velocity": "mobility", "acceleration": "accelerance"}


@dataclass(frozen=True)
class Layout:
    """Inputs and outputs of the common matrix, and their channels in each recording.

    *input_columns*: per recording the channel index of every input, or -1 where that force does not act.
    """

    inputs: tuple[Port, ...]
    outputs: tuple[Port, ...]
    input_columns: tuple[tuple[int, ...], ...]
    output_columns: tuple[tuple[int, ...], ...]
    form: str
    input_sensors: tuple[Channel, ...]
    output_sensors: tuple[Channel, ...]

    def sensor_factor(self, frequency: FloatArray) -> ComplexArray:
        """S_input / S_output, the factor that corrects H for the sensors, (n_line, n_output, n_input) [1], at *frequency* (n_line,) [Hz].

        Of a transmissibility also (j w)^-n, n derivatives of the response more than of the base: displacement of the one over acceleration
        of the other is motion over motion. Raises as sensor_response does. Equation (spec-sensor-frf).
        """
        responses = [[sensor_response(sensor, frequency) for sensor in sensors] for sensors in (self.output_sensors, self.input_sensors)]
        outputs, inputs = (np.array(rows, np.complex128).T for rows in responses)
        factor = inputs[:, None, :] / outputs[:, :, None]
        motion = (2j * np.pi * frequency[:, None, None]) ** -self.derivatives if self.derivatives else 1.0
        return np.asarray(factor * motion)

    @property
    def derivatives(self) -> int:
        """Time derivatives of the measured responses beyond those of the measured motion of a base; 0 for forces."""
        if self.form != TRANSMISSIBILITY:
            return 0
        return ORDER_OF[self.output_sensors[0].quantity] - ORDER_OF[self.input_sensors[0].quantity]

    def padded(self, recording: int, values: ComplexArray, axes: int) -> ComplexArray:
        """*values* (..., n_channel) [any unit], its last *axes* axes in the order inputs, outputs; zero for an absent force."""
        columns = np.array([*self.input_columns[recording], *self.output_columns[recording]])
        if np.array_equal(columns, np.arange(values.shape[-1])):
            return values
        present = columns >= 0
        for axis in range(values.ndim - axes, values.ndim):
            values = np.take(values, np.maximum(columns, 0), axis=axis)
            shape = [1] * values.ndim
            shape[axis] = columns.size
            values = values * present.reshape(shape)
        return values


def find_layout(sources: Sequence[SampleSource]) -> Layout:
    """The layout of the recordings' common matrix; DataError when a recording lacks an output or quantities differ."""
    forces = [_of_role(source, "input") for source in sources]
    responses = [_of_role(source, "output") for source in sources]
    inputs = _distinct(forces)
    outputs = _distinct(responses)
    _check_complete(sources, responses, outputs)
    return Layout(
        inputs=_ports(inputs, _sensors(forces, inputs)),
        outputs=_ports(outputs, _sensors(responses, outputs)),
        input_columns=tuple(_columns(channels, inputs) for channels in forces),
        output_columns=tuple(_columns(channels, outputs) for channels in responses),
        form=_form(forces, responses),
        input_sensors=_sensors(forces, inputs),
        output_sensors=_sensors(responses, outputs),
    )


def response_ports(sources: Sequence[SampleSource]) -> tuple[tuple[Port, ...], tuple[tuple[int, ...], ...], tuple[Channel, ...]]:
    """The responses of recordings without regard to forces: ports, the columns of each recording, channels; DataError as find_layout."""
    check_rates(sources)
    responses = [_of_role(source, "output") for source in sources]
    outputs = _distinct(responses)
    _check_complete(sources, responses, outputs)
    return (
        _ports(outputs, _sensors(responses, outputs)),
        tuple(_columns(channels, outputs) for channels in responses),
        _sensors(responses, outputs),
    )


def sensor_response(sensor: Channel, frequency: FloatArray) -> ComplexArray:
    """Sensor frequency response, indicated / true: exp(-j w delay) g(f) exp(j phi(f)), (n_line,) [1] at *frequency* (n_line,) [Hz].

    Gain g and phase phi are interpolated linearly in the channel's table. DataError for a line outside the table. Equation (spec-sensor).
    """
    response: ComplexArray = np.exp(-2j * np.pi * frequency * sensor.delay)
    if not sensor.response:
        return response
    nodes, gain, phase = np.array(sensor.response).T
    if frequency[0] < nodes[0] * (1 - EDGE) or frequency[-1] > nodes[-1] * (1 + EDGE):
        span = f"{nodes[0]:g}-{nodes[-1]:g} Hz"
        what = f"the FRF ({frequency[0]:g}-{frequency[-1]:g} Hz) leaves the table of channel '{sensor.name}' ({span})"
        raise DataError(what, hint="narrow `band`, or calibrate the sensor further")
    return response * np.interp(frequency, nodes, gain) * np.exp(1j * np.interp(frequency, nodes, np.unwrap(phase)))


Key = tuple[str, str, float | None, float, tuple[tuple[float, float, float], ...]]


def _key(channel: Channel) -> Key:
    return (channel.name, channel.dof, channel.angle, channel.delay, channel.response)


def _sensors(channels: list[list[tuple[int, Channel]]], keys: list[Key]) -> tuple[Channel, ...]:
    by_key = {_key(channel): channel for members in channels for _, channel in members}
    return tuple(by_key[key] for key in keys)


def _of_role(source: SampleSource, role: str) -> list[tuple[int, Channel]]:
    channels = [(number, channel) for number, channel in enumerate(source.channels) if channel.role == role]
    if not channels:
        what = "force (role: input)" if role == "input" else "response (role: output)"
        raise DataError(f"recording '{source.name}' has no {what}", hint="see the channels of the rig file")
    check_in_time(source, [channel for _, channel in channels])
    return channels


def _distinct(channels: list[list[tuple[int, Channel]]]) -> list[Key]:
    return list(dict.fromkeys(_key(channel) for members in channels for _, channel in members))


def _columns(channels: list[tuple[int, Channel]], keys: list[Key]) -> tuple[int, ...]:
    index = {_key(channel): number for number, channel in channels}
    return tuple(index.get(key, -1) for key in keys)


def _ports(keys: list[Key], sensors: tuple[Channel, ...]) -> tuple[Port, ...]:
    """Ports labelled by channel where that is unique, else by dof, else by both."""
    names = [key[0] for key in keys]
    dofs = [key[1] for key in keys]
    ports = []
    for (name, dof, angle, *_), sensor in zip(keys, sensors, strict=True):
        unique = name if names.count(name) == 1 else dof if dofs.count(dof) == 1 else f"{name}@{dof}"
        ports.append(Port(unique, name, dof, angle, sensor.doubts))
    return tuple(ports)


def _form(forces: list[list[tuple[int, Channel]]], responses: list[list[tuple[int, Channel]]]) -> str:
    causes = {channel.quantity for members in forces for _, channel in members}
    effects = {channel.quantity for members in responses for _, channel in members}
    if len(effects) > 1:
        hint = "keep one per FRF matrix (role: reference for the others, or a sum of channels: derived), or use frf: {result: spectra}"
        raise DataError(f"the responses are of several quantities ({', '.join(sorted(effects))})", hint=hint)
    if len(causes) == 1 and causes | effects <= ORDER_OF.keys():
        return TRANSMISSIBILITY
    return FORM_OF.get(effects.pop(), "other") if causes == {"force"} else "other"


def _check_complete(sources: Sequence[SampleSource], responses: list[list[tuple[int, Channel]]], outputs: list[Key]) -> None:
    """DataError when a recording lacks a response that another has."""
    for source, channels in zip(sources, responses, strict=True):
        missing = [key[0] for key in outputs if key not in [_key(channel) for _, channel in channels]]
        if missing:
            raise DataError(f"recording '{source.name}' lacks the response {', '.join(missing)} of another recording")


def check_rates(sources: Sequence[SampleSource]) -> None:
    """DataError for no recordings, and for recordings of different sampling rates."""
    rates = [source.sample_rate for source in sources]
    if not rates:
        raise DataError("no recordings", hint="name at least one")
    if max(rates) - min(rates) > 1e-9 * max(rates):
        named = ", ".join(f"{source.name} {source.sample_rate:g} Hz" for source in sources)
        raise DataError(f"the recordings have different sampling rates: {named}")


def source_findings(sources: Sequence[SampleSource]) -> tuple[Finding, ...]:
    """What was found in the recordings, with the name of each where there are several."""
    several = len(sources) > 1
    return tuple(
        dataclasses.replace(finding, message=f"{source.name}: {finding.message}") if several else finding
        for source in sources
        for finding in source.findings
    )
