"""Conversion of universal files to SI units: by their 164 record, else by the unit labels of the record, else unchanged."""

from __future__ import annotations

import re

from labpipe.errors import DataError
from labpipe.formats.uff import UffAxis, UffRecord
from labpipe.quantities import UnitError, parse_unit

# Specific data types of a record's axes -> SI unit.
SI_UNITS = {8: "m", 11: "m/s", 12: "m/s^2", 9: "N", 13: "N", 15: "Pa", 17: "s", 18: "Hz"}
FORMS = {8: "receptance", 11: "mobility", 12: "accelerance"}
_FORM_UNITS = {8: "m/N", 11: "m/(N.s)", 12: "m/(N.s^2)"}
_FORCES = (9, 13)
_SAME = 1e-4


def readable_unit(label: str, kind: int) -> str:
    """The label in labpipe's notation ("m/s2" -> "m/s^2", and g of an acceleration -> gn), '' for an unknown one."""
    text = re.sub(r"(?<=[A-Za-z])(-?\d)", r"^\1", label.strip().strip("[]"))
    if kind == 12:
        text = re.sub(r"(?<![A-Za-z])g(?![A-Za-z])", "gn", text)
    try:
        parse_unit(text)
    except UnitError:
        return ""
    return text


def axis_unit(axis: UffAxis) -> str:
    """The unit of an axis by its label, '' for none or an unknown one."""
    return readable_unit(axis.unit, axis.kind) if axis.unit else ""


def form_of(record: UffRecord) -> str:
    """receptance, mobility or accelerance by the data types of the two axes; DataError for any other function."""
    if record.ordinate.kind not in FORMS or record.denominator.kind not in _FORCES:
        types = f"{record.ordinate.kind} per {record.denominator.kind}"
        what = f"{record.where}: the data types {types} are not displacement, velocity or acceleration per force"
        raise DataError(what, hint="8, 11 or 12 per 13 are required")
    if max(abs(record.response.direction), abs(record.reference.direction)) > 3:
        raise DataError(f"{record.where}: rotations and moments are not supported")
    return FORMS[record.ordinate.kind]


def frf_factor(record: UffRecord) -> float:
    """SI value per value of an FRF record; DataError for an unknown label, or one that contradicts the 164 record."""
    labelled = _labelled_factor(record)
    if record.scale is None:
        if labelled is None:
            raise DataError(f"{record.where}: unknown unit '{record.ordinate.unit}'", hint="there is no record 164 with the units")
        return labelled
    factor = record.scale.force / record.scale.length
    stated = bool(record.ordinate.unit) and labelled is not None
    if stated and labelled is not None and abs(labelled / factor - 1) > _SAME:
        raise DataError(f"{record.where}: the label '{record.ordinate.unit}' contradicts the units of record 164")
    return factor


def _labelled_factor(record: UffRecord) -> float | None:
    """The factor of the labels: one for the whole quotient, or one for each part; 1 without labels, None for unknown ones."""
    kind, label = record.ordinate.kind, record.ordinate.unit
    if not label:
        return 1.0
    unit = readable_unit(label, kind)
    if not unit:
        return None
    ordinate = parse_unit(unit)
    if ordinate.dimension == parse_unit(_FORM_UNITS[kind]).dimension:
        return ordinate.factor
    force = parse_unit(axis_unit(record.denominator) or "N")
    if ordinate.dimension == parse_unit(SI_UNITS[kind]).dimension and force.dimension == parse_unit("N").dimension:
        return ordinate.factor / force.factor
    return None


def time_unit(record: UffRecord) -> tuple[str, float]:
    """(unit, factor) of a time record: the numbers times the factor are in the unit; ('', 1) without a unit.

    With a record 164 the SI unit by data type; else the unit of the label, and factor 1.
    """
    kind = record.ordinate.kind
    if record.scale is not None and kind in (8, 9, 11, 12, 13):
        return SI_UNITS[kind], 1 / (record.scale.force if kind in _FORCES else record.scale.length)
    return axis_unit(record.ordinate), 1.0
