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
from labpipe.records.identification import Goodness

# Condition number up to which products of columns keep eight digits and more.
WELL_CONDITIONED = 1e4
BIAS_NOTE = (
    "ls: the standard errors come from the equation's residual; the bias that noise in the measured FRF causes is not in them "
    "(the FRF stands among the regressors). The estimator ml has no such bias."
)


def least_squares(measured: Measured, model: DynamicModel, weight: str = "none") -> Estimate:
    """Equation-error estimate; rows of the equation of motion that share no parameter are separate regressions.

    Standard error = sqrt(residual variance * diag((W^T W)^-1)) with n - k real degrees of freedom (Lim et al. 2009, eq. 14-15, 25,
    with n - k for the printed n - 3). FitError when there are fewer equations than parameters.
    """
    equation = regression(measured, model, weight)
    n_parameter = len(model.terms)
    values, covariance, own_dof = equation_solution(equation, model)
    r2, adjusted = determination(equation.known, equation.residual(values), n_parameter)
    design, amplification = _plain_design(measured, model, values, equation.terms)
    dof = measured.n_equation - n_parameter
    gof = Goodness(r2, adjusted, *output_chi_square(measured, model, values, dof))
    scaled, notes = measured.shared_noise * covariance, (BIAS_NOTE,)
    return Estimate(values, scaled, design, gof, dof, notes=notes, own_dof=own_dof, amplification=amplification)


def equation_solution(equation: Regression, model: DynamicModel) -> tuple[FloatArray, FloatArray, IntArray]:
    """(estimate, its covariance, degrees of freedom of each parameter's own regression)."""
    n_parameter = len(model.terms)
    values, covariance = np.zeros(n_parameter), np.zeros((n_parameter, n_parameter))
    own_dof = np.zeros(n_parameter, int)
    for rows, own in _separate_regressions(model):
        side = equation.known[:, rows]
        values[own], covariance[np.ix_(own, own)] = _solve(equation.terms[own][:, :, rows], side)
        own_dof[own] = 2 * side.size - len(own)
    return values, covariance, own_dof


@dataclass(frozen=True)
class Regression:
    """The equation of motion as a regression: *terms* (n_parameter, n_line, n_dof, n_input), *known* (n_line, n_dof, n_input)."""

    terms: ComplexArray
    known: ComplexArray
    line_weights: FloatArray

    def residual(self, values: FloatArray) -> ComplexArray:
        """What the equation leaves, (n_line, n_dof, n_input)."""
        residual: ComplexArray = self.known - np.tensordot(values, self.terms, 1)
        return residual


def regression(measured: Measured, model: DynamicModel, weight: str) -> Regression:
    """The weighted equation of motion of the measured FRF; FitError when there are fewer equations than parameters."""
    if measured.n_equation <= len(model.terms):
        raise FitError(f"{measured.n_equation} real equations cannot determine {len(model.terms)} parameters", hint="widen the band")
    weights = line_weights(measured, weight)
    terms = model.equation_terms(measured.matrix, measured.omega)
    known = model.equation_known(measured.matrix, measured.omega)
    if weight != "none":
        terms, known = terms * weights[:, None, None], known * weights[:, None, None]
    return Regression(terms, known, weights)


def line_weights(measured: Measured, weight: str) -> FloatArray:
    """none: 1. noise: |H| / s per line, for the noise s of H becomes s |Z| = s / |H| in the equation of motion; (n_line,)."""
    if weight == "none":
        return np.ones(measured.omega.size)
    if not has_noise(measured):
        raise FitError("the noise of the FRF is not known, so lines cannot weigh by it", hint="leave `weight` out")
    assert measured.covariance is not None
    size = np.sqrt(np.sum(np.abs(measured.matrix) ** 2, axis=(1, 2)))
    noise = np.sqrt(np.einsum("lii->l", measured.covariance).real)
    if np.any(noise == 0):
        raise FitError("a line of the FRF has no noise, so lines cannot weigh by it", hint="leave `weight` out")
    weights: FloatArray = size / noise
    return weights / float(np.max(weights))


def output_chi_square(measured: Measured, model: DynamicModel, values: FloatArray, dof: int) -> tuple[float | None, float | None]:
    """(chi-square per degree of freedom, its p-value) of measured - fitted FRF; None where the noise is not known well enough."""
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
    """The design by which collinearity is judged, and its amplification: the measured one, or the fitted model's where that is worse.

    Noise in the measured FRF makes collinear columns look different; the model's own FRF has none.
    """
    designs = [noisy_terms]
    with contextlib.suppress(FitError):
        designs.append(model.equation_terms(model.receptance(values, measured.omega), measured.omega))
    found = [equation_design(terms, model, values) for terms in designs]
    return max(found, key=lambda design: condition_number(design[0]))


