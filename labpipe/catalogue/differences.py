"""Comparison of two results, parameter by parameter."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from scipy import special

from labpipe.campaign.bandwise import holm
from labpipe.campaign.common_sources import matrix_of
from labpipe.errors import DataError
from labpipe.records.listed import ListedParameter

LEVEL = 0.05


@dataclass(frozen=True, kw_only=True)
class Difference:
    """One parameter in two results, in SI units.

    p_value: probability of an equal or larger difference by the standard errors alone, corrected for the number of parameters compared
    (Holm); None where a standard error is missing.
    """

    fit: str
    test: str
    parameter: str
    unit: str
    first: float
    second: float
    std_error: float | None
    p_value: float | None

    @property
    def differs(self) -> bool:
        return self.p_value is not None and self.p_value < LEVEL


def differences(first: Iterable[ListedParameter], second: Iterable[ListedParameter]) -> list[Difference]:
    """The parameters common to two results, in the order of the first one; DataError when there is none.

    z = (b - a) / sqrt(s_a^2 + s_b^2 + sum (c_b - c_a)^2), c the changes by sources that both may have in common, two-sided against the
    normal distribution, Holm's correction over all of them. Parameters are matched by fit, term, band, test, name and unit; the test's name
    is ignored where each result has one test only.
    """
    mine, others = list(first), list(second)
    one_test = all(len({listed.test for listed in side}) == 1 for side in (mine, others))
    theirs = {_key(listed, one_test): listed for listed in others}
    pairs = [_difference(listed, partner) for listed in mine if (partner := theirs.get(_key(listed, one_test))) is not None]
    if not pairs:
        names = [", ".join(dict.fromkeys(listed.fit for listed in side)) or "none" for side in (mine, others)]
        raise DataError(f"the two have no fit in common (fits: {names[0]}; {names[1]})", hint="name, term, band and test must be the same")
    with_p_value = [number for number, pair in enumerate(pairs) if pair.p_value is not None]
    corrected = holm(np.array([pairs[number].p_value for number in with_p_value], np.float64))
    for number, p_value in zip(with_p_value, corrected, strict=True):
        pairs[number] = replace(pairs[number], p_value=float(p_value))
    return pairs


def _key(listed: ListedParameter, one_test: bool) -> tuple[str, ...]:
    band = f"{listed.band_hz[0]:g}-{listed.band_hz[1]:g}"
    return listed.fit, listed.term, band, "" if one_test else listed.test, listed.parameter.name, listed.parameter.unit


def _difference(mine: ListedParameter, other: ListedParameter) -> Difference:
    """The difference with its p-value before the correction."""
    change = matrix_of([mine.changes, other.changes])
    errors = mine.random_error, other.random_error
    error = (
        float(np.sqrt(errors[0] ** 2 + errors[1] ** 2 + np.sum((change[:, 1] - change[:, 0]) ** 2))) if errors[0] and errors[1] else None
    )
    value, other_value = mine.parameter.value, other.parameter.value
    p_value = None if error is None else 2 * float(special.ndtr(-abs(other_value - value) / error))
    return Difference(
        fit=f"{mine.fit} of {mine.term}" if mine.term else mine.fit,
        test=mine.test,
        parameter=mine.parameter.name,
        unit=mine.parameter.unit,
        first=value,
        second=other_value,
        std_error=error,
        p_value=p_value,
    )
