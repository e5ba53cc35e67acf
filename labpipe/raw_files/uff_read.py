"""What universal files hold in SI units: the FRF records as one matrix, the time records as a table of
channels.

Units follow from the 164 record, else from the unit labels of a record, else numbers are taken as they are.
"""

from __future__ import annotations

import mmap
import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import DataError, locate_errors
from labpipe.quantities import UnitError, parse_unit, parse_value, unit_of
from labpipe.raw_files import uff
from labpipe.raw_files.frf_csv import checked_coherence, cube
from labpipe.raw_files.table import unique
from labpipe.records.response import FORMS as RESPONSE_FORMS, FrequencyResponse, Port
from labpipe.records.rig import AXIS_ANGLES

# Specific data types of a record's axes -> SI unit.
SI_UNITS = {8: "m", 11: "m/s", 12: "m/s^2", 9: "N", 13: "N"}
FORMS = {8: "receptance", 11: "mobility", 12: "accelerance"}
_FORCES = (9, 13)
# Data types that leave open what was measured: unknown, general.
_OPEN = (0, 1)
_SAME = 1e-4
AXES = ("", *uff.AXES)
# Relative tolerance between the frequency axes of records, which are printed with six digits.
_SAME_AXIS = 1e-5
Key = tuple[str, int, int]
CHUNK_ROWS = 1 << 17
# The time step is printed with six digits: rates are rounded to a whole number of hertz within this relative
# tolerance.
_STEP_DIGITS = 1e-5


Stated = tuple[str, float | None]


def read_frf_uff(
    path: Path, name: str = "", stated: Stated | None = None, numbered: bool = False
) -> FrequencyResponse:
    """The FRF matrix [SI] of all records 58 of function type 4, with coherences (type 6), rows and columns in
    order of appearance; -X is converted to +X. *stated*: form and SI value per value of the file, for records
    that leave their axes open (type 0); without a factor their labels count, else SI. *numbered*: dofs have
    the numbers of their points also where all are at one. DataError for a missing or repeated element,
    different forms or frequencies, and missing numbers.
    """
    records = uff.read_uff(path)
    frfs = [record for record in records if record.function == uff.FRF]
    with locate_errors(path):
        if not frfs:
            hint = "time records belong under recordings: in a pipeline"
            raise DataError("holds no FRF records", hint=hint)
        form = stated[0] if stated else _one_form(frfs)
        with uff.open_uff(path) as buffer:
            factors = [_stated_factor(record, *stated) if stated else frf_factor(record) for record in frfs]
            coherences = [record for record in records if record.function == uff.COHERENCE]
            return _response(buffer, frfs, coherences, form, factors, name, numbered)


def _one_form(frfs: Sequence[uff.UffRecord]) -> str:
    first = form_of(frfs[0])
    for record in frfs:
        if (form := form_of(record)) != first:
            what = f"{record.where} is a {form}, {frfs[0].where} a {first}"
            raise DataError(what, hint="one file holds one form")
    return first


def _response(
    buffer: mmap.mmap,
    frfs: list[uff.UffRecord],
    coherences: list[uff.UffRecord],
    form: str,
    factors: list[float],
    name: str,
    numbered: bool,
) -> FrequencyResponse:
    frequency = _frequency(buffer, frfs[0])
    outputs = tuple(dict.fromkeys(_key(record.response) for record in frfs))
    inputs = tuple(dict.fromkeys(_key(record.reference) for record in frfs))
    several = numbered or len({node for _, node, axis in (*outputs, *inputs) if axis}) > 1
    elements = _elements(frfs)
    factor_of = {record.number: factor for record, factor in zip(frfs, factors, strict=True)}

    def values(output: Key, reference: Key) -> ComplexArray:
        if (output, reference) not in elements:
            what = f"no FRF record for response {_text(output)} and reference {_text(reference)}"
            raise DataError(what, hint="a full matrix is required")
        record = elements[output, reference]
        return _values(buffer, record, frequency, factor_of[record.number])

    matrix = cube(outputs, inputs, values)
    of_pair = _elements(coherences)
    coherence = None
    if all((o, i) in of_pair for o in outputs for i in inputs):
        coherence = cube(outputs, inputs, lambda o, i: _same_lines(buffer, of_pair[o, i], frequency).real)
    return FrequencyResponse(
        frequency,
        matrix,
        _ports(outputs, several),
        _ports(inputs, several),
        form=form,
        coherence=checked_coherence(coherence, ""),
        name=name,
    )


