"""Some tests of a dataset summed up: what each part of it carries, and what adds up to the result of all."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

from labpipe.records.dataset_index import CountedFinding, DatasetIndex
from labpipe.records.dataset_row import PartialOutcome, TestResult
from labpipe.records.identification import Failed, RuleOutcome

# Failed tests that are named by name; the dataset has them all.
MOST_FAILED = 100


@dataclass(frozen=True, kw_only=True)
class DatasetSummary:
    """The index of some tests, what each rule found in them by its number, forbidding warnings, and the first tests that failed."""

    index: DatasetIndex = field(default_factory=DatasetIndex)
    partial: tuple[PartialOutcome, ...] = ()
    forbidden: tuple[RuleOutcome, ...] = ()
    failed: tuple[Failed, ...] = ()

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
        return DatasetSummary(index=DatasetIndex(failed=1, rows=1), failed=(Failed(row.test, row.failed),))
    fits: dict[str, int] = {}
    for name, _, _ in dict.fromkeys((row.fit, row.term, row.low_hz) for row in result.rows if row.fit is not None):
        fits[name] = fits.get(name, 0) + 1
    findings = {(finding.level, finding.code): CountedFinding(finding, origin, 1) for origin, finding in reversed(result.findings)}
    index = DatasetIndex(
        tests=1,
        not_accepted=int(row is not None and row.accepted is False),
        rows=len(result.rows),
        fits=fits,
        findings=tuple(findings[key] for key in sorted(findings)),
    )
    return DatasetSummary(index=index, partial=result.partial, forbidden=result.forbidden)


def summed(summaries: Iterable[DatasetSummary]) -> DatasetSummary:
    """All of them together, in their order."""
    total = DatasetSummary()
    for summary in summaries:
        total = total.with_more(summary)
    return total
