"""Errors in variables by maximum likelihood: e = G - H(p) m with noise in the force side G and in the motion
m.

With u = [G; m] of covariance C, B = [I, -H] and S = B C B^H the likelihood of u over all true u with B u = 0
is, but for constants, V = sum of e^H S^-1 e (Pintelon and Schoukens 2012, System Identification, sec. 9.10).
2 V is chi-square with 4 E L - n degrees of freedom for E runs, L lines, n parameters. By a covariance from nu
complex degrees of freedom 2 V grows by nu / (nu - p) of p equations, and the covariance of the estimates is
that of the information matrix times nu^2 / ((nu - p)^2 - 1) (Maiwald and Kraus 2000, IEE Proc. Radar
147:162).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Generic, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.distributions import chi2_tail, f_tail
from labpipe.errors import FitError
from labpipe.estimation.descent import Minimum, SquareSum, minimise
from labpipe.estimation.regression import triangle_of
from labpipe.estimation.statistics import Pulls, Stated, pulls_of
from labpipe.methods.floating_bearing.forms import FORMS, StiffnessModel
from labpipe.records.spectra import ChannelSpectra
from labpipe.spectra.bands import lines_in


@dataclass(frozen=True)
class Balance:
    """Force side G [N] and motion m [m] of the balance G = H m, with their covariance.

    omega (n_line,) [rad/s]; right, motion (n_line, n_run, 2); right_covariance E[g g^H] [N^2], cross E[m g^H]
    [N.m], motion_covariance E[m m^H] [m^2], each (n_line, n_run, 2, 2).
    """

    omega: FloatArray
    right: ComplexArray
    motion: ComplexArray
    right_covariance: ComplexArray
    cross: ComplexArray
    motion_covariance: ComplexArray

    @property
    def n_equation(self) -> int:
        """Real equations: two complex ones for every line and run."""
        return 2 * self.right.size


@dataclass(frozen=True)
class Whitened:
    """The residual of one H: L L^H = S, the covariance of e; *white* = L^-1 e; *smoothed* motion m^, its
    noise as far as e tells it.

    white, smoothed (n_line, n_run, 2) [1, m]; l_xx, l_yx, l_yy (n_line, n_run) [N]: the elements of L.
    """

    white: ComplexArray
    smoothed: ComplexArray
    l_xx: FloatArray
    l_yx: ComplexArray
    l_yy: FloatArray

    def whiten(self, side: ComplexArray) -> ComplexArray:
        """L^-1 of forces (..., n_line, n_run, 2) [N]."""
        first = side[..., 0] / self.l_xx
        return plane_vectors(first, (side[..., 1] - self.l_yx * first) / self.l_yy)

    def weight(self) -> ComplexArray:
        """S^-1 e (n_line, n_run, 2) [1/N]."""
        second = self.white[..., 1] / self.l_yy
        return plane_vectors((self.white[..., 0] - self.l_yx.conj() * second) / self.l_xx, second)


def times(matrix: NDArray[Any], vectors: ComplexArray) -> ComplexArray:
    """Matrices (..., 2, 2) on vectors (..., 2) [any unit], the axes before them broadcast."""
    return plane_vectors(
        *(matrix[..., n, 0] * vectors[..., 0] + matrix[..., n, 1] * vectors[..., 1] for n in (0, 1))
    )


def plane_vectors(first: ComplexArray, second: ComplexArray) -> ComplexArray:
    """Vectors (..., 2) [any unit] of their components (...); np.stack takes several times as long."""
    both = np.empty((*first.shape, 2), np.complex128)
    both[..., 0], both[..., 1] = first, second
    return both


def whiten(balance: Balance, stiffness: ComplexArray) -> Whitened:
    """Residual e = G - H m, its covariance and the smoothed motion for H (n_line, 2, 2) [N/m]. Equation
    (ds-residual).
    """
    h = stiffness[:, None]
    turned = h.conj().swapaxes(-1, -2)
    of_motion = balance.cross - balance.motion_covariance @ turned
    s = balance.right_covariance - balance.cross.conj().swapaxes(-1, -2) @ turned - h @ of_motion
    l_xx = np.sqrt(s[..., 0, 0].real)
    l_yx = s[..., 1, 0] / l_xx
    l_yy = np.sqrt(s[..., 1, 1].real - np.abs(l_yx) ** 2)
    state = Whitened(balance.right - times(h, balance.motion), balance.motion, l_xx, l_yx, l_yy)
    state = replace(state, white=state.whiten(state.white))
    return replace(state, smoothed=balance.motion - times(of_motion, state.weight()))


class ErrorsInVariables(SquareSum):
    """V of a model as a sum of squares. Its Jacobian is L^-1 dB/dp u^, which gives the gradient of V exactly,
    2 Re sum (dB u^)^H S^-1 e.
    """

    def __init__(self, balance: Balance, model: StiffnessModel) -> None:
        self.balance, self.model = balance, model
        self._at: tuple[bytes, Whitened] | None = None

    def at(self, parameters: FloatArray) -> Whitened:
        """The whitened residual at *parameters* (n_parameter,) [parameter units]."""
        key = parameters.tobytes()
        if self._at is None or self._at[0] != key:
            with np.errstate(all="ignore"):
                self._at = key, whiten(self.balance, self.model.stiffness(parameters, self.balance.omega))
        return self._at[1]

    @property
    def size(self) -> float:
        """Norm of the force side [N] over that of its noise, line by line: what rounding is relative to."""
        return size_over_noise(
            np.sum(np.abs(self.balance.right) ** 2, axis=-1),
            np.trace(self.balance.right_covariance, axis1=-2, axis2=-1).real,
        )

    def residual(self, parameters: FloatArray) -> FloatArray:
        """L^-1 e as real numbers (n_equation,) [1]. Equation (ds-likelihood)."""
        return real_rows(self.at(parameters).white.reshape(1, -1))[0]

    def jacobian(self, parameters: FloatArray) -> FloatArray:
        """-L^-1 (dH/dp) m^ as real columns (n_equation, n_parameter) [1/parameter unit]. Equation
        (ds-jacobian).
        """
        state, slopes = self.at(parameters), self.model.jacobian(parameters, self.balance.omega)
        moved = state.whiten(times(slopes[:, :, None], state.smoothed))
        return real_rows(-moved.reshape(len(slopes), -1)).T


def size_over_noise(power: FloatArray, variance: FloatArray) -> float:
    """Norm [1] of a *power* over its *variance*, (n_line, ...) each [any unit], as far as there is any."""
    ratio = np.divide(power, variance, out=np.zeros_like(power), where=variance > 0)
    return float(np.sqrt(np.sum(ratio)))


def real_rows(rows: ComplexArray) -> FloatArray:
    """Complex rows (n, m) [any unit] as real parts, then imaginary parts, (n, 2 m)."""
    return np.concatenate([rows.real, rows.imag], axis=1)


# Descents from the best places of a grid of shape parameters.
MOST_DESCENTS = 3
REWEIGHTED = 2
# Added to the unit diagonal of scaled normal equations, for forms that hold another one within themselves.
RIDGE = 1e-10


def starts(balance: Balance, model: StiffnessModel) -> list[FloatArray]:
    """Values (n_parameter,) [parameter units] to begin with, the most promising first."""
    weights = _weights(balance, model.symmetry)
    grid = model.form.starts(balance.omega)
    linear, misfit = solve(balance, model, grid, weights)
    order = np.argsort(misfit)[:MOST_DESCENTS]
    return [np.concatenate([linear[number], grid[number]]) for number in order]


def _weights(balance: Balance, symmetry: str) -> Whitened:
    """Weights by the balance's noise: all lines alike, then twice with the K, C and M that result."""
    model = StiffnessModel(FORMS["kcm"], symmetry)
    ones = np.ones(balance.right.shape[:2])
    weights = Whitened(balance.right, balance.motion, ones, np.zeros_like(ones, np.complex128), ones)
    for _ in range(REWEIGHTED):
        values = solve(balance, model, np.empty((1, 0)), weights)[0][0]
        weights = whiten(balance, model.stiffness(values, balance.omega))
    return weights


