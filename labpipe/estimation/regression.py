"""ls and iv: least squares and instrumental variables of the equation of motion."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from labpipe.arrays import ComplexArray, FloatArray, IntArray
from labpipe.errors import FitError
from labpipe.estimation import statistics
from labpipe.estimation.descent import Linearisation, scaled_triangle
from labpipe.estimation.measured import Measured
from labpipe.estimation.model import DynamicModel
from labpipe.estimation.weights import complex_rows, has_noise, weight_uncertainty, whiten_values, whitener
from labpipe.records.identification import Goodness

BIAS_NOTE = (
    "ls: the standard errors come from the equation's residual; they do not include the bias caused by noise "
    "of the measured FRF (the FRF is among the regressors). The estimator ml has no such bias."
)


def least_squares(measured: Measured, model: DynamicModel, weight: str = "none") -> statistics.Estimate:
    """Equation-error estimate; rows of the equation of motion without common parameters are separate
    regressions.

    Standard error = sqrt(residual variance * diag((W^T W)^-1)) with n - k real degrees of freedom (Lim et al.
    2009, eq. 14-15, 25, with n - k for the printed n - 3). FitError for fewer equations than parameters.
    Equation (est-ls).
    """
    n_parameter = len(model.terms)
    dof = measured.dof(n_parameter)
    equation = regression(measured, model, weight)
    values, covariance, parameter_dof = equation_solution(equation, model)
    if not np.all(parameter_dof):
        what = "a direction has as many real equations as parameters, which leaves ls no errors"
        raise FitError(what, hint="widen the band")
    r2, adjusted = statistics.determination(equation.right_side, equation.residual(values), n_parameter)
    design, amplification = _plain_design(measured, model, values, equation.terms)
    return statistics.Estimate(
        values=values,
        covariance=measured.shared_noise * covariance,
        scaled_design=design,
        gof=Goodness(r2, adjusted, *output_chi_square(measured, model, values, dof)),
        dof=dof,
        notes=(BIAS_NOTE,),
        parameter_dof=parameter_dof,
        amplification=amplification,
    )


def equation_solution(equation: Regression, model: DynamicModel) -> tuple[FloatArray, FloatArray, IntArray]:
    """Estimate (n_parameter,) [parameter units], its covariance (n_parameter, n_parameter), and degrees of
    freedom (n_parameter,) of each parameter's regression; FitError as of solve_scaled.
    """
    n_parameter = len(model.terms)
    values, covariance = np.zeros(n_parameter), np.zeros((n_parameter, n_parameter))
    parameter_dof = np.zeros(n_parameter, int)
    for rows, columns in _separate_regressions(model):
        side, terms = equation.right_side[:, rows], equation.terms[columns][:, :, rows]
        values[columns], covariance[np.ix_(columns, columns)] = _solve(terms, side)
        parameter_dof[columns] = 2 * side.size - len(columns)
    return values, covariance, parameter_dof


@dataclass(frozen=True)
class Regression:
    """The equation of motion as a regression: *terms* (n_parameter, n_line, n_dof, n_input), *right_side*
    (n_line, n_dof, n_input) [1]; line_weights (n_line,) [1].
    """

    terms: ComplexArray
    right_side: ComplexArray
    line_weights: FloatArray

    @cached_property
    def rows(self) -> FloatArray:
        """The terms as real rows (n_parameter, n_equation) [1 per parameter unit]."""
        return statistics.stacked_terms(self.terms)

    @cached_property
    def lengths(self) -> FloatArray:
        """Of the rows (n_parameter,) [1 per parameter unit], in which parameters of any dimension compare."""
        return np.sqrt(np.einsum("pe,pe->p", self.rows, self.rows))

    @cached_property
    def side(self) -> FloatArray:
        """The right side as real equations (n_equation,) [1]."""
        return statistics.stack(self.right_side.reshape(-1))

    def instrumental(self, instruments: FloatArray) -> FloatArray:
        """(V^T A)^-1 V^T b (n_parameter,) [parameter units] of *instruments* V (n_parameter, n_equation), all
        scaled by the lengths in between. FitError where V is dependent.
        """
        product = (instruments @ self.rows.T) / np.outer(self.lengths, self.lengths)
        try:
            values: FloatArray = (
                np.linalg.solve(product, (instruments @ self.side) / self.lengths) / self.lengths
            )
        except np.linalg.LinAlgError:
            what = "the instruments of iv are linearly dependent"
            raise FitError(what, hint="excite a second force direction, or use ml") from None
        if not np.all(np.isfinite(values)):
            raise FitError("iv diverged", hint="use ml")
        return values

    def residual(self, values: FloatArray) -> ComplexArray:
        """Residual of the equation, (n_line, n_dof, n_input) [1]."""
        return self.right_side - np.tensordot(values, self.terms, 1)


def regression(measured: Measured, model: DynamicModel, weight: str) -> Regression:
    """The weighted equation of motion of the measured FRF; FitError for fewer equations than parameters."""
    measured.dof(len(model.terms), by_noise=True)
    weights = line_weights(measured, weight)
    by_line = 1.0 if weight == "none" else weights[:, None, None]
    terms = model.equation_terms(measured.matrix, measured.omega)
    right_side = model.equation_constant(measured.matrix, measured.omega)
    return Regression(terms * by_line, right_side * by_line, weights)


def line_weights(measured: Measured, weight: str) -> FloatArray:
    """Weight of every line, (n_line,) [1]; none: 1; noise: |H| / s, since noise s of H becomes s / |H| in the
    equation of motion. FitError for an unknown or zero noise. Equation (est-line-weights).
    """
    if weight == "none":
        return np.ones(measured.omega.size)
    cure = "leave `weight` out"
    if not has_noise(measured):
        raise FitError("the noise of the FRF is not known, so lines cannot be weighted by it", hint=cure)
    assert measured.covariance is not None
    size = np.sqrt(np.sum(np.abs(measured.matrix) ** 2, axis=(1, 2)))
    noise = np.sqrt(np.einsum("lii->l", measured.covariance).real)
    if np.any(noise == 0):
        raise FitError("a line of the FRF has no noise, so lines cannot be weighted by it", hint=cure)
    return size / noise / np.max(size / noise)


def output_chi_square(
    measured: Measured, model: DynamicModel, values: FloatArray, dof: int
) -> tuple[float | None, float | None]:
    """chi-square per degree of freedom [1] and p-value of measured - fitted FRF at *values* (n_parameter,),
    if the noise is known.
    """
    if not has_noise(measured):
        return None, None
    try:
        uncertainty = weight_uncertainty(measured, dof)
        residual = whiten_values(
            whitener(measured), measured.matrix - model.receptance(values, measured.omega)
        )
    except FitError:
        return None, None
    reduced = float(residual @ residual) / dof / uncertainty.excess
    return (reduced, uncertainty.p_value(reduced, dof)) if np.isfinite(reduced) else (None, None)


def _plain_design(
    measured: Measured, model: DynamicModel, values: FloatArray, noisy_terms: ComplexArray
) -> tuple[FloatArray, FloatArray]:
    """Design matrix for the test of collinearity, and its amplification: of the measured FRF, whose noise
    makes collinear columns differ, or of the model's, whichever is worse.
    """
    designs = [noisy_terms]
    with contextlib.suppress(FitError):
        designs.append(model.equation_terms(model.receptance(values, measured.omega), measured.omega))
    candidates = [equation_design(terms, model, values) for terms in designs]
    return max(candidates, key=lambda design: statistics.condition_number(design[0]))


def equation_design(
    terms: ComplexArray, model: DynamicModel, values: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Triangular factor (n_parameter, n_parameter) [1] of the normalised regressors, and amplification
    (n_parameter,) [parameter units]. An error dH adds Z dH to the equation of motion, which is as large as Z
    H = B for dH as large as H.
    """
    lengths, triangle, _ = scaled_triangle(statistics.stacked_terms(terms).T)
    forces = np.sqrt(terms.shape[1]) * np.linalg.norm(model.whole(values).force)
    return triangle, forces * np.sqrt(statistics.inflation_factors(triangle)) / lengths