def _key(point: uff.UffPoint) -> Key:
    return point.name, point.node, abs(point.direction)


def _elements(records: Sequence[uff.UffRecord]) -> dict[tuple[Key, Key], uff.UffRecord]:
    elements: dict[tuple[Key, Key], uff.UffRecord] = {}
    for record in records:
        pair = _key(record.response), _key(record.reference)
        if pair in elements:
            what = f"{record.where} has the same dofs as {elements[pair].where}"
            raise DataError(what, hint="one file holds one test")
        elements[pair] = record
    return elements


def _text(key: Key) -> str:
    return f"{key[0] or key[1]} {AXES[key[2]]}".strip()


def _frequency(buffer: mmap.mmap, record: uff.UffRecord) -> FloatArray:
    _check_abscissa(record, "Hz")
    try:
        abscissa = uff.read_numbers(buffer, record.layout)[0]
    except ValueError as error:
        raise DataError(f"{record.where}: {error}") from None
    return record.start + record.step * np.arange(record.n_value) if abscissa is None else abscissa


def _check_abscissa(record: uff.UffRecord, unit: str) -> None:
    stated = axis_unit(record.abscissa)
    if stated and parse_unit(stated) != parse_unit(unit):
        raise DataError(f"{record.where}: its abscissa is in {stated}", hint=f"{unit} is needed")


def _same_lines(buffer: mmap.mmap, record: uff.UffRecord, frequency: FloatArray) -> FloatArray | ComplexArray:
    if record.n_value != frequency.size:
        what = f"{record.where} has {record.n_value} frequencies, the first FRF record {frequency.size}"
        raise DataError(what)
    abscissa = _frequency(buffer, record)
    if not np.allclose(abscissa, frequency, rtol=_SAME_AXIS, atol=0):
        raise DataError(f"the frequencies of {record.where} differ from those of the first FRF record")
    return uff.read_numbers(buffer, record.layout)[1]


def _values(buffer: mmap.mmap, record: uff.UffRecord, frequency: FloatArray, factor: float) -> ComplexArray:
    if record.layout.parts != 2:
        raise DataError(f"{record.where}: an FRF of real numbers, complex ones are required")
    sign = -1.0 if (record.response.direction < 0) != (record.reference.direction < 0) else 1.0
    return np.asarray(_same_lines(buffer, record, frequency) * np.float64(sign * factor), np.complex128)


def _ports(keys: Sequence[Key], several: bool) -> tuple[Port, ...]:
    labels = [name or _dof(node, axis, several) for name, node, axis in keys]
    if len(set(labels)) < len(labels):
        labels = [
            ".".join(part for part in (name, str(node), AXES[axis]) if part) for name, node, axis in keys
        ]
    ports = []
    for label, (_, node, axis) in zip(labels, keys, strict=True):
        dof, angle = label, AXIS_ANGLES.get(AXES[axis])
        if not axis:
            with suppress(UnitError):
                angle = parse_value(label, "rad")
        elif not label.endswith(f".{AXES[axis]}"):
            dof = _dof(node, axis, several)
        ports.append(Port(label, label, dof, angle))
    return tuple(ports)


def _dof(node: int, axis: int, several: bool) -> str:
    return (f"{node}.{AXES[axis]}" if several else AXES[axis]) if axis else str(node)


class UffTable:
    """Time records of equal length of one file. Satisfies RawTable."""

    def __init__(self, path: Path) -> None:
        self.path = path
        records = [
            record
            for record in uff.read_uff(path)
            if record.function == uff.TIME or (record.function, record.abscissa.kind) == (0, 17)
        ]
        if not records:
            raise DataError("holds no time records", path, "FRFs belong under frfs: in a pipeline")
        _check_alike(records, path)
        self.columns = unique([channel_name(record) for record in records])
        self._records = dict(zip(self.columns, records, strict=True))
        with locate_errors(path):
            units = ((name, time_unit(record)[0]) for name, record in self._records.items())
            self.units = {name: unit for name, unit in units if unit}
        rate = 1 / records[0].step
        is_whole = abs(round(rate) / rate - 1) < _STEP_DIGITS
        self.sample_rate: float | None = float(round(rate)) if is_whole else rate

    def chunks(self, columns: Sequence[str]) -> Iterator[FloatArray]:
        """Consecutive chunks (n, n_column) [unit of the column]; DataError for a truncated record."""
        with uff.open_uff(self.path) as buffer:
            try:
                table = [
                    np.asarray(uff.read_numbers(buffer, self._records[name].layout)[1], float)
                    for name in columns
                ]
            except ValueError as error:
                raise DataError(f"a time record cannot be read: {error}", self.path) from None
        factors = np.array([time_unit(self._records[name])[1] for name in columns])
        for start in range(0, len(table[0]), CHUNK_ROWS):
            yield np.column_stack([column[start : start + CHUNK_ROWS] for column in table]) * factors


