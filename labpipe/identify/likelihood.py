"""ml: output error weighted with the FRF covariance, the maximum-likelihood estimate for known noise.

chi^2(p) = 2 sum_lines d^H C^-1 d with d = vec(H_measured - H(p)) and C = E[d d^H], minimised by Levenberg and Marquardt's method with
the analytic Jacobian. The factor 2 counts real and imaginary part: each holds half of the variance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from labpipe.errors import FitError
from labpipe.identify.measured import Measured
from labpipe.identify.model import DynamicModel
from labpipe.identify.regression import least_squares, solve_scaled
from labpipe.identify.statistics import Estimate, determination, stacked
from labpipe.identify.weights import equal_weights, has_noise, weight_doubt, whitener
from labpipe.records.identification import Goodness

MAX_ITERATIONS = 100
MAX_DAMPING_STEPS = 20
# Share of the residual that a further step could still remove: 1e-6 of it is far below a standard error, and near to where the
# rounding of chi-square (its square) hides any further gain.
GRADIENT_TOLERANCE = 1e-6
# The same for data without noise, as a share of the FRF itself.
ROUNDING = 1e-12
REWEIGHTINGS = 12
UNWEIGHTED_NOTE = (
    "ml: the noise of the FRF is not known (it came without covariance, or free of noise), so all lines weigh alike, the standard "
    "errors come from the residual, and the chi-square test of the model is not possible."
)


@dataclass(frozen=True)
class _Problem:
    """A weighted output-error problem in real numbers: residual and Jacobian as functions of the parameters."""

    measured: Measured
    model: DynamicModel
    whitener: NDArray[np.complexfloating]

    def whitened(self, values: NDArray[np.complexfloating]) -> NDArray[np.floating]:
        """(..., n_line, n_output, n_input) -> (..., n_equation): uncorrelated, each real part of variance 1."""
        flat = values.reshape(*values.shape[:-2], -1)
        white = np.einsum("lab,...lb->...la", self.whitener, flat)
        return np.sqrt(2.0) * stacked(white.reshape(*white.shape[:-2], -1))

    def residual(self, parameters: NDArray[np.floating]) -> NDArray[np.floating]:
        return self.whitened(self.measured.matrix - self.model.receptance(parameters, self.measured.omega))

    def chi2(self, parameters: NDArray[np.floating]) -> float:
        """Sum of the squared residual; infinite where the model has no finite response."""
        try:
            residual = self.residual(parameters)
        except FitError:
            return np.inf
        return float(residual @ residual) if np.all(np.isfinite(residual)) else np.inf

    def jacobian(self, parameters: NDArray[np.floating]) -> NDArray[np.floating]:
        """d residual / d p, (n_equation, n_parameter)."""
        return -self.whitened(self.model.jacobian(parameters, self.measured.omega)).T


def maximum_likelihood(measured: Measured, model: DynamicModel) -> Estimate:
    """Weighted output-error estimate with standard errors from the information matrix, cov = (J^T J)^-1.

    Chi-square and covariance are corrected for a weight that was itself estimated (weights.py). Without measured noise all lines
    weigh alike and the residual gives the standard errors. FitError when there are fewer equations than parameters, or when the
    covariance cannot serve as a weight.
    """
    n_parameter = len(model.terms)
    dof = measured.n_equation - n_parameter
    if dof <= 0:
        raise FitError(f"{measured.n_equation} real equations cannot determine {n_parameter} parameters", hint="widen the band")
    weighted = has_noise(measured)
    problem = _Problem(measured, model, whitener(measured) if weighted else equal_weights(measured))
    values, converged, iterations = _minimise(problem, _start(problem))
    jacobian, residual = problem.jacobian(values), problem.residual(values)
    _, inverse = solve_scaled(jacobian, residual)
    design = jacobian / np.linalg.norm(jacobian, axis=0)
    reduced = float(residual @ residual) / dof
    r2, adjusted = determination(measured.matrix, measured.matrix - model.receptance(values, measured.omega), n_parameter)
    if not weighted:
        notes = (UNWEIGHTED_NOTE,)
        return Estimate(values, reduced * inverse, design, Goodness(r2, adjusted), dof, converged, iterations, notes)
    doubt = weight_doubt(measured, dof)
    reduced /= doubt.excess
    gof = Goodness(r2, adjusted, reduced, doubt.p_value(reduced, dof))
    return Estimate(values, doubt.inflation * inverse, design, gof, dof, converged, iterations)


def _start(problem: _Problem) -> NDArray[np.floating]:
    """The better of plain least squares and of its reweighted form, by their chi-square.

    Plain least squares is biased by noise; reweighting the equation error by Z^-1 of the last iterate (Sanathanan and Koerner 1963)
    makes it nearly an output error and needs no good start itself.
    """
    candidates = [least_squares(problem.measured, problem.model).values]
    for _ in range(REWEIGHTINGS):
        try:
            candidates.append(_reweighted(problem, candidates[-1]))
        except (FitError, np.linalg.LinAlgError):
            break
    return min(candidates, key=problem.chi2)


def _reweighted(problem: _Problem, last: NDArray[np.floating]) -> NDArray[np.floating]:
    """Least squares of Z_last^-1 times the equation error, whitened."""
    measured, model = problem.measured, problem.model
    z = model.dynamic_stiffness(last, measured.omega)
    terms = np.linalg.solve(z[None], model.equation_terms(measured.matrix, measured.omega))
    known = np.linalg.solve(z, model.equation_known(measured.matrix, measured.omega))
    return solve_scaled(problem.whitened(terms).T, problem.whitened(known))[0]


def _minimise(problem: _Problem, start: NDArray[np.floating]) -> tuple[NDArray[np.floating], bool, int]:
    """Levenberg-Marquardt from *start*: (parameters, converged, steps taken)."""
    values, damping = start, 1e-3
    rounding = ROUNDING * float(np.linalg.norm(problem.whitened(problem.measured.matrix)))
    for steps in range(MAX_ITERATIONS):
        residual, jacobian = problem.residual(values), problem.jacobian(values)
        scale = np.linalg.norm(jacobian, axis=0)
        scaled = jacobian / scale
        if _explained(scaled, residual) <= max(GRADIENT_TOLERANCE * float(np.linalg.norm(residual)), rounding):
            return values, True, steps
        step, damping = _damped_step(problem, values, residual, scaled, scale, damping)
        if step is None:
            return values, False, steps
        values = values + step
    return values, False, MAX_ITERATIONS


def _explained(scaled: NDArray[np.floating], residual: NDArray[np.floating]) -> float:
    """Length of the part of the residual that a further full step would remove: its projection on the Jacobian's columns.

    Unlike the length of the last step it does not get small because the damping is large.
    """
    return float(np.linalg.norm(np.linalg.qr(scaled)[0].T @ residual))


def _damped_step(
    problem: _Problem,
    values: NDArray[np.floating],
    residual: NDArray[np.floating],
    scaled: NDArray[np.floating],
    scale: NDArray[np.floating],
    damping: float,
) -> tuple[NDArray[np.floating] | None, float]:
    """A step that lowers chi-square and the damping for the next one; no step when none lowers it any more."""
    n = values.size
    before = float(residual @ residual)
    for _ in range(MAX_DAMPING_STEPS):
        joint = np.vstack([scaled, np.sqrt(damping) * np.eye(n)])
        step = np.linalg.lstsq(joint, np.concatenate([-residual, np.zeros(n)]), rcond=None)[0] / scale
        if problem.chi2(values + step) < before:
            return step, max(damping / 10, 1e-15)
        damping *= 10
    return None, damping
