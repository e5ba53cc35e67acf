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
from tempfile import TemporaryDirectory

import numpy as np
import pytest

from labpipe.errors import DataError
from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import FitSettings
from labpipe.project.ready_response import load_described
from labpipe.project.tests import ReadyFrf
from labpipe.records.frf_layout import FrfColumns, FrfLayout
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


def covers(fit: Fit, name: str, truth: dict[str, float] = TRUTH) -> bool:
    interval = fit.parameter(name).ci95
    return interval is not None and interval[0] <= truth[name] <= interval[1]


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


# Of a mode at 60 Hz, 2 kg and 40 N s/m: standard deviation of the response's noise along the lines, over .3
# of the median of |H|.
LINES = np.arange(25, 115.25, 0.5)
STIFF = {"k": 2.0 * (2 * np.pi * 60) ** 2, "c": 40.0}
KINDS: dict[str, Callable[[np.ndarray, np.ndarray], np.ndarray]] = {
    "even": lambda f, _h: np.ones(f.size),
    "even in the accelerance": lambda f, _h: np.ones(f.size),
    "falling": lambda f, _h: (f / 60) ** -3,
    "hum": lambda f, _h: 1 + 10 * np.exp(-(((f - 50) / 3) ** 2)),
    "growing": lambda _f, h: np.abs(h) / (10 * 0.3 * np.median(np.abs(h))),
}


def fit_of_table(folder: Path, kind: str, seed: int, averages: int) -> Fit:
    """ml of the table that an analyser writes of 16 averages: H1 and coherence of a random force; *averages*
    as the entry states them.
    """
    rng = np.random.default_rng([seed, len(kind)])
    s = 2j * np.pi * LINES
    form = "accelerance" if kind == "even in the accelerance" else "receptance"
    h = (s**2 if form == "accelerance" else 1) / (2.0 * s**2 + STIFF["c"] * s + STIFF["k"])
    force, noise = rng.normal(size=(2, 16, LINES.size, 2)) @ np.array([1, 1j]) / np.sqrt(2)
    motion = h * force + 0.3 * np.median(np.abs(h)) * KINDS[kind](LINES, h) * noise
    cross, of_force = np.mean(motion * force.conj(), axis=0), np.mean(np.abs(force) ** 2, axis=0)
    coherence = np.abs(cross) ** 2 / of_force / np.mean(np.abs(motion) ** 2, axis=0)
    h1 = cross / of_force
    path = folder / "h.txt"
    np.savetxt(path, np.column_stack([LINES, h1.real, h1.imag, coherence]))
    columns = FrfColumns(frequency="1", re="2", im="3", coherence="4")
    layout = FrfLayout(file="h.txt", columns=columns, form=form, averages=averages)
    entry = ReadyFrf((path,), layout, (("x",),), (("f",),))
    return identify(load_described(entry, layout, "", {}), FitSettings("sdof"))[0]


def off(fit: Fit) -> list[float]:
    """Errors of k and c over their standard errors [1]."""
    of_k, of_c = (fit.parameter(name) for name in STIFF)
    return [(p.value - STIFF[p.name]) / p.std_error for p in (of_k, of_c) if p.std_error]


def codes(fit: Fit) -> set[str]:
    return {finding.code for finding in fit.findings}


def test_unknown_noise_is_even_in_the_form_of_the_file(tmp_path: Path) -> None:
    """Noise of the acceleration, even along the lines, is 21 times as large in the receptance at 25 Hz as at
    115 Hz: of three right fits none looks wrong, and errors are of the size that is stated (mean of six
    squares: chi2 of 6 lies between .21 and 2.4 times 6 in 95 of 100).
    """
    fits = [fit_of_table(tmp_path, "even in the accelerance", seed, 0) for seed in range(3)]
    assert not any(codes(fit) & {"model-mismatch", "uneven-noise"} for fit in fits)
    assert 0.21 < np.mean(np.square([off(fit) for fit in fits])) < 2.4


def test_noise_that_falls_along_the_band_is_no_wrong_model(tmp_path: Path) -> None:
    """Noise 97 times as large at one end as at the other, and right fits."""
    fits = [fit_of_table(tmp_path, "falling", seed, 0) for seed in range(3)]
    assert all("uneven-noise" in codes(fit) and "model-mismatch" not in codes(fit) for fit in fits)
    assert all(covers(fit, name, STIFF) for fit in fits for name in STIFF)


def test_averages_and_coherence_tell_the_noise(tmp_path: Path) -> None:
    """Noise that grows with the response: nothing is wrong, and errors are of the stated size."""
    fits = [fit_of_table(tmp_path, "growing", seed, 16) for seed in range(8)]
    assert not any(codes(fit) for fit in fits)
    assert 0.43 < np.mean(np.square([off(fit) for fit in fits])) < 1.8
    assert all(0.6 < (fit.gof.chi2_reduced or 0) < 1.4 for fit in fits)


@pytest.mark.parametrize(
    ("first", "second", "fault"),
    [
        ("", "", "holds no coherence"),
        (" 0.5", " 0", "holds a coherence of zero"),
        (" 1", " 1", "holds a coherence of 1 at all lines"),
    ],
)
def test_averages_need_a_coherence(tmp_path: Path, first: str, second: str, fault: str) -> None:
    path = tmp_path / "h.txt"
    path.write_text(f"1 2 3{first}\n2 2 3{second}\n")
    columns = FrfColumns(frequency="1", re="2", im="3", coherence="4" if first else "")
    layout = FrfLayout(file="h.txt", columns=columns, form="receptance", averages=5)
    with pytest.raises(DataError, match=rf"h\.txt.*{fault}"):
        load_described(ReadyFrf((path,), layout, (("x",),), (("f",),)), layout, "", {})


def test_a_second_mode_on_three_lines_is_no_noise() -> None:
    """With three lines in a half-power width, noise that grows with the response would explain what a second
    mode leaves, and its intervals held the damping in none of 60 fits.
    """
    f = np.arange(F0 - 4 * WIDTH, F0 + 4 * WIDTH, WIDTH / 3)
    for seed in range(3):
        rng = np.random.default_rng([seed, 4])
        h = mode_too_few(f, 4, rng)
        noise = rng.normal(size=(f.size, 2)) @ np.array([1, 1j]) / np.sqrt(2)
        h = h + 0.01 * np.sqrt(np.mean(np.abs(h) ** 2)) * noise
        ports = (Port("y", "y", "y"),), (Port("f", "f", "y"),)
        fit = identify(FrequencyResponse(f, h[:, None, None], *ports), FitSettings("sdof"))[0]
        assert "model-mismatch" in codes(fit)
        assert covers(fit, "zeta")


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
    with TemporaryDirectory() as name:
        for kind in KINDS:
            for stated in (16, 0):
                tables = [fit_of_table(Path(name), kind, seed, stated) for seed in range(40)]
                scatter = " ".join(f"{size:.2f}" for size in np.std([off(fit) for fit in tables], axis=0))
                wrong = sum("model-mismatch" in codes(fit) for fit in tables)
                held = sum(covers(fit, name, STIFF) for fit in tables for name in STIFF)
                print(
                    kind, stated, "scatter of k, c", scatter, "model-mismatch", wrong, "held", held, "of 80"
                )
