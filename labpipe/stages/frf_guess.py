"""The columns of an FRF in a table of another program, as far as their names say."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.formats.packed import plain_suffix
from labpipe.formats.table import TEXT_SUFFIXES
from labpipe.formats.text_columns import TextColumns
from labpipe.quantities import UnitError, unit_of
from labpipe.records.frf_layout import MECHANICAL
from labpipe.records.response import FORMS

_NAMES = (
    ("frequency", r"^freq|frequenz|^f$|^f ?[\[(]"),
    ("coherence", r"coh|kohärenz|gamma"),
    ("phase_rad", r"(phase|arg|winkel).*\brad"),
    ("phase_deg", r"phase|arg\b|winkel"),
    ("re", r"^re(al|\b)|\breal|realteil"),
    ("im", r"^im(ag|\b)|\bimag|imaginärteil"),
    ("amplitude_db", r"(amp|mag|betrag|abs|h\b|frf).*\bdb\b"),
    ("amplitude", r"amp|mag|betrag|\babs|^\|?h\|?\b"),
)
_WHOLE = (("re", "im"), ("amplitude", "phase"), ("amplitude_db", "phase"))


@dataclass(frozen=True)
class GuessedFrf:
    """*columns*: names by what they hold; *unit* where the header states one of an FRF; frequency (n_frequency,)
    [Hz] and size (n_frequency,) [unit of the file] as they stand there.
    """

    columns: dict[str, str]
    unit: str
    frequency: FloatArray
    size: FloatArray


def guessed_frf(path: Path) -> GuessedFrf | None:
    """The FRF of a text table whose header names a frequency and the parts of complex numbers; None for any other file."""
    if plain_suffix(path) not in TEXT_SUFFIXES:
        return None
    table = TextColumns(path)
    columns: dict[str, str] = {}
    for name in table.columns:
        kind = next((kind for kind, pattern in _NAMES if re.search(pattern, name, re.IGNORECASE)), "")
        if kind and kind not in columns:
            columns[kind] = name
    phase = next((kind for kind in ("phase_deg", "phase_rad") if kind in columns), "phase")
    parts = next((pair for pair in _WHOLE if {part.replace("phase", phase) for part in pair} <= columns.keys()), None)
    if parts is None or "frequency" not in columns:
        return None
    used = ["frequency", *(part.replace("phase", phase) for part in parts), "coherence"]
    columns = {kind: columns[kind] for kind in used if kind in columns}
    numbers = {kind: table.column(table.columns.index(name)).real for kind, name in columns.items()}
    size = np.hypot(numbers["re"], numbers["im"]) if parts == ("re", "im") else numbers[parts[0]]
    return GuessedFrf(columns, _unit_of_frf(table.units.get(columns[parts[0]], "")), numbers["frequency"], size)


def _unit_of_frf(unit: str) -> str:
    """The unit, in labpipe's notation where it is SI; '' for one that is none of an FRF."""
    for form in MECHANICAL:
        try:
            return FORMS[form] if unit_of(unit, FORMS[form]).factor == 1 else unit
        except UnitError:
            continue
    return ""
