"""Tests that stop by themselves, drawn anew: how often the interval at the stop holds, how long they take.

`python -m tests.draws.stops 1000 [RIG ...] [--seed N]` prints a row for each rig and length of test. Raw
samples go through the bench of `labpipe live`. The oracle knows the noise: with the error e of a coefficient
at the stop after n averages it stops at n* = mean(n e^2) (1.96 / goal)^2.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.estimation.settings import FitSettings
from labpipe.methods.live.bench import Bench
from labpipe.methods.live.charts import Goal
from labpipe.methods.live.session import WholeFits
from labpipe.records.recording import Channel
from labpipe.spectra.settings import FrfSettings, ImpactSettings

RATE, STIFFNESS, NATURAL, ZETA = 500.0, 2e7, 65.0, 0.006
MASS = STIFFNESS / (2 * np.pi * NATURAL) ** 2
DAMPING = 2 * ZETA * np.sqrt(STIFFNESS * MASS)
TRUTH = {"k": STIFFNESS, "c": DAMPING, "m": MASS}
FIRST, LAST = 60.0, 70.0


def channels() -> tuple[Channel, Channel]:
    """A force and a displacement of one point."""
    return Channel("f", "force", "input", "y"), Channel("y", "displacement", "output", "y")


@dataclass(frozen=True)
class Rig:
    """A rig whose averages are drawn: *samples* (rng, level of noise) -> one average (n, 2) [N, m] after
    another; *settings* of its FRF.
    """

    settings: FrfSettings
    samples: Callable[[np.random.Generator, float], Iterator[FloatArray]]


def receptance(frequency: FloatArray) -> FloatArray:
    """H(f) of the rig, (n,) [m/N]."""
    w = 2 * np.pi * frequency
    return np.asarray(1 / (STIFFNESS + 1j * w * DAMPING - w**2 * MASS))


def periods(rng: np.random.Generator, noise: float) -> Iterator[FloatArray]:
    """Periods of 6 s of a multisine over the band, white noise on both channels."""
    n = int(6 * RATE)
    frequency = np.fft.rfftfreq(n, 1 / RATE)
    lines = (frequency >= FIRST) & (frequency <= LAST)
    spectrum = np.where(lines, np.exp(2j * np.pi * rng.random(frequency.size)), 0) * n / 2
    force, motion = (
        np.fft.irfft(spectrum, n),
        np.fft.irfft(spectrum * receptance(np.maximum(frequency, 0.1)), n),
    )
    size = noise * np.sqrt(n) / 2 * np.sqrt(np.mean(np.abs(receptance(frequency[lines])) ** 2))
    while True:
        x = motion + size * rng.standard_normal(n)
        yield np.stack([force + 0.02 * noise * np.sqrt(n) * rng.standard_normal(n), x], axis=1)


def hits(rng: np.random.Generator, noise: float) -> Iterator[FloatArray]:
    """Hits of 6 s whose level scatters by 30 %, noise on the response; motion dies away within a block."""
    n = int(6 * RATE)
    frequency = np.fft.rfftfreq(n, 1 / RATE)
    push = np.zeros(n)
    push[int(0.02 * n) : int(0.02 * n) + 4] = [0.5, 1.0, 1.0, 0.5]
    motion = np.fft.irfft(np.fft.rfft(push) * receptance(frequency), n)
    size = noise * np.max(np.abs(motion))
    while True:
        level = np.exp(0.3 * rng.standard_normal())
        force = level * push + 1e-4 * rng.standard_normal(n)
        yield np.stack([force, level * motion + size * rng.standard_normal(n)], axis=1)


def blocks(rng: np.random.Generator, noise: float) -> Iterator[FloatArray]:
    """A random force from 5 to 200 Hz in pieces of 4 s, half a block each, noise on the response; an hour of
    it.
    """
    n, piece = int(3600 * RATE), int(4 * RATE)
    frequency = np.fft.rfftfreq(n, 1 / RATE)
    spectrum = np.fft.rfft(rng.standard_normal(n)) * ((frequency >= 5) & (frequency <= 200))
    force, motion = np.fft.irfft(spectrum, n), np.fft.irfft(spectrum * receptance(frequency), n)
    motion = motion + noise * np.std(motion) * rng.standard_normal(n)
    for start in range(0, n, piece):
        yield np.stack([force[start : start + piece], motion[start : start + piece]], axis=1)


def one_test(
    rig: Rig, rng: np.random.Generator, noise: float, goal: float, name: str
) -> tuple[int, float, float]:
    """(averages at the stop, error of *name* over its half-width, error over what was asked for)."""
    fit = FitSettings("sdof", band=(FIRST, LAST), name="s")
    followed = WholeFits if rig.settings.excitation == "random" else Bench
    bench = followed(channels(), RATE, rig.settings, [fit], [Goal.of(f"s.{name}.expanded<={100 * goal:g}%")])
    for samples in rig.samples(rng, noise):
        for update in bench.add(samples):
            if update.stop or update.averages >= 400:
                standing = update.standings[f"s.{name}"]
                error = standing.parameter.value - TRUTH[name]
                return update.averages, error / standing.half, error / (goal * TRUTH[name])
    raise AssertionError("the samples do not end")


RIGS = {
    "periods": Rig(FrfSettings("periodic", period=6.0, skip=0, band=(50.0, 80.0)), periods),
    "hits": Rig(
        FrfSettings("impact", block=6.0, band=(50.0, 80.0), impact=ImpactSettings(trigger=0.2)), hits
    ),
    "blocks": Rig(FrfSettings("random", block=8.0, band=(50.0, 80.0)), blocks),
}
GOALS = {
    "periods": ((0.4, 0.05), (0.4, 0.03), (0.4, 0.02)),
    "hits": ((0.4, 0.05), (0.4, 0.03), (0.4, 0.02)),
    "blocks": ((0.1, 0.012), (0.1, 0.008), (0.1, 0.006)),
}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("tests", type=int, nargs="?", default=200)
    parser.add_argument("rigs", nargs="*", default=list(RIGS))
    parser.add_argument("--seed", type=int, default=20261125)
    options = parser.parse_args()
    print("| rig | noise, goal | coverage | reached | averages: mean, sd | of the oracle's |")
    print("|---|---|---|---|---|---|")
    for kind in options.rigs:
        for noise, goal in GOALS[kind]:
            stops = np.array(
                [
                    one_test(RIGS[kind], np.random.default_rng([options.seed, number]), noise, goal, "c")
                    for number in range(options.tests)
                ]
            )
            held, reached = (np.mean(np.abs(stops[:, column]) <= 1) for column in (1, 2))
            oracle = 1.96**2 * np.mean(stops[:, 0] * stops[:, 2] ** 2)
            print(
                f"| {kind} | {noise}, {100 * goal:g} % | {100 * held:.1f} % | {100 * reached:.1f} % | "
                f"{stops[:, 0].mean():.1f}, {stops[:, 0].std():.1f} | {stops[:, 0].mean() / oracle:.2f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
