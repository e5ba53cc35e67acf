"""Which forces and responses several recordings have together: the rows and columns of their common FRF matrix."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from labpipe.errors import DataError
from labpipe.records.recording import Channel, SampleSource
from labpipe.records.response import Port

FORM_OF = {"displacement": "receptance", "velocity": "mobility", "acceleration": "accelerance"}


@dataclass(frozen=True)
class Layout:
    """Inputs and outputs of the common matrix, and per recording where they stand among its channels.

    *input_columns*: per recording the channel index of every input, or -1 where that force does not act in it.
    """

    inputs: tuple[Port, ...]
    outputs: tuple[Port, ...]
    input_columns: tuple[tuple[int, ...], ...]
    output_columns: tuple[tuple[int, ...], ...]
    form: str
    input_delays: tuple[float, ...]
    output_delays: tuple[float, ...]

    def undelayed(self, frequency: NDArray[np.floating]) -> NDArray[np.complexfloating]:
        """exp(j w (d_output - d_input)): the factor that takes the sensors' delays [s] out of H, (n_line, n_output, n_input)."""
        difference = np.subtract.outer(np.array(self.output_delays), np.array(self.input_delays))
        return np.exp(2j * np.pi * frequency[:, None, None] * difference)

    def padded(self, recording: int, values: NDArray[np.complexfloating], axes: int) -> NDArray[np.complexfloating]:
        """The last *axes* axes of *values* reordered to inputs then outputs; zero for a force that does not act."""
        columns = np.array([*self.input_columns[recording], *self.output_columns[recording]])
        known = columns >= 0
        for axis in range(values.ndim - axes, values.ndim):
            values = np.take(values, np.maximum(columns, 0), axis=axis)
            shape = [1] * values.ndim
            shape[axis] = columns.size
            values = values * known.reshape(shape)
        return values


def find_layout(sources: Sequence[SampleSource]) -> Layout:
    """The layout of the recordings' common matrix; DataError when they do not fit together."""
    forces = [_of_role(source, "input") for source in sources]
    responses = [_of_role(source, "output") for source in sources]
    inputs = _distinct(forces)
    outputs = _distinct(responses)
    for source, own in zip(sources, responses, strict=True):
        missing = [key[0] for key in outputs if key not in [_key(channel) for _, channel in own]]
        if missing:
            raise DataError(f"recording '{source.name}' lacks the response {', '.join(missing)} that another one has")
    return Layout(
        inputs=_ports(inputs),
        outputs=_ports(outputs),
        input_columns=tuple(_columns(own, inputs) for own in forces),
        output_columns=tuple(_columns(own, outputs) for own in responses),
        form=_form(forces, responses),
        input_delays=tuple(key[3] for key in inputs),
        output_delays=tuple(key[3] for key in outputs),
    )


Key = tuple[str, str, float | None, float]


def _key(channel: Channel) -> Key:
    return (channel.name, channel.dof, channel.angle, channel.delay)


def _of_role(source: SampleSource, role: str) -> list[tuple[int, Channel]]:
    found = [(number, channel) for number, channel in enumerate(source.channels) if channel.role == role]
    if not found:
        what = "force (role: input)" if role == "input" else "response (role: output)"
        raise DataError(f"recording '{source.name}' has no {what}", hint="see the channels of the rig file")
    return found


def _distinct(channels: list[list[tuple[int, Channel]]]) -> list[Key]:
    return list(dict.fromkeys(_key(channel) for own in channels for _, channel in own))


def _columns(own: list[tuple[int, Channel]], keys: list[Key]) -> tuple[int, ...]:
    index = {_key(channel): number for number, channel in own}
    return tuple(index.get(key, -1) for key in keys)


def _ports(keys: list[Key]) -> tuple[Port, ...]:
    """Ports labelled by channel where that is unique, else by dof, else by both."""
    names = [key[0] for key in keys]
    dofs = [key[1] for key in keys]
    ports = []
    for name, dof, angle, _ in keys:
        unique = name if names.count(name) == 1 else dof if dofs.count(dof) == 1 else f"{name}@{dof}"
        ports.append(Port(unique, name, dof, angle))
    return tuple(ports)


def _form(forces: list[list[tuple[int, Channel]]], responses: list[list[tuple[int, Channel]]]) -> str:
    causes = {channel.quantity for own in forces for _, channel in own}
    effects = {channel.quantity for own in responses for _, channel in own}
    if len(effects) > 1:
        raise DataError(f"the responses are of several quantities ({', '.join(sorted(effects))})", hint="keep one per FRF matrix")
    return FORM_OF.get(effects.pop(), "other") if causes == {"force"} else "other"
