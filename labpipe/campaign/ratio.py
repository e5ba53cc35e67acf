"""Ratio measured / theory over all tests with its interval, and test of damping proportional to stiffness."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.campaign.amounts import chance, from_log, with_error
from labpipe.campaign.common_sources import change_in, common_changes
from labpipe.campaign.observations import Campaign
from labpipe.campaign.theory import Matched, log_covariance
from labpipe.campaign.weighted import WeightedFit, weighted_fit, weighted_mean
from labpipe.errors import FitError
from labpipe.records.comparison import ComparedPoint, Comparison, Overlay
from labpipe.records.identification import Fit, Parameter

NORMAL_95 = 1.959963984540054
SERIES = "; corrected for the bending shaft"


def stiffness_ratio(campaign: Campaign, matched: Sequence[Matched], overlays: tuple[Overlay, ...], bending_error: float) -> Comparison:
    """Mean of ln(measured / theory) over the tests by generalised least squares with `joint_covariance`.

    *bending_error*: relative standard error of the shaft's stiffness. Equation (comp-ratio).
    """
    logs = np.array([test.log[0] for test in matched])
    covariance = joint_covariance(matched, 0, campaign.settings.setting_error, bending_error)
    mean = weighted_mean(logs, covariance)
    ratio = from_log("ratio", "1", float(mean.values[0]), mean.std_error(0), mean.quantile)
    beta = float(np.exp(np.mean([test.log[1] for test in matched])))
    verdict = _ratio_verdict(ratio.ci95)
    return Comparison(
        name=campaign.settings.name,
        kind="ratio",
        subject=campaign.subject,
        unit=campaign.unit,
        points=_points(campaign, matched, np.sqrt(np.diag(covariance))),
        amounts=(ratio, chance("scatter_p", mean.p_value), Parameter("beta", beta, "s", derived=True)),
        verdict=verdict,
        statement=_ratio_statement(campaign, ratio.value, ratio.ci95, mean, SERIES if any(m.to_bending.any() for m in matched) else ""),
        condition=campaign.settings.condition,
        condition_unit=campaign.condition_unit,
        second=campaign.settings.second,
        second_unit=campaign.second_unit,
        overlays=overlays,
    )


def joint_covariance(matched: Sequence[Matched], number: int, setting_error: float, bending_error: float) -> FloatArray:
    """Covariance (n, n) [1] of the tests' ln ratio (*number* 0) or ln beta (1).

    V = diag(s_fit^2 + (d ln / d ln x  s_x)^2) + b b^T + sum c c^T, b = d ln / d ln k_s  s_ks: noise and the setting of the condition are
    independent between tests, the errors of the shaft's stiffness and of sensors (c) are common to all that have them.
    Equation (comp-joint).
    """
    fits = np.array([test.covariance[number, number] for test in matched])
    setting = np.array([test.to_condition[number] for test in matched]) * setting_error
    shared = np.array([test.to_bending[number] for test in matched]) * bending_error
    sources = dict.fromkeys(source for test in matched for source in test.to_sources)
    common = np.array([[test.to_sources.get(source, np.zeros(2))[number] for test in matched] for source in sources])
    common = common.reshape(len(sources), len(matched))
    return np.diag(fits + setting**2) + np.outer(shared, shared) + common.T @ common


def _ratio_verdict(interval: tuple[float, float] | None) -> str:
    assert interval is not None
    return "as theory" if interval[0] <= 1 <= interval[1] else "stiffer than theory" if interval[0] > 1 else "softer than theory"


def _ratio_statement(campaign: Campaign, ratio: float, interval: tuple[float, float] | None, mean: WeightedFit, series: str) -> str:
    assert interval is not None
    result = f"{campaign.subject}: measured / theory {ratio:.4f} (95 %: {interval[0]:.4f} to {interval[1]:.4f}), fit against fit{series}."
    if mean.inflated:
        return f"{result} One factor does not hold for all tests (p = {mean.p_value:.2g}); the interval is widened by their scatter."
    return result if mean.p_value is None else f"{result} One factor holds for all tests (p = {mean.p_value:.2g})."


def _points(campaign: Campaign, matched: Sequence[Matched], errors: FloatArray) -> tuple[ComparedPoint, ...]:
    points = []
    for point, test, error in zip(campaign.points(), matched, errors, strict=True):
        ratio = from_log("ratio", "1", float(test.log[0]), float(error), NORMAL_95)
        points.append(replace(point, theory=float(test.theory[0]), ratio=ratio.value, ratio_ci95=ratio.ci95))
    return tuple(points)


def rayleigh(campaign: Campaign, matched: Sequence[Matched] | None, bending_error: float = 0.0) -> Comparison:
    """Test of Rayleigh damping c = beta k: chi-square of the tests' beta = c / k about one value, and exponent of c over k.

    With a theory (*matched*), beta is the factor by which the theory's curve has the measured damping, without the influence of
    neighbouring modes and of the bending shaft; without, the fit's c / k. Equation (comp-rayleigh).
    """
    if matched is None:
        logs, covariance = _log_betas([observation.fit for observation in campaign.observations])
    else:
        logs = np.array([test.log[1] for test in matched])
        covariance = joint_covariance(matched, 1, campaign.settings.setting_error, bending_error)
    mean = weighted_mean(logs, covariance)
    stiffness = np.log([observation.fit.parameter("k").value for observation in campaign.observations])
    columns = np.column_stack([np.ones_like(stiffness), stiffness - np.mean(stiffness)])
    change = weighted_fit(columns, logs, covariance)
    exponent = with_error("exponent", "1", 1 + float(change.values[1]), change.std_error(1), change.quantile)
    if mean.p_value is None:
        raise FitError("one test cannot show whether damping is proportional to stiffness")
    verdict = "not proportional" if mean.p_value < campaign.settings.level else "proportional"
    beta = from_log("beta", "s", float(mean.values[0]), mean.std_error(0), mean.quantile)
    result = f"c / k{campaign.subject[1:]}: beta = {1e6 * beta.value:.4g} us, c goes as k^{exponent.value:.3f}"
    rows = zip(campaign.points(), logs, np.sqrt(np.diag(covariance)), strict=True)
    points = tuple(_beta_point(*row, beta.value) for row in rows)
    return Comparison(
        name=campaign.settings.name,
        kind="rayleigh",
        subject=campaign.subject,
        unit=campaign.unit,
        points=points,
        amounts=(beta, exponent, chance("p_value", mean.p_value)),
        verdict=verdict,
        statement=f"{result} (Rayleigh damping: 1): {verdict} (p = {mean.p_value:.2g}).",
        condition=campaign.settings.condition,
        condition_unit=campaign.condition_unit,
        second=campaign.settings.second,
        second_unit=campaign.second_unit,
    )


def _log_betas(fits: Sequence[Fit]) -> tuple[FloatArray, FloatArray]:
    """ln(c / k) and its covariance (n, n), from that of c and k in each fit and from what the fits have in common."""
    covariances = [log_covariance(fit) for fit in fits]
    logs = np.array([np.log(fit.parameter("c").value / fit.parameter("k").value) for fit in fits])
    variances = np.diag([c[0, 0] + c[1, 1] - 2 * c[0, 1] for c in covariances])
    common = common_changes(fits, _log_beta_change)
    return logs, variances + common.T @ common


def _log_beta_change(fit: Fit, source: str) -> float:
    """Change of ln(c / k) by one standard uncertainty of a source."""
    return change_in(fit, source, "c") / fit.parameter("c").value - change_in(fit, source, "k") / fit.parameter("k").value


def _beta_point(point: ComparedPoint, log: float, error: float, beta: float) -> ComparedPoint:
    """The test's c beside the common beta times its k, and their ratio."""
    ratio = from_log("ratio", "1", float(log - np.log(beta)), float(error), NORMAL_95)
    return replace(point, theory=point.value / ratio.value, ratio=ratio.value, ratio_ci95=ratio.ci95)
