"""The most likely K_i and K_s by errors in variables, what noise leaves of them, and what uncertainties of
given numbers do.

With S = B C B^H it is that of a floating bearing (`floating_bearing.likelihood`), V = sum of (B z)^H S^-1 (B
z); its gradient is that of L^-1 dB/dp z^ with z^ the channels without the noise that the residual tells.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from operator import itemgetter

import numpy as np

from labpipe.arrays import BoolArray, ComplexArray, FloatArray
from labpipe.errors import FitError
from labpipe.estimation.causes import BY_DELAY, LIKELIEST, delay_finding, delays_of_grid, is_late
from labpipe.estimation.descent import SquareSum, minimise
from labpipe.estimation.diagnostics import MISMATCH_P
from labpipe.methods.floating_bearing import likelihood
from labpipe.methods.floating_bearing.settings import factor_errors, given_uncertainties, join, response_of
from labpipe.methods.magnetic_bearing.balance import LevitationBalance, MagnetModel
from labpipe.records.finding import Finding
from labpipe.records.fit_details import GivenUncertainty
from labpipe.records.uncertain import Uncertainty

REWEIGHTED = 4


@dataclass(frozen=True)
class Residual:
    """L L^H = S (n_line, n_run, n, n), white = L^-1 e of e = B z (n_line, n_run, n) [N], smoothed channels z^
    (n_line, n_run, n_channel).
    """

    lower: ComplexArray
    white: ComplexArray
    smoothed: ComplexArray

    def whiten(self, errors: ComplexArray) -> ComplexArray:
        """L^-1 of errors (..., n_line, n_run, n) [N]."""
        return np.linalg.solve(self.lower, errors[..., None])[..., 0]


class MagnetLikelihood(SquareSum):
    """V of a magnet's model as a sum of squares."""

    def __init__(self, rotor: LevitationBalance, model: MagnetModel) -> None:
        self.rotor, self.model = rotor, model
        self._at: tuple[bytes, Residual] | None = None

    @property
    def size(self) -> float:
        """Norm of the currents over their noise [1]: what rounding is relative to."""
        axes, n = self.rotor.axes, self.rotor.n_axis
        to_currents = self.rotor.to_axes[:n]
        noise = np.einsum("ac,lrcd,ad->lra", to_currents, self.rotor.covariance, to_currents).real
        return likelihood.size_over_noise(np.abs(axes[..., :n]) ** 2, noise)

    def at(self, values: FloatArray) -> Residual:
        """The whitened residual at *values* (n_parameter,) [parameter units]."""
        key = values.tobytes()
        if self._at is None or self._at[0] != key:
            self._at = key, residual(self.rotor, self.rows(values))
        return self._at[1]

    def rows(self, values: FloatArray) -> ComplexArray:
        """B by channels (n_line, n, n_channel) [N per SI unit of the channel] at *values* (n_parameter,)
        [parameter units].
        """
        return self.model.rows(values, self.rotor.omega) @ self.rotor.to_axes

    def slopes(self, values: FloatArray) -> ComplexArray:
        """dB/dp by channels (n_parameter, n_line, n, n_channel) [N per SI units of channel and parameter]."""
        return self.model.slopes(values, self.rotor.omega) @ self.rotor.to_axes

    def residual(self, parameters: FloatArray) -> FloatArray:
        """L^-1 e as real numbers (n_equation,) [1] at *parameters* (n_parameter,) [parameter units]."""
        return likelihood.real_rows(self.at(parameters).white.reshape(1, -1))[0]

    def jacobian(self, parameters: FloatArray) -> FloatArray:
        """L^-1 dB/dp z^ as real columns (n_equation, n_parameter) [1/parameter unit]."""
        state = self.at(parameters)
        slopes = self.slopes(parameters)
        return likelihood.real_rows(
            state.whiten(np.einsum("plac,lrc->plra", slopes, state.smoothed)).reshape(len(slopes), -1)
        ).T


def residual(rotor: LevitationBalance, rows: ComplexArray) -> Residual:
    """The residual of B = *rows* (n_line, n, n_channel) [N per SI unit of the channel]; LinAlgError where its
    covariance is singular. Equation (mag-likelihood).
    """
    b = rows[:, None]
    e = (b @ rotor.channels[..., None])[..., 0]
    of_channels = rotor.covariance @ b.conj().swapaxes(-1, -2)
    lower = np.linalg.cholesky(b @ of_channels)
    white = np.linalg.solve(lower, e[..., None])
    weighted = np.linalg.solve(lower.conj().swapaxes(-1, -2), white)
    return Residual(lower, white[..., 0], rotor.channels - (of_channels @ weighted)[..., 0])


