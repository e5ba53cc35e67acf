"""Trend of a parameter over a condition, and difference of two groups of tests."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from labpipe import display
from labpipe.arrays import BoolArray, FloatArray
from labpipe.errors import ConfigError, FitError
from labpipe.records.comparison import Comparison
from labpipe.records.finding import Parameter
from labpipe.uncertainty.amounts import chance, from_log, joint_errors, relative_change, with_error
from labpipe.uncertainty.observations import Campaign
from labpipe.uncertainty.settings import levels_of
from labpipe.uncertainty.weighted import WeightedFit, weighted_fit, weighted_mean

# Trend of a parameter over a condition: weighted straight line or power law through the tests, and its
# significance.

DRAWN = 60


def trend(campaign: Campaign) -> Comparison:
    """value = level + slope (x - x_0), or value = level (x / x_0)^exponent; x_0 is the mean (geometric mean)
    of the conditions.

    Over two conditions: level + slope (x - x_0) + second_slope (y - y_0), or level (x / x_0)^exponent (y /
    y_0)^second_exponent; the verdict is that of the first. FitError where conditions or values do not allow
    it. Equation (comp-trend).
    """
    return _power(campaign) if campaign.settings.law == "power" else _line(campaign)


def power_fit(campaign: Campaign) -> WeightedFit:
    """(ln level, exponent) over ln(x / x_0), and over ln(y / y_0) of a second condition.

    With the propagated error of setting the conditions: s^2 = s_fit^2 + (n s_x / x)^2 + (m s_y / y)^2.
    Equation (comp-power).
    """
    for values, name in zip(_conditions(campaign), campaign.settings.over, strict=True):
        if np.any(values <= 0):
            raise FitError(f"a power law needs '{name}' above zero", hint="law: line")
    relative = campaign.relative
    columns = np.column_stack(
        [np.ones_like(campaign.condition), *(np.log(x / _centre(campaign, x)) for x in _conditions(campaign))]
    )
    first = weighted_fit(columns, np.log(campaign.value), relative)
    errors = np.hypot(relative, np.linalg.norm(first.values[1:]) * campaign.settings.setting_error)
    return weighted_fit(
        columns, np.log(campaign.value), joint_errors(errors, campaign.common / campaign.value)
    )


def _conditions(campaign: Campaign) -> list[FloatArray]:
    """The conditions of all tests, (n_test,) each."""
    return [campaign.condition, *([campaign.second] if campaign.settings.second else [])]


def _centre(campaign: Campaign, x: FloatArray) -> float:
    return float(
        np.exp(np.mean(np.log(x))) if campaign.settings.law == "power" or np.all(x > 0) else np.mean(x)
    )


def _power(campaign: Campaign) -> Comparison:
    fit, centre = power_fit(campaign), _centre(campaign, campaign.condition)
    x = _drawn(campaign.condition)
    values = np.exp(fit.values[0]) * (x / centre) ** fit.values[1]
    exponent = with_error("exponent", "1", float(fit.values[1]), fit.std_error(1), fit.quantile)
    level = from_log("level", campaign.unit, float(fit.values[0]), fit.std_error(0), fit.quantile)
    settings = campaign.settings
    amount = display.amount_text(level.value, level.std_error, campaign.unit)
    law = f"{campaign.subject} = ({amount}) ({settings.condition} / {centre:.5g} {campaign.condition_unit})"
    law += f"^({display.with_error(exponent.value, exponent.std_error)})"
    amounts = [exponent, level]
    if settings.second:
        amounts.append(
            with_error("second_exponent", "1", float(fit.values[2]), fit.std_error(2), fit.quantile)
        )
        second = display.with_error(float(fit.values[2]), fit.std_error(2))
        law += (
            f" ({settings.second} / {_centre(campaign, campaign.second):.5g} "
            f"{campaign.second_unit})^({second})"
        )
    return _comparison(campaign, fit, amounts, law, np.column_stack([x, values]))


def _line(campaign: Campaign) -> Comparison:
    x, centre = campaign.condition, float(np.mean(campaign.condition))
    columns = np.column_stack(
        [np.ones_like(x), *(values - np.mean(values) for values in _conditions(campaign))]
    )
    fit = weighted_fit(columns, campaign.value, campaign.std_error)
    setting = np.linalg.norm(
        [slope * values for slope, values in zip(fit.values[1:], _conditions(campaign), strict=True)], axis=0
    )
    errors = np.hypot(campaign.std_error, setting * campaign.settings.setting_error)
    fit = weighted_fit(columns, campaign.value, joint_errors(errors, campaign.common))
    slope = with_error(
        "slope",
        f"{campaign.unit}/{campaign.condition_unit}",
        float(fit.values[1]),
        fit.std_error(1),
        fit.quantile,
    )
    level = with_error("level", campaign.unit, float(fit.values[0]), fit.std_error(0), fit.quantile)
    drawn = _drawn(x)
    settings = campaign.settings
    where = (
        f"{display.amount_text(level.value, level.std_error, campaign.unit)} at {settings.condition} "
        f"{centre:.5g} {campaign.condition_unit}"
    )
    change = display.with_error(slope.value, slope.std_error, slope.unit)
    amounts = [slope, level]
    if settings.second:
        unit = f"{campaign.unit}/{campaign.second_unit}"
        amounts.append(with_error("second_slope", unit, float(fit.values[2]), fit.std_error(2), fit.quantile))
        where += f" and {settings.second} {float(np.mean(campaign.second)):.5g} {campaign.second_unit}"
        change += f" and {display.with_error(float(fit.values[2]), fit.std_error(2), unit)}"
    law = f"{campaign.subject} is {where} and changes by {change}"
    return _comparison(
        campaign, fit, amounts, law, np.column_stack([drawn, level.value + slope.value * (drawn - centre)])
    )


def _drawn(x: FloatArray) -> FloatArray:
    return np.linspace(float(np.min(x)), float(np.max(x)), DRAWN)


def _comparison(
    campaign: Campaign, fit: WeightedFit, amounts: Sequence[Parameter], law: str, line: FloatArray
) -> Comparison:
    p_value = fit.p_of(1)
    second = [chance("second_p_value", fit.p_of(2))] if campaign.settings.second else []
    sure = p_value < campaign.settings.level
    verdict = "no trend" if not sure else "rising" if fit.values[1] > 0 else "falling"
    fits = "" if fit.p_value is None else f"; the law fits the points with p = {fit.p_value:.2g}"
    statement = f"{law}: {verdict} (p = {p_value:.2g}){fits}."
    if fit.inflated:
        statement += " The points scatter more than their errors, which are enlarged accordingly."
    return Comparison(
        name=campaign.settings.name,
        kind="trend",
        subject=campaign.subject,
        unit=campaign.unit,
        points=campaign.points(),
        amounts=(*amounts, chance("p_value", p_value), *second, chance("scatter_p", fit.p_value)),
        verdict=verdict,
        statement=statement,
        condition=campaign.settings.condition,
        condition_unit=campaign.condition_unit,
        second=campaign.settings.second,
        second_unit=campaign.second_unit,
        line=tuple((float(a), float(b)) for a, b in line),
    )


# Difference of two groups of tests: up against down, before against after, paired by condition.


def difference(campaign: Campaign) -> Comparison:
    """exp(mean) - 1 of the weighted mean of ln(second / first) over the conditions common to both groups, and
    its p-value.

    The error of each logarithm is the fit's relative error combined with n s_x / x, the error of setting each
    condition (n: exponent of the trend of all tests). ConfigError for groups without a common condition.
    Equation (comp-difference).
    """
    first, second = campaign.settings.groups
    mean = _mean_of_logs(campaign)
    change = relative_change("difference", float(mean.values[0]), mean.std_error(0), mean.quantile)
    assert change.ci95 is not None
    low, high = (100 * end for end in change.ci95)
    result = (
        f"{campaign.subject}: {second} against {first} {100 * change.value:+.2f} % (95 %: {low:+.2f} "
        f"to {high:+.2f} %)"
    )
    return _of_groups(campaign, change, mean, result)


def quotient(campaign: Campaign) -> Comparison:
    """Second over first group [1], with the same mean of logarithms as `difference`: a ratio of two tests."""
    first, second = campaign.settings.groups
    mean = _mean_of_logs(campaign)
    ratio = from_log("quotient", "1", float(mean.values[0]), mean.std_error(0), mean.quantile)
    assert ratio.ci95 is not None
    result = (
        f"{campaign.subject}: {second} over {first} {ratio.value:.5g} (95 %: {ratio.ci95[0]:.5g} to "
        f"{ratio.ci95[1]:.5g})"
    )
    return _of_groups(campaign, ratio, mean, result)


def _mean_of_logs(campaign: Campaign) -> WeightedFit:
    logs, errors, common = _paired(campaign, *campaign.settings.groups)
    return weighted_mean(logs, joint_errors(errors, common))


def _of_groups(campaign: Campaign, amount: Parameter, mean: WeightedFit, result: str) -> Comparison:
    p_value = mean.p_of(0)
    verdict = "different" if p_value < campaign.settings.level else "no difference"
    pairs = f"{mean.dof + 1} condition(s) tested both ways" if campaign.settings.over else "all tests"
    return Comparison(
        name=campaign.settings.name,
        kind=campaign.settings.kind,
        subject=campaign.subject,
        unit=campaign.unit,
        points=campaign.points(),
        amounts=(amount, chance("p_value", p_value), chance("scatter_p", mean.p_value)),
        verdict=verdict,
        statement=f"{result} from {pairs}: {verdict} (p = {p_value:.2g}).",
        condition=campaign.settings.condition,
        condition_unit=campaign.condition_unit,
        second=campaign.settings.second,
        second_unit=campaign.second_unit,
    )


def _paired(campaign: Campaign, first: str, second: str) -> tuple[FloatArray, FloatArray, FloatArray]:
    """ln(second / first) at every common condition (n,), its error, and its changes by common sources
    (n_source, n) [1].

    What both groups have in common, such as the sensitivity of one sensor, cancels in the difference as far
    as it changes both alike.
    """
    logs, errors = np.log(campaign.value), _errors(campaign)
    relative = campaign.common / campaign.value
    groups = np.array([observation.group for observation in campaign.observations])
    for name in (first, second):
        if name not in groups:
            what = (
                f"no test has {campaign.settings.group}: {name}"
                if campaign.settings.group
                else f"no test '{name}'"
            )
            raise ConfigError(what, hint=f"known: {', '.join(sorted(set(groups)))}")
    pairs = []
    for members in _strata(campaign):
        of_first, of_second = members & (groups == first), members & (groups == second)
        if np.any(of_first) and np.any(of_second):
            means = [weighted_mean(logs[part], errors[part]) for part in (of_first, of_second)]
            changes = [
                np.average(relative[:, part], axis=1, weights=errors[part] ** -2.0)
                for part in (of_first, of_second)
            ]
            error = float(np.hypot(means[0].std_error(0), means[1].std_error(0)))
            pairs.append((means[1].values[0] - means[0].values[0], error, changes[1] - changes[0]))
    if not pairs:
        raise ConfigError(
            f"{first} and {second} were tested at no common '{', '.join(campaign.settings.over)}'",
            hint="leave `over` out",
        )
    return np.array([f[0] for f in pairs]), np.array([f[1] for f in pairs]), np.array([f[2] for f in pairs]).T


def _strata(campaign: Campaign) -> list[BoolArray]:
    """Tests at the same condition; all tests where no condition is named."""
    if not campaign.settings.over:
        return [np.ones(len(campaign.observations), bool)]
    numbers = [levels_of(campaign.condition, campaign.settings.tolerance)[1]]
    if campaign.settings.second:
        numbers.append(levels_of(campaign.second, campaign.settings.tolerance)[1])
    places = np.column_stack(numbers)
    return [np.all(places == place, axis=1) for place in np.unique(places, axis=0)]


def _errors(campaign: Campaign) -> FloatArray:
    """Relative errors of the values, with that of setting the condition."""
    relative, setting = campaign.relative, campaign.settings.setting_error
    if not setting:
        return relative
    if not campaign.settings.over:
        raise FitError("'setting_error' needs the condition that was set", hint="name it with `over`")
    exponents = power_fit(campaign).values[1:]
    return np.hypot(relative, float(np.linalg.norm(exponents)) * setting)
