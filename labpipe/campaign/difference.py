"""Difference of two groups of tests: up against down, before against after, paired by condition."""

from __future__ import annotations

import numpy as np

from labpipe.arrays import BoolArray, FloatArray
from labpipe.campaign.amounts import chance, relative_change
from labpipe.campaign.common_sources import joint_errors
from labpipe.campaign.levels import levels_of
from labpipe.campaign.observations import Campaign
from labpipe.campaign.trend import power_fit
from labpipe.campaign.weighted import weighted_mean
from labpipe.errors import ConfigError, FitError
from labpipe.records.comparison import Comparison


def difference(campaign: Campaign) -> Comparison:
    """Weighted mean of ln(second / first) over the conditions common to both groups, and its p-value.

    The error of each logarithm is the fit's relative error combined with n s_x / x, the error of setting each condition (n: exponent of
    the trend of all tests). ConfigError for groups without a common condition. Equation (comp-difference).
    """
    first, second = campaign.settings.groups
    logs, errors, common = _paired(campaign, first, second)
    mean = weighted_mean(logs, joint_errors(errors, common))
    change = relative_change("difference", float(mean.values[0]), mean.std_error(0), mean.quantile)
    p_value = mean.p_of(0)
    verdict = "different" if p_value < campaign.settings.level else "no difference"
    assert change.ci95 is not None
    low, high = (100 * end for end in change.ci95)
    result = f"{campaign.subject}: {second} against {first} {100 * change.value:+.2f} % (95 %: {low:+.2f} to {high:+.2f} %)"
    pairs = f"{logs.size} condition(s) tested both ways" if campaign.settings.over else "all tests"
    return Comparison(
        name=campaign.settings.name,
        kind="difference",
        subject=campaign.subject,
        unit=campaign.unit,
        points=campaign.points(),
        amounts=(change, chance("p_value", p_value), chance("scatter_p", mean.p_value)),
        verdict=verdict,
        statement=f"{result} from {pairs}: {verdict} (p = {p_value:.2g}).",
        condition=campaign.settings.condition,
        condition_unit=campaign.condition_unit,
        second=campaign.settings.second,
        second_unit=campaign.second_unit,
    )


def _paired(campaign: Campaign, first: str, second: str) -> tuple[FloatArray, FloatArray, FloatArray]:
    """ln(second / first) at every common condition (n,), its error, and its changes by common sources (n_source, n) [1].

    What both groups have in common, such as the sensitivity of one sensor, cancels in the difference as far as it changes both alike.
    """
    logs, errors = np.log(campaign.value), _errors(campaign)
    relative = campaign.common / campaign.value
    groups = np.array([observation.group for observation in campaign.observations])
    for name in (first, second):
        if name not in groups:
            raise ConfigError(f"no test has {campaign.settings.group}: {name}", hint=f"known: {', '.join(sorted(set(groups)))}")
    pairs = []
    for members in _strata(campaign):
        of_first, of_second = members & (groups == first), members & (groups == second)
        if np.any(of_first) and np.any(of_second):
            means = [weighted_mean(logs[part], errors[part]) for part in (of_first, of_second)]
            changes = [np.average(relative[:, part], axis=1, weights=errors[part] ** -2.0) for part in (of_first, of_second)]
            error = float(np.hypot(means[0].std_error(0), means[1].std_error(0)))
            pairs.append((means[1].values[0] - means[0].values[0], error, changes[1] - changes[0]))
    if not pairs:
        raise ConfigError(f"{first} and {second} were tested at no common '{', '.join(campaign.settings.over)}'", hint="leave `over` out")
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
