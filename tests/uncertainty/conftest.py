"""Fits of imagined tests with stated values, errors and conditions."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest

from labpipe.records.finding import Parameter
from labpipe.records.identification import Fit, Goodness
from labpipe.uncertainty.observations import Campaign, campaign_of
from labpipe.uncertainty.settings import CompareSettings


def a_fit(
    test: str,
    values: dict[str, tuple[float, float]],
    correlation: float = 0.0,
    term: str = "",
    name: str = "axial",
) -> Fit:
    """A fit whose parameters have the (value, standard error) given, units by their first letter."""
    units = {"k": "N/m", "c": "N.s/m", "m": "kg"}
    parameters = tuple(
        Parameter(
            key,
            value,
            units[key[0]],
            std_error=error,
            t_ratio=value / error if error else None,
            ci95=(value - 2 * error, value + 2 * error),
        )
        for key, (value, error) in values.items()
    )
    matrix = np.full((len(parameters),) * 2, correlation) + (1 - correlation) * np.eye(len(parameters))
    return Fit(
        name,
        "sdof",
        "ml",
        band_hz=(10.0, 20.0),
        lines=11,
        equations=22,
        dof=20,
        gof=Goodness(1.0, 1.0),
        parameters=parameters,
        condition_number=1.0,
        correlation=matrix,
        test=test,
        term=term,
    )


@pytest.fixture
def campaign() -> Callable[..., Campaign]:
    """The campaign of tests with (value of k, standard error, conditions)."""

    def make(settings: CompareSettings, tests: Sequence[tuple[float, float, dict[str, str]]]) -> Campaign:
        fits = [a_fit(f"test {n}", {"k": (value, error)}) for n, (value, error, _) in enumerate(tests)]
        return campaign_of(settings, fits, {f"test {n}": given for n, (_, _, given) in enumerate(tests)})

    return make
