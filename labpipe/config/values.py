"""Reading one value of each kind that a setting can have; a ValueError says what is wrong, Fault carries the hint."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

from labpipe.identify.settings import COEFFICIENT_UNITS
from labpipe.marked_yaml import Marked
from labpipe.quantities import UnitError, parse_value
from labpipe.records.settings import Setting, Uncertain
from labpipe.registry import nearest

_NUMBER = r"(\d+\.?\d*(?:[eE][+-]?\d+)?|\.\d+(?:[eE][+-]?\d+)?)"
_BAND = re.compile(rf"^\s*{_NUMBER}\s*((?!to\b)[^\d\s.–-][^\s–]*?)?\s*(?:-|–|\.\.|to)\s*{_NUMBER}\s*(.*?)\s*$")


def read_value(node: Marked, setting: Setting) -> float:
    """ "15 Hz" -> 15.0; the dimension is checked."""
    _need_scalar(node, f"a value with its unit, for example '1 {setting.unit}'")
    return parse_value(node.text, setting.unit)


def read_uncertain(node: Marked, setting: Setting) -> Uncertain:
    """ "134.5 kN/m +- 0.4 kN/m" or "... +- 1 %" -> value and standard error."""
    _need_scalar(node, "a value with its unit")
    return parse_uncertain(node.text, setting.unit)


def parse_uncertain(text: str, unit: str) -> Uncertain:
    """Value and tolerance of "45.2 kN/m +- 1 %"; a tolerance in per cent is relative to the value."""
    value_text, _, error_text = text.replace("±", "+-").partition("+-")
    value = parse_value(value_text.strip(), unit)
    if not error_text.strip():
        return Uncertain(value)
    if error_text.strip().endswith("%"):
        return Uncertain(value, abs(value) * parse_value(error_text.strip(), "1"))
    error = parse_value(error_text.strip(), unit)
    if error < 0:
        raise UnitError(f"'{text}' has a negative uncertainty")
    return Uncertain(value, error)


def read_band(node: Marked, setting: Setting) -> tuple[float, float]:
    """ "1-250 Hz" -> (1.0, 250.0)."""
    example = f"a band, for example '10-20 {setting.unit}'"
    _need_scalar(node, example)
    match = _BAND.match(node.text)
    if match is None:
        raise UnitError(f"'{node.text}' is not a band", f"write {example}")
    high_unit = match[4]
    low = parse_value(f"{match[1]} {match[2] or high_unit}".strip(), setting.unit)
    high = parse_value(f"{match[3]} {high_unit}".strip(), setting.unit)
    if not low < high:
        raise UnitError(f"the band '{node.text}' is empty", "the lower frequency comes first")
    return low, high


def read_bands(node: Marked, setting: Setting) -> tuple[tuple[float, float], ...]:
    """A list of bands, or one."""
    nodes = node.content if isinstance(node.content, list) else [node]
    return tuple(read_band(entry, setting) for entry in nodes)


def read_peaks(node: Marked, setting: Setting) -> tuple[tuple[str, tuple[tuple[float, float], ...]], ...]:
    """{x: 700-1100 Hz, z: [300-500 Hz, 900-950 Hz]} -> (("x", ((700.0, 1100.0),)), ...)."""
    if not isinstance(node.content, dict) or not node.content:
        raise UnitError(f"'{_shown(node)}' is not a mapping of dofs to bands", "write for example {x: 700-1100 Hz}")
    return tuple((name, read_bands(entry, setting)) for name, entry in node.content.items())


def read_integer(node: Marked, setting: Setting) -> int:  # noqa: ARG001 (one signature for the whole table)
    """A whole number, zero or more."""
    if isinstance(node.content, bool) or not isinstance(node.content, int) or node.content < 0:
        raise UnitError(f"'{_shown(node)}' is not a whole number of at least 0")
    return node.content


def read_flag(node: Marked, setting: Setting) -> bool:  # noqa: ARG001
    """true or false."""
    if not isinstance(node.content, bool):
        raise UnitError(f"'{_shown(node)}' is neither true nor false")
    return node.content


def read_text(node: Marked, setting: Setting) -> str:  # noqa: ARG001
    """A text; a number is taken as written."""
    _need_scalar(node, "a text")
    if not node.text:
        raise UnitError("a text is missing")
    return node.text


def read_choice(node: Marked, setting: Setting) -> str:
    """One of the setting's choices."""
    _need_scalar(node, f"one of {', '.join(setting.choices)}")
    if node.text not in setting.choices:
        raise UnitError(f"unknown choice '{node.text}'", _near_choice(node.text, setting.choices))
    return node.text


