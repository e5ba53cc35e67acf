"""Unique column names."""

from __future__ import annotations

from collections.abc import Sequence


def unique(names: Sequence[str]) -> tuple[str, ...]:
    """The names, with repeated ones numbered from the second on: a, a_2, a_3."""
    unique_names: list[str] = []
    for name in names:
        candidate, number = name, 1
        while candidate in unique_names:
            number += 1
            candidate = f"{name}_{number}"
        unique_names.append(candidate)
    return tuple(unique_names)
