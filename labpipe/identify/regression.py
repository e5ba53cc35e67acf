"""ls: least squares of the equation of motion, sum_j p_j (Z_j H - B_j) = B_0 - Z_0 H, real and imaginary parts stacked."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass

import numpy as np
from scipy import linalg

from labpipe.arrays import ComplexArray, FloatArray, IntArray
from labpipe.errors import FitError
from labpipe.identify.measured import Measured
from labpipe.identify.model import DynamicModel
from labpipe.identify.statistics import Estimate, condition_number, determination, inflation_factors, stacked, stacked_terms
from labpipe.identify.weights import has_noise, weight_doubt, whitened, whitener
from labpipe.optimise.levenberg import Linearisation
from labpipe.optimise.triangle import scaled_triangle
from labpipe.records.identification import Goodness

BIAS_NOTE = (
    "ls: the standard errors come from the equation's residual; they do not include the bias caused by noise of the measured FRF "
    "(the FRF is among the regressors). The estimator ml has no such bias."
)


def least_squares(measured: Measured, model: DynamicModel, weight: str = "none") -> Estimate:
    """Equation-error estimate; rows of the equation of motion without common parameters are separate regressions.

    Standard error = sqrt(residual variance * diag((W^T W)^-1)) with n - k real degrees of freedom (Lim et al. 2009, eq. 14-15, 25,
    with n - k for the printed n - 3). FitError for fewer equations than parameters. Equation (est-ls).
    """
    equation = regression(measured, model, weight)
    n_parameter = len(model.terms)
    values, covariance, parameter_dof = equation_solution(equation, model)
    r2, adjusted = determination(equation.right_side, equation.residual(values), n_parameter)
    design, amplification = _plain_design(measured, model, values, equation.terms)
    dof = measured.n_equation - n_parameter
    gof = Goodness(r2, adjusted, *output_chi_square(measured, model, values, dof))
    scaled, notes = measured.shared_noise * covariance, (BIAS_NOTE,)
    return Estimate(
        values=values,
        covariance=scaled,
        scaled_design=design,
        gof=gof,
        dof=dof,
        notes=notes,
        parameter_dof=parameter_dof,
        amplification=amplification,
    )


def equation_solution(equation: Regression, model: DynamicModel) -> tuple[FloatArray, FloatArray, IntArray]:
    """Estimate (n_parameter,) [parameter units], its covariance (n_parameter, n_parameter), degrees of freedom (n_parameter,).

    Degrees of freedom are those of the regression of each parameter. Raises FitError as solve_scaled does.
    """
    n_parameter = len(model.terms)
    values, covariance = np.zeros(n_parameter), np.zeros((n_parameter, n_parameter))
    parameter_dof = np.zeros(n_parameter, int)
    for rows, columns in _separate_regressions(model):
        side = equation.right_side[:, rows]
        values[columns], covariance[np.ix_(columns, columns)] = _solve(equation.terms[columns][:, :, rows], side)
        parameter_dof[columns] = 2 * side.size - len(columns)
    return values, covariance, parameter_dof


@dataclass(frozen=True)
class Regression:
    """The equation of motion as a regression: *terms* (n_parameter, n_line, n_dof, n_input), *right_side* (n_line, n_dof, n_input) [1].

    line_weights (n_line,) [1].
    """

    terms: ComplexArray
    right_side: ComplexArray
    line_weights: FloatArray

    def residual(self, values: FloatArray) -> ComplexArray:
        """Residual of the equation, (n_line, n_dof, n_input) [1]."""
        residual: ComplexArray = self.right_side - np.tensordot(values, self.terms, 1)
        return residual


def regression(measured: Measured, model: DynamicModel, weight: str) -> Regression:
    """The weighted equation of motion of the measured FRF; FitError for fewer equations than parameters."""
    if measured.n_equation <= len(model.terms):
        raise FitError(f"{measured.n_equation} real equations cannot determine {len(model.terms)} parameters", hint="widen the band")
    weights = line_weights(measured, weight)
    terms = model.equation_terms(measured.matrix, measured.omega)
    right_side = model.equation_constant(measured.matrix, measured.omega)
    if weight != "none":
        terms, right_side = terms * weights[:, None, None], right_side * weights[:, None, None]
    return Regression(terms, right_side, weights)


def line_weights(measured: Measured, weight: str) -> FloatArray:
    """Weight of every line, (n_line,) [1]; none: 1; noise: |H| / s, since noise s of H becomes s |Z| = s / |H| in the equation of motion.

    FitError for an unknown or zero noise. Equation (est-line-weights).
    """
    if weight == "none":
        return np.ones(measured.omega.size)
    if not has_noise(measured):
        raise FitError("the noise of the FRF is not known, so lines cannot be weighted by it", hint="leave `weight` out")
    assert measured.covariance is not None
    size = np.sqrt(np.sum(np.abs(measured.matrix) ** 2, axis=(1, 2)))
    noise = np.sqrt(np.einsum("lii->l", measured.covariance).real)
    if np.any(noise == 0):
        raise FitError("a line of the FRF has no noise, so lines cannot be weighted by it", hint="leave `weight` out")
    weights: FloatArray = size / noise
    return weights / float(np.max(weights))


def output_chi_square(measured: Measured, model: DynamicModel, values: FloatArray, dof: int) -> tuple[float | None, float | None]:
    """chi-square per degree of freedom [1] and p-value of measured - fitted FRF at *values* (n_parameter,); None for an unknown noise."""
    if not has_noise(measured):
        return None, None
    try:
        doubt = weight_doubt(measured, dof)
        residual = whitened(whitener(measured), measured.matrix - model.receptance(values, measured.omega))
    except FitError:
        return None, None
    reduced = float(residual @ residual) / dof / doubt.excess
    return (reduced, doubt.p_value(reduced, dof)) if np.isfinite(reduced) else (None, None)


def _plain_design(measured: Measured, model: DynamicModel, values: FloatArray, noisy_terms: ComplexArray) -> tuple[FloatArray, FloatArray]:
    """Design matrix for the test of collinearity, and its amplification: measured or fitted model's, whichever is worse.

    Noise in the measured FRF makes collinear columns appear different; the model's FRF has none.
    """
    designs = [noisy_terms]
    with contextlib.suppress(FitError):
        designs.append(model.equation_terms(model.receptance(values, measured.omega), measured.omega))
    candidates = [equation_design(terms, model, values) for terms in designs]
    return max(candidates, key=lambda design: condition_number(design[0]))


def equation_design(terms: ComplexArray, model: DynamicModel, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Triangular factor (n_parameter, n_parameter) [1] of the normalised regressors, and amplification (n_parameter,) [parameter units].

    An error dH adds Z dH to the equation of motion, which is as large as Z H = B for dH as large as H.
    """
    lengths, triangle, _ = scaled_triangle(stacked_terms(terms).T)
    forces = np.sqrt(terms.shape[1]) * np.linalg.norm(model.whole(values).force)
    return triangle, forces * np.sqrt(inflation_factors(triangle)) / lengths


