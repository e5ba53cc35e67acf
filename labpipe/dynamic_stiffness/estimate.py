"""ml: the most likely parameters of a balance, their covariance and chi-square, corrected for a covariance estimated from few periods.

A covariance from nu complex degrees of freedom is complex Wishart; of p equations, 2 here, 2 V grows by nu / (nu - p), and the covariance
of the estimates is that of the information matrix times nu^2 / ((nu - p)^2 - 1) (Maiwald and Kraus 2000, IEE Proc. Radar 147:162).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.distributions import chi2_tail, f_tail
from labpipe.dynamic_stiffness.forms import StiffnessModel
from labpipe.dynamic_stiffness.likelihood import Balance, ErrorsInVariables, Whitened, real_rows
from labpipe.dynamic_stiffness.starts import starts
from labpipe.errors import FitError
from labpipe.identify.regression import triangle_of
from labpipe.optimise.levenberg import Minimum, minimise

# Changes (n, n_line, n_run, 2) [N] of e by one standard deviation of n given numbers, at the values of a model.
GivenErrors = Callable[[StiffnessModel, FloatArray, Whitened], ComplexArray]
# Equations of a line and run.
N_EQUATION = 2
# Distance to the minimum in standard errors at which a descent ends: that which counts, and those from several starts before it.
NEAR, ROUGH = 1e-4, 0.1
MOST_STEPS, FEW_STEPS = 60, 12
# Relative noise below which a covariance is rounding.
NOISE_FREE = 1e-20
# Ratio of the residual's variance to that of chi-square at least, where the covariance was estimated: runs and lines may have a common one.
LEAST_SPREAD = 1.25


@dataclass(frozen=True)
class Estimate:
    """The minimum of V: values (n_parameter,) as they are fitted, covariance of noise (n_parameter, n_parameter) [their units].

    squares: 2 V [1] corrected for estimated covariances and doubtful given numbers, chi-square with *dof* if the model is right; p_value of
    it. design: triangle (n_parameter, n_parameter) [1] of the Jacobian with columns of length 1.
    """

    model: StiffnessModel
    values: FloatArray
    covariance: FloatArray
    squares: float
    dof: int
    p_value: float
    converged: bool
    steps: int
    design: FloatArray

    @property
    def reduced(self) -> float:
        """Chi-square per degree of freedom, 1 if the model is right."""
        return self.squares / self.dof


@dataclass(frozen=True)
class Noise:
    """How far the covariance of the noise is known.

    dof: complex degrees of freedom behind it; shared, shared_power: of lines with common noise; *equations* p of a line and run.
    """

    dof: float = float("inf")
    shared: float = 1.0
    shared_power: float = 1.0
    equations: int = N_EQUATION

    @property
    def least_dof(self) -> float:
        """Degrees of freedom up to which chi-square has no variance."""
        return self.equations + 1.0

    @property
    def excess(self) -> float:
        """E[2 V] over its value for a known covariance. Equation (ds-excess)."""
        return self.dof / (self.dof - self.equations) if np.isfinite(self.dof) else 1.0

    @property
    def inflation(self) -> float:
        """Covariance of the estimates over the inverse of the information matrix. Equation (ds-inflation)."""
        if not np.isfinite(self.dof):
            return self.shared
        return self.shared * self.dof**2 / ((self.dof - self.equations) ** 2 - 1)

    @property
    def _excess_variance(self) -> float:
        """Variance of the residual's squares over chi-square's: a line's e^H S^-1 e is F with 2 p and 2 (nu - p + 1) degrees of freedom."""
        return max(self.dof / (self.dof - self.least_dof), LEAST_SPREAD) if np.isfinite(self.dof) else 1.0

    def spread(self, dof: int) -> float:
        """Standard deviation of chi-square per degree of freedom."""
        return float(np.sqrt(2 * self.shared_power * self._excess_variance / dof))

    def p_value(self, squares: float, dof: int) -> float:
        """Chance of so large a chi-square (mean *dof*); by the F distribution with its variance where the covariance was estimated.

        Equation (ds-p-value).
        """
        effective = dof / self.shared_power
        if not np.isfinite(self.dof):
            return chi2_tail(squares / self.shared_power, effective)
        spread = self._excess_variance
        second = (effective - 2 + 4 * spread) / (spread - 1)
        return f_tail(squares / dof * second / (second - 2), effective, second)


