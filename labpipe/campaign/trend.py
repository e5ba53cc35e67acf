"""A parameter over a condition: straight line or power law through the tests, with weights, and whether there is a trend at all."""

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
    """(ln level, exponent) over ln(x / x_0), with the error of setting x carried over by the exponent: s^2 = s_fit^2 + (n s_x / x)^2."""
    x = campaign.condition
    if np.any(x <= 0):
        raise FitError(f"a power law needs '{campaign.settings.over}' above zero", hint="law: line")
    relative = campaign.relative
    columns = np.column_stack([np.ones_like(x), np.log(x / _centre(campaign))])
    found = weighted_fit(columns, np.log(campaign.value), relative)
    errors = np.hypot(relative, found.values[1] * campaign.settings.setting_error)
    return weighted_fit(columns, np.log(campaign.value), errors)


def _centre(campaign: Campaign) -> float:
    x = campaign.condition
    return float(np.exp(np.mean(np.log(x))) if campaign.settings.law == "power" or np.all(x > 0) else np.mean(x))


def _power(campaign: Campaign) -> Comparison:
    found, centre = power_fit(campaign), _centre(campaign)
    x = _drawn(campaign.condition)
    values = np.exp(found.values[0]) * (x / centre) ** found.values[1]
    exponent = with_error("exponent", "1", float(found.values[1]), found.std_error(1), found.quantile)
    level = from_log("level", campaign.unit, float(found.values[0]), found.std_error(0), found.quantile)
    law = f"{campaign.subject} = {level.value:.5g} {campaign.unit} ({campaign.settings.over} / {centre:.5g} {campaign.condition_unit})"
    return _told(campaign, found, (exponent, level), f"{law}^{exponent.value:.4f}", np.column_stack([x, values]))


def _line(campaign: Campaign) -> Comparison:
    x, centre = campaign.condition, float(np.mean(campaign.condition))
    columns = np.column_stack([np.ones_like(x), x - centre])
    found = weighted_fit(columns, campaign.value, campaign.std_error)
    setting = found.values[1] * x * campaign.settings.setting_error
    found = weighted_fit(columns, campaign.value, np.hypot(campaign.std_error, setting))
    slope_unit = f"{campaign.unit}/{campaign.condition_unit}"
    slope = with_error("slope", slope_unit, float(found.values[1]), found.std_error(1), found.quantile)
    level = with_error("level", campaign.unit, float(found.values[0]), found.std_error(0), found.quantile)
    drawn = _drawn(x)
    where = f"{level.value:.5g} {campaign.unit} at {campaign.settings.over} {centre:.5g} {campaign.condition_unit}"
    law = f"{campaign.subject} is {where} and changes by {slope.value:.4g} {slope_unit}"
    return _told(campaign, found, (slope, level), law, np.column_stack([drawn, level.value + slope.value * (drawn - centre)]))


def _drawn(x: FloatArray) -> FloatArray:
    return np.linspace(float(np.min(x)), float(np.max(x)), DRAWN)


def _told(campaign: Campaign, found: WeightedFit, amounts: tuple[Parameter, ...], law: str, line: FloatArray) -> Comparison:
    p_value = found.p_of(1)
    sure = p_value < campaign.settings.level
    verdict = "no trend" if not sure else "rising" if found.values[1] > 0 else "falling"
    fits = "" if found.p_value is None else f"; the law fits the points with p = {found.p_value:.2g}"
    said = f"{law}: {verdict} (p = {p_value:.2g}){fits}."
    if found.inflated:
        said += " The points scatter more than their errors, which are enlarged accordingly."
    return Comparison(
        name=campaign.settings.name,
        kind="trend",
        subject=campaign.subject,
        unit=campaign.unit,
        points=campaign.points(),
        amounts=(*amounts, chance("p_value", p_value), chance("scatter_p", found.p_value)),
        verdict=verdict,
        statement=said,
        condition=campaign.settings.over,
        condition_unit=campaign.condition_unit,
        line=tuple((float(a), float(b)) for a, b in line),
    )