def triangle_of(columns: FloatArray) -> FloatArray:
    """Triangular factor R (n_parameter, n_parameter) [1] of *columns* (n_equation, n_parameter) scaled to length 1."""
    return scaled_triangle(columns)[1]


def solve_scaled(columns: FloatArray, right_side: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Least-squares solution (n_parameter,) [parameter units] and (W^T W)^-1 (n_parameter, n_parameter).

    *columns* (n_equation, n_parameter), *right_side* (n_equation,). Columns are scaled to length 1, so that units have no influence.
    FitError for linearly dependent columns.
    """
    n = columns.shape[1]
    scale, triangle, by_products = scaled_triangle(columns)
    inverse, (left_vectors, singular, right_vectors) = _inverted(triangle, scale, max(columns.shape))
    if by_products:
        # Corrected seminormal equations (Bjoerck 1987): one refinement makes them as accurate as QR.
        values = inverse @ (columns.T @ right_side)
        return values + inverse @ (columns.T @ (right_side - columns @ values)), inverse
    side = np.asarray(np.linalg.qr(np.column_stack([columns / scale, right_side]), mode="r"))[:n, n]
    # The right side keeps the signs of this factorisation, whose first columns are R up to rounding.
    return right_vectors.T @ ((left_vectors.T @ side) / singular) / scale, inverse


def inverse_of(linear: Linearisation) -> FloatArray:
    """(J^T J)^-1 (n_parameter, n_parameter) [parameter units squared] of a linearisation; FitError for linearly dependent columns."""
    return _inverted(linear.triangle, linear.scale, linear.n_equation)[0]


def _inverted(triangle: FloatArray, scale: FloatArray, n_row: int) -> tuple[FloatArray, tuple[FloatArray, FloatArray, FloatArray]]:
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
    """One regression: estimates and their covariance from its residual variance."""
    columns = stacked_terms(terms).T
    side = stacked(right_side.reshape(-1))
    if side.size <= columns.shape[1]:
        message = f"{side.size} real equations cannot determine the {columns.shape[1]} parameters of a direction"
        raise FitError(message, hint="widen the band")
    values, inverse = solve_scaled(columns, side)
    residual = side - columns @ values
    variance = float(residual @ residual) / (side.size - values.size)
    return values, variance * inverse


def _separate_regressions(model: DynamicModel) -> list[tuple[list[int], list[int]]]:
    """(rows of the equation of motion, parameters) of every group of rows with common parameters."""
    n_dof = model.constant.mass.shape[0]
    acts = [np.any(np.hstack([m.stiffness, m.damping, m.mass, m.force]) != 0, axis=1) for m in (term.matrices for term in model.terms)]
    groups: list[tuple[list[int], list[int]]] = []
    for row in range(n_dof):
        rows, columns = [row], {number for number, places in enumerate(acts) if places[row]}
        for other in [group for group in groups if columns & set(group[1])]:
            groups.remove(other)
            rows, columns = [*other[0], *rows], columns | set(other[1])
        groups.append((rows, sorted(columns)))
    # Elimination may leave a direction without any parameter: it has no regression.
    return [group for group in groups if group[1]]
