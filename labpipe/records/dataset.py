"""A dataset of results: its rows, their summary, and parameters of many tests as columns."""

from __future__ import annotations

import datetime
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.quantities import UnitError, si_amount
from labpipe.records import identification
from labpipe.records.finding import Finding

# Condition that dates a result.
DATE = "date"


def amount_of(condition: object) -> tuple[float, str] | None:
    """A condition in SI with its unit; None for words such as "up"."""
    try:
        return si_amount(str(condition))
    except UnitError:
        return None


def day_of(condition: object) -> datetime.date | None:
    """The day of an ISO date such as 2026-03-02 or 2026-03-02T14:10; None for another text."""
    try:
        return datetime.date.fromisoformat(str(condition)[:10])
    except ValueError:
        return None


@dataclass(frozen=True, kw_only=True)
class DatasetRow:
    """One parameter of one fit of one test, in SI units.

    rig and date of the test decide where the row is kept. std_error by noise alone; full_error: that which
    the 95 % interval goes with; *combined* and *expanded* uncertainty where uncertainties were declared.
    covariance (n,) [unit times unit]: by noise with every estimated parameter of the fit in their order, None
    for a derived one; changes: of the parameter by one standard uncertainty of every systematic source, by
    its name; dofs behind those sources that are not known. accepted: whether all rules on this test hold,
    None without rules. conditions: as people wrote them. source: SHA-256 over the digests of the test's
    files; digest: of its file of fits. failed: why a test has no result; then there is no fit and no
    parameter.
    """

    rig: str
    date: str
    test: str
    fit: str | None = None
    term: str | None = None
    model: str | None = None
    estimator: str | None = None
    low_hz: float | None = None
    high_hz: float | None = None
    parameter: str | None = None
    value: float | None = None
    unit: str | None = None
    std_error: float | None = None
    full_error: float | None = None
    combined: float | None = None
    expanded: float | None = None
    ci_low: float | None = None
    ci_high: float | None = None
    significant: bool | None = None
    gof: float | None = None
    chi2_reduced: float | None = None
    covariance: FloatArray | None = None
    random_error: float | None = None
    changes: Mapping[str, float] = field(default_factory=dict)
    dofs: Mapping[str, float] = field(default_factory=dict)
    conditions: Mapping[str, str] = field(default_factory=dict)
    warnings: str = ""
    accepted: bool | None = None
    failed: str | None = None
    source: str = ""
    digest: str = ""


@dataclass(frozen=True, kw_only=True)
class PartialOutcome:
    """What a rule found in the fits of some tests: the first outcome that fails, or the first; the fits that
    it addresses.

    fault: (what, hint) where fits of a test were addressed and none of them has what the rule names.
    """

    outcome: identification.RuleOutcome | None = None
    addressed: int = 0
    fault: tuple[str, str] | None = None

    def with_more(self, other: PartialOutcome) -> PartialOutcome:
        """Of these tests and of further ones."""
        both = [partial.outcome for partial in (self, other) if partial.outcome is not None]
        first = next((outcome for outcome in both if not outcome.passed), both[0] if both else None)
        return PartialOutcome(
            outcome=first, addressed=self.addressed + other.addressed, fault=self.fault or other.fault
        )


@dataclass(frozen=True, kw_only=True)
class TestResult:
    """What a test among many comes to: its rows, its findings with their origin, and what each rule found in
    it, by the rule's number.
    """

    __test__ = False

    rows: tuple[DatasetRow, ...]
    findings: tuple[tuple[str, Finding], ...] = ()
    partial: tuple[PartialOutcome, ...] = ()
    forbidden: tuple[identification.RuleOutcome, ...] = ()


def rows_of_fit(fit: identification.Fit, common: Mapping[str, object]) -> Iterator[DatasetRow]:
    """The rows of one fit; *common*: what all rows of its test share."""
    covariance = noise_covariance(fit)
    for listed in identification.of_fit(fit):
        row = {**entries_of(listed), "covariance": covariance.get(listed.parameter.name), **common}
        row |= {"gof": fit.gof.r2_adjusted, "chi2_reduced": fit.gof.chi2_reduced}
        yield DatasetRow(**row)  # type: ignore[arg-type]


def entries_of(listed: identification.ListedParameter) -> dict[str, object]:
    """What the row of a parameter says of it and its fit."""
    parameter, (low, high) = listed.parameter, listed.band_hz
    same = ("fit", "term", "model", "estimator", "random_error", "changes", "dofs")
    row = {name: getattr(listed, name) for name in same}
    same = ("value", "unit", "std_error", "full_error", "combined", "expanded", "significant")
    row |= {name: getattr(parameter, name) for name in same}
    row |= zip(("ci_low", "ci_high"), parameter.ci95 or (None, None), strict=True)
    return {
        **row,
        "parameter": parameter.name,
        "low_hz": low,
        "high_hz": high,
        "warnings": ", ".join(listed.warnings),
    }


