"""The FRF records of a universal file as one frequency response matrix."""

from __future__ import annotations

import mmap
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import DataError
from labpipe.formats.uff import COHERENCE, FRF, UffPoint, UffRecord, open_uff, read_uff
from labpipe.formats.uff_numbers import read_numbers
from labpipe.formats.uff_units import form_of, frf_factor
from labpipe.quantities import UnitError, parse_value
from labpipe.records.response import FrequencyResponse, Port
from labpipe.records.rig import AXIS_ANGLES

AXES = ("", "x", "y", "z", "rx", "ry", "rz")
# Relative tolerance between the frequency axes of records, which are printed with six digits.
_SAME_AXIS = 1e-5
Key = tuple[str, int, int]
Numbers = TypeVar("Numbers", np.floating, np.complexfloating)


def read_frf_uff(path: Path, name: str = "") -> FrequencyResponse:
    """The FRF matrix [SI] of all records 58 of function type 4, with coherences (type 6).

    Rows and columns are the responses and references in order of appearance; a function in -X is converted to +X. DataError for a
    missing or repeated element, for different forms or frequencies, and for missing numbers.
    """
    records = read_uff(path)
    frfs = [record for record in records if record.function == FRF]
    try:
        if not frfs:
            raise DataError("holds no FRF records", hint="time records belong under recordings: in a pipeline")
        form = _one_form(frfs)
        with open_uff(path) as buffer:
            return _response(buffer, frfs, [record for record in records if record.function == COHERENCE], form, name)
    except DataError as error:
        error.where = error.where or str(path)
        raise


def _one_form(frfs: Sequence[UffRecord]) -> str:
    forms = [form_of(record) for record in frfs]
    for record, form in zip(frfs, forms, strict=True):
        if form != forms[0]:
            raise DataError(f"{record.where} is a {form}, {frfs[0].where} a {forms[0]}", hint="one file holds one form")
    return forms[0]


def _response(buffer: mmap.mmap, frfs: list[UffRecord], coherences: list[UffRecord], form: str, name: str) -> FrequencyResponse:
    frequency = _frequency(buffer, frfs[0])
    outputs = tuple(dict.fromkeys(_key(record.response) for record in frfs))
    inputs = tuple(dict.fromkeys(_key(record.reference) for record in frfs))
    several = len({node for _, node, axis in (*outputs, *inputs) if axis}) > 1
    elements = _elements(frfs)
    matrix = _cube(outputs, inputs, lambda o, i: _values(buffer, _element(elements, o, i), frequency))
    coherence_records = _elements(coherences)
    has_all = all((o, i) in coherence_records for o in outputs for i in inputs)
    coherence = _cube(outputs, inputs, lambda o, i: _numbers(buffer, coherence_records[o, i], frequency).real) if has_all else None
    return FrequencyResponse(
        frequency, matrix, _ports(outputs, several), _ports(inputs, several), form=form, coherence=coherence, name=name
    )


def _key(point: UffPoint) -> Key:
    """Point and direction, without the sign."""
    return point.name, point.node, abs(point.direction)


def _elements(records: Sequence[UffRecord]) -> dict[tuple[Key, Key], UffRecord]:
    elements: dict[tuple[Key, Key], UffRecord] = {}
    for record in records:
        pair = _key(record.response), _key(record.reference)
        if pair in elements:
            raise DataError(f"{record.where} has the same dofs as {elements[pair].where}", hint="one file holds one test")
        elements[pair] = record
    return elements


def _element(elements: dict[tuple[Key, Key], UffRecord], output: Key, reference: Key) -> UffRecord:
    if (output, reference) not in elements:
        raise DataError(f"no FRF record for response {_text(output)} and reference {_text(reference)}", hint="a full matrix is required")
    return elements[output, reference]


def _text(key: Key) -> str:
    return f"{key[0] or key[1]} {AXES[key[2]]}".strip()


def _cube(outputs: Sequence[Key], inputs: Sequence[Key], values: Callable[[Key, Key], NDArray[Numbers]]) -> NDArray[Numbers]:
    return np.stack([np.stack([values(o, i) for i in inputs], -1) for o in outputs], 1)


def _frequency(buffer: mmap.mmap, record: UffRecord) -> FloatArray:
    """The frequencies [Hz] of a record."""
    try:
        abscissa = read_numbers(buffer, record.layout)[0]
    except ValueError as error:
        raise DataError(f"{record.where}: {error}") from None
    return record.start + record.step * np.arange(record.n_value) if abscissa is None else abscissa


def _numbers(buffer: mmap.mmap, record: UffRecord, frequency: FloatArray) -> FloatArray | ComplexArray:
    """The numbers of a record; DataError unless its frequencies equal *frequency*."""
    if record.n_value != frequency.size:
        raise DataError(f"{record.where} has {record.n_value} frequencies, the first FRF record {frequency.size}")
    abscissa = _frequency(buffer, record)
    if not np.allclose(abscissa, frequency, rtol=_SAME_AXIS, atol=0):
        raise DataError(f"the frequencies of {record.where} differ from those of the first FRF record")
    return read_numbers(buffer, record.layout)[1]


def _values(buffer: mmap.mmap, record: UffRecord, frequency: FloatArray) -> ComplexArray:
    if record.layout.parts != 2:
        raise DataError(f"{record.where}: an FRF of real numbers, complex ones are required")
    sign = -1.0 if (record.response.direction < 0) != (record.reference.direction < 0) else 1.0
    return np.asarray(_numbers(buffer, record, frequency) * np.float64(sign * frf_factor(record)), np.complex128)


def _ports(keys: Sequence[Key], several: bool) -> tuple[Port, ...]:
    """Ports named by entity, else by node and direction ("x", or "3.x" with several nodes)."""
    labels = [name or _dof(node, axis, several) for name, node, axis in keys]
    if len(set(labels)) < len(labels):
        labels = [".".join(part for part in (name, str(node), AXES[axis]) if part) for name, node, axis in keys]
    return tuple(_port(label, key, several) for label, key in zip(labels, keys, strict=True))


def _dof(node: int, axis: int, several: bool) -> str:
    return (f"{node}.{AXES[axis]}" if several else AXES[axis]) if axis else str(node)


def _port(label: str, key: Key, several: bool) -> Port:
    _, node, axis = key
    if axis:
        dof = label if label.endswith(f".{AXES[axis]}") else _dof(node, axis, several)
        return Port(label, label, dof, AXIS_ANGLES.get(AXES[axis]))
    return Port(label, label, label, _angle(label))


def _angle(label: str) -> float | None:
    """The direction of a scalar point named by its angle, as written by labpipe ("45 deg")."""
    try:
        return parse_value(label, "rad")
    except UnitError:
        return None
