"""ls: least squares of the equation of motion, sum_j p_j (Z_j H - B_j) = B_0 - Z_0 H, real and imaginary parts stacked."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from labpipe.errors import FitError
from labpipe.identify.measured import Measured
from labpipe.identify.model import DynamicModel
from labpipe.identify.statistics import Estimate, condition_number, determination, stacked
from labpipe.records.identification import Goodness

BIAS_NOTE = (
    "ls: the standard errors come from the equation's residual; the bias that noise in the measured FRF causes is not in them "
    "(the FRF stands among the regressors). The estimator ml has no such bias."
)


def least_squares(measured: Measured, model: DynamicModel) -> Estimate:
    """Equation-error estimate; rows of the equation of motion that share no parameter are separate regressions.

    Standard error = sqrt(residual variance * diag((W^T W)^-1)) with n - k real degrees of freedom (Lim et al. 2009, eq. 14-15, 25,
    with n - k for the printed n - 3). FitError when there are fewer equations than parameters.
    """
    terms = model.equation_terms(measured.matrix, measured.omega)
    known = model.equation_known(measured.matrix, measured.omega)
    n_parameter = len(model.terms)
    if measured.n_equation <= n_parameter:
        raise FitError(f"{measured.n_equation} real equations cannot determine {n_parameter} parameters", hint="widen the band")
    values, covariance = np.zeros(n_parameter), np.zeros((n_parameter, n_parameter))
    own_dof = np.zeros(n_parameter, int)
    for rows, own in _separate_regressions(terms):
        values[own], covariance[np.ix_(own, own)] = _solve(terms[own][:, :, rows], known[:, rows])
        own_dof[own] = 2 * known[:, rows].size - len(own)
    residual = known - np.einsum("p,plab->lab", values, terms)
    r2, adjusted = determination(known, residual, n_parameter)
    design = _plain_design(measured, model, values, scaled_design(terms))
    dof = measured.n_equation - n_parameter
    return Estimate(values, covariance, design, Goodness(r2, adjusted), dof, notes=(BIAS_NOTE,), own_dof=own_dof)


def _plain_design(
    measured: Measured, model: DynamicModel, values: NDArray[np.floating], noisy: NDArray[np.floating]
) -> NDArray[np.floating]:
    """The design by which collinearity is judged: the measured one, or the fitted model's where that is worse conditioned.

    Noise in the measured FRF makes collinear columns look different; the model's own FRF has none.
    """
    try:
        fitted = scaled_design(model.equation_terms(model.receptance(values, measured.omega), measured.omega))
    except FitError:
        return noisy
    return max(noisy, fitted, key=condition_number)


def scaled_design(terms: NDArray[np.complexfloating]) -> NDArray[np.floating]:
    """Regressors (n_parameter, n_line, ...) as a real matrix (n_equation, n_parameter) with columns of length 1."""
    columns = stacked(terms.reshape(terms.shape[0], -1)).T
    scale = np.linalg.norm(columns, axis=0)
    scaled: NDArray[np.floating] = columns / np.where(scale > 0, scale, 1.0)
    return scaled


def solve_scaled(columns: NDArray[np.floating], known: NDArray[np.floating]) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    """Least-squares solution and (W^T W)^-1, columns scaled to length 1 in between so that units do not matter."""
    scale = np.linalg.norm(columns, axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    left, singular, right = linalg.svd(columns / scale, full_matrices=False)
    if singular[-1] <= singular[0] * np.finfo(float).eps * max(columns.shape):
        raise FitError(
            "the excitation leaves parameters undetermined: columns of the regression are linearly dependent",
            hint="excite a second force direction, or use a model with fewer parameters",
        )
    values = right.T @ ((left.T @ known) / singular) / scale
    inverse = (right.T / singular**2) @ right / np.outer(scale, scale)
    return values, inverse


def _solve(terms: NDArray[np.complexfloating], known: NDArray[np.complexfloating]) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    """One regression: estimates and their covariance from its own residual variance."""
    columns = stacked(terms.reshape(terms.shape[0], -1)).T
    side = stacked(known.reshape(-1))
    if side.size <= columns.shape[1]:
        message = f"{side.size} real equations cannot determine the {columns.shape[1]} parameters of a direction"
        raise FitError(message, hint="widen the band")
    values, inverse = solve_scaled(columns, side)
    residual = side - columns @ values
    variance = float(residual @ residual) / (side.size - values.size)
    return values, variance * inverse


def _separate_regressions(terms: NDArray[np.complexfloating]) -> list[tuple[list[int], list[int]]]:
    """(rows of the equation of motion, parameters) of every group of rows that shares parameters."""
    acts = np.any(terms != 0, axis=(1, 3))
    groups: list[tuple[list[int], list[int]]] = []
    for row in range(acts.shape[1]):
        rows, own = [row], set(np.flatnonzero(acts[:, row]).tolist())
        for other in [group for group in groups if own & set(group[1])]:
            groups.remove(other)
            rows, own = [*other[0], *rows], own | set(other[1])
        groups.append((rows, sorted(own)))
    # Elimination may leave a direction without any parameter: nothing is regressed there.
    return [group for group in groups if group[1]]
