"""What intervals of several recordings hold under ten kinds of scatter between them, without and with an
error that all of them share: a table of the statistics page.

    python -m tests.draws.repeats

A mode of 100 Hz and 1 % damping on 101 lines, noise of 1 % in each recording; faults are closed forms, seeds
are pinned. What is true is the value of the mean condition, that of the middle force where it is known.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from labpipe.records.response import FrequencyResponse, diagonal_covariance
from tests.estimation.test_repeated import F_N, FREQUENCY, NOISE, ZETA, fitted, mode, repeated

DRAWS, FIRST, NUMBERS = 10, 9000, (3, 5, 10)
# ln f over zeta and ln zeta of every recording (n,), and the forces where they are known.
Moves = tuple[np.ndarray, np.ndarray, np.ndarray | None]


def _still(n: int) -> np.ndarray:
    return np.zeros(n)


def levels(n: int, rng: np.random.Generator) -> Moves:
    force = 10 * rng.uniform(0.5, 1.5, n)
    return -0.3 * (force / np.median(force) - 1), _still(n), force


def steps(n: int, rng: np.random.Generator) -> Moves:
    """One change of temperature by .4 half-power half-widths somewhere in between."""
    after = np.arange(n) >= rng.integers(1, n)
    return 0.4 * (after - 0.5), _still(n), None


def one_bad(n: int, rng: np.random.Generator) -> Moves:
    moves = 0.05 * rng.normal(size=n)
    moves[rng.integers(n)] += rng.choice([-2, 2]) if n >= 5 else 0.0
    return moves, _still(n), None


def mixed(n: int, rng: np.random.Generator) -> Moves:
    moves, _, force = levels(n, rng)
    return moves + 0.1 * rng.normal(size=n), 0.05 * rng.normal(size=n), force


KINDS: dict[str, Callable[[int, np.random.Generator], Moves]] = {
    "nothing": lambda n, _: (_still(n), _still(n), None),
    "stiffness follows the force": levels,
    "a mass that moves": lambda n, rng: (-0.5 * (rng.uniform(size=n) - 0.5), _still(n), None),
    "a drift": lambda n, _: (0.5 * np.linspace(-0.5, 0.5, n), _still(n), None),
    "a step of temperature": steps,
    "mounted anew": lambda n, rng: (0.2 * rng.normal(size=n), 0.1 * rng.normal(size=n), None),
    "damping that scatters": lambda n, rng: (_still(n), 0.15 * rng.normal(size=n), None),
    "other positions": lambda n, rng: (0.1 * rng.standard_t(5, n), 0.05 * rng.normal(size=n), None),
    "one bad recording": one_bad,
    "mixed": mixed,
}


def drawn(kind: str, n: int, seed: int, hidden: float) -> FrequencyResponse:
    rng = np.random.default_rng([seed, n, list(KINDS).index(kind)])
    moved, damped, force = KINDS[kind](n, rng)
    std = NOISE * float(np.sqrt(np.mean(np.abs(mode(F_N, ZETA)) ** 2)))
    h = [
        mode(F_N * np.exp(ZETA * f), ZETA * np.exp(z)) + hidden * mode(101.2, 0.012)
        for f, z in zip(moved, damped, strict=True)
    ]
    noise = std * (rng.normal(size=(n, FREQUENCY.size)) + 1j * rng.normal(size=(n, FREQUENCY.size)))
    matrices = (np.array(h) + noise / np.sqrt(2))[:, :, None, None]
    mean = matrices.mean(axis=0)
    covariance = diagonal_covariance(np.full(mean.shape, std**2 / n))
    return replace(
        repeated(n, 0),
        matrix=mean,
        covariance=covariance,
        covariance_dof=float("inf"),
        repeats=matrices,
        repeat_levels=force,
    )


def counted(kind: str, hidden: float) -> tuple[str, str]:
    """Share held for every number of recordings, and mean width over noise and scatter alone."""
    shares, width = [], []
    for n in NUMBERS:
        held = []
        for seed in range(FIRST, FIRST + DRAWS):
            fit = fitted(drawn(kind, n, seed, hidden))
            for name, truth in (("f_n", F_N), ("zeta", ZETA)):
                p = fit.parameter(name)
                held.append(p.ci95[0] < truth < p.ci95[1])
                width.append(
                    np.sqrt(1 + p.interval.discrepancy**2 / (p.interval.noise**2 + p.interval.repeats**2))
                )
        shares.append(f"{100 * np.mean(held):.0f}")
    return " / ".join(shares), f"{np.exp(np.mean(np.log(width))):.2g}"


if __name__ == "__main__":
    for name in KINDS:
        plain, common = counted(name, 0.0), counted(name, 0.03)
        print(f"| {name} | {plain[0]} | {plain[1]} | {common[0]} | {common[1]} |", flush=True)
