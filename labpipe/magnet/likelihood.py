"""Errors in variables by maximum likelihood for a balance B(p) z = 0 of any number of equations, none of the channels free of noise.

With S = B C B^H the likelihood of z over all true z with B z = 0 is, but for constants, V = sum over lines and runs of
(B z)^H S^-1 (B z) (Pintelon and Schoukens 2012, System Identification, sec. 9.10); the gradient is that of L^-1 dB/dp z^ with z^ the
channels without the noise that the residual tells.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.magnet.balance import MagnetModel
from labpipe.magnet.rotor import Levitation

REWEIGHTED = 4


@dataclass(frozen=True)
class Residual:
    """e = B z (n_line, n_run, n) [N], L L^H = S (n_line, n_run, n, n), white = L^-1 e, smoothed channels z^ (n_line, n_run, n_channel)."""

    plain: ComplexArray
    lower: ComplexArray
    white: ComplexArray
    smoothed: ComplexArray

    def whiten(self, errors: ComplexArray) -> ComplexArray:
        """L^-1 of errors (..., n_line, n_run, n) [N]."""
        return np.asarray(np.linalg.solve(self.lower, errors[..., None])[..., 0])


class MagnetLikelihood:
    """V of a magnet's model as a sum of squares."""

    def __init__(self, rotor: Levitation, model: MagnetModel) -> None:
        self.rotor, self.model = rotor, model
        self._at: tuple[bytes, Residual] | None = None

    @property
    def size(self) -> float:
        """Norm of the currents over their noise [1]: what rounding is relative to."""
        axes, n = self.rotor.axes, self.rotor.n_axis
        to_currents = self.rotor.to_axes[:n]
        noise = np.einsum("ac,lrcd,ad->lra", to_currents, self.rotor.covariance, to_currents).real
        power = np.abs(axes[..., :n]) ** 2
        return float(np.sqrt(np.sum(np.divide(power, noise, out=np.zeros_like(power), where=noise > 0))))

    def at(self, values: FloatArray) -> Residual:
        """The whitened residual at *values* (n_parameter,) [parameter units]."""
        key = values.tobytes()
        if self._at is None or self._at[0] != key:
            self._at = key, residual(self.rotor, self.model.rows(values, self.rotor.omega) @ self.rotor.to_axes)
        return self._at[1]

    def residual(self, parameters: FloatArray) -> FloatArray:
        """L^-1 e as real numbers (n_equation,) [1] at *parameters* (n_parameter,) [parameter units]."""
        return real_rows(self.at(parameters).white.reshape(1, -1))[0]

    def jacobian(self, parameters: FloatArray) -> FloatArray:
        """L^-1 dB/dp z^ as real columns (n_equation, n_parameter) [1/parameter unit]."""
        state = self.at(parameters)
        slopes = self.model.slopes(parameters, self.rotor.omega) @ self.rotor.to_axes
        changes = np.einsum("plac,lrc->plra", slopes, state.smoothed)
        return real_rows(state.whiten(changes).reshape(len(slopes), -1)).T

    def chi2(self, parameters: FloatArray) -> float:
        """V [1] at *parameters* (n_parameter,) [parameter units]; infinite where it is no number."""
        try:
            white = self.at(parameters).white
        except np.linalg.LinAlgError:
            return float("inf")
        total = float(np.sum(np.abs(white) ** 2))
        return total if np.isfinite(total) else float("inf")


def residual(rotor: Levitation, rows: ComplexArray) -> Residual:
    """The residual of B = *rows* (n_line, n, n_channel) [N per SI unit of the channel]; LinAlgError where its covariance is singular.

    Equation (mag-likelihood).
    """
    b = rows[:, None]
    e = (b @ rotor.channels[..., None])[..., 0]
    of_channels = rotor.covariance @ b.conj().swapaxes(-1, -2)
    lower = np.linalg.cholesky(b @ of_channels)
    white = np.linalg.solve(lower, e[..., None])
    weighted = np.linalg.solve(lower.conj().swapaxes(-1, -2), white)
    smoothed = rotor.channels - (of_channels @ weighted)[..., 0]
    return Residual(e, lower, white[..., 0], smoothed)


def start(problem: MagnetLikelihood) -> FloatArray:
    """Values (n_parameter,) [parameter units] to begin with: weighted least squares, repeated with the weights that it gives.

    The first weights are those of a free rotor, 1 / (sd(x) m w^2). Equal weights end in a false minimum with k_i = 0, since the noise of
    w^2 x grows with frequency. The best of all repeats counts.
    """
    rotor, model = problem.rotor, problem.model
    smooth = MagnetModel(model.names, model.places, model.mass)
    none = np.zeros(len(model.names))
    slopes = smooth.slopes(none, rotor.omega) @ rotor.to_axes
    columns = np.einsum("plac,lrc->plra", slopes, rotor.channels)
    values, starts = none, []
    for _ in range(REWEIGHTED):
        state = residual(rotor, smooth.rows(values, rotor.omega) @ rotor.to_axes)
        free = (smooth.rows(none, rotor.omega) @ rotor.to_axes)[:, None] @ rotor.channels[..., None]
        design = real_rows(state.whiten(columns).reshape(len(none), -1)).T
        side = real_rows(state.whiten(free[..., 0]).reshape(1, -1))[0]
        scale = np.linalg.norm(design, axis=0)
        scale = np.where(scale > 0, scale, 1.0)
        values = -np.linalg.lstsq(design / scale, side, rcond=None)[0] / scale
        starts.append(values)
    return min(starts, key=problem.chi2)


def unweighted(rotor: Levitation, model: MagnetModel) -> FloatArray:
    """Values (n_parameter,) [parameter units] of least squares that takes currents and displacements for free of noise."""
    smooth = MagnetModel(model.names, model.places, model.mass)
    none = np.zeros(len(model.names))
    columns = np.einsum("plac,lrc->plra", smooth.slopes(none, rotor.omega) @ rotor.to_axes, rotor.channels)
    free = (smooth.rows(none, rotor.omega) @ rotor.to_axes)[:, None] @ rotor.channels[..., None]
    design, side = real_rows(columns.reshape(len(none), -1)).T, real_rows(free[..., 0].reshape(1, -1))[0]
    scale = np.linalg.norm(design, axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    return np.asarray(-np.linalg.lstsq(design / scale, side, rcond=None)[0] / scale)


def real_rows(rows: ComplexArray) -> FloatArray:
    """Complex rows (n, m) [any unit] as real parts, then imaginary parts, (n, 2 m)."""
    return np.concatenate([rows.real, rows.imag], axis=1)
