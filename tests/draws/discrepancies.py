"""What intervals of one mode hold under fourteen kinds of model error: a table of the statistics page.

    python -m tests.draws.discrepancies [FIRST SEED]

One mode near 100 Hz of .3 to 2 % damping on 120 to 200 lines over 6 to 14 half-power widths, noise of .2 to 2
% of the peak: as a transfer FRF (f_n, zeta; a residual constant) and at its driving point (k, c, m). Faults
and truths are closed forms; sizes are drawn, seeds are pinned.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from labpipe.errors import LabpipeError
from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import FitSettings
from labpipe.records.response import FrequencyResponse, Port, diagonal_covariance

DRAWS, FIRST, F_N, MASS = 24, 9000, 100.0, 2.0
VISIBLE = 1.5


@dataclass
class Rig:
    """One mode with its band, drawn from *seed*."""

    seed: int

    def __post_init__(self) -> None:
        self.rng = rng = np.random.default_rng(1000 + self.seed)
        self.zeta = float(np.exp(rng.uniform(np.log(0.003), np.log(0.02))))
        self.width = 2 * self.zeta * F_N
        band = rng.uniform(6, 14) * self.width
        low = F_N - band * rng.uniform(0.35, 0.65)
        self.frequency = np.linspace(low, low + band, int(rng.integers(120, 201)))
        self.x = np.linspace(-1, 1, self.frequency.size)
        self.noise = float(np.exp(rng.uniform(np.log(0.002), np.log(0.02))))
        self.peak = 1 / (2 * self.zeta * MASS * (2 * np.pi * F_N) ** 2)

    def mode(self, moved: float | np.ndarray = 0.0, at: np.ndarray | None = None) -> np.ndarray:
        """The receptance with the stiffness times (1 + moved)^2."""
        w, w_n = 2 * np.pi * (self.frequency if at is None else at), 2 * np.pi * F_N
        return np.asarray(1 / (MASS * (w_n**2 * (1 + moved) ** 2 - w**2 + 2j * self.zeta * w_n * w)))

    def other(self, f_n: float, zeta: float, size: float) -> np.ndarray:
        """A mode whose residue is *size* of that of the first."""
        f = self.frequency
        return np.asarray(size / (MASS * (2 * np.pi) ** 2 * (f_n**2 - f**2 + 2j * zeta * f_n * f)))


Kind = Callable[[Rig], np.ndarray]


def outside(near: float, far: float) -> Kind:
    """A mode below and one above the band, at distances of *near* to *far* of its width."""

    def of(rig: Rig) -> np.ndarray:
        low, high = rig.frequency[0], rig.frequency[-1]
        away = rig.rng.uniform(near, far, 2) * (high - low)
        sizes = rig.rng.uniform(0.3, 1, 2) * rig.rng.choice([-1, 1], 2)
        return (
            rig.mode()
            + rig.other(low - away[0], rig.zeta, sizes[0])
            + rig.other(high + away[1], rig.zeta, sizes[1])
        )

    return of


def close(rig: Rig) -> np.ndarray:
    away = rig.rng.choice([-1, 1]) * rig.rng.uniform(0.7, 2) * rig.width
    return rig.mode() + rig.other(
        F_N + away, rig.zeta * rig.rng.uniform(0.6, 1.6), rig.rng.uniform(0.02, 0.15)
    )


def hysteretic(rig: Rig) -> np.ndarray:
    w, w_n = 2 * np.pi * rig.frequency, 2 * np.pi * F_N
    return np.asarray(1 / (MASS * (w_n**2 * (1 + 2j * rig.zeta) - w**2)))


def of_amplitude(rig: Rig, level: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """Stiffness that follows the square of the amplitude over its largest, at a force of *level* of it."""
    size = rig.rng.choice([-1, 1]) * rig.rng.uniform(0.2, 0.8) * rig.zeta
    h = rig.mode()
    for _ in range(200):
        amplitude = level(h) * np.abs(h) / rig.peak
        h = 0.7 * h + 0.3 * rig.mode(size * np.minimum(amplitude, 1.5) ** 2)
    return np.asarray(h)


def nonlinear(rig: Rig) -> np.ndarray:
    return of_amplitude(rig, np.ones_like)


def shaker(rig: Rig) -> np.ndarray:
    """The force of a shaker drops where the structure moves most."""
    return of_amplitude(rig, lambda h: 1 / (1 + 2 * np.abs(h) / rig.peak))


def gain(rig: Rig) -> np.ndarray:
    phase = rig.rng.uniform(0, 6, 2)
    return np.asarray(1 + 0.02 * np.cos(2.2 * rig.x + phase[0]) + 0.015j * np.sin(2.8 * rig.x + phase[1]))


def delay(rig: Rig) -> np.ndarray:
    """A phase of 1 to 3 degrees at the mode."""
    angle = np.radians(rig.rng.uniform(1, 3))
    return np.asarray(rig.mode() * np.exp(-1j * angle * rig.frequency / F_N))


def drift(rig: Rig) -> np.ndarray:
    size = rig.rng.uniform(0.2, 0.8) * rig.zeta
    return np.asarray(np.mean([rig.mode(size * e) for e in np.linspace(-1, 1, 21)], axis=0))


def leakage(rig: Rig) -> np.ndarray:
    """Lines are means over a window of .2 to .6 half-power widths, r.m.s."""
    spread = rig.rng.uniform(0.2, 0.6) * rig.width / 2
    nodes, weights = np.polynomial.hermite_e.hermegauss(15)
    parts = [w * rig.mode(at=rig.frequency + spread * x) for x, w in zip(nodes, weights, strict=True)]
    return np.asarray(np.sum(parts, axis=0) / weights.sum())


def fixture(rig: Rig) -> np.ndarray:
    f_f, size = rig.rng.uniform(1.3, 2.0) * F_N, rig.rng.uniform(0.02, 0.06)
    return np.asarray(rig.mode() * (1 + size / (1 - (rig.frequency / f_f) ** 2)))


def mixed(rig: Rig) -> np.ndarray:
    return (close(rig) - rig.mode() + drift(rig)) * gain(rig)


def loaded(rig: Rig) -> np.ndarray:
    """A transducer of .2 to 1 % of the modal mass."""
    share = rig.rng.uniform(0.002, 0.01)
    w = 2 * np.pi * rig.frequency
    return np.asarray(1 / (1 / rig.mode() - share * MASS * w**2))


KINDS: dict[str, Kind] = {
    "nothing": Rig.mode,
    "modes far outside the band": outside(0.8, 2.0),
    "modes just outside the band": outside(0.1, 0.5),
    "a close mode": close,
    "hysteretic damping": hysteretic,
    "stiffness that follows the amplitude": nonlinear,
    "the same, with a force that drops": shaker,
    "gain curve of 2 %": lambda rig: rig.mode() * gain(rig),
    "delay of 1 to 3 degrees": delay,
    "drift of the frequency": drift,
    "leakage of the window": leakage,
    "dynamics of a fixture": fixture,
    "a close mode, drift and a gain curve": mixed,
    "mass of the transducer": loaded,
}
DRIVING = {"k", "c", "m"}


def truths(rig: Rig) -> dict[str, float]:
    w_n = 2 * np.pi * F_N
    return {"f_n": F_N, "zeta": rig.zeta, "k": MASS * w_n**2, "c": 2 * rig.zeta * MASS * w_n, "m": MASS}


def counted(name: str, first: int) -> str:
    """A row: median chi-square, and of visible and hidden misfits the share with intervals and that held."""
    reduced, stated, held, width, seconds, n_fit = [], [], [], [], 0.0, 0
    for seed in range(first, first + DRAWS):
        for transfer in (True, False):
            rig = Rig(seed)
            h = KINDS[name](rig)
            std = rig.noise * rig.peak
            h = h + std * (rig.rng.normal(size=h.size) + 1j * rig.rng.normal(size=h.size)) / np.sqrt(2)
            response = FrequencyResponse(
                rig.frequency,
                h[:, None, None],
                (Port("y", "y", "2" if transfer else "1"),),
                (Port("f", "f", "1"),),
                covariance=diagonal_covariance(np.full((h.size, 1, 1), std**2)),
            )
            begun = time.process_time()
            try:
                (fit,) = identify(response, FitSettings("sdof", residuals=not transfer and "outside" in name))
            except LabpipeError:
                continue
            seconds, n_fit = seconds + time.process_time() - begun, n_fit + 1
            for key, value in truths(rig).items():
                if (key in DRIVING) == transfer:
                    continue
                p = fit.parameter(key)
                reduced.append(fit.gof.chi2_reduced or np.nan)
                stated.append(p.ci95 is not None)
                low, high = p.ci95 or (np.inf, -np.inf)
                held.append(low <= value <= high)
                if p.ci95 and p.std_error:
                    width.append((high - low) / (2 * 1.96 * p.std_error))
    chi2, has, good = np.array(reduced), np.array(stated), np.array(held)
    seen = chi2 > VISIBLE
    shares = [
        f"{100 * np.mean(good[part & has]):.0f} % of {(part & has).sum()}" if (part & has).any() else ""
        for part in (seen, ~seen)
    ]
    wider, cpu = float(np.exp(np.mean(np.log(width)))), seconds / n_fit
    head = f"{name} | {float(np.median(chi2)):.3g} | {100 * np.mean(has):.0f} %"
    return f"{head} | {shares[0]} | {shares[1]} | {wider:.3g} | {cpu:.2f}"


if __name__ == "__main__":
    for kind in KINDS:
        print(f"| {counted(kind, FIRST if len(sys.argv) < 2 else int(sys.argv[1]))} |", flush=True)
