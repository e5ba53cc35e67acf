"""ml: output error weighted with the FRF covariance, the maximum-likelihood estimate for known noise.

chi^2(p) = 2 sum_lines d^H C^-1 d with d = vec(H_measured - H(p)) and C = E[d d^H], minimised by Levenberg and Marquardt's method with
the analytic Jacobian. The factor 2 counts real and imaginary part: each holds half of the variance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from labpipe.errors import FitError
from labpipe.identify.measured import Measured
from labpipe.identify.model import DynamicModel
from labpipe.identify.regression import least_squares, solve_scaled
from labpipe.identify.statistics import Estimate, determination, stacked
from labpipe.records.identification import Goodness

MAX_ITERATIONS = 100
MAX_DAMPING_STEPS = 20
STEP_TOLERANCE = 1e-10
# Cosine between the residual and the columns of the Jacobian below which no step can lower chi-square any more.
GRADIENT_TOLERANCE = 1e-5
REWEIGHTINGS = 12
UNWEIGHTED_NOTE = (
    "ml: the noise of the FRF is not known (it came without covariance, or free of noise), so all lines weigh alike, the standard "
    "errors come from the residual, and the chi-square test of the model is not possible."
)
# Below this relative standard deviation an FRF holds rounding errors, which are no measured noise to weigh by.
NOISE_FREE = 1e-10


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

    def jacobian(self, parameters: NDArray[np.floating]) -> NDArray[np.floating]:
        """d residual / d p, (n_equation, n_parameter)."""
        return -self.whitened(self.model.jacobian(parameters, self.measured.omega)).T


def maximum_likelihood(measured: Measured, model: DynamicModel) -> Estimate:
    """Weighted output-error estimate with standard errors from the information matrix, cov = (J^T J)^-1.

    A covariance that was itself estimated from nu degrees of freedom makes E[C^-1] too large by nu / (nu - n) for n FRFs per line
    (complex Wishart); chi-square and covariance are corrected for it. FitError when the covariance cannot serve as a weight.
    """
    n_parameter = len(model.terms)
    if measured.n_equation <= n_parameter:
        raise FitError(f"{measured.n_equation} real equations cannot determine {n_parameter} parameters", hint="widen the band")
    weighted = _has_noise(measured)
    problem = _Problem(measured, model, _whitener(measured) if weighted else _equal_weights(measured))
    values, converged, iterations = _minimise(problem, _start(problem))
    jacobian = problem.jacobian(values)
    _, inverse = solve_scaled(jacobian, problem.residual(values))
    residual = problem.residual(values)
    dof = measured.n_equation - n_parameter
    excess = float(residual @ residual) / dof
    fitted_error = measured.matrix - model.receptance(values, measured.omega)
    r2, adjusted = determination(measured.matrix, fitted_error, n_parameter)
    design = jacobian / np.linalg.norm(jacobian, axis=0)
    if not weighted:
        gof = Goodness(r2, adjusted)
        return Estimate(values, excess * inverse, design, gof, dof, converged, iterations, (UNWEIGHTED_NOTE,))
    factor = _estimated_weight_factor(measured)
    reduced = excess / factor
    p_value = float(stats.f.sf(reduced, dof, measured.band_dof) if np.isfinite(measured.band_dof) else stats.chi2.sf(reduced * dof, dof))
    gof = Goodness(r2, adjusted, reduced, p_value)
    return Estimate(values, factor * inverse, design, gof, dof, converged, iterations)


def _estimated_weight_factor(measured: Measured) -> float:
    """nu / (nu - n): how much a covariance estimated from nu degrees of freedom makes n residuals per line look too large."""
    n = measured.matrix.shape[1] * measured.matrix.shape[2]
    if not np.isfinite(measured.noise_dof):
        return 1.0
    if measured.noise_dof <= n + 1:
        raise FitError(
            f"the covariance of {n} FRFs was estimated from {measured.noise_dof:.3g} degrees of freedom only",
            hint="average more periods or blocks, or raise `smooth`",
        )
    return float(measured.noise_dof / (measured.noise_dof - n))


def _has_noise(measured: Measured) -> bool:
    """Whether the FRF comes with noise that was measured."""
    if measured.covariance is None:
        return False
    variance = np.einsum("lii->li", measured.covariance).real
    return bool(np.max(variance) > NOISE_FREE**2 * np.max(np.abs(measured.matrix) ** 2))


def _equal_weights(measured: Measured) -> NDArray[np.complexfloating]:
    """The same weight for every FRF and line, (n_line, n, n), scaled by the FRF's size so that units do not matter."""
    n = measured.matrix.shape[1] * measured.matrix.shape[2]
    size = np.sqrt(np.mean(np.abs(measured.matrix) ** 2))
    return np.broadcast_to(np.eye(n) / size, (measured.omega.size, n, n)).astype(np.complex128)


