"""Amounts of comparisons as lists of results show them."""

from __future__ import annotations

from collections.abc import Iterator

from labpipe.records.comparison import Comparisons
from labpipe.records.finding import WARNING, of_level
from labpipe.records.listed import ListedParameter


def listed_amounts(comparisons: Comparisons) -> Iterator[ListedParameter]:
    """Every amount under the name of its comparison."""
    for comparison in comparisons:
        codes = tuple(dict.fromkeys(finding.code for finding in of_level(WARNING, comparison.findings)))
        for amount in comparison.amounts:
            yield ListedParameter(fit=comparison.name, parameter=amount, model=comparison.kind, warnings=codes)