def _check_alike(records: list[uff.UffRecord], path: Path) -> None:
    first = records[0]
    for record in records:
        if not record.even or not record.step > 0:
            raise DataError(f"{record.where}: its samples are not evenly spaced", path)
        if record.layout.parts != 1:
            raise DataError(f"{record.where}: a time record of complex values", path)
        _check_abscissa(record, "s")
        if (record.n_value, record.step, record.start) != (first.n_value, first.step, first.start):
            has, others = (
                f"{r.n_value} values, {r.step:g} s apart from {r.start:g} s on" for r in (record, first)
            )
            what = f"{record.where} has {has}; {first.where} {others}"
            raise DataError(what, path, "one file is one recording: split it")


def channel_name(record: uff.UffRecord) -> str:
    """Entity name of the response, else its node and direction, else the axis label, the title or the
    record's number.
    """
    point = record.response
    sign = "-" if point.direction < 0 else "+"
    dof = f"{point.node}{sign}{AXES[abs(point.direction)].upper()}" if point.direction else str(point.node)
    names = (point.name, dof if point.node else "", record.ordinate.label, record.title, str(record.number))
    return next(filter(None, names))


def readable_unit(label: str, kind: int) -> str:
    """The label in labpipe's notation ("m/s2" -> "m/s^2", and g of an acceleration -> gn), '' for an unknown
    one.
    """
    # Some programs write a quotient as (1/N)*(m/s2).
    text = re.sub(r"^\(1/(\w+)\)\*\((.+)\)$", r"\2/\1", label.strip().strip("[]"))
    text = re.sub(r"(?<=[A-Za-z])(-?\d)", r"^\1", text)
    if kind == 12:
        text = re.sub(r"(?<![A-Za-z])g(?![A-Za-z])", "gn", text)
    try:
        parse_unit(text)
    except UnitError:
        return ""
    return text


def axis_unit(axis: uff.UffAxis) -> str:
    """The unit of an axis by its label, '' for none or an unknown one."""
    return readable_unit(axis.unit, axis.kind) if axis.unit else ""


def form_of(record: uff.UffRecord) -> str:
    """receptance, mobility or accelerance by the data types of the two axes. DataError for any other
    function.
    """
    of_force = record.denominator.kind in _FORCES
    form = FORMS.get(record.ordinate.kind, "") if of_force else ""
    if record.ordinate.kind in _OPEN and not of_force:
        form = _labelled_form(record)
    if not form:
        label = f", labelled {record.ordinate.unit}" if record.ordinate.unit else ""
        what = (
            f"{record.where}: the data types {record.ordinate.kind} per {record.denominator.kind}{label} are "
            "not displacement (8), velocity (11) or acceleration (12) per force (13)"
        )
        raise DataError(
            what, hint="state it under frfs: {file: FILE, form: accelerance}, with unit: where not SI"
        )
    _check_directions(record)
    return form


def _check_directions(record: uff.UffRecord) -> None:
    if max(abs(record.response.direction), abs(record.reference.direction)) > 3:
        raise DataError(f"{record.where}: rotations and moments are not supported")


def frf_factor(record: uff.UffRecord) -> float:
    """SI value per value of an FRF record. DataError for an unknown label, or one that contradicts the 164
    record.
    """
    labelled = _labelled_factor(record)
    if record.scale is None:
        if labelled is None:
            labels = " per ".join(filter(None, (record.ordinate.unit, record.denominator.unit)))
            what = f"{record.where}: unknown unit '{labels}'"
            raise DataError(what, hint="there is no record 164 with the units")
        return labelled
    factor = record.scale.force / record.scale.length
    if record.ordinate.unit and labelled is not None:
        _check_label(record, labelled, factor)
    return factor