def solve(
    balance: Balance, model: StiffnessModel, grid: FloatArray, weights: Whitened
) -> tuple[FloatArray, FloatArray]:
    """The matrices' elements (n_start, n_linear) [their units] of least squares with fixed weights, and what
    they leave (n_start,) [1]. grid (n_start, n_shape) of shape parameters.
    """
    moved = weights.whiten(times(model.elements[:, None, None], balance.motion))
    side = weights.whiten(balance.right)
    n_element, n_line = moved.shape[:2]
    rows = moved.transpose(1, 0, 2, 3).reshape(n_line, n_element, -1)
    # (n_line, n_element, n_element) and (n_line, n_element): sums over runs and components.
    products = (rows.conj() @ rows.swapaxes(-1, -2)).reshape(n_line, -1)
    forced = np.einsum("lcr,lr->lc", rows.conj(), side.reshape(n_line, -1))
    basis = np.stack([model.form.basis(theta, balance.omega) for theta in grid])
    n_start, n_matrix = basis.shape[:2]
    pairs = (basis.conj()[:, :, None] * basis[:, None]).reshape(-1, n_line)
    normal = (pairs @ products).real.reshape(n_start, n_matrix, n_matrix, n_element, n_element)
    normal = normal.transpose(0, 1, 3, 2, 4).reshape(n_start, model.n_linear, model.n_linear)
    right = (basis.conj() @ forced).real.reshape(n_start, model.n_linear)
    scale = np.sqrt(np.maximum(np.diagonal(normal, axis1=1, axis2=2), np.finfo(float).tiny))
    scaled = normal / (scale[:, :, None] * scale[:, None]) + RIDGE * np.eye(model.n_linear)
    linear = np.linalg.solve(scaled, (right / scale)[..., None])[..., 0] / scale
    return linear, float(np.sum(np.abs(side) ** 2)) - np.sum(right * linear, axis=1)


