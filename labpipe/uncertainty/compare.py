"""compare: fits and responses of several tests -> one Comparison per question.

Kinds by the table COMPARISONS.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from labpipe import display, distributions
from labpipe.arrays import BoolArray, FloatArray
from labpipe.errors import ConfigError, DataError, FitError
from labpipe.estimation.settings import FitSettings
from labpipe.records.comparison import ComparedPoint, Comparison
from labpipe.records.finding import Parameter
from labpipe.records.identification import Fit
from labpipe.records.response import FrequencyResponse
from labpipe.records.spectra import ChannelSpectra
from labpipe.spectra.quality import reciprocity
from labpipe.uncertainty.amounts import chance, from_log, relative_change, with_error
from labpipe.uncertainty.bandwise import bandwise, two_tests
from labpipe.uncertainty.observations import Campaign, campaign_of, group_of, select_fits
from labpipe.uncertainty.settings import CompareSettings, ComparisonKind, comparison_kind, levels_of
from labpipe.uncertainty.weighted import (
    Components,
    WeightedFit,
    components,
    curvature_text,
    dof_of_sum,
    trend_verdict,
    weighted_fit,
    weighted_mean,
)


def _mean_of_settings(campaign: Campaign, scatter: Components) -> Parameter:
    """The mean of the settings [unit of the values]: their scatter s, and errors that no repetition shows.

    u^2 = s^2 + sum over sources of (mean of their changes)^2, the former with a - 1 degrees of freedom. The
    quantile is the mean of each part's own, by its share of u^2 (Cochran and Cox, Experimental Designs, 1957,
    sec. 4.14), since that of Welch and Satterthwaite is too small beside a scatter of two settings.
    """
    parts = np.array([scatter.mean_error, *campaign.common @ scatter.weights])
    dofs = [scatter.settings - 1, *campaign.common_dof]
    quantiles = np.array([distributions.coverage_factor(0.95, dof) for dof in dofs])
    error = float(np.linalg.norm(parts))
    quantile = float(quantiles @ parts**2) / (error**2 or 1.0)
    return with_error("mean", campaign.unit, scatter.mean, error, quantile)


def repeatability(campaign: Campaign) -> Comparison:
    """Variance components, and the scatter within settings against the fits' standard errors. Equation
    (comp-repeatability).
    """
    settings, unit = campaign.settings, campaign.unit
    groups = np.array([observation.group for observation in campaign.observations])
    scatter = components(campaign.value, groups)
    mean = _mean_of_settings(campaign, scatter)
    noise = float(np.sqrt(np.mean(campaign.std_error**2)))
    ratio = (scatter.within / noise) ** 2
    dof = scatter.repeats - scatter.settings
    noise_p = distributions.chi2_tail(ratio * dof, dof)
    verdict = "settings differ" if scatter.p_value < settings.level else "settings alike"
    percent = [100 * part / abs(scatter.mean) for part in (scatter.within, scatter.between)]
    result = (
        f"{campaign.subject}: scatter within a setting {percent[0]:.3g} %, between settings "
        f"{percent[1]:.3g} % ({display.chance_text(scatter.p_value)})"
    )
    explained = f"{'agrees with' if noise_p >= settings.level else 'exceeds'} the fits' standard errors"
    amounts = (
        mean,
        Parameter("within", scatter.within, unit, ci95=scatter.within_ci),
        Parameter("between", scatter.between, unit, ci95=scatter.between_ci, at_bound=scatter.between == 0),
        Parameter("noise", noise, unit, derived=True),
        chance("p_value", scatter.p_value),
        chance("noise_p", noise_p),
    )
    statement = f"{result}: {verdict}; the scatter within {explained} ({display.chance_text(noise_p)})."
    return replace(
        campaign.comparison(amounts, verdict, statement),
        condition=settings.group,
        condition_unit="",
        second="",
        second_unit="",
    )


# Trend of a parameter over a condition: weighted straight line or power law.

DRAWN = 60


def trend(campaign: Campaign) -> Comparison:
    """value = level + slope (x - x_0), or level (x / x_0)^exponent; x_0 is the mean (geometric mean) of the
    conditions. Of two the verdict is that of the first. FitError where conditions or values do not allow it.
    Equation (comp-trend).
    """
    return _power(campaign) if campaign.settings.law == "power" else _line(campaign)


def power_fit(campaign: Campaign) -> WeightedFit:
    """(ln level, exponent) over ln(x / x_0), and over ln(y / y_0) of a second condition, with the error of
    setting them. Equation (comp-power).
    """
    conditions = _conditions(campaign)
    for values, name in zip(conditions, campaign.settings.over, strict=True):
        if np.any(values <= 0):
            raise FitError(f"a power law needs '{name}' above zero", hint="law: line")
    relative, logs = campaign.relative, np.log(campaign.value)
    columns = np.column_stack([np.ones_like(logs), *(np.log(x / _centre(x)) for x in conditions)])
    first = weighted_fit(columns, logs, relative)
    errors = np.hypot(relative, np.linalg.norm(first.values[1:]) * campaign.settings.setting_error)
    return weighted_fit(columns, logs, errors, campaign.common / campaign.value, campaign.common_dof)


def _conditions(campaign: Campaign) -> list[FloatArray]:
    return [campaign.condition, *([campaign.second] if campaign.settings.second else [])]


def _centre(x: FloatArray) -> float:
    return float(np.exp(np.mean(np.log(x))))


def _power(campaign: Campaign) -> Comparison:
    fit, centre = power_fit(campaign), _centre(campaign.condition)
    x = _draw(campaign.condition)
    values = np.exp(fit.values[0]) * (x / centre) ** fit.values[1]
    exponent = fit.amount("exponent", "1", 1)
    level = from_log("level", campaign.unit, *fit.state())
    settings = campaign.settings
    amount = display.amount_text(level.value, level.std_error, campaign.unit)
    law = f"{campaign.subject} = ({amount}) ({settings.condition} / {centre:.5g} {campaign.condition_unit})"
    law += f"^({display.with_error(exponent.value, exponent.std_error)})"
    amounts = [exponent, level]
    if settings.second:
        second = fit.amount("second_exponent", "1", 2)
        amounts.append(second)
        law += (
            f" ({settings.second} / {_centre(campaign.second):.5g} "
            f"{campaign.second_unit})^({display.with_error(second.value, second.std_error)})"
        )
    return _comparison(campaign, fit, amounts, law, np.column_stack([x, values]))


def _line(campaign: Campaign) -> Comparison:
    settings, conditions = campaign.settings, np.array(_conditions(campaign))
    centre = float(np.mean(campaign.condition))
    columns = np.vstack([np.ones(conditions.shape[1]), conditions - conditions.mean(axis=1)[:, None]]).T
    fit = weighted_fit(columns, campaign.value, campaign.std_error)
    setting = np.linalg.norm(fit.values[1:, None] * conditions, axis=0)
    errors = np.hypot(campaign.std_error, setting * settings.setting_error)
    fit = weighted_fit(columns, campaign.value, errors, campaign.common, campaign.common_dof)
    slope = fit.amount("slope", f"{campaign.unit}/{campaign.condition_unit}", 1)
    level = fit.amount("level", campaign.unit, 0)
    drawn = _draw(campaign.condition)
    where = (
        f"{display.amount_text(level.value, level.std_error, campaign.unit)} at {settings.condition} "
        f"{centre:.5g} {campaign.condition_unit}"
    )
    change = display.with_error(slope.value, slope.std_error, slope.unit)
    amounts = [slope, level]
    if settings.second:
        second = fit.amount("second_slope", f"{campaign.unit}/{campaign.second_unit}", 2)
        amounts.append(second)
        where += f" and {settings.second} {float(np.mean(campaign.second)):.5g} {campaign.second_unit}"
        change += f" and {display.with_error(second.value, second.std_error, second.unit)}"
    law = f"{campaign.subject} is {where} and changes by {change}"
    line = np.column_stack([drawn, level.value + slope.value * (drawn - centre)])
    return _comparison(campaign, fit, amounts, law, line)


def _draw(x: FloatArray) -> FloatArray:
    return np.linspace(x.min(), x.max(), DRAWN)


def _comparison(
    campaign: Campaign, fit: WeightedFit, amounts: Sequence[Parameter], law: str, line: FloatArray
) -> Comparison:
    p_value = fit.p_of(1)
    second = [chance("second_p_value", fit.p_of(2))] if campaign.settings.second else []
    over, values, scale = np.array(_conditions(campaign)), campaign.value, fit.values[0]
    per = np.ones_like(values)
    if campaign.settings.law == "power":
        over, values, per, scale = np.log(over), np.log(values), values, 1.0
    errors = campaign.std_error / np.abs(per), campaign.common / per
    curved = curvature_text(over, values, *errors, scale)
    verdict = trend_verdict(fit.values[1], curved, sure=p_value < campaign.settings.level)
    fits = "" if fit.p_value is None else f"; the law fits the points with {display.chance_text(fit.p_value)}"
    statement = f"{law}: {verdict} ({display.chance_text(p_value)}){fits}."
    if fit.inflated:
        statement += f" The points are {curved}." if curved else ""
        statement += " The points scatter more than their errors, which are enlarged accordingly."
    stated = (*amounts, chance("p_value", p_value), *second, chance("scatter_p", fit.p_value))
    comparison = campaign.comparison(stated, verdict, statement)
    return replace(comparison, line=tuple((float(a), float(b)) for a, b in line))


# Difference of two groups of tests: up against down, before against after, paired by condition.


def difference(campaign: Campaign) -> Comparison:
    """exp(mean) - 1 of the weighted mean of ln(second / first) over the conditions common to both groups, and
    its p-value. Equation (comp-difference). ConfigError for groups without a common condition.
    """
    mean = _mean_of_logs(campaign)
    change = relative_change("difference", *mean.state())
    assert change.ci95 is not None
    low, high = (100 * end for end in change.ci95)
    words = f"against {{}} {100 * change.value:+.2f} % (95 %: {low:+.2f} to {high:+.2f} %)"
    return _of_groups(campaign, change, mean, words)


def quotient(campaign: Campaign) -> Comparison:
    """Second over first group [1], with the same mean of logarithms as `difference`: a ratio of two tests."""
    mean = _mean_of_logs(campaign)
    ratio = from_log("quotient", "1", *mean.state())
    assert ratio.ci95 is not None
    low, high = ratio.ci95
    return _of_groups(campaign, ratio, mean, f"over {{}} {ratio.value:.5g} (95 %: {low:.5g} to {high:.5g})")


def _mean_of_logs(campaign: Campaign) -> WeightedFit:
    logs, errors, common, dofs = _pair(campaign, *campaign.settings.groups)
    mean = weighted_mean(logs, errors, common, campaign.common_dof)
    return replace(mean, behind=dof_of_sum(1 / errors, dofs))


def _of_groups(campaign: Campaign, amount: Parameter, mean: WeightedFit, words: str) -> Comparison:
    first, second = campaign.settings.groups
    result = f"{campaign.subject}: {second} {words.format(first)}"
    p_value = mean.p_of(0)
    verdict = "different" if p_value < campaign.settings.level else "no difference"
    pairs = f"{mean.dof + 1} condition(s) tested both ways" if campaign.settings.over else "all tests"
    amounts = (amount, chance("p_value", p_value), chance("scatter_p", mean.p_value))
    return campaign.comparison(
        amounts, verdict, f"{result} from {pairs}: {verdict} ({display.chance_text(p_value)})."
    )


def _pair(campaign: Campaign, first: str, second: str) -> tuple[FloatArray, ...]:
    """ln(second / first) at every common condition (n,), its error, its changes by common sources (n_source,
    n) [1], and the degrees of freedom of the error.
    """
    errors, logs = _errors(campaign), np.log(campaign.value)
    relative = campaign.common / campaign.value
    groups = np.array([observation.group for observation in campaign.observations])
    for name in (first, second):
        if name not in groups:
            group = campaign.settings.group
            what = f"no test has {group}: {name}" if group else f"no test '{name}'"
            raise ConfigError(what, hint=f"known: {', '.join(sorted(set(groups)))}")
    pairs = []
    for members in _strata(campaign):
        of_first, of_second = members & (groups == first), members & (groups == second)
        if np.any(of_first) and np.any(of_second):
            parts = of_first, of_second
            before, after = means = [weighted_mean(logs[part], errors[part]) for part in parts]
            old, new = (
                np.average(relative[:, part], axis=1, weights=1 / (errors[part] ** 2 + mean.spread))
                for part, mean in zip(parts, means, strict=True)
            )
            both = np.array([before.std_error(0), after.std_error(0)])
            dof = dof_of_sum(both, np.array([before.effective_dof, after.effective_dof]))
            pairs.append((after.values[0] - before.values[0], np.linalg.norm(both), new - old, dof))
    if not pairs:
        what = f"{first} and {second} were tested at no common '{', '.join(campaign.settings.over)}'"
        raise ConfigError(what, hint="leave `over` out")
    differences, spreads, changes, dofs = (np.array(column) for column in zip(*pairs, strict=True))
    return differences, spreads, changes.T, dofs


def _strata(campaign: Campaign) -> list[BoolArray]:
    if not campaign.settings.over:
        return [np.ones(len(campaign.observations), bool)]
    tolerance = campaign.settings.tolerance
    places = np.column_stack([levels_of(values, tolerance)[1] for values in _conditions(campaign)])
    return [np.all(places == place, axis=1) for place in np.unique(places, axis=0)]


def _errors(campaign: Campaign) -> FloatArray:
    relative, setting = campaign.relative, campaign.settings.setting_error
    if not setting:
        return relative
    if not campaign.settings.over:
        raise FitError("'setting_error' needs the condition that was set", hint="name it with `over`")
    exponents = power_fit(campaign).values[1:]
    return np.hypot(relative, float(np.linalg.norm(exponents)) * setting)


# Reciprocity of every test: H_ij = H_ji within the standard errors.

# Relative rms difference beyond which both are noise: the dofs are not coupled.
UNCOUPLED = 0.7


def reciprocal(settings: CompareSettings, responses: Sequence[FrequencyResponse]) -> Comparison:
    """Every pair of dofs in every test with its p-value; the verdict takes the smallest one times their
    number (Bonferroni). Equation (comp-reciprocity). DataError without a response that can be tested.
    """
    pairs = [(response.name, pair) for response in responses for pair in reciprocity(response)]
    if not pairs:
        raise DataError("there is no response whose reciprocity can be tested")
    p_value = min(1.0, min(pair.p_value for _, pair in pairs) * len(pairs))
    coupled = [pair.difference for _, pair in pairs if pair.difference < UNCOUPLED]
    largest = max(coupled, default=float("nan"))
    verdict = "not reciprocal" if p_value < settings.level else "reciprocal"
    statement = (
        f"{len(pairs)} pair(s) of dofs in {len(responses)} test(s), {len(coupled)} of them coupled; "
        + (
            f"coupled pairs differ by at most {display.per_cent(largest)} rms"
            if coupled
            else "no pair is coupled above the noise"
        )
        + f": {verdict} ({display.chance_text(p_value)}, corrected for the number of pairs)."
    )
    return Comparison(
        name=settings.name,
        kind="reciprocity",
        subject="|H_ij - H_ji| / |H|",
        unit="1",
        points=tuple(
            ComparedPoint(test, pair.difference, group=f"{pair.first}-{pair.second}", p_value=pair.p_value)
            for test, pair in pairs
        ),
        amounts=(chance("p_value", p_value), Parameter("difference", largest, "1", derived=True)),
        verdict=verdict,
        statement=statement,
    )


@dataclass(frozen=True)
class Evidence:
    """Inputs of a comparison: fits and responses of the tests, and the settings of the fits.

    *spectra*, and *conditions* by name, of tests without a response. *folder* of the files that settings
    name; *theory* in place of that of the file. *solved*: cache of theories matched to a fit.
    """

    fits: tuple[Fit, ...]
    responses: tuple[FrequencyResponse, ...]
    fit_settings: tuple[FitSettings, ...]
    solved: dict[Any, Any] = field(default_factory=dict)
    conditions: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    spectra: tuple[ChannelSpectra, ...] = ()
    folder: Path = Path()
    theory: Any = None

    def fits_of(self, settings: CompareSettings) -> list[Fit]:
        """The fits that the settings name; ConfigError where there is none."""
        return select_fits(settings.fit, self.fits)

    def campaign(self, settings: CompareSettings, parameter: str = "") -> Campaign:
        """The observations of the settings; *parameter*: in place of theirs."""
        measured = {response.name: response.conditions for response in self.responses}
        return campaign_of(settings, self.fits, {**measured, **self.conditions}, parameter)

    def response(self, test: str) -> FrequencyResponse:
        """The response of a test; ConfigError where it is missing."""
        for response in self.responses:
            if response.name == test:
                return response
        raise ConfigError(f"the response of test '{test}' is missing")

    def settings_of(self, fit: str) -> FitSettings:
        """The settings of a fit; ConfigError where there are none."""
        for settings in self.fit_settings:
            if settings.name == fit:
                return settings
        raise ConfigError(f"the settings of fit '{fit}' are missing")


def compare(settings: CompareSettings, evidence: Evidence, theory: Any = None) -> Comparison:
    """The comparison of the settings; *theory*: in place of their bearing file. LabpipeError where the tests
    do not allow it.
    """
    evidence = replace(evidence, fits=tuple(fit.as_fitted for fit in evidence.fits))
    return comparison_kind(settings.kind).compare(
        settings, evidence if theory is None else replace(evidence, theory=theory)
    )


def _bands(settings: CompareSettings, evidence: Evidence) -> Comparison:
    named = evidence.fits_of(settings)
    tests = dict.fromkeys(fit.test for fit in named)
    groups = [(test, group_of(settings, test, evidence.response(test).conditions)) for test in tests]
    return bandwise(settings, two_tests(settings, named, groups))


# Keys of comparisons of one parameter of the fit of every test.
OF_TESTS = ("fit", "term", "over", "group")
TREND = ComparisonKind(
    lambda settings, evidence: trend(evidence.campaign(settings)),
    keys=(*OF_TESTS, "parameter", "law", "setting_error", "level"),
    needs=("fit", "over"),
    verdicts=("rising", "falling", "curved", "no trend"),
    conditions=2,
)
# Groups of tests that share a condition, or, without `group`, two tests by their names.
DIFFERENCE = ComparisonKind(
    lambda settings, evidence: difference(evidence.campaign(settings)),
    keys=(*OF_TESTS, "parameter", "groups", "tolerance", "setting_error", "level"),
    needs=("fit", "groups"),
    verdicts=("different", "no difference"),
    conditions=2,
)
QUOTIENT = replace(DIFFERENCE, compare=lambda settings, evidence: quotient(evidence.campaign(settings)))
REPEATABILITY = ComparisonKind(
    lambda settings, evidence: repeatability(evidence.campaign(settings)),
    keys=(*OF_TESTS, "parameter", "level"),
    needs=("fit", "group"),
    verdicts=("settings differ", "settings alike"),
)
RECIPROCITY = ComparisonKind(
    lambda settings, evidence: reciprocal(settings, evidence.responses),
    keys=("level",),
    verdicts=("reciprocal", "not reciprocal"),
)
BANDS = ComparisonKind(
    _bands,
    keys=("fit", "parameter", "group", "groups", "level"),
    needs=("fit", "group", "groups"),
    verdicts=("different", "no difference"),
)
