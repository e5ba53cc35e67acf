"""From the outcomes of many repeats to bias, scatter against the bound, coverage and success."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.identify.settings import FitSettings
from labpipe.records.identification import Parameter
from labpipe.records.study import StudiedParameter, StudyCase
from labpipe.study.repeats import Outcome

Truth = dict[str, float]


def summarised(
    outcomes: Sequence[Outcome],
    settings: FitSettings,
    truth: Truth,
    bounds: dict[str, float],
    limits: tuple[float, ...],
    noise: float,
    lines: int,
) -> StudyCase:
    """One fit over all repeats. Equation (comp-study)."""
    ended = [outcome for outcome in outcomes if outcome.parameters]
    results = [outcome for outcome in ended if outcome.converged]
    names = _names(ended[0].parameters, truth) if ended else []
    errors = np.array([squared_error(outcome, names, truth, settings) for outcome in ended])
    parameters = tuple(_parameter(name, results, truth[name], bounds.get(name)) for name in names if results)
    ratios = [p.rmse / p.bound for p in parameters if p.bound is not None]
    coverages = [p.coverage for p in parameters if p.coverage is not None]
    return StudyCase(
        fit=settings.name,
        estimator=settings.estimator,
        noise=noise,
        lines=lines,
        repeats=len(outcomes),
        failed=len(outcomes) - len(results),
        mean_error=float(errors.mean()) if errors.size else float("nan"),
        median_error=float(np.median(errors)) if errors.size else float("nan"),
        error_variance=float(np.var(errors, ddof=1)) if errors.size > 1 else float("nan"),
        success=tuple(success_rate(outcomes, settings, truth, limit) for limit in limits),
        rmse_over_bound=float(np.sqrt(np.mean(np.square(ratios)))) if ratios else None,
        coverage=float(np.mean(coverages)) if coverages else None,
        parameters=parameters,
    )


def success_rate(outcomes: Sequence[Outcome], settings: FitSettings, truth: Truth, limit: float) -> float:
    """Share of all repeats that ended in a result within *limit* of the truth: |p - p_true| < limit |p_true| of all together.

    Equation (comp-success).
    """
    return float(np.mean([_succeeded(outcome, settings, truth, limit) for outcome in outcomes]))


def _succeeded(outcome: Outcome, settings: FitSettings, truth: Truth, limit: float) -> bool:
    if not outcome.converged:
        return False
    names = _names(outcome.parameters, truth)
    size = sum(count * truth[name] ** 2 for name, count in zip(names, _places(names, settings), strict=True))
    return squared_error(outcome, names, truth, settings) < limit**2 * size


def squared_error(outcome: Outcome, names: Sequence[str], truth: Truth, settings: FitSettings) -> float:
    """Sum of squared parameter errors; an entry of a symmetric matrix beside the diagonal counts at both its places.

    Equation (comp-squared-error).
    """
    values = {parameter.name: parameter.value for parameter in outcome.parameters}
    deviations = np.array([values.get(name, 0.0) - truth[name] for name in names])
    return float(_places(names, settings) @ deviations**2)


def _places(names: Sequence[str], settings: FitSettings) -> FloatArray:
    if not settings.symmetric:
        return np.ones(len(names))
    return np.array([1.0 if len(parts := name.split("_")) != 3 or parts[1] == parts[2] else 2.0 for name in names])


def _names(parameters: Sequence[Parameter], truth: Truth) -> list[str]:
    """The coefficients that were estimated and whose truth is known."""
    return [p.name for p in parameters if not p.derived and p.name in truth]


def _parameter(name: str, results: Sequence[Outcome], truth: float, bound: float | None) -> StudiedParameter:
    estimates = [parameter for outcome in results for parameter in outcome.parameters if parameter.name == name]
    values = np.array([parameter.value for parameter in estimates])
    stated = [parameter.std_error for parameter in estimates if parameter.std_error is not None]
    intervals = [parameter.ci95 for parameter in estimates if parameter.ci95 is not None]
    return StudiedParameter(
        name=name,
        unit=estimates[0].unit,
        truth=truth,
        mean=float(values.mean()),
        rmse=float(np.sqrt(np.mean((values - truth) ** 2))),
        bound=bound,
        std_error=float(np.mean(stated)) if stated else None,
        coverage=float(np.mean([low <= truth <= high for low, high in intervals])) if intervals else None,
    )