# Changes (n, n_line, n_run, 2) [N] of e by one standard deviation of n given numbers, at the values of a
# model.
GivenErrors = Callable[[StiffnessModel, FloatArray, Whitened], ComplexArray]
N_EQUATION = 2
Model = TypeVar("Model")
# Distance to the minimum in standard errors at which a descent ends: that which counts, and those from
# several starts before it.
NEAR, ROUGH = 1e-4, 0.1
MOST_STEPS, FEW_STEPS = 60, 12
# Relative noise below which a covariance is rounding.
NOISE_FREE = 1e-20
# Ratio of the residual's variance to that of chi-square at least, where the covariance was estimated: runs
# and lines may have a common one.
LEAST_SPREAD = 1.25


@dataclass(frozen=True)
class BalanceEstimate(Generic[Model]):
    """The minimum of V: values (n_parameter,) as they are fitted, covariance of noise (n_parameter,
    n_parameter) [their units]. squares: 2 V [1] corrected for estimated covariances and uncertain given
    numbers, chi-square with *dof* if the model is right; p_value of it. design: triangle (n_parameter,
    n_parameter) [1] of the Jacobian with columns of length 1.
    """

    model: Model
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
class Optimum(BalanceEstimate[StiffnessModel]):
    """The minimum of V of a dynamic stiffness; pulls: what the data say of given numbers."""

    pulls: Pulls | None = None


@dataclass(frozen=True)
class Noise:
    """How far the covariance of the noise is known. dof: complex degrees of freedom behind it; shared,
    shared_power: of lines with common noise; *equations* p of a line and run.
    """

    dof: float = float("inf")
    shared: float = 1.0
    shared_power: float = 1.0
    equations: int = N_EQUATION

    @property
    def least_dof(self) -> float:
        """Degrees of freedom up to which chi-square has no variance."""
        return self.equations + 1.0

    def check_dof(self) -> None:
        """FitError for a covariance from too few periods."""
        if self.dof <= self.least_dof:
            raise FitError(
                f"the covariance of the channels was estimated from {self.dof:.3g} degrees of freedom only",
                hint="average more periods or blocks, or let neighbouring lines share their noise",
            )

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
        """Of the squares over chi-square's: each is F with 2 p and 2 (nu - p + 1) degrees."""
        return max(self.dof / (self.dof - self.least_dof), LEAST_SPREAD) if np.isfinite(self.dof) else 1.0

    @property
    def loss(self) -> float:
        """Standard errors over those with a known covariance [1]."""
        if not np.isfinite(self.dof):
            return 1.0
        return float(np.sqrt(self.inflation / self.shared * (self.dof - self.equations) / self.dof))

    def spread(self, dof: int) -> float:
        """Standard deviation of chi-square per degree of freedom."""
        return float(np.sqrt(2 * self.shared_power * self._excess_variance / dof))

    def p_value(self, squares: float, dof: int) -> float:
        """Chance of so large a chi-square (mean *dof*); by the F distribution with its variance where the
        covariance was estimated. Equation (ds-p-value).
        """
        effective = dof / self.shared_power
        if not np.isfinite(self.dof):
            return chi2_tail(squares / self.shared_power, effective)
        spread = self._excess_variance
        second = (effective - 2 + 4 * spread) / (spread - 1)
        return f_tail(squares / dof * second / (second - 2), effective, second)


