"""Trend of a parameter over a condition: weighted straight line or power law through the tests, and its significance."""

from __future__ import annotations

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.campaign.amounts import chance, from_log, with_error
from labpipe.campaign.observations import Campaign
from labpipe.campaign.weighted import WeightedFit, weighted_fit
from labpipe.errors import FitError
from labpipe.records.comparison import Comparison
from labpipe.records.identification import Parameter

DRAWN = 60


def trend(campaign: Campaign) -> Comparison:
    """value = level + slope (x - x_0), or value = level (x / x_0)^exponent; x_0 is the mean (geometric mean) of the conditions.

    FitError where conditions or values do not allow it.
    """
    return _power(campaign) if campaign.settings.law == "power" else _line(campaign)


def power_fit(campaign: Campaign) -> WeightedFit:
    """(ln level, exponent) over ln(x / x_0), with the propagated error of setting x: s^2 = s_fit^2 + (n s_x / x)^2."""
    x = campaign.condition
    if np.any(x <= 0):
        raise FitError(f"a power law needs '{campaign.settings.over}' above zero", hint="law: line")
    relative = campaign.relative
    columns = np.column_stack([np.ones_like(x), np.log(x / _centre(campaign))])
    first = weighted_fit(columns, np.log(campaign.value), relative)
    errors = np.hypot(relative, first.values[1] * campaign.settings.setting_error)
    return weighted_fit(columns, np.log(campaign.value), errors)


def _centre(campaign: Campaign) -> float:
    x = campaign.condition
    return float(np.exp(np.mean(np.log(x))) if campaign.settings.law == "power" or np.all(x > 0) else np.mean(x))


def _power(campaign: Campaign) -> Comparison:
    fit, centre = power_fit(campaign), _centre(campaign)
    x = _drawn(campaign.condition)
    values = np.exp(fit.values[0]) * (x / centre) ** fit.values[1]
    exponent = with_error("exponent", "1", float(fit.values[1]), fit.std_error(1), fit.quantile)
    level = from_log("level", campaign.unit, float(fit.values[0]), fit.std_error(0), fit.quantile)
    law = f"{campaign.subject} = {level.value:.5g} {campaign.unit} ({campaign.settings.over} / {centre:.5g} {campaign.condition_unit})"
    return _comparison(campaign, fit, (exponent, level), f"{law}^{exponent.value:.4f}", np.column_stack([x, values]))


def _line(campaign: Campaign) -> Comparison:
    x, centre = campaign.condition, float(np.mean(campaign.condition))
    columns = np.column_stack([np.ones_like(x), x - centre])
    fit = weighted_fit(columns, campaign.value, campaign.std_error)
    setting = fit.values[1] * x * campaign.settings.setting_error
    fit = weighted_fit(columns, campaign.value, np.hypot(campaign.std_error, setting))
    slope_unit = f"{campaign.unit}/{campaign.condition_unit}"
    slope = with_error("slope", slope_unit, float(fit.values[1]), fit.std_error(1), fit.quantile)
    level = with_error("level", campaign.unit, float(fit.values[0]), fit.std_error(0), fit.quantile)
    drawn = _drawn(x)
    where = f"{level.value:.5g} {campaign.unit} at {campaign.settings.over} {centre:.5g} {campaign.condition_unit}"
    law = f"{campaign.subject} is {where} and changes by {slope.value:.4g} {slope_unit}"
    return _comparison(campaign, fit, (slope, level), law, np.column_stack([drawn, level.value + slope.value * (drawn - centre)]))


def _drawn(x: FloatArray) -> FloatArray:
    return np.linspace(float(np.min(x)), float(np.max(x)), DRAWN)


def _comparison(campaign: Campaign, fit: WeightedFit, amounts: tuple[Parameter, ...], law: str, line: FloatArray) -> Comparison:
    p_value = fit.p_of(1)
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
        amounts=(*amounts, chance("p_value", p_value), chance("scatter_p", fit.p_value)),
        verdict=verdict,
        statement=statement,
        condition=campaign.settings.over,
        condition_unit=campaign.condition_unit,
        line=tuple((float(a), float(b)) for a, b in line),
    )