def _check_label(record: uff.UffRecord, labelled: float, factor: float) -> None:
    if abs(labelled / factor - 1) > _SAME:
        what = f"{record.where}: the label '{record.ordinate.unit}' contradicts the units of record 164"
        raise DataError(what, hint="correct the record that is wrong")


# What titles call the response, as in "Frequency Response H1(Acc,Force)", by the form that it makes.
_TITLED = re.compile(r"\(\s*(\w+)\s*,\s*\w*(?:for|ham|kraft|mart|load)\w*\s*\)", re.IGNORECASE)
_CALLED = (
    ("accelerance", r"acc|acel|beschl|\ba\b"),
    ("mobility", r"vel|gesch|\bv\b"),
    ("receptance", r"disp|desl|desp|weg|ausl|\b[dx]\b"),
)


def titled_form(record: uff.UffRecord) -> str:
    """The form that the title of an FRF record names, '' where it does not."""
    called = _TITLED.search(record.title)
    if called is None:
        return ""
    return next((form for form, word in _CALLED if re.match(word, called[1], re.IGNORECASE)), "")


def frf_values(path: Path, records: Sequence[uff.UffRecord]) -> tuple[FloatArray, ComplexArray]:
    """Frequencies (n,) [Hz] and H (n, n_record) [unit of the file] of FRF records of one length; of the
    first alone where they differ.
    """
    with uff.open_uff(path) as buffer:
        frequency = _frequency(buffer, records[0])
        alike = [record for record in records if record.n_value == frequency.size]
        values = np.stack([uff.read_numbers(buffer, r.layout)[1] for r in alike], axis=1)
        return frequency, np.asarray(values, np.complex128)


def _labelled_form(record: uff.UffRecord) -> str:
    unit = readable_unit(record.ordinate.unit, 12) if record.ordinate.unit else ""
    dimension = parse_unit(unit).dimension if unit else None
    return next((f for f in FORMS.values() if parse_unit(RESPONSE_FORMS[f]).dimension == dimension), "")


def _stated_factor(record: uff.UffRecord, form: str, factor: float | None) -> float:
    """SI value per value of a record whose *form* somebody states: their *factor*, else by its label, else 1.
    DataError where the record itself says another form.
    """
    _check_directions(record)
    kind, of_force = record.ordinate.kind, record.denominator.kind in _FORCES
    of_kind = FORMS.get(kind, "") if of_force else ""
    if of_kind and of_kind != form:
        raise DataError(f"{record.where} holds {of_kind} by its data types, {form} by the entry under frfs")
    if factor is not None:
        return factor
    if of_kind:
        return frf_factor(record)
    try:
        return unit_of(record.ordinate.unit, RESPONSE_FORMS[form]).factor if record.ordinate.unit else 1.0
    except UnitError:
        return 1.0


def _labelled_factor(record: uff.UffRecord) -> float | None:
    """The factor of the labels: one for the whole quotient, or one for each part. 1 without labels, None for
    unknown ones.
    """
    kind, label, per = record.ordinate.kind, record.ordinate.unit, record.denominator
    if kind in _OPEN and not label:
        return 1.0
    unit = readable_unit(label, 12 if kind in _OPEN else kind) if label else SI_UNITS[kind]
    if not unit:
        return None
    ordinate = parse_unit(unit)
    if kind in _OPEN or ordinate.dimension == parse_unit(RESPONSE_FORMS[FORMS[kind]]).dimension:
        return ordinate.factor
    force = parse_unit(axis_unit(per) or ("1" if per.unit else "N"))
    wanted = [parse_unit(text).dimension for text in (SI_UNITS[kind], "N")]
    return ordinate.factor / force.factor if [ordinate.dimension, force.dimension] == wanted else None


def time_unit(record: uff.UffRecord) -> tuple[str, float]:
    """(unit, factor) of a time record: the numbers times the factor are in the unit, that of SI with a record
    164, else of the label; ('', 1) without one. DataError for a label that contradicts record 164.
    """
    kind, label = record.ordinate.kind, axis_unit(record.ordinate)
    if record.scale is None or kind not in SI_UNITS:
        return label, 1.0
    factor = 1 / (record.scale.force if kind in _FORCES else record.scale.length)
    unit = parse_unit(label or "1")
    if unit.dimension == parse_unit(SI_UNITS[kind]).dimension:
        _check_label(record, unit.factor, factor)
    return SI_UNITS[kind], factor
