"""Intervals by drawing: the fit repeated on random noise, and on drawn errors of every number that was given.

JCGM 101:2008 (GUM Supplement 1): the check of the first-order budget, and the interval where that fails.
"""

from __future__ import annotations

import contextlib
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from labpipe.arrays import ComplexArray
from labpipe.errors import FitError
from labpipe.estimation.budget import Case, Change, Refit, sources_of
from labpipe.estimation.measured import Measured
from labpipe.estimation.settings import FEWEST
from labpipe.estimation.weights import has_noise, weight_uncertainty, whitener
from labpipe.records.finding import Finding, Parameter
from labpipe.records.uncertain import Budget, Uncertainty

# Largest share of failed refits: above it the intervals would be biased towards the successful ones.
MOST_FAILED = 0.05


def bootstrap(
    parameters: tuple[Parameter, ...], case: Case, fitted: ComplexArray, refit: Refit
) -> tuple[tuple[Parameter, ...], str]:
    """Parameters with standard errors and 95 % intervals from the scatter of refits, as many as the *case*
    asks for, and a note.

    *fitted* (n_line, n_output, n_input) [m/N]. The seed follows from the fit's name. FitError for an unknown
    noise or failed refits.
    """
    repeats = case.setup.settings.bootstrap
    _check_noise("bootstrap", case.measured)
    refits = [drawn for drawn in _draws(case, (), fitted, refit, repeats) if drawn]
    _check_failed("bootstrap", len(refits), repeats)
    note = (
        f"Standard errors and intervals by noise alone come from {len(refits)} refits on noise drawn from "
        "the FRF's covariance (bootstrap)."
    )
    scattered = (with_scatter(p, [of[p.name] for of in refits if p.name in of]) for p in parameters)
    return tuple(scattered), note


def _check_noise(key: str, measured: Measured) -> None:
    if not has_noise(measured):
        what = f"{key} needs the noise of the FRF, which is not known"
        raise FitError(what, hint=f"leave `{key}` out")


def _check_failed(key: str, n_fit: int, n: int) -> None:
    if n_fit < (1 - MOST_FAILED) * n:
        raise FitError(f"{key}: {n - n_fit} of {n} refits failed", hint="widen the band")


def cost_of_weights(case: Case) -> float:
    """Factor [1] on the variance of refits that all have one set of weights, for what it costs that these
    were estimated as well: of ml, which alone rests on them.
    """
    if not case.setup.settings.estimates.likelihood:
        return 1.0
    return weight_uncertainty(case.measured, case.estimate.dof).inflation / case.measured.shared_noise


def redrawn(measured: Measured, fitted: ComplexArray, rng: np.random.Generator, cost: float) -> Measured:
    """*fitted* (n_line, n_output, n_input) [m/N] with circular noise of the measured covariance times *cost*
    [1]. Equation (est-bootstrap).
    """
    assert measured.covariance is not None
    n = measured.covariance.shape[1]
    if measured.noise is not None:
        noise = np.linalg.solve(whitener(measured), measured.noise.draw(rng, n))[:, :, 0]
    else:
        values, vectors = np.linalg.eigh(measured.covariance)
        # The refits' lines are independent: stronger noise gives the scatter of lines that share noise.
        size = np.sqrt(measured.shared_noise * np.maximum(values, 0.0) / 2)
        white = rng.standard_normal((2, *size.shape)) * size
        noise = np.einsum("lab,lb->la", vectors, white[0] + 1j * white[1])
    return replace(measured, matrix=fitted + np.sqrt(cost) * noise.reshape(fitted.shape))


def with_scatter(parameter: Parameter, values: list[float]) -> Parameter:
    """The parameter with standard error and interval of its *values* in refits, where enough converged."""
    if parameter.std_error is None or len(values) < FEWEST["bootstrap"] * (1 - MOST_FAILED):
        return parameter
    low, high = np.percentile(values, [2.5, 97.5])
    error = float(np.std(values, ddof=1))
    t_ratio = None if parameter.t_ratio is None else parameter.value / error
    significant = None if parameter.significant is None else bool(low > 0 or high < 0)
    ends = float(low), float(high)
    return replace(parameter, std_error=error, ci95=ends, t_ratio=t_ratio, significant=significant)


# Scatter of the draws over the first-order uncertainty beyond which that is not enough, besides chance.
ENOUGH = 0.05


@dataclass(frozen=True)
class Budgeted:
    """Parameters with all uncertainties, their budget, with draws where there are any, and what is said."""

    parameters: tuple[Parameter, ...]
    budget: Budget | None = None
    findings: tuple[Finding, ...] = ()
    notes: tuple[str, ...] = ()