def start(problem: MagnetLikelihood) -> FloatArray:
    """Values (n_parameter,) [parameter units] to begin with: weighted least squares, repeated with the
    weights that it gives. The first weights are those of a free rotor, 1 / (sd(x) m w^2). Equal weights end
    in a false minimum with k_i = 0, since the noise of w^2 x grows with frequency.
    """
    rotor = problem.rotor
    smooth, columns, free = _linear(rotor, problem.model)
    values: FloatArray = np.zeros(len(columns))
    starts = []
    for _ in range(REWEIGHTED):
        state = residual(rotor, smooth.rows(values, rotor.omega) @ rotor.to_axes)
        values = _least_squares(state.whiten(columns), state.whiten(free))
        starts.append(values)
    return min(starts, key=problem.chi2)


def _linear(rotor: LevitationBalance, model: MagnetModel) -> tuple[MagnetModel, ComplexArray, ComplexArray]:
    """The model of smooth currents, its forces by parameter (n, n_line, n_run, n_axis), the free rotor's."""
    smooth = MagnetModel(model.names, model.places, model.mass)
    none = np.zeros(len(model.names))
    slopes = smooth.slopes(none, rotor.omega) @ rotor.to_axes
    free = (smooth.rows(none, rotor.omega) @ rotor.to_axes)[:, None] @ rotor.channels[..., None]
    return smooth, np.einsum("plac,lrc->plra", slopes, rotor.channels), free[..., 0]


def unweighted_values(rotor: LevitationBalance, model: MagnetModel) -> FloatArray:
    """Values (n_parameter,) [parameter units] of least squares that takes all channels for free of noise."""
    return _least_squares(*_linear(rotor, model)[1:])