# The fewest lines of a balance.
LEAST_LINES = 3


@dataclass(frozen=True)
class BalanceLines:
    """Spectra of a balance on the lines of a fit.

    omega (n_line,) [rad/s]; channels (n_line, n_run, n_channel) and their covariance (n_line, n_run,
    n_channel, n_channel): all that was measured [SI units]; to_axes (n_axis, n_channel) [1]: what is balanced
    is to_axes @ channels.
    """

    omega: FloatArray
    channels: ComplexArray
    covariance: ComplexArray
    to_axes: FloatArray
    spectra: ChannelSpectra
    noise: Noise

    @classmethod
    def of(
        cls,
        spectra: ChannelSpectra,
        band: tuple[float, float] | None,
        to_axes: FloatArray,
        equations: int,
        cure: str = "",
        **more: Any,
    ) -> Self:
        """The lines in a band [Hz], to_axes (n_axis, n_channel) [1]; FitError for too few, with a *cure*."""
        lines = np.ones(spectra.frequency.size, bool) if band is None else lines_in(spectra.frequency, band)
        n_line = int(np.count_nonzero(lines))
        if n_line < LEAST_LINES:
            hint = f"{LEAST_LINES} or more: widen `band`{cure}"
            raise FitError(f"{n_line} lines in the band", hint=hint)
        noise = Noise(spectra.covariance_dof, *shared_noise(spectra, n_line), equations)
        omega = 2 * np.pi * spectra.frequency[lines]
        if omega[0] == 0:
            raise FitError("nothing moves at 0 Hz", hint="begin `band` above it")
        return cls(omega, spectra.vectors[lines], spectra.covariance[lines], to_axes, spectra, noise, **more)

    @property
    def axes(self) -> ComplexArray:
        """(n_line, n_run, n_axis) [SI units]: what is balanced."""
        return self.channels @ self.to_axes.T


def shared_noise(spectra: ChannelSpectra, n: int) -> tuple[float, float]:
    """1 + 2 sum Re c_d and 1 + 2 sum |c_d|^2 of the correlation c of lines that lie side by side, among *n*:
    factors of the noise that they share on the variance of a sum over lines, and on that of a sum of powers.
    """
    correlation = np.array(spectra.line_correlation, np.complex128)
    pairs = np.maximum(n - np.arange(1, correlation.size + 1), 0) / n
    shared = max(1 + 2 * float(np.sum(pairs * correlation.real)), 1.0)
    return shared, 1 + 2 * float(np.sum(pairs * np.abs(correlation) ** 2))


def check(sides: Sequence[tuple[ComplexArray, ComplexArray]], noise: Noise, otherwise: str) -> None:
    """FitError for *sides* of a balance (n_line, n_run, n) without noise by their covariances (n_line, n_run,
    n, n) [any unit], or where these come from too few periods.
    """
    if all(
        np.sum(np.trace(covariance, axis1=-2, axis2=-1).real) <= NOISE_FREE * np.sum(np.abs(side) ** 2)
        for side, covariance in sides
    ):
        hint = f"measure several periods or blocks{otherwise}"
        raise FitError("the noise of the channels is not known, so ml cannot weigh them", hint=hint)
    noise.check_dof()