def noise_covariance(fit: identification.Fit) -> dict[str, FloatArray]:
    """Rows of the covariance by noise, r_ij s_i s_j, of the estimated parameters by their names: (n,) [units
    of both]; none without.
    """
    estimated = fit.estimated
    errors = np.array([parameter.std_error for parameter in estimated], np.float64)
    if fit.correlation.shape != (len(estimated), len(estimated)):
        return {}
    covariance = fit.correlation * np.outer(errors, errors)
    return {parameter.name: row for parameter, row in zip(estimated, covariance, strict=True)}


def is_accepted(
    partial: Sequence[PartialOutcome], forbidden: Sequence[identification.RuleOutcome]
) -> bool | None:
    """Whether every rule that addresses a test holds there; None where none does.

    A rule that the test cannot keep or break does not.
    """
    if any(row.fault is not None for row in partial):
        return False
    outcomes = [row.outcome for row in partial if row.outcome is not None] + list(forbidden)
    return all(outcome.passed for outcome in outcomes) if outcomes else None


# Some tests of a dataset summed up: what each part of it carries, and what adds up to the result of all.

# Failed tests that are named by name; the dataset has them all.
MOST_FAILED = 100


@dataclass(frozen=True, kw_only=True)
class DatasetSummary:
    """The index of some tests, what each rule found in them by its number, forbidding warnings, and the first
    tests that failed.
    """

    index: identification.DatasetIndex = field(default_factory=identification.DatasetIndex)
    partial: tuple[PartialOutcome, ...] = ()
    forbidden: tuple[identification.RuleOutcome, ...] = ()
    failed: tuple[identification.Failed, ...] = ()

    def with_more(self, other: DatasetSummary) -> DatasetSummary:
        """Of these tests and of further ones."""
        none = (PartialOutcome(),) * max(len(self.partial), len(other.partial))
        pairs = zip(self.partial or none, other.partial or none, strict=True)
        forbidden = {outcome.rule: outcome for outcome in (*other.forbidden, *self.forbidden)}
        return DatasetSummary(
            index=self.index.with_more(other.index),
            partial=tuple(mine.with_more(theirs) for mine, theirs in pairs),
            forbidden=tuple(forbidden[rule] for rule in sorted(forbidden)),
            failed=(*self.failed, *other.failed)[:MOST_FAILED],
        )


def summary_of(result: TestResult) -> DatasetSummary:
    """One test summed up."""
    row = result.rows[0] if result.rows else None
    if row is not None and row.failed is not None:
        return DatasetSummary(
            index=identification.DatasetIndex(failed=1, rows=1),
            failed=(identification.Failed(row.test, row.failed),),
        )
    fits: dict[str, int] = {}
    for name, _, _ in dict.fromkeys(
        (row.fit, row.term, row.low_hz) for row in result.rows if row.fit is not None
    ):
        fits[name] = fits.get(name, 0) + 1
    findings = {
        (finding.level, finding.code): identification.CountedFinding(finding, origin, 1)
        for origin, finding in reversed(result.findings)
    }
    index = identification.DatasetIndex(
        tests=1,
        not_accepted=int(row is not None and row.accepted is False),
        rows=len(result.rows),
        fits=fits,
        findings=tuple(findings[key] for key in sorted(findings)),
    )
    return DatasetSummary(index=index, partial=result.partial, forbidden=result.forbidden)


def sum_summaries(summaries: Iterable[DatasetSummary]) -> DatasetSummary:
    """All of them together, in their order."""
    total = DatasetSummary()
    for summary in summaries:
        total = total.with_more(summary)
    return total


# One parameter of one fit in many tests, as columns: what tables and figures of a dataset of results are
# made of.


@dataclass(frozen=True)
class TestColumns:
    """A parameter in (n,) tests, ordered by date and name.

    values, errors, low, high (n,) [unit]: with the standard error (combined where uncertainties were
    declared) and the ends of the 95 % interval, NaN where there is none. amounts: of every condition that is
    an amount its unit and (n,) values [that unit, SI], NaN where a test has none. band: of a
    fit that has several, in words.
    """

    __test__ = False

    fit: str
    term: str
    parameter: str
    unit: str
    _: KW_ONLY
    tests: tuple[str, ...]
    dates: tuple[str, ...]
    values: FloatArray
    errors: FloatArray
    low: FloatArray
    high: FloatArray
    amounts: Mapping[str, tuple[str, FloatArray]] = field(default_factory=dict)
    band: str = ""

    @property
    def title(self) -> str:
        """The parameter and whose it is."""
        term = f" of {self.term}" if self.term else ""
        return f"{self.parameter} of {self.fit}{term} {self.band}".rstrip()


@dataclass(frozen=True)
class ManyTests:
    """All that a dataset of results holds, for a report: parameters as columns; tests that failed and that
    were not accepted, and why.

    failed, not_accepted: (test, conditions as text, why or warnings), the first of them.
    """

    parameters: tuple[TestColumns, ...]
    failed: tuple[tuple[str, str, str], ...] = ()
    not_accepted: tuple[tuple[str, str, str], ...] = ()
