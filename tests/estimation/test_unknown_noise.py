"""Fits of FRFs whose noise is not known: how often a warning comes with a fault and without, and what its
intervals are worth.

One mode (40 Hz, 1 %, 1 kg) in bands of four and of eight half-power widths either way, ten lines in each,
noise of 1 % of the response's root mean square. Truth and faults are closed forms, the noise is drawn here;
the table of the statistics page is held to what is counted.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import FitSettings
from labpipe.records.identification import Fit
from labpipe.records.response import FrequencyResponse, Port
from labpipe.spectra.windows import amplitude_correlation

PAGE = Path(__file__).parents[2] / "docs/pages/statistics.md"
F0, ZETA = 40.0, 0.01
WIDTH = 2 * ZETA * F0
TRUTH = {"f_n": F0, "zeta": ZETA, "k": (2 * np.pi * F0) ** 2, "m": 1.0}
HALVES = (4, 8)
EVERY = 200
# Every how many of them the suite repeats.
SOUND_STEP, FAULTY_STEP = 3, 25


def mode(f: np.ndarray, natural: float, amount: float) -> np.ndarray:
    w, w0 = 2 * np.pi * f, 2 * np.pi * natural
    return amount / (w0**2 - w**2 + 2j * ZETA * w0 * w)


Fault = Callable[[np.ndarray, int, np.random.Generator], np.ndarray]


def right(f: np.ndarray, _half: int, _rng: np.random.Generator) -> np.ndarray:
    return mode(f, F0, 1.0)


def mode_too_few(f: np.ndarray, _half: int, rng: np.random.Generator) -> np.ndarray:
    """Another mode .4 to 1 half-power width away, .3 to 1 as strong."""
    return mode(f, F0, 1.0) + mode(
        f, F0 + rng.choice([-1, 1]) * rng.uniform(0.4, 1.0) * WIDTH, rng.uniform(0.3, 1.0)
    )


def neighbour(f: np.ndarray, half: int, rng: np.random.Generator) -> np.ndarray:
    """As strong a mode .5 to 3 Hz beside the band, on either side."""
    return mode(f, F0, 1.0) + mode(f, F0 + rng.choice([-1, 1]) * (half * WIDTH + rng.uniform(0.5, 3.0)), 1.0)


def random_gain(f: np.ndarray, _half: int, rng: np.random.Generator) -> np.ndarray:
    return mode(f, F0, 1.0) * (1 + 0.03 * rng.normal(size=f.size))


def step_of_gain(f: np.ndarray, _half: int, rng: np.random.Generator) -> np.ndarray:
    return mode(f, F0, 1.0) * np.where(f > F0 + rng.uniform(-0.5, 0.5) * WIDTH, 1.03, 1.0)


@dataclass(frozen=True)
class Case:
    """What is measured, in words; True where a warning is right; *hann*: noise as a Hann window leaves it,
    which is known.
    """

    name: str
    fault: Fault
    faulty: bool = True
    hann: bool = False


CASES = (
    Case("right", right, False),
    Case("right, Hann window known", right, False, True),
    Case("one mode too few", mode_too_few),
    Case("mode 0.5-3 Hz beside the band", neighbour),
    Case("3 % random gain per line", random_gain),
    Case("3 % step of gain", step_of_gain),
)


def fitted(case: Case, half: int, seed: int) -> Fit:
    rng = np.random.default_rng([seed, half])
    f = np.arange(F0 - half * WIDTH, F0 + half * WIDTH, WIDTH / 10)
    h = case.fault(f, half, rng)
    noise = rng.normal(size=(f.size + 2, 2)) @ np.array([1, 1j]) / np.sqrt(2)
    # The Hann window's convolution of the spectrum, to unit variance again.
    noise = (noise[1:-1] - (noise[2:] + noise[:-2]) / 2) / np.sqrt(1.5) if case.hann else noise[1:-1]
    h = h + 0.01 * np.sqrt(np.mean(np.abs(h) ** 2)) * noise
    response = FrequencyResponse(f, h[:, None, None], (Port("y", "y", "y"),), (Port("f", "f", "y"),))
    shared = amplitude_correlation("hann") if case.hann else ()
    return identify(replace(response, line_correlation=shared), FitSettings("sdof"))[0]


@dataclass(frozen=True)
class Counted:
    """Share of fits warned, share without interval, and coverage of f_n and zeta where there is one [1], nan
    without any.
    """

    warned: float
    refused: float
    covered: tuple[float, float]


def counted(case: Case, half: int, seeds: range) -> Counted:
    fits = [fitted(case, half, seed) for seed in seeds]
    warned = np.mean(["model-mismatch" in {finding.code for finding in fit.findings} for fit in fits])
    given = [fit for fit in fits if fit.parameters[0].ci95 is not None]
    covered = tuple(
        float(np.mean([covers(fit, name) for fit in given])) if given else np.nan for name in ("f_n", "zeta")
    )
    return Counted(float(warned), 1 - len(given) / len(fits), covered)


def covers(fit: Fit, name: str) -> bool:
    interval = fit.parameter(name).ci95
    return interval is not None and interval[0] <= TRUTH[name] <= interval[1]


def on_page() -> dict[tuple[str, int], float]:
    """(fault, half-power widths) -> share warned [1] of the statistics page."""
    rows = re.findall(r"^\| (.+?) \| (\d) \| ([\d.]+) % \|", PAGE.read_text("utf-8"), re.MULTILINE)
    return {(name, int(half)): float(share) / 100 for name, half, share in rows}


@pytest.mark.long
@pytest.mark.parametrize(
    ("case", "half"),
    [
        pytest.param(case, half, id=f"{case.name}-{half}")
        for case in CASES
        for half in (HALVES[:1] if case.faulty else HALVES)
    ],
)
def test_a_fault_is_warned_of_and_a_right_fit_is_not(case: Case, half: int) -> None:
    """Every third of 200 right fits, at most 5 % warned (6 % with the window), intervals less than three
    binomial deviations below 95 %: .4 % by chance, seen in 93 of 100 where 80 % hold.

    Every 25th faulty one, all warned of: at a rate of 75 % once in ten.
    """
    seeds = range(0, EVERY, FAULTY_STEP if case.faulty else SOUND_STEP)
    found = counted(case, half, seeds)
    if case.faulty:
        assert found.warned >= 0.95
    else:
        assert found.warned <= (0.06 if case.hann else 0.05)
        assert all(share >= 0.95 - 3 * np.sqrt(0.0475 / len(seeds)) for share in found.covered)
    if case.fault is neighbour:
        assert min(found.covered) >= 0.93
    # A share of n fits lies within three standard errors of that of all.
    expected = on_page()[case.name, half]
    assert abs(found.warned - expected) <= 3 * np.sqrt(max(expected * (1 - expected), 0.01) / len(seeds))


def test_the_page_has_every_case() -> None:
    assert set(on_page()) == {(case.name, half) for case in CASES for half in HALVES}


if __name__ == "__main__":
    for row in CASES:
        for width in HALVES:
            of_all = counted(row, width, range(EVERY))
            shares = " | ".join(f"{100 * share:.1f} %" for share in (of_all.warned, of_all.refused))
            intervals = ", ".join(
                "none" if np.isnan(share) else f"{100 * share:.0f} %" for share in of_all.covered
            )
            print(f"| {row.name} | {width} | {shares} | {intervals} |", flush=True)
