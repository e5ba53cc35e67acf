"""Free decays of known truth, and their Cramer-Rao bound by an independent way."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from labpipe.records.response import Port
from labpipe.records.spectra import FreeDecay, FreeDecays

RATE, DURATION = 1024.0, 4.0
Modes = Sequence[tuple[float, float, float, float]]  # f [Hz], zeta, amplitude, phase


def times(duration: float = DURATION, rate: float = RATE) -> np.ndarray:
    return np.arange(round(duration * rate)) / rate


def motion(modes: Modes, t: np.ndarray) -> np.ndarray:
    """sum A exp(-zeta w t) cos(w sqrt(1 - zeta^2) t + phase)."""
    omega = [2 * np.pi * f for f, *_ in modes]
    return sum(
        a * np.exp(-z * w * t) * np.cos(w * np.sqrt(1 - z**2) * t + phase)
        for (_, z, a, phase), w in zip(modes, omega, strict=True)
    )


def record(columns: Sequence[np.ndarray], rate: float = RATE, units: str = "m") -> FreeDecays:
    """One output; each column is a decay."""
    decays = tuple(FreeDecay(f"hit-{n}", 0.0, column[:, None]) for n, column in enumerate(columns, 1))
    return FreeDecays(rate, (Port("y", "y", "y"),), (units,), decays)


def bound(modes: Modes, t: np.ndarray, sigma: float) -> np.ndarray:
    """Cramer-Rao standard errors of f_1, zeta_1, f_2, ...: the whole Fisher matrix of f, zeta, A, phase and
    the offset, by differences.
    """
    values = np.array([value for mode in modes for value in mode])

    def model(x: np.ndarray) -> np.ndarray:
        return motion(x.reshape(-1, 4), t)

    steps = 1e-6 * np.maximum(np.abs(values), 1e-3)
    columns = [
        (model(values + d) - model(values - d)) / (2 * h) for h, d in zip(steps, np.diag(steps), strict=True)
    ]
    jacobian = np.stack([*columns, np.ones(t.size)], axis=1)
    errors = sigma * np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian)))
    return errors[:-1].reshape(-1, 4)[:, :2].reshape(-1)
