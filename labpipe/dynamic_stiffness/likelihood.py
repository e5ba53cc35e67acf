"""Errors in variables by maximum likelihood: e = G - H(p) m with noise in the force side G and in the motion m.

With u = [G; m] of covariance C, B = [I, -H] and S = B C B^H the likelihood of u over all true u with B u = 0 is, but for constants,
V = sum over lines and runs of e^H S^-1 e (Pintelon and Schoukens 2012, System Identification, sec. 9.10). No run is inverted, so that one
run with one vector per line is as good as two. 2 V is chi-square with 4 E L - n degrees of freedom for E runs, L lines, n parameters.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.dynamic_stiffness.forms import StiffnessModel


@dataclass(frozen=True)
class Balance:
    """Force side G [N] and motion m [m] of the balance G = H m, with their covariance.

    omega (n_line,) [rad/s]; right, motion (n_line, n_run, 2); right_covariance E[g g^H] [N^2], cross E[m g^H] [N.m], motion_covariance
    E[m m^H] [m^2], each (n_line, n_run, 2, 2).
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
    """The residual of one H: L L^H = S, the covariance of e; *white* = L^-1 e; *smoothed* motion m^, its noise as far as e tells it.

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
        return np.stack([first, (side[..., 1] - self.l_yx * first) / self.l_yy], axis=-1)

    def weighted(self) -> ComplexArray:
        """S^-1 e (n_line, n_run, 2) [1/N]."""
        second = self.white[..., 1] / self.l_yy
        return np.stack([(self.white[..., 0] - self.l_yx.conj() * second) / self.l_xx, second], axis=-1)


def times(matrix: NDArray[Any], vectors: ComplexArray) -> ComplexArray:
    """Matrices (..., 2, 2) on vectors (..., 2) [any unit], the axes before them broadcast."""
    return np.stack([matrix[..., n, 0] * vectors[..., 0] + matrix[..., n, 1] * vectors[..., 1] for n in (0, 1)], axis=-1)


def whitened(balance: Balance, stiffness: ComplexArray) -> Whitened:
    """Residual e = G - H m, its covariance and the smoothed motion for H (n_line, 2, 2) [N/m]. Equation (ds-residual)."""
    h = stiffness[:, None]
    of_motion = balance.cross - balance.motion_covariance @ h.conj().swapaxes(-1, -2)
    s = balance.right_covariance - balance.cross.conj().swapaxes(-1, -2) @ h.conj().swapaxes(-1, -2) - h @ of_motion
    l_xx = np.sqrt(s[..., 0, 0].real)
    l_yx = s[..., 1, 0] / l_xx
    l_yy = np.sqrt(s[..., 1, 1].real - np.abs(l_yx) ** 2)
    plain = Whitened(balance.right - times(h, balance.motion), balance.motion, l_xx, l_yx, l_yy)
    white = Whitened(plain.whiten(plain.white), balance.motion, l_xx, l_yx, l_yy)
    smoothed = balance.motion - times(of_motion, white.weighted())
    return Whitened(white.white, smoothed, l_xx, l_yx, l_yy)


class ErrorsInVariables:
    """V of a model as a sum of squares; its Jacobian is L^-1 dB/dp u^, which gives the gradient of V exactly, 2 Re sum (dB u^)^H S^-1 e."""

    def __init__(self, balance: Balance, model: StiffnessModel) -> None:
        self.balance, self.model = balance, model
        self._at: tuple[bytes, Whitened] | None = None

    def at(self, parameters: FloatArray) -> Whitened:
        """The whitened residual at *parameters* (n_parameter,) [parameter units]."""
        key = parameters.tobytes()
        if self._at is None or self._at[0] != key:
            with np.errstate(all="ignore"):
                self._at = key, whitened(self.balance, self.model.stiffness(parameters, self.balance.omega))
        return self._at[1]

    @property
    def size(self) -> float:
        """Norm of the force side [N] over that of its noise, line by line: what rounding is relative to."""
        variance = np.trace(self.balance.right_covariance, axis1=-2, axis2=-1).real
        power = np.sum(np.abs(self.balance.right) ** 2, axis=-1)
        return float(np.sqrt(np.sum(np.divide(power, variance, out=np.zeros_like(power), where=variance > 0))))

    def residual(self, parameters: FloatArray) -> FloatArray:
        """L^-1 e as real numbers (n_equation,) [1]."""
        return real_rows(self.at(parameters).white.reshape(1, -1))[0]

    def jacobian(self, parameters: FloatArray) -> FloatArray:
        """(n_equation, n_parameter) [1/parameter unit]."""
        return self.columns(parameters)

    def columns(self, parameters: FloatArray) -> FloatArray:
        """-L^-1 (dH/dp) m^ as real columns (n_equation, n_parameter) [1/parameter unit], element by element of the matrices.

        Equation (ds-jacobian).
        """
        state, model, omega = self.at(parameters), self.model, self.balance.omega
        theta = parameters[model.n_linear :]
        moved = state.whiten(times(model.elements[:, None, None], state.smoothed))
        basis = model.form.basis(theta, omega)
        linear = (-basis[:, None, :, None, None] * moved).reshape(model.n_linear, -1)
        if model.n_shape:
            slopes = model.form.slopes(theta, omega)
            change = np.tensordot(slopes.transpose(0, 2, 1), model.matrices(parameters), 1)
            shaped = -state.whiten(times(change[:, :, None], state.smoothed)).reshape(model.n_shape, -1)
            linear = np.concatenate([linear, shaped])
        return real_rows(linear).T

    def chi2(self, parameters: FloatArray) -> float:
        """V [1] at *parameters* (n_parameter,); infinite where it is no number. Equation (ds-likelihood)."""
        white = self.at(parameters).white
        total = float(np.sum(white.real**2 + white.imag**2))
        return total if np.isfinite(total) else float("inf")


def real_rows(rows: ComplexArray) -> FloatArray:
    """Complex rows (n, m) [any unit] as real parts, then imaginary parts, (n, 2 m)."""
    return np.concatenate([rows.real, rows.imag], axis=1)
