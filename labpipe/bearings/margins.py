"""Margins of a loop transfer function: gain, phase, delay and disk, and the peak of the sensitivity.

A loop around an unstable plant has two gain margins: it becomes unstable by too much gain and by too little.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import optimize

from labpipe.arrays import ComplexArray, FloatArray

# Lines of the search, and its lowest frequency over the highest.
LINES, LOWEST = 1201, 1e-6
LoopTransfer = Callable[[FloatArray], ComplexArray]


@dataclass(frozen=True)
class Margins:
    """Factors of the gain (1) down to and up to the border of stability, phase [rad], delay [s], disk [1], peak of |S| [1], its place [Hz].

    gain_lower 0 and gain_upper, phase, delay infinite where the loop never gets there. disk: the balanced (symmetric) disk margin
    1 / max|S - 1/2|: gain and phase may change together within it (Seiler, Packard and Gahinet 2020, IEEE Control Systems 40:78).
    """

    gain_lower: float
    gain_upper: float
    phase: float
    delay: float
    disk: float
    peak: float
    peak_frequency: float


def margins(loop: LoopTransfer, highest: float) -> Margins:
    """Margins of *loop*, L(omega) with omega (n_line,) [rad/s], of a stable closed loop, from 0 Hz up to *highest* [Hz].

    Equation (mag-margins).
    """
    omega = 2 * np.pi * np.concatenate([[0.0], np.geomspace(LOWEST * highest, highest, LINES)])
    values = loop(omega)
    finite = np.isfinite(values)
    omega, values = omega[finite], values[finite]
    gains = _gains(loop, omega, values)
    turns, delays = _phases(loop, omega, values)
    sensitivity = 1 / (1 + values)
    peak, at = _largest(lambda w: np.abs(1 / (1 + loop(w))), omega, np.abs(sensitivity))
    widest, _ = _largest(lambda w: np.abs(1 / (1 + loop(w)) - 0.5), omega, np.abs(sensitivity - 0.5))
    return Margins(
        gain_lower=max((gain for gain in gains if gain < 1), default=0.0),
        gain_upper=min((gain for gain in gains if gain > 1), default=float("inf")),
        phase=min(turns, default=float("inf")),
        delay=min(delays, default=float("inf")),
        disk=1 / widest,
        peak=peak,
        peak_frequency=at / (2 * np.pi),
    )


def _gains(loop: LoopTransfer, omega: FloatArray, values: ComplexArray) -> list[float]:
    """Factors that bring L onto -1, where it crosses the negative real axis; at rest it lies on the real axis."""
    gains = [-1 / values[0].real] if omega[0] == 0 and values[0].real < 0 else []
    for place in _roots(lambda w: loop(w).imag, omega, values.imag):
        at = loop(np.array([place]))[0].real
        if at < 0:
            gains.append(-1 / at)
    return [float(gain) for gain in gains]


def _phases(loop: LoopTransfer, omega: FloatArray, values: ComplexArray) -> tuple[list[float], list[float]]:
    """Distance of the phase from -180 deg to either side [rad], and the delay that takes it there [s], where |L| is 1."""
    turns, delays = [], []
    for place in _roots(lambda w: np.log(np.abs(loop(w))), omega, np.log(np.abs(values))):
        angle = float(np.angle(-loop(np.array([place]))[0]))
        turns.append(abs(angle))
        delays.append(angle % (2 * np.pi) / place)
    return turns, delays


def _roots(function: Callable[[FloatArray], FloatArray], omega: FloatArray, values: FloatArray) -> list[float]:
    """Places where a function of frequency changes its sign, between lines and none at rest."""
    places = np.flatnonzero((values[:-1] * values[1:] < 0) & (omega[:-1] > 0))
    return [float(optimize.brentq(lambda w: float(function(np.array([w]))[0]), omega[n], omega[n + 1], rtol=1e-12)) for n in places]


def _largest(function: Callable[[FloatArray], FloatArray], omega: FloatArray, values: FloatArray) -> tuple[float, float]:
    """The largest value and its place [rad/s], between the lines."""
    top = int(np.argmax(values))
    if top in (0, omega.size - 1):
        return float(values[top]), float(omega[top])
    ends, accuracy = (omega[top - 1], omega[top + 1]), {"xatol": 1e-9 * omega[top]}
    maximum = optimize.minimize_scalar(lambda w: -float(function(np.array([w]))[0]), bounds=ends, method="bounded", options=accuracy)
    return float(-maximum.fun), float(maximum.x)
