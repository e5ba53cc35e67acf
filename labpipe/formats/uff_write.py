"""Frequency responses and recordings as universal files: a record 164 (SI), then one record 58 or 58b per function."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from labpipe.arrays import FloatArray
from labpipe.errors import DataError
from labpipe.formats.uff import COHERENCE, FRF, TIME, UffAxis, UffPoint
from labpipe.formats.uff_frf import AXES
from labpipe.formats.uff_units import FORMS, SI_UNITS
from labpipe.records.recording import Recording
from labpipe.records.response import FrequencyResponse, Port

UNITS = "    -1\n   164\n         1SI                           2\n{0:25.17E}{0:25.17E}{0:25.17E}\n{1:25.17E}\n    -1\n"
_KINDS = {"displacement": 8, "velocity": 11, "acceleration": 12, "force": 13, "pressure": 15}
_NO_AXIS, _TIME_AXIS, _FREQUENCY_AXIS = UffAxis(0, "", ""), UffAxis(17, "Time", "s"), UffAxis(18, "Frequency", "Hz")
_FORCE_AXIS = UffAxis(13, "Force", "N")
_SCALAR = UffPoint("", 0, 0)
_NAME_WIDTH = 10
_EVEN = 1e-9


def write_frf_uff(path: Path, response: FrequencyResponse, binary: bool = False) -> None:
    """Write the FRFs, and coherences if available, as `read_frf_uff` reads them; the format has no covariances."""
    kind = next((number for number, form in FORMS.items() if form == response.form), None)
    if kind is None:
        raise DataError(f"a response of the form '{response.form}' cannot be written as a universal file")
    points = _points([*response.outputs, *response.inputs])
    outputs, inputs = points[: len(response.outputs)], points[len(response.outputs) :]
    ordinate = UffAxis(kind, response.form, SI_UNITS[kind])
    with path.open("wb") as stream:
        stream.write(UNITS.format(1.0, 0.0).encode())
        for o, i in itertools.product(range(len(outputs)), range(len(inputs))):
            ends = (outputs[o], inputs[i])
            _write(stream, response.name, FRF, ends, response.frequency, response.matrix[:, o, i], (ordinate, _FORCE_AXIS), binary)
            if response.coherence is not None:
                axes = (UffAxis(0, "Coherence", ""), _NO_AXIS)
                _write(stream, response.name, COHERENCE, ends, response.frequency, response.coherence[:, o, i], axes, binary)


def write_recording_uff(path: Path, recording: Recording, binary: bool = False) -> None:
    """Write one time record per channel as `UffTable` reads it; a small time step has seven digits in the format."""
    time = np.arange(recording.n_sample) / recording.sample_rate
    points = _points([Port(channel.name, channel.name, channel.dof, channel.angle) for channel in recording.channels])
    with path.open("wb") as stream:
        stream.write(UNITS.format(1.0, 0.0).encode())
        for channel, point, samples in zip(recording.channels, points, recording.samples.T, strict=True):
            axes = (UffAxis(_KINDS.get(channel.quantity, 0), channel.quantity, channel.unit), _NO_AXIS)
            _write(stream, channel.name, TIME, (point, _SCALAR), time, samples, axes, binary)


def _points(ports: Iterable[Port]) -> list[UffPoint]:
    """Entity name, node and direction of each port; DataError for two ports with the same name."""
    all_ports = list(ports)
    places = list(dict.fromkeys(_place(port.dof)[0] for port in all_ports))
    points = {port: _point(port, places) for port in all_ports}
    for first, second in itertools.combinations(dict.fromkeys(all_ports), 2):
        if points[first] == points[second] and first.label != second.label:
            raise DataError(f"'{first.label}' and '{second.label}' have the same name in a universal file", hint="use ten letters at most")
    return [points[port] for port in all_ports]


def _place(dof: str) -> tuple[str, int]:
    """ "bearing2.y" -> ("bearing2", 2); a dof that is no axis is a scalar, 0."""
    place, _, axis = dof.rpartition(".")
    return (place, AXES.index(axis)) if axis in AXES[1:4] else (dof, 0)


def _point(port: Port, places: list[str]) -> UffPoint:
    place, direction = _place(port.dof)
    name = port.dof if port.angle is not None and not direction else port.label
    name = name if len(name) <= _NAME_WIDTH or not direction else ""
    return UffPoint(name[:_NAME_WIDTH], places.index(place) + 1, direction)


def _write(
    stream: BinaryIO,
    title: str,
    function: int,
    ends: tuple[UffPoint, UffPoint],
    abscissa: FloatArray,
    values: NDArray[np.generic],
    axes: tuple[UffAxis, UffAxis],
    binary: bool,
) -> None:
    """One record; the abscissa is stored beside the values unless it is evenly spaced as printed."""
    step = abscissa[1] - abscissa[0] if function == TIME and abscissa.size > 1 else _printed_step(abscissa)
    parts = 2 if np.iscomplexobj(values) else 1
    table = np.ascontiguousarray(values).view(np.float64).reshape(-1, parts)
    numbers = _binary(table, abscissa, step) if binary else _text(table, abscissa, step)
    head = f"    58b     1     2          11{len(numbers):12d}     0     0           0           0" if binary else "    58"
    x_axis = _TIME_AXIS if function == TIME else _FREQUENCY_AXIS
    lines = [
        "    -1",
        head,
        (title or "NONE")[:80],
        *["NONE"] * 4,
        f"{function:5d}{0:10d}{0:5d}{0:10d} {_dof(ends[0])} {_dof(ends[1])}",
        f"{2 + 2 * parts:10d}{len(table):10d}{int(step is not None):10d}{_short(abscissa[0] if step else 0)}{_short(step or 0)}{_short(0)}",
        *(_axis(axis) for axis in (x_axis, *axes, _NO_AXIS)),
    ]
    stream.write(("\n".join(lines) + "\n").encode("utf-8"))
    stream.write(numbers + (b"\n" if binary else b"") + b"    -1\n")


def _printed_step(abscissa: FloatArray) -> float | None:
    """The printed step, or None where it does not reproduce the abscissa."""
    if abscissa.size < 2:
        return None
    step = float(_short((abscissa[-1] - abscissa[0]) / (abscissa.size - 1)))
    axis = float(_short(abscissa[0])) + step * np.arange(abscissa.size)
    return step if np.max(np.abs(axis - abscissa)) <= _EVEN * np.max(np.abs(abscissa)) else None


def _dof(point: UffPoint) -> str:
    return f"{point.name or 'NONE':<10}{point.node:10d}{point.direction:4d}"


def _axis(axis: UffAxis) -> str:
    return f"{axis.kind:10d}{0:5d}{0:5d}{0:5d} {(axis.label or 'NONE')[:20]:<20} {(axis.unit or 'NONE')[:20]:<20}"


def _short(value: float) -> str:
    """A number in 13 columns with as many digits as fit beside a blank."""
    texts = (f"{float(value):.{digits}g}" for digits in range(12, 4, -1))
    return f"{next(text for text in texts if len(text) <= 12):>13}"


def _binary(table: FloatArray, abscissa: FloatArray, step: float | None) -> bytes:
    if step is not None:
        return np.ascontiguousarray(table, "<f8").tobytes()
    pairs = np.empty(len(table), np.dtype([("x", "<f4"), ("y", "<f8", (table.shape[1],))]))
    pairs["x"], pairs["y"] = abscissa, table
    return pairs.tobytes()


def _text(table: FloatArray, abscissa: FloatArray, step: float | None) -> bytes:
    if step is None:
        rows = zip(abscissa, table, strict=True)
        return "".join(_short(x) + "".join(f"{y:20.12E}" for y in row) + "\n" for x, row in rows).encode()
    numbers = [f"{y:20.12E}" for y in table.ravel()]
    return "".join("".join(numbers[n : n + 4]) + "\n" for n in range(0, len(numbers), 4)).encode()