def equation_design(terms: ComplexArray, model: DynamicModel, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(triangular factor of the regressors with columns of length 1, amplification of every parameter).

    An error dH puts Z dH into the equation of motion, as large as Z H = B for dH as large as H.
    """
    lengths, triangle, _ = _factorised(stacked_terms(terms).T)
    forces = np.sqrt(terms.shape[1]) * np.linalg.norm(model.whole(values).force)
    return triangle, forces * np.sqrt(inflation_factors(triangle)) / lengths


def triangle_of(columns: FloatArray) -> FloatArray:
    """Triangular factor R of *columns* (n_equation, n_parameter) scaled to length 1."""
    return _factorised(columns)[1]


def _factorised(columns: FloatArray) -> tuple[FloatArray, FloatArray, bool]:
    """(lengths of the columns, R of the columns scaled by them, whether R came from their products).

    Products of columns (Cholesky) cost a fraction of Householder's QR and are as good while the condition number is far below
    1 / sqrt(rounding); beyond that QR takes over.
    """
    products = columns.T @ columns
    scale = np.sqrt(np.diag(products))
    scale = np.where(scale > 0, scale, 1.0)
    try:
        triangle: FloatArray = np.linalg.cholesky(products / np.outer(scale, scale)).T
        if np.linalg.cond(triangle) < WELL_CONDITIONED:
            return scale, triangle, True
    except np.linalg.LinAlgError:
        pass
    return scale, np.asarray(np.linalg.qr(columns / scale, mode="r")), False


def solve_scaled(columns: FloatArray, known: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Least-squares solution and (W^T W)^-1, columns scaled to length 1 in between so that units do not matter."""
    n = columns.shape[1]
    scale, triangle, by_products = _factorised(columns)
    left, singular, right = linalg.svd(triangle)
    if singular[-1] <= singular[0] * np.finfo(float).eps * max(columns.shape):
        raise FitError(
            "the excitation leaves parameters undetermined: columns of the regression are linearly dependent",
            hint="excite a second force direction, or use a model with fewer parameters",
        )
    inverse = (right.T / singular**2) @ right / np.outer(scale, scale)
    if by_products:
        # Corrected seminormal equations (Bjoerck 1987): one refinement makes them as accurate as QR.
        values = inverse @ (columns.T @ known)
        return values + inverse @ (columns.T @ (known - columns @ values)), inverse
    side = np.asarray(np.linalg.qr(np.column_stack([columns / scale, known]), mode="r"))[:n, n]
    # The last column shares the signs of its own factorisation, whose first columns are R up to rounding.
    return right.T @ ((left.T @ side) / singular) / scale, inverse


def _solve(terms: ComplexArray, known: ComplexArray) -> tuple[FloatArray, FloatArray]:
    """One regression: estimates and their covariance from its own residual variance."""
    columns = stacked_terms(terms).T
    side = stacked(known.reshape(-1))
    if side.size <= columns.shape[1]:
        message = f"{side.size} real equations cannot determine the {columns.shape[1]} parameters of a direction"
        raise FitError(message, hint="widen the band")
    values, inverse = solve_scaled(columns, side)
    residual = side - columns @ values
    variance = float(residual @ residual) / (side.size - values.size)
    return values, variance * inverse


def _separate_regressions(model: DynamicModel) -> list[tuple[list[int], list[int]]]:
    """(rows of the equation of motion, parameters) of every group of rows that shares parameters."""
    n_dof = model.given.mass.shape[0]
    acts = [np.any(np.hstack([m.stiffness, m.damping, m.mass, m.force]) != 0, axis=1) for m in (term.matrices for term in model.terms)]
    groups: list[tuple[list[int], list[int]]] = []
    for row in range(n_dof):
        rows, own = [row], {number for number, places in enumerate(acts) if places[row]}
        for other in [group for group in groups if own & set(group[1])]:
            groups.remove(other)
            rows, own = [*other[0], *rows], own | set(other[1])
        groups.append((rows, sorted(own)))
    # Elimination may leave a direction without any parameter: nothing is regressed there.
    return [group for group in groups if group[1]]
