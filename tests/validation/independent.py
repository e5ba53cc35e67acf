"""Modes by calculations that share nothing with labpipe: least squares of a rational function, by numpy and
scipy alone.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.optimize import least_squares


def stacked(values: np.ndarray) -> np.ndarray:
    """Real above imaginary parts."""
    return np.concatenate([values.real, values.imag])


def remaining(columns: np.ndarray, y: np.ndarray) -> np.ndarray:
    """What real multiples of the *columns* (n_line, n) leave of *y* (n_line,), over its rms."""
    a, b = stacked(columns) / np.std(y), stacked(y) / np.std(y)
    size = np.linalg.norm(a, axis=0)
    a = a / np.where(size > 0, size, 1.0)
    return np.asarray(b - a @ np.linalg.lstsq(a, b, rcond=None)[0])


def mode_of_frf(
    frequency: np.ndarray, h: np.ndarray, band: tuple[float, float], start: tuple[float, float]
) -> tuple[float, float]:
    """Natural frequency [Hz] and damping ratio of the one mode of an FRF *h* (n_line,) in a band: complex
    residue, constant and slope over it, equal weights.
    """
    inside = (frequency >= band[0]) & (frequency <= band[1])
    f, h = frequency[inside], h[inside]
    x = (f - np.mean(f)) / np.ptp(f)
    units = np.stack([np.ones_like(f), 1j * np.ones_like(f)], axis=1)

    def left(p: np.ndarray) -> np.ndarray:
        pole = 1 / (1 - (f / p[0]) ** 2 + 2j * p[1] * f / p[0])
        return remaining(np.hstack([pole[:, None] * units, units, x[:, None] * units]), h)

    best = least_squares(left, start, x_scale=(start[0] * start[1], start[1]))
    return float(best.x[0]), float(best.x[1])


def modes_of_record(
    force: np.ndarray,
    response: np.ndarray,
    rate: float,
    band: tuple[float, float],
    start: Sequence[tuple[float, float]],
) -> list[tuple[float, float]]:
    """Natural frequencies [Hz] and damping ratios from one record, output error on its whole transform.

    Y = sum_m (a + b s) / (s^2 + 2 zeta w s + w^2) U + (c + d x) U + the same poles and a parabola for the
    motion at both ends; x runs over the band.
    """
    f = np.fft.rfftfreq(force.size, 1 / rate)
    inside = (f >= band[0]) & (f <= band[1])
    f = f[inside]
    u, y = (np.fft.rfft(signal - signal.mean())[inside] for signal in (force, response))
    x = (f - np.mean(f)) / np.ptp(f)
    smooth = np.hstack([np.vander(x, 3), 1j * np.vander(x, 3)])
    scale, number = np.std(y), len(start)

    def left(p: np.ndarray) -> np.ndarray:
        poles = [1 / (1 - (f / a) ** 2 + 2j * b * f / a) for a, b in zip(p[:number], p[number:], strict=True)]
        both = np.stack([part for pole in poles for part in (pole, 1j * f * pole)], axis=1)
        of_force = np.hstack([both, np.vander(x, 2), 1j * np.vander(x, 2)]) * u[:, None]
        return remaining(np.hstack([of_force, both, smooth * scale]), y)

    first = np.array([mode[0] for mode in start] + [mode[1] for mode in start])
    step = np.concatenate([first[:number] * first[number:], first[number:]])
    best = least_squares(left, first, x_scale=step, max_nfev=60).x
    return [(float(a), float(b)) for a, b in zip(best[:number], best[number:], strict=True)]


# The electronic oscillator of a benchmark: rate [Hz], samples of a period, odd lines of the multisines.
RATE, PERIOD, LINES = 610.3515625, 8192, np.arange(135, 2013, 2)


def equivalent_frequency(period: np.ndarray, variance: float) -> float:
    """Natural frequency [Hz] under motion of a *variance*, from a *period* (n_sample, 2) of force and motion.

    m y'' + c y' + k y + k2 y^2 + k3 y^3 = u is linear in its coefficients at the lines of a period
    (force-state mapping, Masri and Caughey 1979); under Gaussian motion of variance s^2 the spring is on the
    whole as stiff as k + 3 k3 s^2 (statistical linearisation, Caughey 1963).
    """
    w = 2 * np.pi * LINES * RATE / PERIOD
    u, y = period[:, 0], period[:, 1] - period[:, 1].mean()
    force, motion, square, cube = (np.fft.rfft(of)[LINES] for of in (u, y, y**2, y**3))
    terms = np.stack([-(w**2) * motion, 1j * w * motion, motion, square, cube], axis=1)
    # Errors of the motion act on the force by the dynamic stiffness: over that they count alike.
    weight = np.ones(LINES.size)
    for _ in range(4):
        m, c, k, _, k3 = np.linalg.lstsq(
            stacked(terms * weight[:, None]), stacked(force * weight), rcond=None
        )[0]
        weight = 1 / np.abs(k - m * w**2 + 1j * c * w)
    return float(np.sqrt((k + 3 * k3 * variance) / m) / (2 * np.pi))
