"""Whirl: the ratio of whirl frequency to shaft speed at the onset of instability, and the onset speed of a rotor on the bearing.

A rotor whirls undamped where det(K - k I + jw C - w^2 M) = 0 for a real stiffness k and frequency w. The imaginary part gives k, the
equivalent stiffness, linear in x = w^2; the real part then is a quadratic in x. Without M: w^2 = ((k - K_xx)(k - K_yy) - K_xy K_yx) / det C
with k = (K_xx C_yy + K_yy C_xx - K_xy C_yx - K_yx C_xy) / (C_xx + C_yy) (Lund 1987; San Andres 2006 for seals). Negative: no whirl.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.dynamic_stiffness.forms import StiffnessModel

# Imaginary step of derivatives: exact to rounding.
STEP = 1e-30
# Two-sided 95 % of a standard normal value.
LIMIT = 1.959964
# Share of a complex root's size below which its imaginary part is rounding.
REAL = 1e-6
FORMS_WITH_WHIRL = ("kc", "kcm")


@dataclass(frozen=True)
class Whirl:
    """x = w^2 [(rad/s)^2] of the whirl frequency w, its slopes (n_parameter,) [per parameter unit] and its 95 % interval (Fieller).

    stiffness k [N/m] at which a rotor whirls, with its slopes (n_parameter,). Ends of the interval are infinite where it has none.
    """

    square: float
    slopes: FloatArray
    interval: tuple[float, float]
    stiffness: float
    stiffness_slopes: FloatArray


def whirl(model: StiffnessModel, values: FloatArray, covariance: FloatArray) -> Whirl | None:
    """The whirl of K, C and M of values (n_parameter,) with their covariance [parameter units]; None where there is no real solution.

    Equation (ds-whirl).
    """
    polynomial = _polynomial(model, values)[0].real
    square = _root(polynomial)
    if square is None:
        return None
    stepped = [_polynomial(model, values + 1j * STEP * scale * row) for row, scale in zip(np.eye(values.size), _sizes(values), strict=True)]
    slopes = np.stack([part[0].imag for part in stepped]) / (STEP * _sizes(values))[:, None]
    powers = np.array([square**2, square, 1.0])
    along = float(2 * polynomial[0] * square + polynomial[1])
    square_slopes = -(slopes @ powers) / along
    stiffness = _polynomial(model, values)[1].real
    stiffness_slopes = np.stack([part[1].imag for part in stepped]) / (STEP * _sizes(values))[:, None]
    return Whirl(
        square,
        square_slopes,
        _fieller(polynomial, slopes, covariance, square),
        float(stiffness[0] + stiffness[1] * square),
        np.asarray(stiffness_slopes @ np.array([1.0, square]) + stiffness[1] * square_slopes),
    )


def _sizes(values: FloatArray) -> FloatArray:
    return np.where(values != 0, np.abs(values), 1.0)


def _polynomial(model: StiffnessModel, values: ComplexArray | FloatArray) -> tuple[ComplexArray, ComplexArray]:
    """Coefficients (3,) of the quadratic in x, highest first, and (2,) of k = k_0 + k_1 x; complex for complex values."""
    # Linear in the values, so that complex steps pass.
    matrices: NDArray[Any] = model.matrices(values)  # type: ignore[arg-type]
    k, c = matrices[0], matrices[1]
    m = matrices[2] if len(matrices) > 2 else np.zeros_like(k)
    # Every element of K - x M as (constant, slope).
    (xx, xy), (yx, yy) = [[np.array([k[i, j], -m[i, j]], np.complex128) for j in (0, 1)] for i in (0, 1)]
    level = (xx * c[1, 1] + yy * c[0, 0] - xy * c[1, 0] - yx * c[0, 1]) / (c[0, 0] + c[1, 1])
    quadratic = _product(xx - level, yy - level) - _product(xy, yx)
    quadratic[1] -= c[0, 0] * c[1, 1] - c[0, 1] * c[1, 0]
    return quadratic, level


def _product(a: ComplexArray, b: ComplexArray) -> ComplexArray:
    """(a_0 + a_1 x)(b_0 + b_1 x), highest power first."""
    return np.array([a[1] * b[1], a[0] * b[1] + a[1] * b[0], a[0] * b[0]])


def _root(polynomial: FloatArray) -> float | None:
    """The root that is the only one without added mass."""
    second, first, constant = (float(value) for value in polynomial)
    inside = first**2 - 4 * second * constant
    if inside < 0 or first == 0:
        return None
    return -2 * constant / (first + np.copysign(np.sqrt(inside), first))


def _fieller(polynomial: FloatArray, slopes: FloatArray, covariance: FloatArray, square: float) -> tuple[float, float]:
    """All x around the root at which the quadratic is not significantly different from zero: phi(x)^2 < 1.96^2 var phi(x)."""
    slope = 2 * polynomial[0] * square + polynomial[1]
    powers = slopes @ np.array([square**2, square, 1.0])
    unit = max(abs(square), float(np.sqrt(powers @ covariance @ powers)) / abs(float(slope)), np.finfo(float).tiny)
    scales = np.array([unit**2, unit, 1.0])
    scaled = polynomial * scales
    spread = (slopes * scales).T @ covariance @ (slopes * scales)
    variance = np.zeros(5)
    for i in range(3):
        for j in range(3):
            variance[i + j] += spread[i, j]
    roots = np.roots(np.convolve(scaled, scaled) - LIMIT**2 * variance)
    real = unit * np.sort(roots[np.abs(roots.imag) <= REAL * np.maximum(np.abs(roots), 1e-9)].real)
    below, above = real[real <= square], real[real >= square]
    return float(below[-1]) if below.size else -np.inf, float(above[0]) if above.size else np.inf
