"""iv: instrumental variables, with the regressors of the fitted model's noise-free FRF as instruments (Young 1970)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import FitError
from labpipe.identify.measured import Measured
from labpipe.identify.model import DynamicModel
from labpipe.identify.regression import Regression, equation_design, equation_solution, output_chi_square, regression, triangle_of
from labpipe.identify.statistics import Estimate, determination, stacked, stacked_terms
from labpipe.identify.weights import has_noise
from labpipe.records.identification import Goodness

MAX_ITERATIONS = 25
TOLERANCE = 1e-4
# Smallest canonical correlation between instruments and regressors. In trials on a three-dof system it is above 0.39 for good fits
# and below 0.2 where the iteration diverges to a model unrelated to the data.
WEAKEST_INSTRUMENTS = 0.3
BREAKDOWN_NOTE = (
    "iv broke down: the fitted model's FRF hardly resembles the measured one (smallest canonical correlation {correlation:.2f}, "
    f"limit {WEAKEST_INSTRUMENTS:g}), or the iteration does not converge. The estimator ml converges without it."
)


def instrumental_variables(measured: Measured, model: DynamicModel, weight: str = "none") -> Estimate:
    """V^T A p = V^T b, V being A with the model's FRF of the last estimate instead of the measured one; started from ls.

    Stops when parameters or FRF change by less than 1e-4, after at most 25 iterations (Knaapen 1997, ch. 4). A fit with weak instruments
    counts as not converged. Standard errors: the sandwich (V^T A)^-1 (V^T Omega V) (A^T V)^-1. FitError for dependent instruments.
    Equation (est-iv).
    """
    equation = regression(measured, model, weight)
    values, stationary, iterations = _iterate(measured, model, equation, equation_solution(equation, model)[0])
    fitted_terms = model.equation_terms(model.receptance(values, measured.omega), measured.omega)
    instruments = _weighted_columns(fitted_terms, equation)
    correlation = weakest_correlation(instruments, stacked_terms(equation.terms))
    converged = stationary and correlation >= WEAKEST_INSTRUMENTS
    covariance = _sandwich(measured, model, equation, instruments, values)
    dof = measured.n_equation - len(model.terms)
    r2, adjusted = determination(equation.right_side, equation.residual(values), len(model.terms))
    gof = Goodness(r2, adjusted, *output_chi_square(measured, model, values, dof))
    notes = () if converged else (BREAKDOWN_NOTE.format(correlation=correlation),)
    design, amplification = equation_design(fitted_terms, model, values)
    scaled = measured.shared_noise * covariance
    return Estimate(
        values=values,
        covariance=scaled,
        scaled_design=design,
        gof=gof,
        dof=dof,
        converged=converged,
        iterations=iterations,
        notes=notes,
        amplification=amplification,
    )


def instrument_step(
    measured: Measured, model: DynamicModel, weight: str, values: FloatArray
) -> Callable[[DynamicModel, Measured], FloatArray]:
    """From a model and data to the estimate (n_parameter,) [parameter units] by the instruments of *values* (n_parameter,)."""
    fitted_terms = model.equation_terms(model.receptance(values, measured.omega), measured.omega)
    instruments = _weighted_columns(fitted_terms, regression(measured, model, weight))

    def step(changed_model: DynamicModel, changed: Measured) -> FloatArray:
        equation = regression(changed, changed_model, weight)
        columns, side = stacked_terms(equation.terms), stacked(equation.right_side.reshape(-1))
        return _solve(instruments, columns, side, np.sqrt(np.einsum("pe,pe->p", columns, columns)))

    return step


def _iterate(measured: Measured, model: DynamicModel, equation: Regression, values: FloatArray) -> tuple[FloatArray, bool, int]:
    """(estimate, True if converged, iterations)."""
    columns, side = stacked_terms(equation.terms), stacked(equation.right_side.reshape(-1))
    # Parameters of different dimension are compared in units of the regressors' lengths.
    size = np.sqrt(np.einsum("pe,pe->p", columns, columns))
    last: ComplexArray | None = None
    for iteration in range(1, MAX_ITERATIONS + 1):
        response = model.receptance(values, measured.omega)
        instruments = _weighted_columns(model.equation_terms(response, measured.omega), equation)
        new = _solve(instruments, columns, side, size)
        stationary = _change(new * size, values * size) < TOLERANCE or (last is not None and _change(response, last) < TOLERANCE)
        values, last = new, response
        if stationary:
            return values, True, iteration
    return values, False, MAX_ITERATIONS


def _solve(instruments: FloatArray, columns: FloatArray, side: FloatArray, size: FloatArray) -> FloatArray:
    """(V^T A)^-1 V^T b, both sides scaled by the *size* of the regressors in between."""
    product = (instruments @ columns.T) / np.outer(size, size)
    try:
        values: FloatArray = np.linalg.solve(product, (instruments @ side) / size) / size
    except np.linalg.LinAlgError:
        raise FitError("the instruments of iv are linearly dependent", hint="excite a second force direction, or use ml") from None
    if not np.all(np.isfinite(values)):
        raise FitError("iv diverged", hint="use ml")
    return values


def weakest_correlation(instruments: FloatArray, columns: FloatArray) -> float:
    """Smallest canonical correlation [1] between the spaces of instruments and of regressors, both (n_parameter, n_equation).

    With V = Q_v R_v and A = Q_a R_a it is the smallest singular value of Q_v^T Q_a = R_v^-T V^T A R_a^-1. Equation (est-canonical).
    """
    sizes = [np.sqrt(np.einsum("pe,pe->p", rows, rows)) for rows in (instruments, columns)]
    half = np.linalg.solve(triangle_of(instruments.T).T, instruments @ columns.T / np.outer(*sizes))
    between = np.linalg.solve(triangle_of(columns.T).T, half.T)
    return float(np.linalg.svd(between, compute_uv=False)[-1])


def _sandwich(measured: Measured, model: DynamicModel, equation: Regression, instruments: FloatArray, values: FloatArray) -> FloatArray:
    """Covariance of the estimate from the noise of the FRF or, if it is unknown, from the residual line by line (White)."""
    scores = _scores if has_noise(measured) else _residual_scores
    middle = scores(measured, model, equation, instruments, values)
    bread = np.linalg.pinv(instruments @ stacked_terms(equation.terms).T)
    covariance: FloatArray = bread @ middle @ bread.T
    return covariance


def _scores(measured: Measured, model: DynamicModel, equation: Regression, instruments: FloatArray, values: FloatArray) -> FloatArray:
    """V^T Omega V with Omega of the equation's error Z dH, cov(Z dH) = (Z x I) cov(dH) (Z x I)^H, half of it in the real part."""
    assert measured.covariance is not None
    n_line, n_output, n_input = measured.matrix.shape
    z = model.dynamic_stiffness(values, measured.omega) * equation.line_weights[:, None, None]
    turned = np.einsum("lab,ij->laibj", z, np.eye(n_input)).reshape(n_line, n_output * n_input, -1)
    omega = turned @ measured.covariance @ turned.conj().swapaxes(1, 2)
    half = instruments.shape[1] // 2
    rows = (instruments[:, :half] + 1j * instruments[:, half:]).reshape(-1, n_line, n_output * n_input).transpose(1, 0, 2)
    middle: FloatArray = 0.5 * np.sum(rows.conj() @ omega @ rows.swapaxes(1, 2), axis=0).real
    return middle


def _residual_scores(
    measured: Measured,
    model: DynamicModel,  # noqa: ARG001 (one signature for both)
    equation: Regression,
    instruments: FloatArray,
    values: FloatArray,
) -> FloatArray:
    """sum over lines of g g^T, g = V^T e of one line, enlarged by n / (n - k)."""
    products = instruments * stacked(equation.residual(values).reshape(-1))
    by_line = products.reshape(values.size, 2, measured.omega.size, -1).sum(axis=(1, 3))
    middle: FloatArray = by_line @ by_line.T * (measured.n_equation / (measured.n_equation - values.size))
    return middle


def _weighted_columns(terms: ComplexArray, equation: Regression) -> FloatArray:
    weights = equation.line_weights
    return stacked_terms(terms if np.all(weights == 1) else terms * weights[:, None, None])


def _change(new: NDArray[np.inexact], old: NDArray[np.inexact]) -> float:
    return float(np.linalg.norm(new - old) / np.linalg.norm(old))
