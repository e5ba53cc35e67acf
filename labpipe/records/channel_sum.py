"""Sums of channels: f - m a, x_stator - x_shaft, (x_1 + x_2) / 2, with the doubt of the numbers in them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Number:
    """A number with its doubt that stands in a sum: *value*, *std_error* [unit], an SI unit; numbers of one *source* have one error."""

    name: str
    value: float
    std_error: float
    unit: str
    source: str = ""


@dataclass(frozen=True)
class Term:
    """A channel in a sum, times *factor* [SI unit of the sum per SI unit of the channel].

    numbers: those in the factor that have a doubt; derivatives: of the factor by each of them.
    """

    channel: str
    factor: float
    numbers: tuple[Number, ...] = ()
    derivatives: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        # A file gives lists of mappings.
        object.__setattr__(self, "numbers", tuple(_number(entry) for entry in self.numbers))
        object.__setattr__(self, "derivatives", tuple(self.derivatives))

    def times(self, factor: float) -> Term:
        """The term times a number without doubt."""
        return Term(self.channel, factor * self.factor, self.numbers, tuple(factor * derivative for derivative in self.derivatives))


def _number(entry: Any) -> Number:
    return entry if isinstance(entry, Number) else Number(**entry)


def as_terms(entries: Any) -> tuple[Term, ...]:
    """The terms of a channel, as they are or from the mappings of a file."""
    return tuple(entry if isinstance(entry, Term) else Term(**entry) for entry in entries)
