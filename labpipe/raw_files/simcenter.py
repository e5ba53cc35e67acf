"""Structures that Simcenter Test.Lab (Siemens, before that LMS) writes into MATLAB files: channels or FRFs
over an axis of equal steps, with the names and units of their channels.

The numbers of a file "saved in MKS" are in SI units, whatever unit its label says: a channel labelled g
holds m/s^2, and the factor beside the label would make g of them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from labpipe.quantities import parse_unit

_VALUES, _STEP = ".y_values.values", ".x_values.increment"
# Exponents of a unit in the order of quantities.Dimension, by Test.Lab's names, and the units that are named.
_BASES = ("LENGTH", "MASS", "TIME", "CURRENT", "TEMPERATURE", "ANGLE")
_UNITS = (
    "m", "m/s", "m/s^2", "N", "Pa", "V", "A", "N.m", "rad", "rad/s", "rad/s^2", "Hz", "s", "K", "W", "kg",
    "m/N", "m/(N.s)", "m/(N.s^2)", "N/m", "N.s/m", "1",
)  # fmt: skip


@dataclass(frozen=True)
class Signals:
    """What one structure *place* of a file holds: *step* of its axis and the axis's unit (s, Hz), labels of
    responding channels and, of FRFs, of references, one for each column; *unit* of the numbers, '' for none.
    """

    place: str
    step: float
    axis: str
    labels: tuple[str, ...]
    references: tuple[str, ...]
    unit: str

    @property
    def values(self) -> str:
        """The field that holds the numbers, (n_step,) or (n_step, n_channel)."""
        return self.place + _VALUES


def signals_of(fields: Mapping[str, Any]) -> list[Signals]:
    """The structures among the fields of a MATLAB file, by their full names."""
    signals = []
    for key in fields:
        place = key.removesuffix(_VALUES)
        step = _number(fields, place + _STEP)
        if place != key and np.isfinite(step):
            channels = (f"{place}.function_record.{side}_channel.label" for side in ("primary", "reference"))
            labels, references = (_texts(fields.get(name)) for name in channels)
            axis = "".join(_texts(fields.get(f"{place}.x_values.quantity.label")))
            signals.append(Signals(place, step, axis, labels, references, _unit(fields, place)))
    return signals


def labels_and_units(
    signals: Sequence[Signals], columns: Mapping[str, Collection[str]]
) -> tuple[dict[str, str], dict[str, str]]:
    """The label of each column that no other one shares, and its unit; *columns* by the field they are of."""
    labels: dict[str, str] = {}
    units: dict[str, str] = {}
    for part in signals:
        names = columns[part.values]
        units |= dict.fromkeys(names, part.unit)
        labels |= dict(zip(names, part.labels, strict=False)) if len(names) == len(part.labels) else {}
    counts = Counter(labels.values())
    return {name: label for name, label in labels.items() if label and counts[label] == 1}, units


def _unit(fields: Mapping[str, Any], place: str) -> str:
    """The unit of the numbers: SI in a file that was saved in MKS, else what the label says."""
    quantity = f"{place}.y_values.quantity"
    if "MKS" not in "".join(_texts(fields.get(f"{quantity}.info"))):
        return "".join(_texts(fields.get(f"{quantity}.label")))
    powers = dict.fromkeys(_BASES, 0.0)
    for number in range(1, len(fields)):
        term = f"{quantity}.quantity_terms({number})"
        base = "".join(_texts(fields.get(f"{term}.quantity")))
        if not base:
            break
        divisor = _number(fields, f"{term}.den")
        powers[base] = _number(fields, f"{term}.num") / divisor if divisor else np.nan
    wanted = tuple(powers[base] for base in _BASES)
    others = sum(abs(power) for base, power in powers.items() if base not in _BASES)
    return next((unit for unit in _UNITS if not others and parse_unit(unit).dimension == wanted), "")


def _number(fields: Mapping[str, Any], key: str) -> float:
    array = np.asarray(fields.get(key, ()))
    return float(array.item()) if array.size == 1 and array.dtype.kind in "iuf" else np.nan


def _texts(value: Any) -> tuple[str, ...]:
    array = np.asarray(() if value is None else value)
    if array.dtype.kind == "O":
        return tuple(text for cell in array.flat for text in _texts(cell) or ("",))
    return ("".join(map(str, array.flat)).strip(),) if array.dtype.kind == "U" and array.size else ()