def _whitener(measured: Measured) -> NDArray[np.complexfloating]:
    """L^-1 of C = L L^H per line, (n_line, n, n)."""
    assert measured.covariance is not None
    std = np.sqrt(np.einsum("lii->li", measured.covariance).real)
    if np.any(std == 0):
        line = int(np.argwhere(std == 0)[0][0])
        frequency = measured.omega[line] / (2 * np.pi)
        hint = "leave this line out with `exclude`"
        raise FitError(f"the variance of the FRF is zero at {frequency:g} Hz", hint=hint)
    scaled = measured.covariance / (std[:, :, None] * std[:, None, :])
    try:
        lower = np.linalg.cholesky(scaled)
    except np.linalg.LinAlgError:
        raise FitError("the covariance of the FRF is singular", hint="average more periods or blocks") from None
    whitener: NDArray[np.complexfloating] = np.linalg.inv(lower) / std[:, None, :]
    return whitener


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
    chi2 = [float(np.sum(problem.residual(candidate) ** 2)) for candidate in candidates]
    return candidates[int(np.nanargmin(chi2))]


def _reweighted(problem: _Problem, last: NDArray[np.floating]) -> NDArray[np.floating]:
    """Least squares of Z_last^-1 times the equation error, whitened."""
    measured, model = problem.measured, problem.model
    z = model.dynamic_stiffness(last, measured.omega)
    terms = np.linalg.solve(z[None], model.equation_terms(measured.matrix, measured.omega))
    known = np.linalg.solve(z, model.equation_known(measured.matrix, measured.omega))
    return solve_scaled(problem.whitened(terms).T, problem.whitened(known))[0]


def _minimise(problem: _Problem, start: NDArray[np.floating]) -> tuple[NDArray[np.floating], bool, int]:
    """Levenberg-Marquardt from *start*: (parameters, converged, iterations)."""
    values, residual = start, problem.residual(start)
    damping = 1e-3
    for iteration in range(1, MAX_ITERATIONS + 1):
        jacobian = problem.jacobian(values)
        scale = np.linalg.norm(jacobian, axis=0)
        step, residual_new, damping = _damped_step(problem, values, residual, jacobian / scale, scale, damping)
        if step is None:
            slope = float(np.linalg.norm((jacobian / scale).T @ residual))
            return values, slope <= GRADIENT_TOLERANCE * float(np.linalg.norm(residual)), iteration
        values = values + step
        before, after = float(residual @ residual), float(residual_new @ residual_new)
        residual = residual_new
        # In units of the standard errors, which do not depend on the units of the parameters.
        small = float(np.linalg.norm(step * scale)) <= STEP_TOLERANCE * max(float(np.linalg.norm(values * scale)), 1.0)
        if small or before - after < 1e-13 * before:
            return values, True, iteration
    return values, False, MAX_ITERATIONS


def _damped_step(
    problem: _Problem,
    values: NDArray[np.floating],
    residual: NDArray[np.floating],
    jacobian: NDArray[np.floating],
    scale: NDArray[np.floating],
    damping: float,
) -> tuple[NDArray[np.floating] | None, NDArray[np.floating], float]:
    """A step that lowers chi-square and the damping for the next one; no step when none lowers it any more."""
    n = values.size
    for _ in range(MAX_DAMPING_STEPS):
        joint = np.vstack([jacobian, np.sqrt(damping) * np.eye(n)])
        step = np.linalg.lstsq(joint, np.concatenate([-residual, np.zeros(n)]), rcond=None)[0] / scale
        try:
            trial = problem.residual(values + step)
        except FitError:
            trial = np.full_like(residual, np.inf)
        if np.all(np.isfinite(trial)) and trial @ trial <= residual @ residual:
            return step, trial, max(damping / 10, 1e-15)
        damping *= 10
    return None, residual, damping
