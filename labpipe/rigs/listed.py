"""Largest radii of a response to unbalance for lists of results."""

from __future__ import annotations

from collections.abc import Iterator

from labpipe.records.listed import ListedParameter
from labpipe.records.parameter import Parameter
from labpipe.records.unbalance import UnbalanceRuns


def listed_peaks(runs: UnbalanceRuns) -> Iterator[ListedParameter]:
    """Peaks [m] and their speeds [Hz] of every state of wear."""
    for case in runs.cases:
        for name, (value, unit) in runs.values(case).items():
            error = case.error(name)
            parameter = Parameter(name, value, unit, derived=True, std_error=error)
            yield ListedParameter(fit="unbalance", parameter=parameter, test=case.name, model="unbalance")
