"""What a comparison of tests that differ in a condition gives: its points, its amounts with their doubt, and a verdict in words."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import KW_ONLY, dataclass
from typing import Protocol

from labpipe.records.budget import Budget
from labpipe.records.finding import Finding
from labpipe.records.parameter import Parameter


@dataclass(frozen=True)
class ComparedPoint:
    """One test's part in a comparison, in SI units.

    *value* with its 95 % interval *ci95*; *condition* [condition_unit of the comparison], the *second* condition [second_unit] if there is
    one, and *group* tell it from the others.
    *theory*: the same fit on the theory's own curve; *ratio* measured / theory with *ratio_ci95*. *p_value* where the point is a test
    of its own (reciprocity of a pair of dofs).
    """

    test: str
    value: float
    _: KW_ONLY
    ci95: tuple[float, float] | None = None
    condition: float | None = None
    second: float | None = None
    group: str = ""
    theory: float | None = None
    ratio: float | None = None
    ratio_ci95: tuple[float, float] | None = None
    p_value: float | None = None


@dataclass(frozen=True)
class ComparedBand:
    """One parameter of one band of a sliding fit and *other*: its prediction, or the same band of another test; SI units.

    *ratio* value / other with its 95 % interval; *p_value* of the difference, corrected for the number of bands.
    """

    test: str
    parameter: str
    unit: str
    _: KW_ONLY
    band_hz: tuple[float, float]
    value: float
    ci95: tuple[float, float]
    other: float
    other_ci95: tuple[float, float] | None = None
    ratio: float | None = None
    ratio_ci95: tuple[float, float] | None = None
    p_value: float | None = None

    @property
    def centre_hz(self) -> float:
        return (self.band_hz[0] + self.band_hz[1]) / 2

    @property
    def holds(self) -> bool:
        """True if the 95 % interval covers the other value."""
        return self.ci95[0] <= self.other <= self.ci95[1]


@dataclass(frozen=True)
class Curve:
    """A quantity over frequency [Hz], (n_frequency,) each, SI; empty where missing.

    *measured* with *low* and *high* of its 95 % intervals; the *theory*; the theory *matched* to the measurement.
    """

    test: str
    quantity: str
    unit: str
    _: KW_ONLY
    frequency: tuple[float, ...]
    theory: tuple[float, ...] = ()
    matched: tuple[float, ...] = ()
    measured: tuple[float, ...] = ()
    low: tuple[float, ...] = ()
    high: tuple[float, ...] = ()


@dataclass(frozen=True)
class Overlay:
    """|H| of one test measured, of the theory, and of the fitted theory; (n_frequency,) each, *form* in SI."""

    test: str
    form: str
    frequency: tuple[float, ...]
    measured: tuple[float, ...]
    theory: tuple[float, ...]
    matched: tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Comparison of tests: its *kind*, quantity, *condition* and result.

    *second*: another condition, where tests differ in two.
    *verdict* is one word or two for rules ("no difference"), *statement* the same as a sentence for people. *line*: condition and value
    of the fitted trend, for drawing; *overlays*: measured curves and the theory's, at the first and the last condition. *bands* and
    *curves*: where something is compared over frequency; *correlations* of estimated amounts, (name, name, value); *findings*: warnings.
    *budgets*: of amounts to whose doubt systematic sources add, each of those that rest on the same data.
    """

    name: str
    kind: str
    subject: str
    unit: str
    points: tuple[ComparedPoint, ...]
    amounts: tuple[Parameter, ...]
    verdict: str
    statement: str
    condition: str = ""
    condition_unit: str = ""
    second: str = ""
    second_unit: str = ""
    line: tuple[tuple[float, float], ...] = ()
    overlays: tuple[Overlay, ...] = ()
    bands: tuple[ComparedBand, ...] = ()
    curves: tuple[Curve, ...] = ()
    correlations: tuple[tuple[str, str, float], ...] = ()
    findings: tuple[Finding, ...] = ()
    budgets: tuple[Budget, ...] = ()

    def amount(self, name: str) -> Parameter:
        """The amount of that name; KeyError with the known names otherwise."""
        for amount in self.amounts:
            if amount.name == name:
                return amount
        raise KeyError(f"no amount '{name}'; known: {', '.join(a.name for a in self.amounts)}")


Comparisons = tuple[Comparison, ...]


class Named(Protocol):
    """Settings or result of one comparison."""

    @property
    def name(self) -> str: ...


def names(comparisons: Iterable[Named]) -> tuple[str, ...]:
    """The names of comparisons or of their settings, by which rules address them."""
    return tuple(comparison.name for comparison in comparisons)


def findings(comparisons: Comparisons) -> tuple[tuple[str, Finding], ...]:
    """Every finding with the name of its comparison."""
    return tuple((comparison.name, finding) for comparison in comparisons for finding in comparison.findings)