def checked(balance: Balance, noise: Noise) -> None:
    """FitError for a balance without noise, or whose covariance comes from too few periods."""
    power, variance = np.sum(np.abs(balance.motion) ** 2), np.sum(np.trace(balance.motion_covariance, axis1=-2, axis2=-1).real)
    forced, scatter = np.sum(np.abs(balance.right) ** 2), np.sum(np.trace(balance.right_covariance, axis1=-2, axis2=-1).real)
    if variance <= NOISE_FREE * power and scatter <= NOISE_FREE * forced:
        raise FitError(
            "the noise of the channels is not known, so ml cannot weigh them", hint="measure several periods or blocks, or `estimator: ls`"
        )
    if noise.dof <= noise.least_dof:
        raise FitError(
            f"the covariance of the channels was estimated from {noise.dof:.3g} degrees of freedom only",
            hint="average more periods or blocks, or let neighbouring lines share their noise",
        )


def estimate(balance: Balance, model: StiffnessModel, noise: Noise, doubtful: GivenErrors | None = None) -> Estimate:
    """The most likely parameters; FitError for fewer equations than parameters, or a singular covariance.

    *doubtful* gives the changes of e by given numbers: chi-square then is that with these numbers moved within their doubt.
    Equation (ds-explained).
    """
    n = len(model.names)
    dof = balance.n_equation - n
    if dof <= 0:
        raise FitError(f"{balance.n_equation} real equations cannot determine {n} parameters", hint="widen the band, or a smaller `form`")
    checked(balance, noise)
    problem = ErrorsInVariables(balance, model)
    best = _lowest(problem)
    squares = 2 * problem.chi2(best.values)
    jacobian = problem.columns(best.values)
    if doubtful is not None:
        squares -= _explained(problem, best.values, jacobian, doubtful, noise.excess)
    squares /= noise.excess
    design = triangle_of(jacobian)
    covariance = noise.inflation * inverse_information(jacobian)
    p_value = noise.p_value(squares, dof)
    return Estimate(model, best.values, covariance, squares, dof, p_value, best.converged, best.steps, design)


def _explained(problem: ErrorsInVariables, values: FloatArray, jacobian: FloatArray, doubtful: GivenErrors, excess: float) -> float:
    """What chi-square loses if given numbers take their most likely values, each standard deviation of theirs counting as one.

    min over d of 2 |r + U^T d|^2 / excess + d^T d, U the whitened changes of e less what the parameters can follow.
    """
    state = problem.at(values)
    errors = doubtful(problem.model, values, state)
    if not len(errors):
        return 0.0
    scale = np.linalg.norm(jacobian, axis=0)
    basis = np.linalg.qr(jacobian / np.where(scale > 0, scale, 1.0))[0]
    changes = real_rows(state.whiten(errors).reshape(len(errors), -1))
    changes = changes - (changes @ basis) @ basis.T
    along = 2 * changes @ problem.residual(values) / excess
    stiff = np.eye(len(errors)) + 2 * changes @ changes.T / excess
    return float(excess * along @ np.linalg.solve(stiff, along))


def _lowest(problem: ErrorsInVariables) -> Minimum:
    """The lowest of the descents from all starts: each until it is clear where it ends, the best one to its end."""
    begun = [start for start in starts(problem.balance, problem.model) if np.isfinite(problem.chi2(start))]
    if not begun:
        raise FitError("the covariance of the channels is singular on a line", hint="leave out lines without noise, or `estimator: ls`")
    if len(begun) > 1:
        rough = [minimise(problem, start, ROUGH, FEW_STEPS).values for start in begun]
        begun = [min(rough, key=problem.chi2)]
    return minimise(problem, begun[0], NEAR, MOST_STEPS)


def inverse_information(jacobian: FloatArray) -> FloatArray:
    """(2 J^T J)^-1 (n, n) [parameter units] of real columns (n_equation, n) of unit complex noise; pseudo-inverse of a singular one.

    Equation (ds-covariance).
    """
    scale = np.linalg.norm(jacobian, axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    columns = jacobian / scale
    inverse: FloatArray = np.linalg.pinv(2 * columns.T @ columns, hermitian=True) / np.outer(scale, scale)
    return inverse
