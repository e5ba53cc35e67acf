"""Repeatability: scatter within and between settings (one-way random effects)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from labpipe.arrays import FloatArray
from labpipe.campaign.amounts import chance, with_error
from labpipe.campaign.observations import Campaign
from labpipe.distributions import chi2_quantile, chi2_tail, coverage_factor, f_quantile, f_tail
from labpipe.errors import FitError
from labpipe.records.comparison import Comparison
from labpipe.records.identification import Parameter

TAIL = 0.025


@dataclass(frozen=True, kw_only=True)
class Components:
    """y_ij = mean + setting_i + repeat_ij: standard deviations *within* and *between* settings with 95 % intervals.

    *between* is 0 where the settings scatter less than their repeats. p_value: probability of an equal or larger scatter of settings
    without an effect of the setting (F test). mean_error: of the settings' scatter alone, with *settings* - 1 degrees of freedom.
    """

    mean: float
    mean_error: float
    within: float
    within_ci: tuple[float, float]
    between: float
    between_ci: tuple[float, float]
    p_value: float
    settings: int
    repeats: int


def components(values: FloatArray, groups: NDArray[np.str_]) -> Components:
    """Variance components of values (n,) [any unit] in groups (n,), by the analysis of variance.

    within^2 = MSW; between^2 = (MSB - MSW) / n_0, n_0 = (N - sum n_i^2 / N) / (a - 1). Interval of within^2 by chi-square, of
    between^2 after Tukey (1951) and Williams (1962): SSB (1 - F_q / F) / (n_0 chi2_q) at both ends, exact to first order for equal n_i.
    Searle, Casella and McCulloch, Variance Components (1992), sec. 3.5-3.6. FitError for fewer than two settings or no repeats.
    Equation (comp-components).
    """
    names = np.unique(groups)
    counts = np.array([np.sum(groups == name) for name in names])
    a, n = names.size, values.size
    if a < 2 or n <= a:
        raise FitError(f"{n} test(s) in {a} setting(s) show no scatter within and between", hint="repeat tests in two settings or more")
    means = np.array([np.mean(values[groups == name]) for name in names])
    within_sum = float(sum(np.sum((values[groups == name] - mean) ** 2) for name, mean in zip(names, means, strict=True)))
    between_sum = float(np.sum(counts * (means - np.mean(values)) ** 2))
    within, between = within_sum / (n - a), between_sum / (a - 1)
    if not within > 0:
        raise FitError("the repeats do not scatter at all", hint="are they the same recording?")
    n_0 = (n - np.sum(counts**2) / n) / (a - 1)
    f = between / within
    # SSB (1 - F_q / F), which has no F to divide by where the means are alike.
    ends = [(between_sum - (a - 1) * within * f_quantile(q, a - 1, n - a)) / (n_0 * chi2_quantile(q, a - 1)) for q in (1 - TAIL, TAIL)]
    low, high = (float(np.sqrt(max(end, 0.0))) for end in ends)
    spread = (float(np.sqrt(within_sum / chi2_quantile(1 - TAIL, n - a))), float(np.sqrt(within_sum / chi2_quantile(TAIL, n - a))))
    part = float(np.sqrt(max((between - within) / n_0, 0.0)))
    error = float(np.sqrt(between / n))
    return Components(
        mean=float(np.mean(values)),
        mean_error=error,
        within=float(np.sqrt(within)),
        within_ci=spread,
        between=part,
        between_ci=(low, high),
        p_value=_tail(f, a, n),
        settings=a,
        repeats=n,
    )


def _mean(campaign: Campaign, scatter: Components) -> Parameter:
    """The mean of all tests [unit of the values]: scatter of the settings, and errors that no repetition shows.

    u^2 = MSB / n + sum over sources of (mean of their changes)^2, with (a - 1) u^4 / (MSB / n)^2 degrees of freedom (JCGM 100:2008, G.4.1).
    """
    common = float(np.sum(np.mean(campaign.common, axis=1) ** 2))
    error = float(np.hypot(scatter.mean_error, np.sqrt(common)))
    # Settings whose means are alike to the last digit leave nothing that was estimated from them.
    dof = (scatter.settings - 1) * (error / scatter.mean_error) ** 4 if scatter.mean_error > 0 else np.inf
    return with_error("mean", campaign.unit, scatter.mean, error, coverage_factor(1 - 2 * TAIL, dof))


def _tail(f: float, a: int, n: int) -> float:
    return f_tail(f, a - 1, n - a)


def repeatability(campaign: Campaign) -> Comparison:
    """Variance components of the parameter, and a test of the scatter within settings against the fits' standard errors.

    Equation (comp-repeatability).
    """
    values, settings = campaign.value, campaign.settings
    scatter = components(values, np.array([observation.group for observation in campaign.observations]))
    mean = _mean(campaign, scatter)
    noise = float(np.sqrt(np.mean(campaign.std_error**2)))
    ratio = (scatter.within / noise) ** 2
    dof = scatter.repeats - scatter.settings
    noise_p = chi2_tail(ratio * dof, dof)
    verdict = "settings differ" if scatter.p_value < settings.level else "settings alike"
    unit = campaign.unit
    percent = [100 * part / abs(scatter.mean) for part in (scatter.within, scatter.between)]
    result = (
        f"{campaign.subject}: scatter within a setting {percent[0]:.3g} %, between settings {percent[1]:.3g} % (p = {scatter.p_value:.2g})"
    )
    explained = "agrees with the fits' standard errors" if noise_p >= settings.level else "exceeds the fits' standard errors"
    return Comparison(
        name=settings.name,
        kind="repeatability",
        subject=campaign.subject,
        unit=unit,
        points=campaign.points(),
        amounts=(
            mean,
            Parameter("within", scatter.within, unit, ci95=scatter.within_ci),
            Parameter("between", scatter.between, unit, ci95=scatter.between_ci, at_bound=scatter.between == 0),
            Parameter("noise", noise, unit, derived=True),
            chance("p_value", scatter.p_value),
            chance("noise_p", noise_p),
        ),
        verdict=verdict,
        statement=f"{result}: {verdict}; the scatter within {explained} (p = {noise_p:.2g}).",
        condition=settings.group,
    )