def estimate(
    balance: Balance, model: StiffnessModel, noise: Noise, uncertain: GivenErrors | None = None
) -> Optimum:
    """The most likely parameters; FitError for fewer equations than parameters, or a singular covariance.

    *uncertain* gives the changes of e by given numbers: chi-square then is that with these numbers moved
    within their uncertainty. Equation (ds-explained).
    """
    n = len(model.names)
    dof = balance.n_equation - n
    if dof <= 0:
        hint = "widen the band, or a smaller `form`"
        raise FitError(f"{balance.n_equation} real equations cannot determine {n} parameters", hint=hint)
    sides = ((balance.motion, balance.motion_covariance), (balance.right, balance.right_covariance))
    check(sides, noise, ", or `estimator: ls`")
    problem = ErrorsInVariables(balance, model)
    begun = [start for start in starts(problem.balance, problem.model) if np.isfinite(problem.chi2(start))]
    if not begun:
        hint = "leave out lines without noise, or `estimator: ls`"
        raise FitError("the covariance of the channels is singular on a line", hint=hint)
    if len(begun) > 1:
        rough = [minimise(problem, start, ROUGH, FEW_STEPS).values for start in begun]
        begun = [min(rough, key=problem.chi2)]
    best = minimise(problem, begun[0], NEAR, MOST_STEPS)
    state, changes = problem.at(best.values), None
    if uncertain is not None:
        changes = state.whiten(uncertain(model, best.values, state))
    minimum, pulls = minimum_of(problem, best, noise, dof, changes)
    return Optimum(model, *minimum, pulls)


def minimum_of(
    problem: Any, best: Minimum, noise: Noise, dof: int, changes: ComplexArray | None
) -> tuple[tuple[FloatArray, FloatArray, float, int, float, bool, int, FloatArray], Pulls | None]:
    """Values (n,) [parameter units] to design of a BalanceEstimate at the minimum of a problem of unit noise,
    and what it says of given numbers by which the residual *changes* (n, ...) [1].
    """
    jacobian, squares, pulls = problem.jacobian(best.values), 2 * problem.chi2(best.values), None
    if changes is not None and len(changes):
        rows = real_rows(changes.reshape(len(changes), -1))
        pulls = stated_pulls(rows, problem.residual(best.values), jacobian, noise)
        squares -= pulls.explained
    squares /= noise.excess
    covariance = noise.inflation * inverse_information(jacobian)
    p_value, design = noise.p_value(squares, dof), triangle_of(jacobian)
    return (best.values, covariance, squares, dof, p_value, best.converged, best.steps, design), pulls


def stated_pulls(changes: FloatArray, residual: FloatArray, jacobian: FloatArray, noise: Noise) -> Pulls:
    """What a residual (n_equation,) [1] of unit complex noise says of given numbers, each 0 +- 1 standard
    deviation of its own, by which it has *changes* (n, n_equation) [1]; *jacobian* (n_equation, n_parameter).

    Chi-square loses what their most likely values explain by noise of the *excess* alone; the numbers that
    data ask for have the errors of estimates.
    """
    stated = Stated.of(np.sqrt(2) * changes)
    residual, slopes = np.sqrt(2) * residual, np.sqrt(2) * jacobian
    inverse = inverse_information(jacobian)
    # The columns are not the whole derivative of e^H S^-1 e, whose minimum leaves a part along them.
    residual = residual - slopes @ (inverse @ (slopes.T @ residual))
    by_noise, by_estimate = (
        pulls_of(residual, stated, slopes, inverse, variance) for variance in (noise.excess, noise.inflation)
    )
    return replace(by_estimate, explained=by_noise.explained)


def unit_columns(columns: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Columns (n_equation, n) [any unit] of length 1, and their lengths (n,), 1 of those of zero."""
    scale = np.linalg.norm(columns, axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    return columns / scale, scale


def inverse_information(jacobian: FloatArray) -> FloatArray:
    """(2 J^T J)^-1 (n, n) [parameter units] of real columns (n_equation, n) of unit complex noise;
    pseudo-inverse of a singular one. Equation (ds-covariance).
    """
    columns, scale = unit_columns(jacobian)
    return np.linalg.pinv(2 * columns.T @ columns, hermitian=True) / np.outer(scale, scale)
