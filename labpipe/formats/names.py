"""Column names that stand once each."""

from __future__ import annotations

from collections.abc import Sequence


def unique(names: Sequence[str]) -> tuple[str, ...]:
    """The names, numbered from the second on where one comes again: a, a_2, a_3."""
    found: list[str] = []
    for name in names:
        candidate, number = name, 1
        while candidate in found:
            number += 1
            candidate = f"{name}_{number}"
        found.append(candidate)
    return tuple(found)
