"""What intervals of a floating bearing and of a magnet hold where the model is wrong: two tables of the
statistics page.

    python -m tests.draws.balances

A water seal in a floating stator, 90 lines from 20 to 198 Hz, and a levitated rotor, 60 lines from 5 to 300
Hz; faults and truths are closed forms, seeds are pinned.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from labpipe.records.identification import Fit
from labpipe.records.spectra import ChannelSpectra
from tests.methods.floating_bearing.floating_rig import SEAL, kcm, truth
from tests.methods.floating_bearing.test_fit import EVEN, GIVEN, fitted as floating
from tests.methods.magnetic_bearing.levitated import COUPLED, circular
from tests.methods.magnetic_bearing.test_fit import fitted as magnet

DRAWS = 20
MAGNET_TRUTH = {
    f"{name}_{row}{column}": matrix[i, j]
    for name, matrix in (("k_i", COUPLED.k_i), ("k_s", COUPLED.k_s))
    for i, row in enumerate("xy")
    for j, column in enumerate("xy")
}
Vectors = tuple[np.ndarray, np.ndarray]


def normalised(f: np.ndarray) -> np.ndarray:
    return np.asarray((2 * f - f[0] - f[-1]) / (f[-1] - f[0]))


def gains(clean: np.ndarray, f: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Gain and phase of every channel bend by 2 and 1.5 %."""
    phase, x = rng.uniform(0, 6, (2, 1, clean.shape[2])), normalised(f)[:, None]
    gain = 1 + 0.02 * np.cos(2.2 * x + phase[0]) + 0.015j * np.sin(2.8 * x + phase[1])
    return np.asarray(clean * gain[:, None])


def other_modes(clean: np.ndarray, f: np.ndarray, rng: np.random.Generator, share: float) -> np.ndarray:
    """Displacements see a bending mode above the band as well, driven by the first two channels."""
    moves = slice(2, 4)
    f_b = 1.3 * f[-1]
    mode = 1 / (1 - (f / f_b) ** 2 + 0.02j * f / f_b)[:, None, None]
    force = clean[..., :2] / np.sqrt(np.mean(np.abs(clean[..., :2]) ** 2))
    size = share * np.sqrt(np.mean(np.abs(clean[..., moves]) ** 2))
    bent = clean.copy()
    bent[..., moves] += mode * size * (force @ rng.normal(size=(2, 2)))
    return bent


def floating_with(bearing: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    return replace(SEAL_RIG, bearing=bearing).clean()


SEAL_RIG = replace(EVEN, bearing=kcm(**SEAL), noise=0.002)


def scaled(e: float) -> Callable[[np.ndarray], np.ndarray]:
    return kcm((np.array(SEAL["k"]) * (1 + e)).tolist(), SEAL["c"], SEAL["m"])


def lawful(w: np.ndarray) -> np.ndarray:
    """The stiffness grows with frequency, by 5 % of the largest at both ends of the band."""
    x = normalised(w)[:, None, None]
    return np.asarray(kcm(**SEAL)(w) + 0.05 * 5e6 * x**2 * np.eye(2))


FLOATING: dict[str, Callable[[np.random.Generator], np.ndarray]] = {
    "a bending mode above the band": lambda rng: other_modes(
        SEAL_RIG.clean(), SEAL_RIG.frequency, rng, 0.002
    ),
    "gain curves of 2 %": lambda rng: gains(SEAL_RIG.clean(), SEAL_RIG.frequency, rng),
    "stiffness that grows with frequency, 5 % at the edges": lambda rng: floating_with(lawful),
    "stiffness that moves by 10 % to either side": lambda rng: np.mean(
        [floating_with(scaled(e)) for e in np.linspace(-0.1, 0.1, 9)], axis=0
    ),
    "nothing": lambda rng: SEAL_RIG.clean(),
}


def floating_draw(fault: Callable[[np.random.Generator], np.ndarray], seed: int) -> Fit:
    rng = np.random.default_rng(seed)
    clean, std = fault(rng), SEAL_RIG.std()
    noisy = clean + std * circular(rng, clean.shape)
    covariance = np.broadcast_to(np.diag(std**2).astype(complex), (*clean.shape, std.size))
    return floating(SEAL_RIG.spectra(noisy, covariance), **GIVEN)


def moving() -> np.ndarray:
    spring = [replace(COUPLED, k_s=COUPLED.k_s * (1 + e)).clean() for e in np.linspace(-0.1, 0.1, 9)]
    return np.asarray(np.mean(spring, axis=0))


MAGNETS: dict[str, Callable[[np.random.Generator], np.ndarray]] = {
    "a bending mode above the band": lambda rng: other_modes(COUPLED.clean(), COUPLED.frequency, rng, 0.01),
    "gain curves of 2 %": lambda rng: gains(COUPLED.clean(), COUPLED.frequency, rng),
    "stiffness that moves by 10 % to either side": lambda rng: moving(),
    "nothing": lambda rng: COUPLED.clean(),
}


def magnet_draw(fault: Callable[[np.random.Generator], np.ndarray], seed: int) -> Fit:
    rng = np.random.default_rng(seed)
    clean, std = fault(rng), COUPLED.std()
    covariance = np.broadcast_to(np.diag(std**2).astype(complex), (*clean.shape[:2], std.size, std.size))
    spectra: ChannelSpectra = COUPLED.record(clean + circular(rng, clean.shape) * std, covariance)
    return magnet(spectra, coupling="full")


def counted(
    draw: Callable[[Callable[[np.random.Generator], np.ndarray], int], Fit],
    fault: Callable[[np.random.Generator], np.ndarray],
    expected: dict[str, float],
) -> tuple[float, float, float, float]:
    """Median chi-square per degree of freedom, share held, share by noise alone, mean width over noise's."""
    reduced, held, by_noise, width = [], [], [], []
    for seed in range(DRAWS):
        fit = draw(fault, seed)
        reduced.append(fit.gof.chi2_reduced)
        for name, value in expected.items():
            p = fit.parameter(name)
            low, high = p.ci95 or (np.inf, -np.inf)
            held.append(low <= value <= high)
            by_noise.append(abs(p.value - value) <= 1.96 * p.std_error)
            width.append((high - low) / (2 * 1.96 * p.std_error))
    wider = float(np.exp(np.mean(np.log(width))))
    return float(np.median(reduced)), float(np.mean(held)), float(np.mean(by_noise)), wider


if __name__ == "__main__":
    for title, faults, of, values in (
        ("floating bearing", FLOATING, floating_draw, truth(SEAL)),
        ("magnet", MAGNETS, magnet_draw, MAGNET_TRUTH),
    ):
        for name, one in faults.items():
            chi2, share, plain, wide = counted(of, one, values)
            row = f"{chi2:.3g} | {100 * share:.0f} % | {100 * plain:.0f} % | {wide:.2g}"
            print(f"| {title}: {name} | {row} |", flush=True)
