"""What intervals of K, C and M hold where the model is wrong: the table of the statistics page.

    python -m tests.draws.coefficients

Two masses seen from both, driven at both, 120 lines from 20 to 60 Hz, noise of 0.3 % of the response; faults
and truths are closed forms, seeds are pinned.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import FitSettings
from labpipe.records.response import FrequencyResponse, Port, diagonal_covariance

DRAWS, N, LINES, NOISE = 20, 2, 120, 0.003
F = np.linspace(20.0, 60.0, LINES)
W = 2 * np.pi * F
S = (2 * np.pi * 40) ** 2


class Rig:
    """K, C, M drawn from *seed*, and their receptance with one fault."""

    def __init__(self, seed: int) -> None:
        self.rng = rng = np.random.default_rng(seed)
        self.mass = np.diag(rng.uniform(0.8, 1.2, N))
        skew = rng.normal(size=(N, N)) * 0.15
        self.stiffness = S * np.diag(rng.uniform(0.6, 1.4, N)) + S * (skew + skew.T) / 2 * 0.3
        self.damping = np.diag(rng.uniform(5, 12, N)) + rng.normal(size=(N, N)) * 0.3

    def receptance(self, stiffness: np.ndarray) -> np.ndarray:
        return np.linalg.inv(
            stiffness - W[:, None, None] ** 2 * self.mass + 1j * W[:, None, None] * self.damping
        )

    def mode(self, f_n: float, zeta: float, size: float) -> np.ndarray:
        v = self.rng.normal(size=N)
        return np.outer(v, v) * size / (f_n**2 - F**2 + 2j * zeta * f_n * F)[:, None, None]


def rms(h: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.abs(h) ** 2)))


def hidden(rig: Rig) -> np.ndarray:
    h, f_n = rig.receptance(rig.stiffness), rig.rng.uniform(30, 55)
    return h + rig.mode(f_n, 0.015, 0.004 * rms(h) * f_n**2)


def moves(rig: Rig) -> np.ndarray:
    return np.mean([rig.receptance(rig.stiffness * (1 + e)) for e in np.linspace(-0.01, 0.01, 9)], axis=0)


def law(rig: Rig) -> np.ndarray:
    return rig.receptance(rig.stiffness * (1 + 0.02 * ((F - 40) / 20)[:, None, None] ** 2 * np.eye(N)))


def gains(rig: Rig) -> np.ndarray:
    x, phase = (F - 40) / 20, rig.rng.uniform(0, 6, (2, N, 1))
    gain = 1 + 0.02 * np.cos(2.2 * x + phase[0]) + 0.015j * np.sin(2.8 * x + phase[1])
    return rig.receptance(rig.stiffness) * gain.T[:, :, None]


def beside(rig: Rig) -> np.ndarray:
    h = rig.receptance(rig.stiffness)
    return h + sum(rig.mode(f_n, 0.01, 0.09 * rms(h) * 40**2) for f_n in (12.0, 75.0, 90.0))


def nothing(rig: Rig) -> np.ndarray:
    return rig.receptance(rig.stiffness)


FAULTS: dict[str, Callable[[Rig], np.ndarray]] = {
    "a hidden mode in the band": hidden,
    "stiffness that moves by 1 % to either side": moves,
    "stiffness that grows with frequency, 2 % at the edges": law,
    "gain curves of 2 %": gains,
    "three modes beside the band": beside,
    "nothing": nothing,
}


def counted(fault: Callable[[Rig], np.ndarray]) -> tuple[float, float, float]:
    """Median chi-square per degree of freedom, share of coefficients held, mean width over that of noise."""
    outputs, inputs = (
        tuple(Port(f"{letter}{n}", f"{letter}{n}", str(n)) for n in range(1, N + 1)) for letter in "yf"
    )
    reduced, held, width = [], [], []
    for seed in range(DRAWS):
        rig = Rig(seed)
        h = fault(rig)
        std = NOISE * rms(rig.receptance(rig.stiffness))
        noise = std * (rig.rng.normal(size=h.shape) + 1j * rig.rng.normal(size=h.shape)) / np.sqrt(2)
        response = FrequencyResponse(
            F, h + noise, outputs, inputs, covariance=diagonal_covariance(np.full(h.shape, std**2))
        )
        (fit,) = identify(response, FitSettings("mdof"))
        reduced.append(fit.gof.chi2_reduced)
        for letter, matrix in (("k", rig.stiffness), ("c", rig.damping), ("m", rig.mass)):
            for (row, column), truth in np.ndenumerate(matrix):
                p = fit.parameter(f"{letter}_{row + 1}_{column + 1}")
                low, high = p.ci95 or (np.inf, -np.inf)
                held.append(low <= truth <= high)
                width.append((high - low) / (2 * 1.96 * p.std_error))
    return float(np.median(reduced)), float(np.mean(held)), float(np.exp(np.mean(np.log(width))))


if __name__ == "__main__":
    for name, of in FAULTS.items():
        chi2, share, wider = counted(of)
        print(f"| {name} | {chi2:.3g} | {100 * share:.0f} % | {wider:.2g} |", flush=True)
