"""ml: output error weighted with the full FRF covariance, maximum likelihood for circular Gaussian noise, and
its start values.

Minimises sum over lines of e^H C^-1 e, e = vec(H_measured - H(p)), C the measured covariance, by
Levenberg-Marquardt with the analytic Jacobian. For a known C this is the maximum-likelihood estimate and
reaches the Cramer-Rao bound.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import FitError
from labpipe.estimation.descent import MAX_ITERATIONS, Linearisation, Minimum, minimise, triangle_of_products
from labpipe.estimation.leakage import leaking_noise, shared_residual
from labpipe.estimation.measured import Measured
from labpipe.estimation.model import FittedModel, ReceptanceModel, ResponseModel, compliance
from labpipe.estimation.output_error import NormalEquations, OutputError, has_line_products, normal_equations
from labpipe.estimation.regression import equation_solution, inverse_of, regression, solve_scaled
from labpipe.estimation.statistics import Estimate, Pulls, Stated, determination, pulls_of
from labpipe.estimation.transfer_mode import TransferMode, peak_starts, transfer_start
from labpipe.estimation.weights import (
    WeightUncertainty,
    complex_rows,
    fitted_uncertainty,
    has_noise,
    weight_uncertainty,
)
from labpipe.records.identification import Goodness

REWEIGHTINGS = 12
# Degrees of freedom of a noise that is known.
KNOWN = 1_000_000
# Share of the lowest chi-square that a useful pass must fall below, and another minimum to be the better one.
WORTHWHILE, LOWER = 0.99, 0.999


@dataclass(frozen=True, eq=False)
class Start:
    """Start values (n_parameter,) [parameter units], the name of their method, and their chi-square."""

    name: str
    values: FloatArray
    chi2: float


def starts(
    problem: OutputError[ResponseModel], p_value: Callable[[float], float] | None = None
) -> list[Start]:
    """The start of the lowest chi-square, then others: the last pass, plain least squares, the first pass.

    Plain least squares is biased by noise; reweighting the equation error by Z^-1 of the last iterate
    (Sanathanan and Koerner 1963) makes it nearly an output error. It ends after two successive passes with
    hardly lower chi-square, or where by the *p_value* of chi-square noise explains the residual.
    """
    model, linear = problem.model, problem.model.linear
    # Least squares of the equation of motion, all lines alike.
    values = _step_by_line_products(problem, None)
    if values is None:
        values = equation_solution(regression(problem.measured, linear, "none"), linear)[0]
    attempts = [_start(problem, "least squares", model.from_linear(values))]
    idle = 0
    for number in range(1, REWEIGHTINGS + 1):
        try:
            values = _reweight(problem, values)
        except (FitError, np.linalg.LinAlgError):
            break
        lowest = min(start.chi2 for start in attempts)
        name = f"reweighted least squares (pass {number})"
        attempts.append(_start(problem, name, model.from_linear(values)))
        idle = 0 if attempts[-1].chi2 < WORTHWHILE * lowest else idle + 1
        if idle == 2 or (p_value is not None and p_value(attempts[-1].chi2) >= SUSPECT_P):
            break
    best = min(attempts, key=lambda start: start.chi2)
    return list(dict.fromkeys([best, attempts[-1], attempts[0], attempts[min(1, len(attempts) - 1)]]))


def _start(problem: OutputError[ResponseModel], name: str, values: FloatArray) -> Start:
    return Start(name, values, problem.chi2(values))


def _reweight(problem: OutputError[ResponseModel], last: FloatArray) -> FloatArray:
    values = _step_by_line_products(problem, last)
    if values is not None:
        return values
    linear, h, omega = problem.model.linear, problem.measured.matrix, problem.measured.omega
    terms = linear.filter(last, linear.equation_terms(h, omega), omega)
    right_side = linear.filter(last, linear.equation_constant(h, omega)[None], omega)[0]
    return solve_scaled(problem.whiten(terms).T, problem.whiten(right_side))[0]


def _step_by_line_products(problem: OutputError[ResponseModel], last: FloatArray | None) -> FloatArray | None:
    """The same from products line by line, without weights and Z_last^-1 if no *last*; None where there are
    none, or inexact ones.
    """
    measured, linear, weights = problem.measured, problem.model.linear, problem.weights
    if not has_line_products(linear, weights):
        return None
    if last is None:
        weights = np.ones((measured.omega.size, measured.matrix[0].size), np.complex128)

    def equations_at(values: FloatArray, products: bool) -> NormalEquations:
        def lines_of(lines: slice) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
            omega, response = measured.omega[lines], measured.matrix[lines]
            n = response.shape[1]
            none = np.broadcast_to(np.eye(n, dtype=np.complex128), (omega.size, n, n))
            inverse = none if last is None else compliance(linear, last, omega)
            error = linear.whole(values).force - linear.dynamic_stiffness(values, omega) @ response
            return inverse, response, inverse @ error

        return normal_equations(linear, measured.omega, weights, lines_of, products)

    values = np.zeros(len(linear.terms))
    equations = equations_at(values, True)
    factor = triangle_of_products(equations.products)
    if factor is None:
        return None
    scale, triangle = factor
    for projected in (equations.projected, None):
        # The second round is the one refinement of the seminormal equations.
        side = equations_at(values, False).projected if projected is None else projected
        values = values + np.linalg.solve(triangle, np.linalg.solve(triangle.T, side / scale)) / scale
    return values


# p-value of a minimum below which further starts are tried.
SUSPECT_P = 1e-3
UNWEIGHTED_NOTE = (
    "ml: the noise of the FRF is not known (no covariance, or noise-free data), so all lines have equal "
    "weight, the standard errors come from the residual, and the chi-square test of the model is not "
    "possible."
)


def maximum_likelihood(
    measured: Measured,
    model: ResponseModel | TransferMode,
    weight: str = "noise",  # noqa: ARG001 (always by noise)
    *,
    most_steps: int = MAX_ITERATIONS,
) -> Estimate:
    """Weighted output-error estimate with standard errors from the information matrix, cov = (J^T J)^-1.

    Chi-square and covariance are corrected for the estimated weights (weights.py). Without measured noise all
    lines have equal weight and the residual gives the standard errors. *most_steps* bounds each descent.
    With as many equations as parameters the noise alone gives the errors, and no chi-square is left.
    FitError for fewer, or a covariance without inverse. Equation (est-ml).
    """
    if isinstance(model, TransferMode):
        return _fit_transfer_mode(measured, model)
    weighted = has_noise(measured)
    dof = measured.dof(len(model.names), by_noise=weighted)
    uncertainty = weight_uncertainty(measured, dof) if weighted else WeightUncertainty()
    problem = OutputError.of(measured, model)

    def p_value(chi2: float) -> float:
        return uncertainty.p_value(chi2 / dof / uncertainty.excess, dof)

    best, start = _best_minimum(problem, p_value if weighted and dof else None, most_steps)
    return _estimate(measured, model, problem, best, start.name)


def _fit_transfer_mode(measured: Measured, model: TransferMode) -> Estimate:
    """The lowest minimum from least squares and, where that is not surely right, from the peaks of |H|."""
    name = "least squares of a mode with a residue of any phase"
    best = maximum_likelihood_from(measured, model, model.start_of(transfer_start(measured)), name)
    if best.gof.chi2_p is not None and best.gof.chi2_p >= SUSPECT_P and best.converged:
        return best
    for start in peak_starts(measured):
        try:
            other = maximum_likelihood_from(measured, model, model.start_of(start), "a peak of the FRF")
        except (FitError, np.linalg.LinAlgError):
            continue
        is_lower = not best.converged or _squares(other) < LOWER * _squares(best)
        if other.converged and other.values[1] > 0 and is_lower:
            best = other
    return best


def _squares(estimate: Estimate) -> float:
    return np.inf if estimate.squares is None else estimate.squares


def maximum_likelihood_from(measured: Measured, model: FittedModel, start: FloatArray, name: str) -> Estimate:
    """The same from start values (n_parameter,) [parameter units] at hand, for a model that no linear one is
    near; *name* of the start.
    """
    measured.dof(len(model.names), by_noise=has_noise(measured))
    problem = OutputError.of(measured, model)
    return _estimate(measured, model, problem, minimise(problem, start, linearise=problem.linearise), name)


def _estimate(
    measured: Measured, model: FittedModel, problem: OutputError[ReceptanceModel], best: Minimum, start: str
) -> Estimate:
    n_parameter, weighted = len(model.names), has_noise(measured)
    dof = measured.dof(n_parameter, by_noise=weighted)
    linear = problem.linearise(best.values)
    assessed = assess(measured, model, problem, best.values, linear)
    residual = measured.matrix - problem.model.receptance(best.values, measured.omega)
    r2, adjusted = determination(measured.matrix, residual, n_parameter)
    notes = (f"ml: started from {start}.", *(() if weighted else (UNWEIGHTED_NOTE,)))
    # Where few hits give the noise, and lines share what they tell, or it alone gives the errors.
    few = (measured.noise is not None and np.isfinite(measured.noise_dof)) or not dof
    by_noise = int(min(2 * measured.noise_dof, KNOWN))
    interval_dof = np.full(n_parameter, min(dof or KNOWN, by_noise)) if few else None
    return Estimate(
        values=best.values,
        covariance=assessed.covariance,
        scaled_design=linear.triangle,
        gof=Goodness(r2, adjusted, assessed.reduced, assessed.p_value),
        dof=dof,
        converged=best.converged,
        iterations=best.steps,
        notes=notes,
        parameter_dof=interval_dof,
        amplification=problem.size * np.sqrt(np.diag(assessed.inverse)),
        squares=linear.chi2,
    )


@dataclass(frozen=True)
class Assessed:
    """What noise leaves of a minimum: the estimates' covariance (n, n) [parameter units], and chi-square
    where the noise is known.

    *inverse* (J^T J)^-1 (n, n) of the whitened Jacobian; *reduced* chi-square per degree of freedom with its
    *p_value*, None for an unknown noise; *pulls* of stated numbers, whose likeliest values these allow for.
    """

    covariance: FloatArray
    inverse: FloatArray
    reduced: float | None = None
    p_value: float | None = None
    pulls: Pulls | None = None


def assess(
    measured: Measured,
    model: FittedModel,
    problem: OutputError[ReceptanceModel],
    values: FloatArray,
    linear: Linearisation | None = None,
    stated: Stated | None = None,
) -> Assessed:
    """The uncertainty of the minimum *values* (n,) [parameter units] of *problem*; *model*: that of the data,
    its parameters first among them.

    *linear*: the linearisation there, where it is at hand. Corrections for weights and shared noise as in
    `weights`. *stated*: numbers that chi-square allows for. Equation (est-unweighted).
    """
    linear = linear or problem.linearise(values)
    inverse, squares, dof = inverse_of(linear), linear.chi2, linear.n_equation - values.size
    if not has_noise(measured):
        if measured.line_noise is None:
            return Assessed(squares / dof * (measured.shared_noise * inverse), inverse)
        rows = complex_rows(problem.jacobian(values), measured.omega.size)
        shared = shared_residual(measured.line_noise, rows, inverse)
        return Assessed(squares / shared.mean * shared.covariance, inverse)
    noise = measured.noise or leaking_noise(measured, model, values[: len(model.names)])
    uncertainty = weight_uncertainty(measured, dof)
    covariance = uncertainty.inflation * inverse
    if not dof:
        return Assessed(covariance, inverse)
    if noise is not None:
        rows = complex_rows(problem.jacobian(values), measured.omega.size)
        covariance, uncertainty = fitted_uncertainty(measured, noise, uncertainty, rows, inverse)
    pulls = None
    if stated is not None:
        jacobian, residual = problem.jacobian(values), problem.residual(values)
        # Of another estimate than ml, what the parameters would still take away says nothing of the numbers.
        residual = residual - jacobian @ (inverse @ (jacobian.T @ residual))
        larger = float(np.max(np.diag(covariance) / np.diag(inverse)))
        pulls = pulls_of(residual, stated, jacobian, inverse, larger)
        squares -= pulls.explained
    reduced = squares / dof / uncertainty.excess
    return Assessed(covariance, inverse, reduced, uncertainty.p_value(reduced, dof), pulls)


def _best_minimum(
    problem: OutputError[ResponseModel], p_value: Callable[[float], float] | None, most_steps: int
) -> tuple[Minimum, Start]:
    minima: list[tuple[float, Minimum, Start]] = []
    for start in starts(problem, p_value):
        minimum = minimise(problem, start.values, most_steps=most_steps, linearise=problem.linearise)
        minima.append((problem.chi2(minimum.values), minimum, start))
        suspect = p_value is not None and p_value(minima[-1][0]) < SUSPECT_P
        if minimum.converged and not suspect:
            break
    _, best, start = min(minima, key=lambda entry: (not entry[1].converged, entry[0]))
    return best, start
