"""amplitude: one degree of freedom from the amplitudes of the FRF alone, where the phase is unreliable."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.errors import ConfigError, FitError
from labpipe.estimation.descent import SquareSum, minimise
from labpipe.estimation.measured import Measured
from labpipe.estimation.model import DynamicModel
from labpipe.estimation.regression import solve_scaled, triangle_of
from labpipe.estimation.statistics import Estimate
from labpipe.estimation.weights import has_noise, weight_uncertainty
from labpipe.records.identification import Goodness

NOTE = "amplitude: the phase of the FRF was not used; k, c and m are positive by construction."
NO_DAMPING = "the amplitudes fit no real damping: c^2 came out negative"


@dataclass(frozen=True)
class _Amplitudes(SquareSum):
    """|H| (n_line,) [m/N] with its standard deviation (n_line,), None for an unknown noise."""

    measured: Measured
    model: DynamicModel
    amplitude: FloatArray
    std: FloatArray | None

    @property
    def size(self) -> float:
        return float(np.linalg.norm(self.scale(self.amplitude)))

    def residual(self, parameters: FloatArray) -> FloatArray:
        fitted = np.abs(self.model.receptance(parameters, self.measured.omega)).reshape(-1)
        return self.scale(self.amplitude - fitted)

    def jacobian(self, parameters: FloatArray) -> FloatArray:
        """d|H| = Re(H^* dH) / |H|."""
        h = self.model.receptance(parameters, self.measured.omega).reshape(-1)
        slopes = self.model.jacobian(parameters, self.measured.omega).reshape(len(self.model.terms), -1)
        return -self.scale((h.conj() * slopes).real / np.abs(h)).T

    def scale(self, values: FloatArray) -> FloatArray:
        return values / (self.std if self.std is not None else float(np.max(self.amplitude)))


def amplitude_fit(measured: Measured, model: DynamicModel, weight: str) -> Estimate:
    """|H|^2 [(w_0^2 - w^2)^2 + (c w / m)^2] = 1 / m^2, linear in (w_0^4, c^2 / m^2 - 2 w_0^2, 1 / m^2)
    (Knaapen 1997, sec. 4.2).

    weight none: linear least squares of the equation times |H|, as in the source; noise: amplitudes weighted
    by their noise, started from the former. FitError where the amplitudes correspond to no real stiffness or
    damping. Equation (est-amplitude).
    """
    if model.names not in (("k", "c"), ("k", "c", "m")):
        what = "the amplitude fit estimates k and c, or k, c and m"
        raise ConfigError(what, hint="leave `fixed` and `eliminate` out")
    amplitude = np.abs(measured.matrix).reshape(-1)
    dof = amplitude.size - len(model.terms)
    if dof <= 0:
        what = f"{amplitude.size} amplitudes cannot determine {len(model.terms)} parameters"
        raise FitError(what, hint="widen the band")
    # Standard deviation of |H| [m/N]: half of the variance of H is along H.
    std = None
    if measured.covariance is not None and has_noise(measured):
        variance = measured.covariance.reshape(-1).real
        std = np.sqrt(variance / 2) if np.all(variance > 0) else None
    if weight == "noise" and std is None:
        what = "the noise of the FRF is not known, so lines cannot weigh by it"
        raise FitError(what, hint="leave `weight` out")
    problem = _Amplitudes(measured, model, amplitude, std)
    values, covariance = _linear(problem)
    converged, steps = True, 0
    if weight == "noise":
        minimum = minimise(problem, values)
        values, converged, steps = minimum.values, minimum.converged, minimum.steps
        covariance = solve_scaled(problem.jacobian(values), problem.residual(values))[1]
    return Estimate(
        values=values,
        covariance=measured.shared_noise * covariance,
        scaled_design=triangle_of(problem.jacobian(values)),
        gof=_goodness(problem, values, dof),
        dof=dof,
        converged=converged,
        iterations=steps,
        notes=(NOTE,),
    )


def _linear(problem: _Amplitudes) -> tuple[FloatArray, FloatArray]:
    """(k, c[, m]) and their covariance from A^3 x_1 + A^3 w^2 x_2 - A x_3 = -A^3 w^4, x_3 = 1 / m^2."""
    a, w = problem.amplitude, problem.measured.omega
    # Amplitude and frequency near 1: fourth powers span too many digits otherwise.
    a_unit, w_unit = float(np.max(a)), float(np.max(w))
    a, w = a / a_unit, w / w_unit
    columns, side = np.column_stack([a**3, a**3 * w**2, -a]), -(a**3) * w**4
    mass = float(problem.model.constant.mass[0, 0])
    if "m" not in problem.model.names:
        if mass == 0:
            raise FitError("the amplitude fit needs a mass above zero", hint="give the mass, or `estimate`")
        side, columns = side - columns[:, 2] / (mass * a_unit * w_unit**2) ** 2, columns[:, :2]
    x, inverse = solve_scaled(columns, side)
    residual = side - columns @ x
    x3 = x[2] if x.size == 3 else 1 / (mass * a_unit * w_unit**2) ** 2
    spread = np.full(a.size, residual @ residual / (a.size - x.size))
    if problem.std is not None:
        # d(A^3 D^2 - A P^2) = 2 P^2 dA where A^2 D^2 = P^2.
        spread = 4 * x3**2 * (problem.std / a_unit) ** 2
    covariance = inverse @ (columns.T * spread) @ columns @ inverse
    values, slopes = _physical(np.array([x[0], x[1], x3]), x.size)
    units = np.array([1 / a_unit, 1 / (a_unit * w_unit), 1 / (a_unit * w_unit**2)])[: x.size]
    return values * units, (slopes @ covariance @ slopes.T) * np.outer(units, units)


def _physical(x: FloatArray, n: int) -> tuple[FloatArray, FloatArray]:
    """k = sqrt(x_1 / x_3), c = sqrt((x_2 + 2 sqrt(x_1)) / x_3), m = 1 / sqrt(x_3), their slopes (n, n)."""
    if x[0] <= 0 or x[2] <= 0:
        hint = "widen the band to both sides of the resonance"
        raise FitError("the amplitudes fit no real stiffness and mass", hint=hint)
    damping_square = x[1] + 2 * np.sqrt(x[0])
    if damping_square <= 0:
        raise FitError(NO_DAMPING, hint="lines nearer to the resonance, or the estimator ml")
    k, c, m = np.sqrt(x[0] / x[2]), np.sqrt(damping_square / x[2]), 1 / np.sqrt(x[2])
    slopes = np.array(
        [
            [k / (2 * x[0]), 0.0, -k / (2 * x[2])],
            [c / (2 * damping_square) / np.sqrt(x[0]), c / (2 * damping_square), -c / (2 * x[2])],
            [0.0, 0.0, -m / (2 * x[2])],
        ]
    )
    return np.array([k, c, m])[:n], slopes[:n, :n]


def _goodness(problem: _Amplitudes, values: FloatArray, dof: int) -> Goodness:
    residual, amplitude = problem.residual(values), problem.amplitude
    scaled = problem.scale(amplitude)
    total = float(np.sum((scaled - scaled.mean()) ** 2))
    r2 = 1 - float(residual @ residual) / total if total > 0 else 0.0
    adjusted = 1 - (1 - r2) * (amplitude.size - 1) / dof
    if problem.std is None:
        return Goodness(r2, adjusted)
    uncertainty = weight_uncertainty(problem.measured, dof)
    reduced = float(residual @ residual) / dof / uncertainty.excess
    return Goodness(r2, adjusted, reduced, uncertainty.p_value(reduced, dof))