def _least_squares(columns: ComplexArray, side: ComplexArray) -> FloatArray:
    design = likelihood.real_rows(columns.reshape(len(columns), -1)).T
    scale = np.linalg.norm(design, axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    right = likelihood.real_rows(side.reshape(1, -1))[0]
    return -np.linalg.lstsq(design / scale, right, rcond=None)[0] / scale


NEAR, MOST_STEPS = 1e-4, 60


@dataclass(frozen=True)
class MagnetEstimate(likelihood.BalanceEstimate[MagnetModel]):
    """The minimum of V of magnets; uncertainties: what given numbers do, amplification (n_parameter,) [units
    of the parameters]: of errors of the channels.
    """

    uncertainties: tuple[GivenUncertainty, ...]
    amplification: FloatArray


def magnet_estimate(
    rotor: LevitationBalance, model: MagnetModel, given: Sequence[tuple[Uncertainty, FloatArray]] = ()
) -> MagnetEstimate:
    """The most likely parameters; *given*: uncertainties of the mass matrix with its change (n, n) [kg] by
    one standard deviation.

    FitError for too few lines, a covariance from too few periods, channels without noise.
    """
    noise, n = rotor.noise, len(model.names)
    n_equation = 2 * rotor.omega.size * rotor.channels.shape[1] * rotor.n_axis
    if n_equation <= n:
        hint = "widen the band, or `coupling: direct`"
        raise FitError(f"{n_equation} real equations cannot determine {n} parameters", hint=hint)
    likelihood.check([(rotor.channels, rotor.covariance)], noise, "")
    problem = MagnetLikelihood(rotor, model)
    try:
        best = minimise(problem, start(problem), NEAR, MOST_STEPS)
    except np.linalg.LinAlgError:
        hint = "leave out lines without noise"
        raise FitError("the covariance of the channels is singular on a line", hint=hint) from None
    state, errors = problem.at(best.values), changes_by_given(problem, best.values, given)
    changes = state.whiten(np.stack([error for _, error in errors])) if errors else None
    minimum, _ = likelihood.minimum_of(problem, best, noise, n_equation - n, changes)
    respond = response_of(state.whiten, problem.jacobian(best.values))
    uncertainties = given_uncertainties([(number, error[None]) for number, error in errors], respond)
    amplification = problem.size * np.sqrt(2 * np.diag(minimum[1]) / noise.inflation)
    return MagnetEstimate(model, *minimum, uncertainties, amplification)


def changes_by_given(
    problem: MagnetLikelihood, values: FloatArray, given: Sequence[tuple[Uncertainty, FloatArray]]
) -> list[tuple[Uncertainty, ComplexArray]]:
    """Changes (n_line, n_run, n) [N] of the residual by one standard deviation of each source."""
    rotor, model = problem.rotor, problem.model
    smoothed = problem.at(values).smoothed
    axes = smoothed @ rotor.to_axes.T
    rows = model.rows(values, rotor.omega)
    errors = []
    for number, change in given:
        changed = model.rows(values, rotor.omega, model.mass + change) - rows
        errors.append((number, (changed[:, None] @ axes[..., None])[..., 0]))
    return join([*errors, *factor_errors(rotor.spectra, rotor.omega, rows @ rotor.to_axes, smoothed)])


class LateLikelihood(MagnetLikelihood):
    """V where the channels of *late* (n_channel,) were recorded tau [s] after the others, the last of the
    parameters: their spectra count as z exp(j w tau).
    """

    def __init__(self, rotor: LevitationBalance, model: MagnetModel, late: BoolArray) -> None:
        super().__init__(rotor, model)
        self._late = late

    def rows(self, values: FloatArray) -> ComplexArray:
        """B by channels (n_line, n, n_channel) [N per SI unit of the channel] at values (n_parameter + 1,)
        [parameter units, s]. Equation (mag-late).
        """
        return super().rows(values[:-1]) * self._turn(values[-1])

    def slopes(self, values: FloatArray) -> ComplexArray:
        """dB/dp by channels (n_parameter + 1, n_line, n, n_channel) [N per SI units of channel and
        parameter], the last by tau.
        """
        turned = np.where(self._late, 1j * self.rotor.omega[:, None, None], 0.0) * self.rows(values)
        return np.concatenate([super().slopes(values[:-1]) * self._turn(values[-1]), turned[None]])

    def _turn(self, delay: float) -> ComplexArray:
        return np.where(self._late, np.exp(1j * self.rotor.omega[:, None, None] * delay), 1.0)

    def best_of_grid(self, values: FloatArray) -> tuple[float, FloatArray]:
        """The least V of a grid of delays and its parameters (n_parameter + 1,): the others follow by least
        squares from *values* (n_parameter,) [parameter units], whose weights are kept.
        """
        lower = self.at(np.append(values, 0.0)).lower
        plain = super().rows(values)
        columns = np.concatenate([super().slopes(values), plain[None]])
        best = np.inf, np.append(values, 0.0)
        for delay in delays_of_grid(float(self.rotor.omega[-1])):
            turned = self.rotor.channels * np.exp(1j * self.rotor.omega[:, None, None] * delay * self._late)
            forces = np.einsum("plac,lrc->plra", columns, turned)
            white = np.linalg.solve(lower, forces[..., None])[..., 0].reshape(len(columns), -1)
            step = _least_squares(white[:-1], white[-1])
            left = float(np.sum(np.abs(white[-1] + step @ white[:-1]) ** 2))
            if left < best[0]:
                best = left, np.append(values + step, delay)
        return best


def late_findings(rotor: LevitationBalance, best: MagnetEstimate) -> list[Finding]:
    """A finding where one channel, or all readings, recorded later or earlier explain a residual that is far
    from noise. Each delay is fitted beside all parameters, from the best of a grid; as `likeliest_delay`.
    """
    if best.p_value >= MISMATCH_P:
        return []
    tried = [(LateLikelihood(rotor, best.model, late), name) for name, late in _may_be_late(rotor)]
    try:
        grids = [(*problem.best_of_grid(best.values), problem, name) for problem, name in tried]
    except np.linalg.LinAlgError:
        return []
    grids.sort(key=itemgetter(0))
    fitted = (_late(problem, start_at, best, name) for _, start_at, problem, name in grids[:LIKELIEST])
    explained = sorted(filter(None, fitted), key=itemgetter(0))
    return [finding for _, finding in explained[:1]]


def _may_be_late(rotor: LevitationBalance) -> list[tuple[str, BoolArray]]:
    """Name and channels (n_channel,) of what may be late; of one axis its reading only."""
    n, used = rotor.n_axis, np.any(rotor.to_axes != 0, axis=0)
    readings = np.any(rotor.to_axes[n:] != 0, axis=0)
    channels = rotor.spectra.channels
    if n == 1:
        return [(f"{channels[int(np.argmax(readings))].name} against {rotor.currents[0].name}", readings)]
    single = [(channels[k].name, np.arange(used.size) == k) for k in np.flatnonzero(used)]
    return [("every reading against the currents", readings), *single]


def _late(
    problem: LateLikelihood, start_at: FloatArray, best: MagnetEstimate, name: str
) -> tuple[float, Finding] | None:
    """Chi-square with the delay, and the finding; None where it explains too little."""
    model, noise = problem.model, problem.rotor.noise
    try:
        minimum = minimise(problem, start_at, NEAR, MOST_STEPS)
        covariance = noise.inflation * likelihood.inverse_information(problem.jacobian(minimum.values))
    except (FitError, np.linalg.LinAlgError):
        return None
    before, after = (
        2 * problem.chi2(values) / noise.excess / best.dof
        for values in (np.append(best.values, 0.0), minimum.values)
    )
    errors = np.sqrt(np.diag(covariance) * max(after, 1.0))
    delay, error = float(minimum.values[-1]), float(errors[-1])
    if not is_late(delay, error, float(problem.rotor.omega[-1])) or after - 1 > (1 - BY_DELAY) * (before - 1):
        return None
    cure = "" if model.between else ". A current that is held acts half a sample late: `hold`"
    of_fit = zip(model.names, model.units, minimum.values, errors, strict=False)
    return after, delay_finding(name, (delay, error), (before, after), of_fit, cure)
