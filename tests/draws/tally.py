"""Counts over many worlds: scatter over combined uncertainty, how often intervals hold the truth, and the
random part alone.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from labpipe.records.finding import Parameter

# Two-sided 95 % of a normal distribution.
TWO_SIDED = 1.959964


@dataclass(frozen=True)
class Row:
    """One parameter by *draws* worlds: *ratio* of the scatter to the root mean square of the combined
    uncertainty, shares of the worlds that hold the truth, *bias* in combined uncertainties.
    """

    name: str
    draws: int
    relative: float
    ratio: float
    held: float
    by_noise: float
    bias: float

    @property
    def chance(self) -> float:
        """Three standard deviations of a scatter of so many draws."""
        return 3 / np.sqrt(2 * self.draws)

    @property
    def is_good(self) -> bool:
        """Within 5 % of first order and 93-97 %, beside chance."""
        spread = 3 * np.sqrt(0.95 * 0.05 / self.draws)
        return not abs(self.ratio - 1) > 0.05 + self.chance and 0.93 - spread <= self.held <= 0.97 + spread


@dataclass
class Tally:
    """Worlds of parameters by name; *truth* by name."""

    truth: dict[str, float]
    worlds: dict[str, list[tuple[float, float, bool, bool]]] = field(default_factory=dict)
    failed: int = 0
    reasons: list[str] = field(default_factory=list)

    def add(self, parameters: Mapping[str, Parameter]) -> None:
        for name, one in parameters.items():
            truth = self.truth.get(name)
            if truth is None or one.ci95 is None or one.full_error == 0:
                continue
            # An interval without a standard error is compared with the truth alone.
            error = np.nan if one.full_error is None else one.full_error
            noise = error if one.systematic is None else np.sqrt(max(error**2 - one.systematic**2, 0.0))
            held = one.ci95[0] <= truth <= one.ci95[1]
            self.worlds.setdefault(name, []).append(
                (one.value, error, held, abs(one.value - truth) <= TWO_SIDED * noise)
            )

    def rows(self) -> Iterable[Row]:
        for name, worlds in self.worlds.items():
            if len(worlds) < 20:
                continue
            values, errors, held, by_noise = np.array(worlds, float).T
            error, truth = float(np.sqrt(np.mean(errors**2))), self.truth[name]
            relative = error / abs(truth) if truth else np.nan
            ratio = float(np.std(values, ddof=1)) / error
            yield Row(
                name,
                len(worlds),
                relative,
                ratio,
                float(np.mean(held)),
                float(np.mean(by_noise)),
                float(np.mean(values) - truth) / error,
            )


HEAD = f"{'parameter':58s} {'draws':>6s} {'u_c':>8s} {'ratio':>6s} {'held':>6s} {'noise':>6s} {'bias':>6s}"


def line(row: Row) -> str:
    """One row as text; what is not as it should be carries a mark."""
    mark = "" if row.is_good else "  <--"
    sizes = (
        f"{row.draws:6d} {100 * row.relative:7.3g}% {row.ratio:6.3f} {100 * row.held:5.1f}% "
        f"{100 * row.by_noise:5.1f}% {row.bias:+6.2f}"
    )
    return f"{row.name:58s} {sizes}{mark}"
