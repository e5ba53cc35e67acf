"""Comparison of two results, parameter by parameter."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import special

from labpipe.campaign.bandwise import holm
from labpipe.campaign.common_sources import parameter_changes, random_error
from labpipe.errors import DataError
from labpipe.records.identification import Fit, Identification, Parameter

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


def differences(first: Identification, second: Identification) -> list[Difference]:
    """The parameters common to both results, in the order of the first one; DataError when there is none.

    z = (b - a) / sqrt(s_a^2 + s_b^2 + sum (c_b - c_a)^2), c the changes by sources that both may have in common, two-sided against the
    normal distribution, Holm's correction over all of them. Fits are matched by name, term, band and test; the test's name is ignored
    where each result has one test only.
    """
    one_test = all(len({fit.test for fit in side.fits}) == 1 for side in (first, second))
    theirs = {_key(fit, one_test): fit for fit in second.fits}
    pairs = [(fit, theirs[_key(fit, one_test)]) for fit in first.fits if _key(fit, one_test) in theirs]
    pairs_of_parameters = [
        _difference(fit, partner, mine, other)
        for fit, partner in pairs
        for mine in fit.parameters
        for other in partner.parameters
        if mine.name == other.name and mine.unit == other.unit
    ]
    if not pairs_of_parameters:
        names = [", ".join(dict.fromkeys(fit.name for fit in side.fits)) or "none" for side in (first, second)]
        raise DataError(f"the two have no fit in common (fits: {names[0]}; {names[1]})", hint="name, term, band and test must be the same")
    with_p_value = [number for number, pair in enumerate(pairs_of_parameters) if pair.p_value is not None]
    corrected = holm(np.array([pairs_of_parameters[number].p_value for number in with_p_value], np.float64))
    for number, p_value in zip(with_p_value, corrected, strict=True):
        pairs_of_parameters[number] = replace(pairs_of_parameters[number], p_value=float(p_value))
    return pairs_of_parameters


def _key(fit: Fit, one_test: bool) -> tuple[str, str, str, str]:
    return fit.name, fit.term, f"{fit.band_hz[0]:g}-{fit.band_hz[1]:g}", "" if one_test else fit.test


def _difference(fit: Fit, partner: Fit, mine: Parameter, other: Parameter) -> Difference:
    """The difference with its p-value before the correction."""
    mine_error, other_error = random_error(fit, mine), random_error(partner, other)
    first, second = parameter_changes((fit, partner), mine.name).T
    error = float(np.sqrt(mine_error**2 + other_error**2 + np.sum((second - first) ** 2))) if mine_error and other_error else None
    p_value = None if error is None else 2 * float(special.ndtr(-abs(other.value - mine.value) / error))
    term = f" of {fit.term}" if fit.term else ""
    return Difference(
        fit=f"{fit.name}{term}",
        test=fit.test,
        parameter=mine.name,
        unit=mine.unit,
        first=mine.value,
        second=other.value,
        std_error=error,
        p_value=p_value,
    )
