"""What comparisons of tests give: points, amounts with their uncertainty and a verdict; tests ordered by
their conditions; and a Monte Carlo study: errors of every fit over many repeats.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import KW_ONLY, dataclass, field
from fnmatch import fnmatchcase
from typing import Protocol

from labpipe.quantities import display_unit, readable_unit, to_display
from labpipe.records.finding import Finding, Parameter, parameter_by_name
from labpipe.records.uncertain import Budget


@dataclass(frozen=True)
class ComparedPoint:
    """One test's part in a comparison, in SI units.

    *value* with its 95 % interval *ci95*; *condition* [condition_unit of the comparison], the *second*
    condition [second_unit] if there is one, and *group* tell it from the others. *theory*: the same fit on
    the theory's own curve; *ratio* measured / theory with *ratio_ci95*. *p_value* where the point is a test
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
    """One parameter of one band of a sliding fit and *other*: its prediction, or the same band of another
    test; SI units.

    *ratio* value / other with its 95 % interval; *p_value* of the difference, corrected for the number of
    bands.
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
class QuantityCurve:
    """A quantity over frequency [Hz], (n_frequency,) each, SI; empty where missing.

    *measured* with *low* and *high* of its 95 % intervals; the *theory*; the theory *matched* to the
    measurement.
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
    """|H| of one test measured, of the theory, and of the fitted theory.

    (n_frequency,) each, *form* in SI.
    """

    test: str
    form: str
    frequency: tuple[float, ...]
    measured: tuple[float, ...]
    theory: tuple[float, ...]
    matched: tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Comparison of tests: its *kind*, quantity, *condition* and result.

    *second*: another condition, where tests differ in two. *verdict* is one word or two for rules ("no
    difference"), *statement* the same as a sentence for people. *line*: condition and value of the fitted
    trend, for drawing; *overlays*: measured curves and the theory's, at the first and the last condition.
    *bands* and *curves*: where something is compared over frequency; *correlations* of estimated amounts,
    (name, name, value); *findings*: warnings. *budgets*: of amounts to whose uncertainty systematic sources
    add, those on the same data one by one. *undecided*: amounts by name, or patterns of them (`pole_*`), and
    the verdict, that could not be judged, each with the reason.
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
    curves: tuple[QuantityCurve, ...] = ()
    correlations: tuple[tuple[str, str, float], ...] = ()
    findings: tuple[Finding, ...] = ()
    budgets: tuple[Budget, ...] = ()
    undecided: tuple[tuple[str, str], ...] = ()

    def why_undecided(self, name: str) -> str:
        """Why an amount or the verdict could not be judged; empty where it was."""
        return next((why for pattern, why in self.undecided if fnmatchcase(name, pattern)), "")

    def amount(self, name: str) -> Parameter:
        """The amount of that name; KeyError with the known names otherwise."""
        return parameter_by_name(self.amounts, name, "amount")


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


# The tests of one fit ordered by their conditions: a matrix whose points are the coefficients at one level
# of every condition.

# Frequencies of conditions whose names begin so are speeds of rotation.
SPEEDS = ("speed", "spin", "rotation", "omega")

# Units of conditions that differ from those of results.
CONDITION_UNITS = {"K": "degC", "m^3/s": "l/min", "Pa": "bar"}


def condition_unit(name: str, si_unit: str) -> str:
    """The unit in which a condition is shown: speeds of rotation in rpm, temperatures in degC."""
    if si_unit == "Hz" and name.lower().startswith(SPEEDS):
        return "rpm"
    return CONDITION_UNITS.get(si_unit) or display_unit(si_unit)


@dataclass(frozen=True)
class ConditionAxis:
    """One condition: its name, SI unit, and its *levels* in ascending order [unit]."""

    name: str
    unit: str
    levels: tuple[float, ...]

    @property
    def shown_unit(self) -> str:
        """The unit in which levels are shown, with a prefix that suits the largest."""
        unit = condition_unit(self.name, self.unit)
        return readable_unit(unit, self.levels) if unit == self.unit else unit

    def show(self, level: float) -> float:
        """A level in the unit in which it is shown."""
        return to_display(level, self.shown_unit)

    def text(self, level: float) -> str:
        """A level with name and unit, as people read it."""
        return f"{self.name} {self.digits(level)} {self.shown_unit}".removesuffix(" 1")

    def digits(self, level: float) -> str:
        """A level in the unit in which it is shown, to four digits: 12000 rpm, not 1.2e+04."""
        shown = self.show(level)
        return f"{shown:.0f}" if 1e4 <= abs(shown) < 1e6 else f"{shown:.4g}"


@dataclass(frozen=True)
class Repeated:
    """One coefficient at one point: the mean of its *repeats* as a parameter, with its uncertainty.

    scatter: standard deviation of the repeats [unit of the parameter], None for one; p_value: chance of so
    large a scatter by the standard errors of the fits alone; theory: the value of a theory at the conditions,
    None without one; changes: of the mean by one standard uncertainty of every source that its tests share,
    and dofs behind those sources that are not known.
    """

    parameter: Parameter
    repeats: int
    _: KW_ONLY
    scatter: float | None = None
    p_value: float | None = None
    theory: float | None = None
    changes: Mapping[str, float] = field(default_factory=dict)
    dofs: Mapping[str, float] = field(default_factory=dict)

    @property
    def error_alone(self) -> float | None:
        """Standard error [unit of the parameter] without these changes; None where there is none."""
        if (full := self.parameter.full_error) is None:
            return None
        return math.sqrt(max(full**2 - math.fsum(change**2 for change in self.changes.values()), 0.0))

    @property
    def holds_theory(self) -> bool | None:
        """Whether the 95 % interval covers the theory; None where one of them is missing."""
        if self.theory is None or self.parameter.ci95 is None:
            return None
        return self.parameter.ci95[0] <= self.theory <= self.parameter.ci95[1]


@dataclass(frozen=True)
class Beside:
    """A further condition at a point: mean over its tests and their scatter [unit, an SI unit]."""

    name: str
    value: float
    scatter: float
    unit: str


@dataclass(frozen=True)
class MatrixPoint:
    """The tests at one level of every condition; *place*: number of the level on each axis. warnings: codes
    of the tests' findings.
    """

    place: tuple[int, ...]
    tests: tuple[str, ...]
    values: tuple[Repeated, ...]
    beside: tuple[Beside, ...] = ()
    warnings: tuple[str, ...] = ()

    def value(self, name: str) -> Repeated | None:
        """The coefficient of that name; None where the tests do not have it."""
        return next((value for value in self.values if value.parameter.name == name), None)


@dataclass(frozen=True)
class PathPoint:
    """Rest position of the shaft at one load: *position* (x, y) [m] from the centre with standard errors [m],
    eccentricity [m].

    attitude: angle [rad] from the load to the position.

    statics: displacement per force along the load by the slope of the path, (x, y) [m/N]; shaking: the same
    by K from shaking; with their standard errors; empty where there is no slope or no K. p_value: chance of
    so large a difference of the two.
    """

    load: float
    position: tuple[float, float]
    position_error: tuple[float, float]
    eccentricity: float
    attitude: float
    _: KW_ONLY
    statics: tuple[float, ...] = ()
    statics_error: tuple[float, ...] = ()
    shaking: tuple[float, ...] = ()
    shaking_error: tuple[float, ...] = ()
    p_value: float | None = None


@dataclass(frozen=True)
class EquilibriumPath:
    """Rest positions over the load at one level of all other conditions, which *at* says.

    Clearance [m], None where it is not known.
    """

    at: str
    points: tuple[PathPoint, ...]
    clearance: float | None = None


@dataclass(frozen=True, kw_only=True)
class ConditionMatrix:
    """The points of one fit over the levels of its conditions.

    missing: combinations of levels without a test; amounts: what rules may ask; statement: the result as a
    sentence.
    """

    name: str
    fit: str
    axes: tuple[ConditionAxis, ...]
    names: tuple[str, ...]
    points: tuple[MatrixPoint, ...]
    missing: tuple[tuple[int, ...], ...] = ()
    paths: tuple[EquilibriumPath, ...] = ()
    amounts: tuple[Parameter, ...] = ()
    statement: str = ""
    findings: tuple[Finding, ...] = ()

    def amount(self, name: str) -> Parameter:
        """The amount of that name; KeyError with the known names otherwise."""
        return parameter_by_name(self.amounts, name, "amount")

    def unit_of(self, name: str) -> str:
        """The unit in which a coefficient is shown at all points, with a prefix that suits the largest."""
        values = [value.parameter for point in self.points if (value := point.value(name)) is not None]
        return readable_unit(values[0].unit, (parameter.value for parameter in values)) if values else "1"

    def text_of(self, point: MatrixPoint) -> str:
        """The conditions of a point as people read them."""
        return ", ".join(
            axis.text(level) for axis, level in zip(self.axes, self.levels_of(point), strict=True)
        )

    def levels_of(self, point: MatrixPoint) -> tuple[float, ...]:
        """The condition of a point on every axis [units of the axes]."""
        return tuple(axis.levels[number] for axis, number in zip(self.axes, point.place, strict=True))


ConditionMatrices = tuple[ConditionMatrix, ...]


def matrix_findings(matrices: ConditionMatrices) -> tuple[tuple[str, Finding], ...]:
    """Every finding with the name of its matrix."""
    return tuple((matrix.name, finding) for matrix in matrices for finding in matrix.findings)


@dataclass(frozen=True)
class StudiedParameter:
    """One parameter over the repeats that gave a result.

    *bound*: Cramer-Rao standard deviation of an unbiased estimate, None where it is not known. *std_error*:
    mean of what the fits stated, None where they stated none. *coverage*: share of 95 % intervals that hold
    the truth.
    """

    name: str
    unit: str
    _: KW_ONLY
    truth: float
    mean: float
    rmse: float
    bound: float | None
    std_error: float | None
    coverage: float | None

    @property
    def bias(self) -> float:
        return self.mean - self.truth


@dataclass(frozen=True, kw_only=True)
class StudyCase:
    """One fit at one noise level with one number of lines.

    *failed*: repeats without a result (no convergence, or refused). mean_error, median_error, error_variance:
    of the sum of squared parameter errors of all repeats that ended with numbers, a coefficient of a
    symmetric matrix counted at both its places; *success*: share of all repeats that ended in a result whose
    relative deviation is below each of the study's limits. rmse_over_bound: root mean square over the
    parameters of rmse / bound. *coverage*: mean over the parameters.
    """

    fit: str
    estimator: str
    noise: float
    lines: int
    repeats: int
    failed: int
    mean_error: float
    median_error: float
    error_variance: float
    success: tuple[float, ...]
    rmse_over_bound: float | None
    coverage: float | None
    parameters: tuple[StudiedParameter, ...]


@dataclass(frozen=True)
class StudyThreshold:
    """The noise level at which a fit's success rate falls under the study's share.

    None when it did not within the range searched.
    """

    fit: str
    limit: float
    noise: float | None
    repeats: int


@dataclass(frozen=True)
class Study:
    """All cases of a study. *limits*: relative deviations that count as success; *share*: the required
    success rate. *printed*: mean errors published elsewhere, by fit, one for each noise level.
    """

    rig: str
    seed: int
    limits: tuple[float, ...]
    share: float
    cases: tuple[StudyCase, ...]
    thresholds: tuple[StudyThreshold, ...] = ()
    printed: tuple[tuple[str, tuple[float, ...]], ...] = ()


Studies = tuple[Study, ...]
