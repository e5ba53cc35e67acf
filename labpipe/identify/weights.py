"""How the lines weigh in an output-error fit, and what it costs that the weights themselves were estimated.

A covariance S estimated from nu complex degrees of freedom is complex Wishart, S = C W / nu. With a = nu - n for n responses
(several forces share or have their own estimate of the responses' noise, so they do not count in n):
E[S^-1] = nu / a C^-1 and E[S^-1 C S^-1] = nu^3 / (a (a^2 - 1)) C^-1 (Maiwald and Kraus 2000, IEE Proc. Radar 147:162).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labpipe.arrays import BoolArray, ComplexArray, FloatArray
from labpipe.distributions import chi2_tail, f_tail
from labpipe.errors import FitError
from labpipe.identify.measured import Measured
from labpipe.identify.statistics import stacked

# Below this relative standard deviation an FRF holds rounding errors, which are no measured noise to weigh by.
NOISE_FREE = 1e-10
# A covariance of normalised FRFs whose smallest eigenvalue is within this many roundings of zero has lost a rank.
SINGULAR_ROUNDINGS = 100


@dataclass(frozen=True)
class WeightDoubt:
    """What weights from an estimated covariance do to a fit; all 1 and infinite for a known covariance.

    excess        E[d^H S^-1 d] / E[d^H C^-1 d]: how much too large the weighted residual looks
    inflation     true covariance of the estimates / (J^H S^-1 J)^-1, lost efficiency and noise shared by lines included
    residual_dof  second degree of freedom of the F distribution that the reduced chi-square follows
    shared        how many times fewer degrees of freedom the residual has than equations, since lines share noise
    """

    excess: float = 1.0
    inflation: float = 1.0
    residual_dof: float = np.inf
    shared: float = 1.0

    def p_value(self, reduced: float, dof: int) -> float:
        """Chance of a reduced chi-square at least this large for a right model; chi-square, or F scaled to the mean 1."""
        own = dof / self.shared
        if not np.isfinite(self.residual_dof):
            return chi2_tail(reduced * own, own)
        return f_tail(reduced * self.residual_dof / (self.residual_dof - 2), own, self.residual_dof)


def weight_doubt(measured: Measured, dof: int) -> WeightDoubt:
    """excess = nu / a, inflation = s nu^2 / (a^2 - 1), residual_dof by the variance of the weighted residual; *dof* of the fit.

    s = sum of the correlation of a line's noise with all lines' (Hann: 1.9): exact where the model changes little from line to line.
    The inflation is exact when the noise estimates of the lines are independent, and slightly too large when neighbouring lines
    share theirs. FitError when nu <= n + 1: the weighted residual then has no variance, or no mean.
    """
    nu, n = measured.noise_dof, measured.matrix.shape[1]
    if not np.isfinite(nu):
        return WeightDoubt(inflation=measured.shared_noise, shared=measured.shared_power)
    a = nu - n
    if a <= 1:
        raise FitError(
            f"the covariance of {n} response(s) was estimated from {nu:.3g} degrees of freedom only",
            hint="average more periods or blocks, or raise `smooth`",
        )
    inflation = measured.shared_noise * nu**2 / (a**2 - 1)
    return WeightDoubt(nu / a, inflation, _residual_dof(measured, a, dof), measured.shared_power)


def _residual_dof(measured: Measured, a: float, dof: int) -> float:
    """The second degree of freedom of the F distribution with the variance of the weighted residual over all lines.

    Relative variance of the residual: [g nu a / (q n (a^2 - 1)) + W nu / (n (a^2 - 1))] / L for L lines, q forces, W lines that
    share one noise estimate and g, the lines' shared power; of F with d1 = dof / g, d2: 2 (d1 + d2 - 2) / (d1 (d2 - 4)).
    """
    n_line, n, q = measured.matrix.shape
    estimates = max(min(measured.noise_lines, n_line), measured.shared_noise)
    spread = measured.noise_dof * (measured.shared_power * a / q + estimates) / (n * (a**2 - 1) * n_line)
    # The fit takes up some of the residual: both parts scale with what it leaves.
    scaled = spread * measured.n_equation / measured.shared_power
    return float((2 * dof / measured.shared_power - 4 + 4 * scaled) / (scaled - 2))


def has_noise(measured: Measured) -> bool:
    """Whether the FRF comes with noise that was measured."""
    if measured.covariance is None:
        return False
    variance = np.einsum("lii->li", measured.covariance).real
    return bool(np.max(variance) > NOISE_FREE**2 * np.max(np.abs(measured.matrix) ** 2))


def equal_weights(measured: Measured) -> ComplexArray:
    """The same weight for every FRF and line, (n_line, n, n) [N/m], scaled by the FRF's size so that units do not matter."""
    n = measured.matrix.shape[1] * measured.matrix.shape[2]
    size = np.sqrt(np.mean(np.abs(measured.matrix) ** 2))
    return np.broadcast_to(np.eye(n) / size, (measured.omega.size, n, n)).astype(np.complex128)


def whitener(measured: Measured) -> ComplexArray:
    """L^-1 of C = L L^H per line, (n_line, n, n) [N/m]; FitError where a variance is zero or C has lost a rank."""
    assert measured.covariance is not None
    std = np.sqrt(np.einsum("lii->li", measured.covariance).real)
    if np.any(std == 0):
        raise FitError(f"the variance of the FRF is zero at {_first(measured, std == 0)}", hint="leave this line out with `exclude`")
    scaled = measured.covariance / (std[:, :, None] * std[:, None, :])
    n = scaled.shape[1]
    singular = np.linalg.eigvalsh(scaled)[:, 0] < SINGULAR_ROUNDINGS * n * np.finfo(float).eps
    if np.any(singular):
        hint = "average more periods or blocks, or name fewer responses with `output`"
        raise FitError(f"the covariance of the {n} FRFs is singular at {_first(measured, singular[:, None])}", hint=hint)
    weights: ComplexArray = np.linalg.inv(np.linalg.cholesky(scaled)) / std[:, None, :]
    return weights


def whitened(whitener: ComplexArray, values: ComplexArray) -> FloatArray:
    """(..., n_line, n_output, n_input) -> (..., n_equation): uncorrelated, each real part of variance 1."""
    flat = values.reshape(*values.shape[:-2], -1)
    white = np.matmul(whitener, np.moveaxis(flat, -2, 0).reshape(flat.shape[-2], -1, flat.shape[-1]).swapaxes(1, 2))
    lines = np.moveaxis(white, 2, 0).reshape(*values.shape[:-3], -1)
    return np.sqrt(2.0) * stacked(lines)


def _first(measured: Measured, at: BoolArray) -> str:
    """The first line, in Hz, at which *at* (n_line, n) holds for any FRF."""
    line = int(np.argmax(np.any(at, axis=1)))
    return f"{measured.omega[line] / (2 * np.pi):g} Hz"
