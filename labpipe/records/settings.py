"""Declaring a parameter once: the frozen dataclass of a stage feeds the YAML reader, the schema, the help and the docs."""

from __future__ import annotations

import dataclasses
from dataclasses import MISSING, dataclass
from typing import Any

KINDS = (
    "value",  # "15 Hz" -> float in the SI unit
    "uncertain",  # "134.5 kN/m +- 0.4 kN/m" or "... +- 1 %" -> Uncertain
    "band",  # "1-250 Hz" -> (low, high) in the SI unit
    "bands",  # list of bands
    "peaks",  # {x: 700-1100 Hz, z: [...]} -> (("x", ((700.0, 1100.0),)), ...)
    "integer",
    "flag",
    "text",
    "choice",  # one of `choices`
    "names",  # one text or a list of texts -> tuple
    "mass",  # "0.92 kg", a list (diagonal), a matrix, or `estimate`
    "values",  # one value or a list of values -> tuple
    "matrix",  # list of rows -> tuple of tuples
    "coefficients",  # {k_1_2: 0 N/m} -> (("k_1_2", 0.0), ...)
    "series",  # {ls: [1, 2]} -> (("ls", (1.0, 2.0)), ...)
    "groups",  # lists of names -> tuple of tuples
    "section",  # a nested dataclass
)


@dataclass(frozen=True)
class Uncertain:
    """A value with its standard error, both in SI units."""

    value: float
    std_error: float = 0.0


@dataclass(frozen=True)
class Setting:
    """What a settings field means to people: its kind, SI unit, choices, and one line of help."""

    kind: str
    help: str
    unit: str = ""
    choices: tuple[str, ...] = ()
    section: type | None = None


def setting(
    kind: str,
    help: str,
    *,
    unit: str = "",
    default: Any = MISSING,
    choices: tuple[str, ...] = (),
    section: type | None = None,
) -> Any:
    """A dataclass field that carries a Setting; without a default the YAML must give it."""
    if kind not in KINDS:
        raise ValueError(f"unknown kind of setting '{kind}'")
    return dataclasses.field(default=default, metadata={"setting": Setting(kind, help, unit, choices, section)})


def settings_of(owner: type) -> dict[str, tuple[Setting, bool]]:
    """Field name -> (its Setting, whether it must be given) of a settings dataclass, in order of declaration."""
    return {f.name: (f.metadata["setting"], f.default is MISSING) for f in dataclasses.fields(owner) if "setting" in f.metadata}
