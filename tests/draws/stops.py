"""Tests that stop by themselves, drawn anew: how often the interval at the stop holds, how long they take.

`python -m tests.draws.stops 1000 [RIG ...] [--seed N]` prints a row for each rig and length of test,
`--faults` one for each fault of a test of some 20 averages. Raw samples go through the bench of `labpipe
live`. The oracle knows the noise: with the error e of a coefficient at the stop after n averages it stops at
n* = mean(n e^2) (1.96 / goal)^2.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import count, islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from labpipe.arrays import ComplexArray, FloatArray
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


@dataclass(frozen=True)
class Fault:
    """What goes wrong in average *number* from 1: the *stiffness* over the sound one, and what becomes of its
    *motion* (rng, number, clean motion (n,) [m], usual peak [m]).
    """

    stiffness: Callable[[int], float] = lambda number: 1.0
    motion: Callable[[np.random.Generator, int, FloatArray, float], FloatArray] = lambda rng, n, x, peak: x


SOUND = Fault()
Samples = Callable[[np.random.Generator, float, Fault], Iterator[FloatArray]]


@dataclass(frozen=True)
class Rig:
    """A rig whose averages are drawn: *samples* (rng, level of noise, fault) -> one average (n, n_channel)
    [N, m] after another; *settings* of its FRF; *wanted*: the coefficient whose width is asked for.
    """

    settings: FrfSettings
    samples: Samples
    fit: FitSettings = FitSettings("sdof", band=(FIRST, LAST), name="s")
    channels: tuple[Channel, ...] = (
        Channel("f", "force", "input", "y"),
        Channel("y", "displacement", "output", "y"),
    )
    wanted: str = "c"
    truth: float = DAMPING


def receptance(frequency: FloatArray, stiffness: float = STIFFNESS) -> FloatArray:
    """H(f) of the rig, (n,) [m/N]."""
    w = 2 * np.pi * frequency
    return np.asarray(1 / (stiffness + 1j * w * DAMPING - w**2 * MASS))


def multisine(rng: np.random.Generator, frequency: FloatArray, lines: NDArray[np.bool_]) -> ComplexArray:
    """Spectrum (n_line,) [N samples / 2] of unit amplitudes with random phases."""
    phases = np.exp(2j * np.pi * rng.random(frequency.size))
    return np.asarray(np.where(lines, phases, 0) * (frequency.size - 1))


def periods(rng: np.random.Generator, noise: float, fault: Fault) -> Iterator[FloatArray]:
    """Periods of 6 s of a multisine over the band, white noise on both channels."""
    n = int(6 * RATE)
    frequency = np.fft.rfftfreq(n, 1 / RATE)
    lines = (frequency >= FIRST) & (frequency <= LAST)
    spectrum = multisine(rng, frequency, lines)
    force = np.fft.irfft(spectrum, n)
    size = noise * np.sqrt(n) / 2 * np.sqrt(np.mean(np.abs(receptance(frequency[lines])) ** 2))
    usual = 0.0
    for number in count(1):
        stiffness = STIFFNESS * fault.stiffness(number)
        motion = np.fft.irfft(spectrum * receptance(np.maximum(frequency, 0.1), stiffness), n)
        usual = usual or float(np.max(np.abs(motion)))
        x = fault.motion(rng, number, motion, usual) + size * rng.standard_normal(n)
        yield np.stack([force + 0.02 * noise * np.sqrt(n) * rng.standard_normal(n), x], axis=1)


def hits(rng: np.random.Generator, noise: float, fault: Fault) -> Iterator[FloatArray]:
    """Hits of 6 s whose level scatters by 30 %, noise on the response; motion dies away within a block."""
    n = int(6 * RATE)
    frequency = np.fft.rfftfreq(n, 1 / RATE)
    push = np.zeros(n)
    push[int(0.02 * n) : int(0.02 * n) + 4] = [0.5, 1.0, 1.0, 0.5]
    usual = 0.0
    for number in count(1):
        stiffness = STIFFNESS * fault.stiffness(number)
        motion = np.fft.irfft(np.fft.rfft(push) * receptance(frequency, stiffness), n)
        usual = usual or float(np.max(np.abs(motion)))
        level = np.exp(0.3 * rng.standard_normal())
        force = level * push + 1e-4 * rng.standard_normal(n)
        x = fault.motion(rng, number, level * motion, usual) + noise * usual * rng.standard_normal(n)
        yield np.stack([force, x], axis=1)


ROTOR_K = STIFFNESS * np.array([[1.0, 0.05], [-0.04, 0.92]])
ROTOR_C = DAMPING * np.array([[1.5, 0.2], [-0.1, 1.2]])


def shaken_both_ways(rng: np.random.Generator, noise: float, _fault: Fault) -> Iterator[FloatArray]:
    """Periods of 6 s of a rotor in two axes, shaken in x and y by turns, white noise on all channels."""
    n = int(6 * RATE)
    frequency = np.fft.rfftfreq(n, 1 / RATE)
    lines = (frequency >= FIRST - 5) & (frequency <= LAST + 5)
    w = 2 * np.pi * np.maximum(frequency, 0.1)[:, None, None]
    matrix = np.linalg.inv(ROTOR_K + 1j * w * ROTOR_C - w**2 * MASS * np.eye(2))
    spectrum = multisine(rng, frequency, lines)
    size = noise * np.sqrt(n) / 2 * np.sqrt(np.mean(np.abs(matrix[lines]) ** 2))
    scales = np.array([*(2 * [0.02 * noise * np.sqrt(n)]), size, size])
    clean = []
    for direction in range(2):
        force = spectrum[:, None] * np.eye(2)[direction]
        both = np.concatenate([force, (matrix @ force[..., None])[..., 0]], axis=1)
        clean.append(np.fft.irfft(both, n, axis=0))
    for number in count():
        yield clean[number % 2] + scales * rng.standard_normal((n, 4))


def decays(rng: np.random.Generator, noise: float, _fault: Fault) -> Iterator[FloatArray]:
    """Decays of 6 s from releases whose size scatters by 30 %, noise on the response."""
    t = np.arange(int(6 * RATE)) / RATE
    pole = 2 * np.pi * NATURAL * (-ZETA + 1j * np.sqrt(1 - ZETA**2))
    while True:
        release = 1e-4 * np.exp(0.3 * rng.standard_normal() + 2j * np.pi * rng.random())
        motion = (release * np.exp(pole * t)).real
        yield (motion + noise * 1e-4 * rng.standard_normal(t.size))[:, None]


def blocks(rng: np.random.Generator, noise: float, _fault: Fault) -> Iterator[FloatArray]:
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


@dataclass(frozen=True)
class Stop:
    """A test that ended after *n* averages: its error over the half-width, and over what was asked for;
    whether the forecast halfway held; whether a fault was *there*, and *named*; whether the goals were
    reached.
    """

    n: int
    error: float
    of_goal: float
    forecast: bool
    there: bool
    named: bool
    reached: bool


def one_test(
    rig: Rig, rng: np.random.Generator, noise: float, goal: float, fault: Fault = SOUND, most: int = 400
) -> Stop:
    """A test that is drawn until its goal is reached, or for the *most* averages; AssertionError for one that
    does not get there by twice as many.
    """
    whole = rig.settings.excitation in ("random", "decay") or rig.fit.kind.equations is None
    followed = WholeFits if whole else Bench
    name = f"{rig.fit.name}.{rig.wanted}"
    goals = [Goal.of(f"{name}.expanded<={100 * goal:g}%")]
    bench = followed(rig.channels, RATE, rig.settings, [rig.fit], goals)
    there = []

    def motion(rng: np.random.Generator, number: int, clean: FloatArray, peak: float) -> FloatArray:
        spoilt = fault.motion(rng, number, clean, peak)
        there.append(fault.stiffness(number) != 1 or not np.array_equal(spoilt, clean))
        return spoilt

    for samples in islice(rig.samples(rng, noise, replace(fault, motion=motion)), 2 * most):
        if rig.settings.excitation == "decay":
            bench.restart()
        for update in bench.add(samples):
            # Averages that are left out end no test.
            if not update.stop and max(len(bench.updates), update.averages) < most:
                continue
            standing = update.standings[name]
            error = standing.parameter.value - rig.truth
            halfway = bench.updates[len(bench.updates) // 2 - 1].standings.get(name)
            left = None if halfway is None else halfway.remaining
            held = left is not None and (left.low or 0) <= update.averages <= (left.high or np.inf)
            said = {finding.code for finding in update.findings}
            left_out = any("left out" in event for earlier in bench.updates for event in earlier.events)
            named = left_out or bool(said & {"changes", "bad-averages", "level-dependent"})
            of_goal = error / (goal * rig.truth)
            if isinstance(bench, WholeFits):
                bench.close()
            return Stop(update.averages, error / standing.half, of_goal, held, any(there), named, update.stop)
    raise AssertionError(f"no end after {2 * most} averages: {bench.updates[-1].findings}")


def band(first: float, last: float, excitation: str, **keys: Any) -> FrfSettings:
    return FrfSettings(excitation, band=(first, last), **keys)


RIGS = {
    "periods": Rig(band(50, 80, "periodic", period=6.0, skip=0), periods),
    "hits": Rig(band(50, 80, "impact", block=6.0, impact=ImpactSettings(trigger=0.2)), hits),
    "rotor": Rig(
        band(50, 80, "periodic", period=6.0, skip=0),
        shaken_both_ways,
        FitSettings("rotor-2dof", band=(FIRST - 5, LAST + 5), name="r", mass=float(MASS)),
        (
            *(Channel(f"f{axis}", "force", "input", axis) for axis in "xy"),
            *(Channel(axis, "displacement", "output", axis) for axis in "xy"),
        ),
        "c_xx",
        float(ROTOR_C[0, 0]),
    ),
    "blocks": Rig(band(50, 80, "random", block=8.0), blocks),
    "decays": Rig(
        FrfSettings("decay"),
        decays,
        FitSettings("decay", name="d"),
        (Channel("y", "displacement", "output", "y"),),
        "zeta_1",
        ZETA,
    ),
    "modal": Rig(
        band(50, 80, "impact", block=6.0, impact=ImpactSettings(trigger=0.2)),
        hits,
        FitSettings("modal", band=(55, 75), name="m", repeats="pool"),
        wanted="zeta_1",
        truth=ZETA,
    ),
}
GOALS = {
    "periods": ((0.4, 0.05), (0.4, 0.03), (0.4, 0.02)),
    "hits": ((0.4, 0.05), (0.4, 0.03), (0.4, 0.02)),
    "rotor": ((0.4, 0.09), (0.4, 0.062)),
    "blocks": ((0.1, 0.012), (0.1, 0.008), (0.1, 0.006)),
    "decays": ((0.1, 0.015),),
    "modal": ((0.4, 0.05),),
}


def moving(size: float) -> Fault:
    """The stiffness moves by *size* [1] over ten averages, from the tenth on."""
    return Fault(stiffness=lambda number: 1 + size * float(np.clip((number - 10) / 10, 0, 1)))


def wrong(share: float, size: float, first: int = 1) -> Fault:
    """From average *first* on a *share* [1] of them has a response that is wrong by *size* [1]."""
    return Fault(motion=lambda rng, number, x, _: x * (1 + size * (number >= first and rng.random() < share)))


def saturating(level: float) -> Fault:
    """The response saturates softly at *level* times the usual peak."""
    return Fault(motion=lambda _rng, _number, x, peak: level * peak * np.tanh(x / (level * peak)))


FAULTS = {
    "none": SOUND,
    **{f"stiffness drifts by {100 * size:g} %": moving(size) for size in (0.0005, 0.001, 0.002, 0.005)},
    **{f"1 in 10 wrong by {100 * size:g} %": wrong(0.1, size) for size in (0.05, 0.2)},
    "loose: from 10 on 1 in 5 loses half": wrong(0.2, -0.5, 10),
    **{f"saturates softly at {level:g}": saturating(level) for level in (1.0, 1.5)},
}
# Goals that take some 20 averages; a test without a fault is looked at for 50.
FAULTY_NOISE, FAULTY_GOALS = 0.03, {"periods": 0.0017, "hits": 0.0022}


def drawn(
    options: argparse.Namespace, kind: str, noise: float, goal: float, times: int = 1, **keys: Any
) -> list[Stop]:
    return [
        one_test(RIGS[kind], np.random.default_rng([options.seed, number]), noise, goal, **keys)
        for number in range(times * options.tests)
    ]


def faulty(options: argparse.Namespace) -> None:
    """Print the table of faults."""
    print("| rig | fault | tests that held it | named of these | silent and wrong | averages |")
    print("|---|---|---|---|---|---|")
    for kind in options.rigs or FAULTY_GOALS:
        for name, fault in FAULTS.items():
            if options.only not in name:
                continue
            goal, most, times = (1e-5, 50, 3) if fault is SOUND else (FAULTY_GOALS[kind], 40, 1)
            stops = drawn(options, kind, FAULTY_NOISE, goal, times, fault=fault, most=most)
            held = [stop.named for stop in stops if stop.there or fault is SOUND]
            silent = np.mean([stop.reached and not stop.named and abs(stop.of_goal) > 1 for stop in stops])
            length = np.mean([stop.n for stop in stops])
            print(
                f"| {kind} | {name} | {len(held)} of {len(stops)} | {100 * np.mean(held):.1f} % | "
                f"{100 * silent:.1f} % | {length:.1f} |",
                flush=True,
            )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("tests", type=int, nargs="?", default=200)
    parser.add_argument("rigs", nargs="*")
    parser.add_argument("--seed", type=int, default=20261125)
    parser.add_argument("--faults", action="store_true")
    parser.add_argument("--only", default="", help="faults with this in their name")
    parser.add_argument("--goal", type=float, help="only this one [1]")
    options = parser.parse_args()
    if options.faults:
        faulty(options)
        return
    print("| rig | noise, goal | coverage | reached | averages: mean, sd | of the oracle's | forecast |")
    print("|---|---|---|---|---|---|---|")
    for kind in options.rigs or RIGS:
        for noise, goal in GOALS[kind]:
            if options.goal not in (None, goal):
                continue
            stops = drawn(options, kind, noise, goal)
            held = np.mean([abs(stop.error) <= 1 for stop in stops])
            reached = np.mean([abs(stop.of_goal) <= 1 for stop in stops])
            n, of_goal = (np.array([getattr(stop, name) for stop in stops]) for name in ("n", "of_goal"))
            oracle = 1.96**2 * np.mean(n * of_goal**2)
            foreseen = np.mean([stop.forecast for stop in stops])
            print(
                f"| {kind} | {noise}, {100 * goal:g} % | {100 * held:.1f} % | {100 * reached:.1f} % | "
                f"{n.mean():.1f}, {n.std():.1f} | {n.mean() / oracle:.2f} | {100 * foreseen:.0f} % |",
                flush=True,
            )


if __name__ == "__main__":
    main()