def propagate(
    case: Case,
    parameters: Sequence[Parameter],
    budget: Budget,
    fitted: ComplexArray,
    refit: Refit,
    draws: int,
) -> Budgeted:
    """*draws* refits on *fitted* (n_line, n_output, n_input) [m/N] plus noise, every number off by an error
    of its distribution.

    The seed follows from the fit's name. FitError for an unknown noise or failed refits.
    Equation (unc-first-order).
    """
    _check_noise("monte_carlo", case.measured)
    # A number that the data contradict is as uncertain as in the budget.
    counted = {source.source: source for source in budget.sources}
    sources = [(counted.get(of.source, of), change) for of, change in sources_of(case.setup, case.measured)]
    drawn = _draws(case, sources, fitted, refit, draws)
    # Where a stiffness or a mass comes out negative there is no frequency.
    values = [[of_draw[name] for name in budget.names] for of_draw in drawn if {*budget.names} <= {*of_draw}]
    _check_failed("monte_carlo", len(values), draws)
    columns = np.array(values)
    scatter, (low, high) = np.std(columns, axis=0, ddof=1), np.percentile(columns, [2.5, 97.5], axis=0)
    complete = replace(budget, drawn=np.column_stack([scatter, low, high]))
    by_noise = budget.with_random({p.name: p.std_error for p in parameters if p.std_error})
    findings = _findings(replace(by_noise, drawn=complete.drawn), len(values))
    note = (
        f"Intervals are those of {len(values)} draws of the noise and of all numbers with an uncertainty "
        "(Monte Carlo, JCGM 101:2008)."
    )
    drawn_parameters = (with_drawn_interval(p, *ends) for p, *ends in zip(parameters, low, high, strict=True))
    return Budgeted(tuple(drawn_parameters), complete, findings, (note,))


def _draws(
    case: Case, sources: Sequence[tuple[Uncertainty, Change]], fitted: ComplexArray, refit: Refit, n: int
) -> Iterator[dict[str, float]]:
    """Reported values [parameter units] of *n* draws by name; none where the fit fails."""
    rng, cost = np.random.default_rng(zlib.crc32(case.setup.settings.name.encode())), cost_of_weights(case)
    for _ in range(n):
        changed = replace(case, measured=redrawn(case.measured, fitted, rng, cost))
        for uncertainty, change in sources:
            changed = change(changed, drawn_error(uncertainty, rng))
        values: dict[str, float] = {}
        with contextlib.suppress(FitError):
            parameters = refit(changed.setup, case.model_of(changed.setup), changed.measured)
            values = {parameter.name: parameter.value for parameter in parameters}
        yield values


def drawn_error(uncertainty: Uncertainty, rng: np.random.Generator) -> float:
    """An error [unit of the uncertainty]: limits at sqrt(3) or sqrt(6) standard uncertainties, Student's t,
    or normal. Equation (unc-draw).
    """
    if uncertainty.shape == "rectangular":
        drawn = np.sqrt(3.0) * rng.uniform(-1.0, 1.0)
    elif uncertainty.shape == "triangular":
        drawn = np.sqrt(6.0) * rng.triangular(-1.0, 0.0, 1.0)
    else:
        drawn = rng.standard_t(uncertainty.dof) if uncertainty.dof else rng.standard_normal()
    return uncertainty.std_error * float(drawn)


def with_drawn_interval(parameter: Parameter, low: float, high: float) -> Parameter:
    """The parameter with the ends of its draws, and with the model error, which they do not hold, beside."""
    if parameter.ci95 is None or parameter.std_error is None or parameter.full_error is None:
        return parameter
    excess = parameter.full_error**2 - parameter.std_error**2 - (parameter.systematic or 0.0) ** 2
    if excess > 1e-9 * parameter.full_error**2:
        centre = parameter.value if parameter.fitted is None else parameter.fitted
        shares = (np.sqrt(excess) / parameter.full_error * (end - parameter.value) for end in parameter.ci95)
        below, above = (np.hypot(end - centre, share) for end, share in zip((low, high), shares, strict=True))
        low, high = parameter.value - below, parameter.value + above
    significant = None if parameter.significant is None else not low <= 0 <= high
    return replace(parameter, ci95=(float(low), float(high)), significant=significant)


def _findings(budget: Budget, draws: int) -> tuple[Finding, ...]:
    """The parameters whose scatter is not what first order says, beyond three standard deviations of it."""
    assert budget.drawn is not None
    # What never scatters (the largest entry of a mode's shape, which is 1) is known.
    stated, excess = budget.scatter_of_draws()
    ratio = np.divide(budget.drawn[:, 0], stated, out=np.ones_like(stated), where=stated > 0)
    far = np.abs(ratio - 1) > ENOUGH + 3 * np.sqrt((2 + excess) / (4 * draws))
    if not np.any(far):
        return ()
    named = ", ".join(f"{budget.names[n]} ({ratio[n]:.2f})" for n in np.flatnonzero(far))
    message = (
        "first order is not enough: the scatter of the draws over what the combined standard uncertainty "
        f"makes of it is not 1 for {named}; the intervals are those of the draws"
    )
    return (Finding("first-order", message),)