def _near_choice(text: str, choices: tuple[str, ...]) -> str:
    hint = nearest(text, choices)
    return hint if hint.startswith("known") else f"{hint} (known: {', '.join(choices)})"


def read_names(node: Marked, setting: Setting) -> tuple[str, ...]:
    """One name or a list of names."""
    if isinstance(node.content, list):
        return tuple(read_text(entry, setting) for entry in node.content)
    return (read_text(node, setting),)


def read_mass(node: Marked, setting: Setting) -> Any:
    """ "0.92 kg", a list (diagonal matrix), a list of lists (matrix), or `estimate`."""
    if isinstance(node.content, list):
        rows = node.content
        return tuple(read_values(row, setting) if isinstance(row.content, list) else read_mass(row, setting) for row in rows)
    if node.text == "estimate":
        return "estimate"
    mass = read_value(node, setting)
    if mass < 0:
        raise UnitError(f"the mass '{node.text}' is negative")
    return mass


def read_values(node: Marked, setting: Setting) -> tuple[float, ...]:
    """One value or a list of values."""
    nodes = node.content if isinstance(node.content, list) else [node]
    return tuple(read_value(entry, setting) for entry in nodes)


def read_matrix(node: Marked, setting: Setting) -> tuple[tuple[float, ...], ...]:
    """A list of rows of equal length."""
    if not isinstance(node.content, list) or not all(isinstance(row.content, list) for row in node.content):
        raise UnitError(f"'{_shown(node)}' is not a matrix", f"write rows, for example [[2 {setting.unit}, 0], [0, 2 {setting.unit}]]")
    rows = tuple(read_values(row, setting) for row in node.content)
    if len({len(row) for row in rows}) != 1:
        raise UnitError("the rows of the matrix are not equally long")
    return rows


def read_coefficients(node: Marked, setting: Setting) -> tuple[tuple[str, float], ...]:
    """{k_1_2: 0 N/m, c_1_2: 0 N.s/m} -> (("k_1_2", 0.0), ...); the first letter of a name says its unit."""
    if not isinstance(node.content, dict):
        raise UnitError(f"'{_shown(node)}' is not a mapping of coefficients", "write for example {k_1_3: 0 N/m}")
    found = []
    for name, entry in node.content.items():
        unit = COEFFICIENT_UNITS.get(name[:1]) if name[1:2] in ("", "_") else None
        if unit is None:
            raise UnitError(f"'{name}' is no coefficient", "their names begin with k_, c_, m_ or b_")
        found.append((name, read_value(entry, replace(setting, unit=unit))))
    return tuple(found)


def read_series(node: Marked, setting: Setting) -> tuple[tuple[str, tuple[float, ...]], ...]:
    """{ls: [0.03, 0.2]} -> (("ls", (0.03, 0.2)),)."""
    if not isinstance(node.content, dict):
        raise UnitError(f"'{_shown(node)}' is not a mapping of names to lists of values")
    return tuple((name, read_values(entry, setting)) for name, entry in node.content.items())


def read_groups(node: Marked, setting: Setting) -> tuple[tuple[str, ...], ...]:
    """A list of lists of names, or one list."""
    entries = node.content
    if not isinstance(entries, list) or not entries:
        raise UnitError(f"'{_shown(node)}' is not a list of names", "write for example [[k_xx, k_yy], [c_xx, c_yy]]")
    if all(isinstance(entry.content, list) for entry in entries):
        return tuple(read_names(entry, setting) for entry in entries)
    return (read_names(node, setting),)


READERS = {
    "value": read_value,
    "uncertain": read_uncertain,
    "band": read_band,
    "bands": read_bands,
    "peaks": read_peaks,
    "integer": read_integer,
    "flag": read_flag,
    "text": read_text,
    "choice": read_choice,
    "names": read_names,
    "mass": read_mass,
    "values": read_values,
    "matrix": read_matrix,
    "coefficients": read_coefficients,
    "groups": read_groups,
    "series": read_series,
}


def _need_scalar(node: Marked, wanted: str) -> None:
    if isinstance(node.content, (dict, list)) or node.content is None:
        raise UnitError(f"'{_shown(node)}' is not {wanted}")


def _shown(node: Marked) -> str:
    if node.content is None:
        return "(nothing)"
    return "(a list)" if isinstance(node.content, list) else "(a mapping)" if isinstance(node.content, dict) else node.text
