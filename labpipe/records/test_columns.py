"""One parameter of one fit in many tests, as columns: what tables and figures of a dataset of results are made of."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, field

from labpipe.arrays import FloatArray


@dataclass(frozen=True)
class TestColumns:
    """A parameter in (n,) tests, ordered by date and name.

    values, errors, low, high (n,) [unit]: with the standard error (combined where doubts were declared) and the ends of the 95 % interval,
    NaN where there is none. amounts: of every condition that is an amount its unit and (n,) values [that unit, SI], NaN where a test has
    none.
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
    band_hz: tuple[float, float] = (0.0, 0.0)

    @property
    def title(self) -> str:
        """The parameter and whose it is."""
        return f"{self.parameter} of {self.fit}" + (f" of {self.term}" if self.term else "")


@dataclass(frozen=True)
class ManyTests:
    """All that a dataset of results holds, for a report: parameters as columns; tests that failed and that were not accepted, and why.

    failed, not_accepted: (test, conditions as text, why or warnings), the first of them.
    """

    parameters: tuple[TestColumns, ...]
    failed: tuple[tuple[str, str, str], ...] = ()
    not_accepted: tuple[tuple[str, str, str], ...] = ()
