"""Roots of polynomials as texts: "-100", "-100+300j", and "-100 +- 300j" for the pair."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from numbers import Complex
from typing import Any

from labpipe.quantities import UnitError

_NUMBER = r"(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_ROOT = re.compile(rf"^(?P<real>[+-]?{_NUMBER})?(?:(?P<sign>\+-|[+-])?(?P<imaginary>{_NUMBER})?[ij])?$")
EXAMPLE = "for example [-100, -50 +- 300j], in rad/s"


def to_roots(value: Any, setting: Any) -> tuple[complex, ...]:  # noqa: ARG001 (one signature for the whole table)
    """A list of real and complex numbers; a pair of conjugates may be written as one, "-50 +- 300j"."""
    if isinstance(value, (str, Complex)):
        value = [value]
    if not isinstance(value, Iterable) or isinstance(value, Mapping):
        raise UnitError("a list of roots is needed", EXAMPLE)
    return tuple(root for entry in value for root in _roots(entry))


def _roots(entry: Any) -> tuple[complex, ...]:
    if isinstance(entry, Complex) and not isinstance(entry, bool):
        return (complex(entry),)
    text = "".join(str(entry).replace("±", "+-").replace("rad/s", "").split())
    match = _ROOT.match(text)
    if match is None or not text:
        raise UnitError(f"'{str(entry)[:80]}' is no root", EXAMPLE)
    real = float(match["real"] or 0.0)
    if text[-1] not in "ij":
        return (complex(real),)
    if match["sign"] is None and match["real"] is not None:
        # "300j" alone: what was read as the real part is the imaginary one.
        return (complex(0.0, real),)
    imaginary = float(match["imaginary"] or 1.0)
    if match["sign"] == "+-":
        return (complex(real, imaginary), complex(real, -imaginary))
    return (complex(real, -imaginary if match["sign"] == "-" else imaginary),)
