"""ml: output error weighted with the full FRF covariance, maximum likelihood for circular Gaussian noise.

Minimises sum over lines of e^H C^-1 e, e = vec(H_measured - H(p)), C the measured covariance, by Levenberg-Marquardt with the
analytic Jacobian. For a known C this is the maximum-likelihood estimate and reaches the Cramer-Rao bound.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from labpipe.arrays import FloatArray, IntArray
from labpipe.errors import FitError
from labpipe.identify.leakage import expected, leaking_noise
from labpipe.identify.measured import Measured
from labpipe.identify.model import FittedModel, ReceptanceModel, ResponseModel
from labpipe.identify.output_error import OutputError
from labpipe.identify.regression import inverse_of
from labpipe.identify.shared_noise import shared_residual
from labpipe.identify.starts import Start, starts
from labpipe.identify.statistics import Estimate, determination
from labpipe.identify.transfer_mode import TransferMode, transfer_start
from labpipe.identify.weights import WeightDoubt, complex_rows, fit_weights, fitted_doubt, has_noise, weight_doubt
from labpipe.optimise.levenberg import MAX_ITERATIONS, Linearisation, Minimum, minimise
from labpipe.records.identification import Goodness

# p-value of a minimum below which, as without convergence, further starts are tried.
DOUBTFUL_P = 1e-3
UNWEIGHTED_NOTE = (
    "ml: the noise of the FRF is not known (no covariance, or noise-free data), so all lines have equal weight, the standard "
    "errors come from the residual, and the chi-square test of the model is not possible."
)


def maximum_likelihood(
    measured: Measured,
    model: ResponseModel | TransferMode,
    weight: str = "noise",  # noqa: ARG001 (always by noise)
    *,
    most_steps: int = MAX_ITERATIONS,
) -> Estimate:
    """Weighted output-error estimate with standard errors from the information matrix, cov = (J^T J)^-1.

    Chi-square and covariance are corrected for the estimated weights (weights.py). Without measured noise all lines have equal weight and
    the residual gives the standard errors. *most_steps* bounds the descent from each start. FitError for fewer equations than parameters,
    or for a covariance that cannot be inverted. Equation (est-ml).
    """
    if isinstance(model, TransferMode):
        return maximum_likelihood_from(measured, model, transfer_start(measured), "least squares of a mode with a residue of any phase")
    n_parameter = len(model.names)
    dof = measured.n_equation - n_parameter
    if dof <= 0:
        raise FitError(f"{measured.n_equation} real equations cannot determine {n_parameter} parameters", hint="widen the band")
    weighted = has_noise(measured)
    doubt = weight_doubt(measured, dof) if weighted else WeightDoubt()
    problem = OutputError(measured, expected(measured, model), fit_weights(measured))
    best, start = _best_minimum(problem, lambda chi2: weighted and doubt.p_value(chi2 / dof / doubt.excess, dof) < DOUBTFUL_P, most_steps)
    return _estimate(measured, model, problem, best, start.name)


def maximum_likelihood_from(measured: Measured, model: FittedModel, start: FloatArray, name: str) -> Estimate:
    """The same from start values (n_parameter,) [parameter units] at hand, for a model that no linear one is near; *name* of the start."""
    n_parameter = len(model.names)
    if measured.n_equation <= n_parameter:
        raise FitError(f"{measured.n_equation} real equations cannot determine {n_parameter} parameters", hint="widen the band")
    problem: OutputError[ReceptanceModel] = OutputError(measured, expected(measured, model), fit_weights(measured))
    return _estimate(measured, model, problem, minimise(problem, start, linearise=problem.linearised), name)


def _estimate(measured: Measured, model: FittedModel, problem: OutputError[ReceptanceModel], best: Minimum, start: str) -> Estimate:
    """The estimate at a minimum of *problem*, with its doubt."""
    n_parameter, dof = len(model.names), measured.n_equation - len(model.names)
    values, converged, iterations = best.values, best.converged, best.steps
    linear = problem.linearised(values)
    assessed = assess(measured, model, problem, values, linear)
    amplification = problem.size * np.sqrt(np.diag(assessed.inverse))
    r2, adjusted = determination(measured.matrix, measured.matrix - problem.model.receptance(values, measured.omega), n_parameter)
    notes: tuple[str, ...] = (f"ml: started from {start}.",)
    if not has_noise(measured):
        notes = (*notes, UNWEIGHTED_NOTE)
    gof = Goodness(r2, adjusted, assessed.reduced, assessed.p_value)
    return Estimate(
        values=values,
        covariance=assessed.covariance,
        scaled_design=linear.triangle,
        gof=gof,
        dof=dof,
        converged=converged,
        iterations=iterations,
        notes=notes,
        parameter_dof=_interval_dof(measured, n_parameter, dof),
        amplification=amplification,
        squares=linear.chi2,
    )


@dataclass(frozen=True)
class Assessed:
    """What noise leaves of a minimum: the estimates' covariance (n, n) [parameter units], and chi-square where the noise is known.

    *inverse* (J^T J)^-1 (n, n) of the whitened Jacobian; *reduced* chi-square per degree of freedom with its *p_value*, None for an
    unknown noise, whose size the residual gives.
    """

    covariance: FloatArray
    inverse: FloatArray
    reduced: float | None = None
    p_value: float | None = None


def assess(
    measured: Measured,
    model: FittedModel,
    problem: OutputError[ReceptanceModel],
    values: FloatArray,
    linear: Linearisation | None = None,
) -> Assessed:
    """The doubt of the minimum *values* (n,) [parameter units] of *problem*; *model*: that of the data, its parameters first among them.

    *linear*: the linearisation there, where it is at hand. Correction for weights from an estimated covariance and for noise that lines
    share as in `weights`. Equation (est-unweighted).
    """
    linear = linear or problem.linearised(values)
    inverse, squares, dof = inverse_of(linear), linear.chi2, linear.n_equation - values.size
    if not has_noise(measured):
        if measured.line_noise is None:
            return Assessed(squares / dof * (measured.shared_noise * inverse), inverse)
        shared = shared_residual(measured.line_noise, complex_rows(problem.jacobian(values), measured.omega.size), inverse)
        return Assessed(squares / shared.mean * shared.covariance, inverse)
    noise, doubt = measured.noise or leaking_noise(measured, model, values[: len(model.names)]), weight_doubt(measured, dof)
    covariance = doubt.inflation * inverse
    if noise is not None:
        covariance, doubt = fitted_doubt(measured, noise, doubt, problem.jacobian(values), inverse)
    reduced = squares / dof / doubt.excess
    return Assessed(covariance, inverse, reduced, doubt.p_value(reduced, dof))


def _interval_dof(measured: Measured, n_parameter: int, dof: int) -> IntArray | None:
    """Degrees of freedom (n_parameter,) of the intervals where few hits tell the noise, and lines share what they tell; else None."""
    if measured.noise is None or not np.isfinite(measured.noise_dof):
        return None
    return np.full(n_parameter, min(dof, int(2 * measured.noise_dof)))


def _best_minimum(problem: OutputError[ResponseModel], doubtful: Callable[[float], bool], most_steps: int) -> tuple[Minimum, Start]:
    """The lowest minimum of the starts; further starts only where the last minimum's chi-square is *doubtful*."""
    minima: list[tuple[float, Minimum, Start]] = []
    for start in starts(problem):
        minimum = minimise(problem, start.values, most_steps=most_steps, linearise=problem.linearised)
        minima.append((problem.chi2(minimum.values), minimum, start))
        if minimum.converged and not doubtful(minima[-1][0]):
            break
    _, best, start = min(minima, key=lambda entry: (not entry[1].converged, entry[0]))
    return best, start
