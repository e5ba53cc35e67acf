"""Numbers with their standard uncertainty, and how people write them: 8 V/mm +- 1 %, 0.79 kg +- 5 g (rectangular, source=scale)."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import KW_ONLY, dataclass, replace
from typing import Any

from labpipe.quantities import UnitError, parse_value, written_unit
from labpipe.registry import nearest

# Half width over standard uncertainty of distributions with sharp ends (GUM 4.3.7, 4.3.9).
SHAPES = {"normal": 1.0, "rectangular": math.sqrt(3.0), "triangular": math.sqrt(6.0)}


@dataclass(frozen=True)
class Uncertain:
    """A value with its standard uncertainty, both in SI units.

    dof: degrees of freedom behind the uncertainty, None where it is known; shape: its distribution, one of SHAPES; source: name of its
    cause, numbers of one source have one error in common; empty where the number stands for itself.
    """

    value: float
    std_error: float = 0.0
    _: KW_ONLY
    dof: float | None = None
    shape: str = "normal"
    source: str = ""


def split_doubt(text: str) -> tuple[str, str]:
    """A text and the doubt behind it: "8 V/mm +- 1 %" -> ("8 V/mm", "1 %"); the doubt is empty where there is none."""
    number, _, doubt = text.replace("±", "+-").partition("+-")
    return number.strip(), doubt.strip()


def is_doubtful(value: Any) -> bool:
    """Whether a text gives a number with its doubt."""
    return isinstance(value, str) and ("+-" in value or "±" in value)


def parse_uncertain(text: str, unit: str) -> Uncertain:
    """Value and standard uncertainty of "45.2 kN/m +- 1 %"; one in per cent is relative to the value.

    Behind it in brackets: what the number is, where it is no standard uncertainty (k=2, rectangular or triangular limits), its degrees of
    freedom (dof=12), and its cause (source=scale).
    """
    value_text, _, error_text = text.replace("±", "+-").partition("+-")
    value = parse_value(value_text.strip(), unit)
    if not error_text.strip():
        return Uncertain(value)
    size_text, qualities = _qualities(error_text.strip())
    relative = size_text.endswith("%")
    size = abs(value) * parse_value(size_text, "1") if relative else _difference(size_text, unit)
    if size < 0:
        raise UnitError(f"'{text}' has a negative uncertainty")
    return _qualified(Uncertain(value, size), qualities)


def _difference(text: str, si_unit: str) -> float:
    """A difference in a unit that may have an offset: 2 degC are 2 K."""
    unit = written_unit(text)
    return parse_value(text, si_unit) - (parse_value(f"0 {unit}", si_unit) if unit else 0.0)


def _qualities(text: str) -> tuple[str, list[str]]:
    """The size of an uncertainty and what stands in brackets behind it; brackets of a unit are part of the size."""
    match = re.match(r"^(.*?)\(([^()]*)\)$", text)
    parts = [part.strip() for part in match[2].split(",")] if match else []
    if match is None or not any("=" in part or nearest(part, SHAPES).startswith("did you mean") or part in SHAPES for part in parts):
        return text, []
    return match[1].strip(), parts


def _qualified(plain: Uncertain, qualities: Iterable[str]) -> Uncertain:
    """The uncertainty with its qualities; UnitError for an unknown one."""
    entries: dict[str, Any] = {}
    factor = 1.0
    for quality in qualities:
        name, _, text = (part.strip() for part in quality.partition("="))
        if name in SHAPES and not text:
            entries["shape"], factor = name, factor * SHAPES[name]
        elif name == "source" and text:
            entries["source"] = text
        elif name in ("k", "dof"):
            number = parse_value(text, "1")
            if not number > 0:
                raise UnitError(f"'{quality}' must be above zero")
            factor, entries = (factor * number, entries) if name == "k" else (factor, {**entries, "dof": number})
        else:
            words = (*SHAPES, "k=2", "dof=12", "source=NAME")
            raise UnitError(f"'{quality}' says nothing of an uncertainty", nearest(name, words))
    return replace(plain, std_error=plain.std_error / factor, **entries)
