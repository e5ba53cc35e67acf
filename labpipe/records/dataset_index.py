"""What the results of many tests say as a whole, while their numbers stand in a dataset."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from labpipe.records.finding import WARNING, Finding


@dataclass(frozen=True)
class CountedFinding:
    """A kind of finding: in how many tests it was made, and the first one with its origin."""

    finding: Finding
    origin: str
    tests: int

    @property
    def message(self) -> str:
        """The finding as one sentence of all tests."""
        more = f" ({self.tests} tests in all; this is the first)" if self.tests > 1 else ""
        return f"{self.finding.code}: {self.origin}{more}: {self.finding.message}"


@dataclass(frozen=True, kw_only=True)
class DatasetIndex:
    """Tests with a result and *failed* ones without, those whose rules do not all hold, *rows* of the dataset, fits by their name."""

    tests: int = 0
    failed: int = 0
    not_accepted: int = 0
    rows: int = 0
    fits: Mapping[str, int] = field(default_factory=dict)
    findings: tuple[CountedFinding, ...] = ()

    def of_level(self, level: str = WARNING) -> tuple[CountedFinding, ...]:
        """The kinds of findings of a level."""
        return tuple(counted for counted in self.findings if counted.finding.level == level)

    def with_more(self, other: DatasetIndex) -> DatasetIndex:
        """Of these tests and of further ones."""
        counted: dict[tuple[str, str], CountedFinding] = {}
        for finding in (*self.findings, *other.findings):
            key = finding.finding.level, finding.finding.code
            before = counted.get(key)
            counted[key] = finding if before is None else CountedFinding(before.finding, before.origin, before.tests + finding.tests)
        return DatasetIndex(
            tests=self.tests + other.tests,
            failed=self.failed + other.failed,
            not_accepted=self.not_accepted + other.not_accepted,
            rows=self.rows + other.rows,
            fits={name: self.fits.get(name, 0) + other.fits.get(name, 0) for name in dict.fromkeys((*self.fits, *other.fits))},
            findings=tuple(counted[key] for key in sorted(counted)),
        )
