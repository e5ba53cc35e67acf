"""What a recording's own metadata say of its channels: quantity, unit, role, direction; what they do not say, a person must."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.config.reader import DECIDE
from labpipe.config.rig import DEFAULT_ROLES
from labpipe.formats.table import Table
from labpipe.quantities import QUANTITIES, UnitError, parse_unit

# Largest number of rows read.
MOST_ROWS = 1 << 21
# Relative deviation of the steps of a time axis.
EVEN = 1e-3

_RECORDED = ("force", "displacement", "velocity", "acceleration", "voltage", "current", "pressure", "temperature", "moment")
_BRACKETS = re.compile(r"\[.*?\]|\(.*?\)")
_BY_NAME = (
    ("tacho", r"tacho|keyphasor|key.?phasor|trigger|rpm|drehzahl"),
    ("force", r"force|hammer|kraft|load.?cell|impact|shaker|\bf[xyz]?\d*\b"),
    ("acceleration", r"acc|beschl|\ba[xyz]?\d*\b"),
    ("velocity", r"vel|\bv[xyz]?\d*\b"),
    ("displacement", r"disp|prox|probe|eddy|gap|weg|\b[xyz]\d*\b"),
    ("current", r"current|strom|\bi\d*\b"),
)


@dataclass(frozen=True)
class GuessedChannel:
    """One channel of a rig file to be: *key* its name, *quantity* and *unit* or DECIDE; *sensitivity* DECIDE for a sensor in volts.

    *role* is empty where it follows from a quantity that is still to be decided.
    """

    key: str
    column: str
    quantity: str
    unit: str
    role: str
    dof: str
    sensitivity: str = ""

    @property
    def decisions(self) -> tuple[str, ...]:
        """Decisions that the user must take, as text."""
        questions = {
            "quantity": f"what is measured: {', '.join(_RECORDED[:4])}, ...; delete a channel that is not needed",
            "unit": f"the unit of the recorded numbers, for example {QUANTITIES[self.quantity].si_unit}"
            if self.quantity in QUANTITIES
            else "the unit of the recorded numbers",
            "sensitivity": "recorded volts per quantity, for example 8 V/mm",
        }
        return tuple(text for name, text in questions.items() if getattr(self, name) == DECIDE)


def first_rows(table: Table) -> tuple[tuple[str, ...], FloatArray]:
    """Distinct columns of a table and their first rows (n_row, n_column) [recorded units]."""
    names = tuple(dict.fromkeys(table.columns))
    chunks: list[FloatArray] = []
    rows = 0
    for chunk in table.chunks(names):
        chunks.append(chunk[: MOST_ROWS - rows])
        rows += chunks[-1].shape[0]
        if rows >= MOST_ROWS:
            break
    return names, np.concatenate(chunks)


def time_columns(names: Sequence[str], rows: FloatArray) -> list[str]:
    """Columns of *rows* (n_row, n_column) [recorded units] that are a time axis: all steps equal and positive."""
    steps = np.diff(rows, axis=0)
    mean = steps.mean(axis=0)
    even = (mean > 0) & (np.abs(steps - mean).max(axis=0) <= EVEN * np.abs(mean))
    return [name for name, is_even in zip(names, even, strict=True) if is_even]


def guess_channels(names: Sequence[str], units: dict[str, str]) -> list[GuessedChannel]:
    """A channel for every column; the force of a rig with one response acts along it."""
    keys: list[str] = []
    for name in names:
        keys.append(_key(name, keys))
    guessed = [_guess(name, key, units.get(name, "")) for name, key in zip(names, keys, strict=True)]
    outputs = [channel for channel in guessed if channel.role == "output"]
    return [_along(channel, outputs) for channel in guessed]


def _guess(name: str, key: str, unit: str) -> GuessedChannel:
    plain_name = re.sub(r"[_\W]+", " ", _BRACKETS.sub(" ", name).lower())
    by_name = next((quantity for quantity, pattern in _BY_NAME if re.search(pattern, plain_name)), DECIDE)
    quantity = _measured_in(unit)
    sensitivity = ""
    if quantity in ("voltage", "") and by_name not in (DECIDE, "tacho"):
        # A sensor's volts, or a number without a unit: the quantity follows from the name.
        sensitivity = DECIDE if quantity == "voltage" else ""
        quantity = by_name
    elif by_name == "tacho":
        quantity, unit = "tacho", unit or "V"
    quantity = quantity or DECIDE
    role = DEFAULT_ROLES.get(quantity, "" if quantity == DECIDE else "reference")
    return GuessedChannel(key, name, quantity, unit or DECIDE, role, _direction(name) or key, sensitivity)


def _measured_in(unit: str) -> str:
    """The quantity that is recorded in a unit; nothing for a number or an unknown unit."""
    if not unit:
        return ""
    try:
        dimension = parse_unit(unit).dimension
    except UnitError:
        return ""
    matching = (name for name in _RECORDED if parse_unit(QUANTITIES[name].si_unit).dimension == dimension)
    return next(matching, "")


def _direction(name: str) -> str:
    """x, y or z where the name has one as a word or at its end."""
    plain_name = _BRACKETS.sub(" ", name)
    match = re.search(r"(?:^|[_\W\d])([xyz])(?:$|[_\W\d])", plain_name, re.I) or re.search(r"[a-z]([XYZ])\b", plain_name)
    return match[1].lower() if match else ""


def _key(name: str, used_keys: Sequence[str]) -> str:
    """A short name for a channel: the column's without its unit, in letters, digits and underscores."""
    plain = re.sub(r"\W+", "_", _BRACKETS.sub(" ", name)).strip("_").lower() or "channel"
    key = plain if plain[0].isalpha() else f"ch_{plain}"
    number = 1
    while key in used_keys:
        number += 1
        key = f"{plain}_{number}"
    return key


def _along(channel: GuessedChannel, outputs: Sequence[GuessedChannel]) -> GuessedChannel:
    """A force whose name has no direction acts along the only response."""
    if channel.role != "input" or channel.dof != channel.key or len(outputs) != 1:
        return channel
    return GuessedChannel(channel.key, channel.column, channel.quantity, channel.unit, channel.role, outputs[0].dof, channel.sensitivity)
