"""Measured against theory: one ratio over all tests with its interval, and whether damping is proportional to stiffness."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.campaign.amounts import chance, from_log, with_error
from labpipe.campaign.observations import Campaign
from labpipe.campaign.theory import Matched, log_covariance
from labpipe.campaign.weighted import WeightedFit, weighted_fit, weighted_mean
from labpipe.errors import FitError
from labpipe.records.comparison import ComparedPoint, Comparison, Overlay
from labpipe.records.identification import Fit

NORMAL_95 = 1.959963984540054
SERIES = "; the bending shaft is taken out"


def stiffness_ratio(campaign: Campaign, matched: Sequence[Matched], overlays: tuple[Overlay, ...], bending_error: float) -> Comparison:
    """The mean of ln(measured / theory) over the tests by generalised least squares with `joint_covariance`.

    *bending_error*: relative standard error of the shaft's stiffness.
    """
    logs = np.array([each.log[0] for each in matched])
    covariance = joint_covariance(matched, 0, campaign.settings.setting_error, bending_error)
    found = weighted_mean(logs, covariance)
    ratio = from_log("ratio", "1", float(found.values[0]), found.std_error(0), found.quantile)
    beta = float(np.exp(np.mean([each.log[1] for each in matched])))
    verdict = _ratio_verdict(ratio.ci95)
    return Comparison(
        name=campaign.settings.name,
        kind="ratio",
        subject=campaign.subject,
        unit=campaign.unit,
        points=_points(campaign, matched, np.sqrt(np.diag(covariance))),
        amounts=(ratio, chance("scatter_p", found.p_value), from_log("beta", "s", float(np.log(beta)), 0.0, 0.0)),
        verdict=verdict,
        statement=_ratio_statement(campaign, ratio.value, ratio.ci95, found, SERIES if any(m.to_bending.any() for m in matched) else ""),
        condition=campaign.settings.over,
        condition_unit=campaign.condition_unit,
        overlays=overlays,
    )


def joint_covariance(matched: Sequence[Matched], number: int, setting_error: float, bending_error: float) -> FloatArray:
    """Covariance (n, n) of the tests' ln ratio (*number* 0) or ln beta (1).

    V = diag(s_fit^2 + (d ln / d ln x  s_x)^2) + b b^T, b = d ln / d ln k_s  s_ks: noise and the setting of the condition are each
    test's own, the shaft's stiffness is wrong for all tests alike.
    """
    fits = np.array([each.covariance[number, number] for each in matched])
    setting = np.array([each.to_condition[number] for each in matched]) * setting_error
    shared = np.array([each.to_bending[number] for each in matched]) * bending_error
    return np.diag(fits + setting**2) + np.outer(shared, shared)


def _ratio_verdict(interval: tuple[float, float] | None) -> str:
    assert interval is not None
    return "as theory" if interval[0] <= 1 <= interval[1] else "stiffer than theory" if interval[0] > 1 else "softer than theory"


def _ratio_statement(campaign: Campaign, ratio: float, interval: tuple[float, float] | None, found: WeightedFit, series: str) -> str:
    assert interval is not None
    said = f"{campaign.subject}: measured / theory {ratio:.4f} (95 %: {interval[0]:.4f} to {interval[1]:.4f}), fit against fit{series}."
    if found.inflated:
        return f"{said} One factor does not hold for all tests (p = {found.p_value:.2g}); the interval is widened by their scatter."
    return said if found.p_value is None else f"{said} One factor holds for all tests (p = {found.p_value:.2g})."


def _points(campaign: Campaign, matched: Sequence[Matched], errors: FloatArray) -> tuple[ComparedPoint, ...]:
    points = []
    for point, each, error in zip(campaign.points(), matched, errors, strict=True):
        ratio = from_log("ratio", "1", float(each.log[0]), float(error), NORMAL_95)
        points.append(replace(point, theory=float(each.theory[0]), ratio=ratio.value, ratio_ci95=ratio.ci95))
    return tuple(points)


def rayleigh(campaign: Campaign, matched: Sequence[Matched] | None, bending_error: float = 0.0) -> Comparison:
    """Is damping proportional to stiffness, c = beta k? chi-square of the tests' beta = c / k about one value, and ln c over ln k.

    With a theory (*matched*), beta is the factor by which the theory's curve has the measured damping, free of neighbouring modes and
    of the bending shaft; without, the fit's c / k.
    """
    if matched is None:
        logs, covariance = _log_betas([each.fit for each in campaign.observations])
    else:
        logs = np.array([each.log[1] for each in matched])
        covariance = joint_covariance(matched, 1, campaign.settings.setting_error, bending_error)
    found = weighted_mean(logs, covariance)
    stiffness = np.log([each.fit.parameter("k").value for each in campaign.observations])
    columns = np.column_stack([np.ones_like(stiffness), stiffness - np.mean(stiffness)])
    change = weighted_fit(columns, logs, covariance)
    exponent = with_error("exponent", "1", 1 + float(change.values[1]), change.std_error(1), change.quantile)
    if found.p_value is None:
        raise FitError("one test cannot show whether damping is proportional to stiffness")
    verdict = "not proportional" if found.p_value < campaign.settings.level else "proportional"
    beta = from_log("beta", "s", float(found.values[0]), found.std_error(0), found.quantile)
    said = f"c / k{campaign.subject[1:]}: beta = {1e6 * beta.value:.4g} us, c goes as k^{exponent.value:.3f}"
    points = tuple(_beta_point(*each, beta.value) for each in zip(campaign.points(), logs, np.sqrt(np.diag(covariance)), strict=True))
    return Comparison(
        name=campaign.settings.name,
        kind="rayleigh",
        subject=campaign.subject,
        unit=campaign.unit,
        points=points,
        amounts=(beta, exponent, chance("p_value", found.p_value)),
        verdict=verdict,
        statement=f"{said} (Rayleigh damping: 1): {verdict} (p = {found.p_value:.2g}).",
        condition=campaign.settings.over,
        condition_unit=campaign.condition_unit,
    )


def _log_betas(fits: Sequence[Fit]) -> tuple[FloatArray, FloatArray]:
    """ln(c / k) and its covariance (n, n), from that of c and k in each fit."""
    covariances = [log_covariance(fit) for fit in fits]
    logs = np.array([np.log(fit.parameter("c").value / fit.parameter("k").value) for fit in fits])
    return logs, np.diag([c[0, 0] + c[1, 1] - 2 * c[0, 1] for c in covariances])


def _beta_point(point: ComparedPoint, log: float, error: float, beta: float) -> ComparedPoint:
    """The test's c beside what the common beta makes of its k, and their ratio."""
    ratio = from_log("ratio", "1", float(log - np.log(beta)), float(error), NORMAL_95)
    return replace(point, theory=point.value / ratio.value, ratio=ratio.value, ratio_ci95=ratio.ci95)