def triangle_of(columns: FloatArray) -> FloatArray:
    """Triangular factor R (n_parameter, n_parameter) [1] of *columns* (n_equation, n_parameter), scaled."""
    return scaled_triangle(columns)[1]


def solve_scaled(columns: FloatArray, right_side: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Least-squares solution (n_parameter,) [parameter units] and (W^T W)^-1 (n_parameter, n_parameter).

    *columns* (n_equation, n_parameter), *right_side* (n_equation,). Columns are scaled to length 1, so that
    units have no influence. FitError for linearly dependent columns.
    """
    n = columns.shape[1]
    scale, triangle, by_products = scaled_triangle(columns)
    inverse, (left_vectors, singular, right_vectors) = _invert(triangle, scale, max(columns.shape))
    if by_products:
        # Corrected seminormal equations (Bjoerck 1987): one refinement makes them as accurate as QR.
        values = inverse @ (columns.T @ right_side)
        return values + inverse @ (columns.T @ (right_side - columns @ values)), inverse
    side = np.asarray(np.linalg.qr(np.column_stack([columns / scale, right_side]), mode="r"))[:n, n]
    # The right side keeps the signs of this factorisation, whose first columns are R up to rounding.
    return right_vectors.T @ ((left_vectors.T @ side) / singular) / scale, inverse


def inverse_of(linear: Linearisation) -> FloatArray:
    """(J^T J)^-1 (n_parameter, n_parameter) [parameter units squared] of a linearisation. FitError for
    linearly dependent columns.
    """
    return _invert(linear.triangle, linear.scale, linear.n_equation)[0]


def _invert(
    triangle: FloatArray, scale: FloatArray, n_row: int
) -> tuple[FloatArray, tuple[FloatArray, FloatArray, FloatArray]]:
    """(W^T W)^-1 of W = Q R S, and the singular vectors and values of R."""
    left_vectors, singular, right_vectors = linalg.svd(triangle)
    if singular[-1] <= singular[0] * np.finfo(float).eps * n_row:
        raise FitError(
            "the excitation leaves parameters undetermined: columns of the regression are linearly dependent",
            hint="excite a second force direction, or use a model with fewer parameters",
        )
    inverse = (right_vectors.T / singular**2) @ right_vectors / np.outer(scale, scale)
    return inverse, (left_vectors, singular, right_vectors)


def _solve(terms: ComplexArray, right_side: ComplexArray) -> tuple[FloatArray, FloatArray]:
    columns = statistics.stacked_terms(terms).T
    side = statistics.stack(right_side.reshape(-1))
    if side.size < columns.shape[1]:
        what = f"{side.size} real equations cannot determine the {columns.shape[1]} parameters of a direction"
        raise FitError(what, hint="widen the band")
    values, inverse = solve_scaled(columns, side)
    residual = side - columns @ values
    variance = float(residual @ residual) / max(side.size - values.size, 1)
    return values, variance * inverse


def _separate_regressions(model: DynamicModel) -> list[tuple[list[int], list[int]]]:
    n_dof = model.constant.mass.shape[0]
    every = [term.matrices for term in model.terms]
    acts = [np.any(np.hstack([m.stiffness, m.damping, m.mass, m.force]) != 0, axis=1) for m in every]
    groups: list[tuple[list[int], list[int]]] = []
    for row in range(n_dof):
        rows, columns = [row], {number for number, places in enumerate(acts) if places[row]}
        for other in [group for group in groups if columns & set(group[1])]:
            groups.remove(other)
            rows, columns = [*other[0], *rows], columns | set(other[1])
        groups.append((rows, sorted(columns)))
    # Elimination may leave a direction without any parameter: it has no regression.
    return [group for group in groups if group[1]]


# iv: instrumental variables, the regressors of the fitted model's noise-free FRF (Young 1970).

MAX_ITERATIONS = 25
TOLERANCE = 1e-4
# Smallest canonical correlation between instruments and regressors: in trials above 0.39 for good fits, and
# below 0.2 where the iteration diverges to a model unrelated to the data.
WEAKEST_INSTRUMENTS = 0.3
BREAKDOWN_NOTE = (
    "iv broke down: the fitted model's FRF hardly resembles the measured one (smallest canonical "
    f"correlation {{correlation:.2f}}, limit {WEAKEST_INSTRUMENTS:g}), or the iteration does not converge. "
    "The estimator ml converges without it."
)


def instrumental_variables(
    measured: Measured, model: DynamicModel, weight: str = "none"
) -> statistics.Estimate:
    """V^T A p = V^T b, V being A with the model's FRF of the last estimate instead of the measured one;
    started from ls.

    Stops when parameters or FRF change by less than 1e-4, after at most 25 iterations (Knaapen 1997, ch. 4);
    weak instruments do not converge. Standard errors: (V^T A)^-1 (V^T Omega V) (A^T V)^-1. FitError for
    dependent instruments. Equation (est-iv).
    """
    dof, equation = measured.dof(len(model.terms)), regression(measured, model, weight)
    start = equation_solution(equation, model)[0]
    values, stationary, iterations = _iterate(measured, model, equation, start)
    fitted_terms = model.equation_terms(model.receptance(values, measured.omega), measured.omega)
    instruments = _weighted_columns(fitted_terms, equation)
    correlation = weakest_correlation(instruments, equation.rows)
    converged = stationary and correlation >= WEAKEST_INSTRUMENTS
    r2, adjusted = statistics.determination(equation.right_side, equation.residual(values), len(model.terms))
    design, amplification = equation_design(fitted_terms, model, values)
    return statistics.Estimate(
        values=values,
        covariance=measured.shared_noise * _sandwich(measured, model, equation, instruments, values),
        scaled_design=design,
        gof=Goodness(r2, adjusted, *output_chi_square(measured, model, values, dof)),
        dof=dof,
        converged=converged,
        iterations=iterations,
        notes=() if converged else (BREAKDOWN_NOTE.format(correlation=correlation),),
        amplification=amplification,
    )


def instrument_step(
    measured: Measured, model: DynamicModel, weight: str, values: FloatArray
) -> Callable[[DynamicModel, Measured], FloatArray]:
    """From a model and data to the estimate (n_parameter,) [parameter units] by the instruments of *values*
    (n_parameter,).
    """
    fitted_terms = model.equation_terms(model.receptance(values, measured.omega), measured.omega)
    instruments = _weighted_columns(fitted_terms, regression(measured, model, weight))
    return lambda changed_model, changed: regression(changed, changed_model, weight).instrumental(instruments)


def _iterate(
    measured: Measured, model: DynamicModel, equation: Regression, values: FloatArray
) -> tuple[FloatArray, bool, int]:
    last: ComplexArray | None = None
    for iteration in range(1, MAX_ITERATIONS + 1):
        response = model.receptance(values, measured.omega)
        instruments = _weighted_columns(model.equation_terms(response, measured.omega), equation)
        new = equation.instrumental(instruments)
        stationary = _change(new * equation.lengths, values * equation.lengths) < TOLERANCE or (
            last is not None and _change(response, last) < TOLERANCE
        )
        values, last = new, response
        if stationary:
            return values, True, iteration
    return values, False, MAX_ITERATIONS


def weakest_correlation(instruments: FloatArray, columns: FloatArray) -> float:
    """Smallest canonical correlation [1] between the spaces of instruments and of regressors, both
    (n_parameter, n_equation).

    With V = Q_v R_v and A = Q_a R_a it is the smallest singular value of Q_v^T Q_a = R_v^-T V^T A R_a^-1.
    Equation (est-canonical).
    """
    sizes = [np.sqrt(np.einsum("pe,pe->p", rows, rows)) for rows in (instruments, columns)]
    half = np.linalg.solve(triangle_of(instruments.T).T, instruments @ columns.T / np.outer(*sizes))
    between = np.linalg.solve(triangle_of(columns.T).T, half.T)
    return float(np.linalg.svd(between, compute_uv=False)[-1])


def _sandwich(
    measured: Measured, model: DynamicModel, equation: Regression, instruments: FloatArray, values: FloatArray
) -> FloatArray:
    """Covariance of the estimate from the noise of the FRF or, if unknown, from the residual (White)."""
    if has_noise(measured):
        middle = _scores(measured, model, equation, instruments, values)
    else:
        middle = _residual_scores(measured, equation, instruments, values)
    bread = np.linalg.pinv(instruments @ equation.rows.T)
    return bread @ middle @ bread.T


def _scores(
    measured: Measured, model: DynamicModel, equation: Regression, instruments: FloatArray, values: FloatArray
) -> FloatArray:
    """V^T Omega V of the equation's error, Omega = (Z x I) cov(dH) (Z x I)^H, half of it in the real part."""
    assert measured.covariance is not None
    n_line, n_output, n_input = measured.matrix.shape
    z = model.dynamic_stiffness(values, measured.omega) * equation.line_weights[:, None, None]
    turned = np.einsum("lab,ij->laibj", z, np.eye(n_input)).reshape(n_line, n_output * n_input, -1)
    omega = turned @ measured.covariance @ turned.conj().swapaxes(1, 2)
    rows = complex_rows(instruments.T, n_line).swapaxes(1, 2)
    return 0.5 * np.sum(rows.conj() @ omega @ rows.swapaxes(1, 2), axis=0).real


def _residual_scores(
    measured: Measured, equation: Regression, instruments: FloatArray, values: FloatArray
) -> FloatArray:
    """sum over lines of g g^T, g = V^T e of one line, enlarged by n / (n - k)."""
    products = instruments * statistics.stack(equation.residual(values).reshape(-1))
    by_line = products.reshape(values.size, 2, measured.omega.size, -1).sum(axis=(1, 3))
    n = measured.n_equation
    return by_line @ by_line.T * (n / (n - values.size))


def _weighted_columns(terms: ComplexArray, equation: Regression) -> FloatArray:
    return statistics.stacked_terms(terms * equation.line_weights[:, None, None])


def _change(new: NDArray[np.inexact], old: NDArray[np.inexact]) -> float:
    return float(np.linalg.norm(new - old) / np.linalg.norm(old))
