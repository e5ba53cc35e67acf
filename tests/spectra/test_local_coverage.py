"""White noise on a lightly damped simulated oscillator: local polynomials beside Hann windows on the same
records.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal

from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import FitSettings
from labpipe.records.recording import Channel, Recording
from labpipe.spectra.measurement import measure
from labpipe.spectra.settings import FrfSettings

RATE, F_N, ZETA = 1024.0, 60.0, 0.005
W_N = 2 * np.pi * F_N
TRUTH = np.array([W_N**2, 2 * ZETA * W_N])
CHANNELS = (Channel("f", "force", "input", "x", 0.0), Channel("x", "displacement", "output", "x", 0.0))
LOCAL = {"local": "polynomial", "degree": 4}


def displacement(force: np.ndarray) -> np.ndarray:
    """Response of a mass of 1 kg: the sampled impulse response, less what sampling adds to its receptance, a
    + b w^2 in the band.
    """
    pole = -ZETA * W_N + 1j * W_N * np.sqrt(1 - ZETA**2)
    z = np.exp(pole / RATE)
    system = [0.0, float(z.imag) / (pole.imag * RATE)], [1.0, -2 * float(z.real), float(abs(z) ** 2)]
    frequency = np.linspace(50, 70, 9)
    w = 2 * np.pi * frequency
    excess = signal.freqz(*system, worN=frequency, fs=RATE)[1] - 1 / (W_N**2 - w**2 + 2j * ZETA * W_N * w)
    slope, level = np.polyfit(w**2, excess.real, 1)
    return (
        signal.lfilter(*system, force)
        - level * force
        + slope * np.convolve(force, [1.0, -2.0, 1.0], "same") * RATE**2
    )


def record(seed: int, lines: float, n_block: int) -> tuple[Recording, float]:
    """Blocks with *lines* in the half-power width, 1 % of noise; and the length of a block [s]."""
    rng = np.random.default_rng([31, seed])
    n, before = round(lines / (2 * ZETA * F_N) * RATE), int(8 / (ZETA * W_N) * RATE)
    force = rng.normal(size=before + n * n_block)
    x = displacement(force)[before:]
    return Recording(
        CHANNELS,
        np.column_stack([force[before:], x + 0.01 * x.std() * rng.normal(size=x.size)]),
        RATE,
        "noise",
    ), n / RATE


def fits(
    method: dict[str, object], lines: float, n_block: int, draws: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Errors and standard errors of k and c relative to the truth, (draw, 2), and whether the intervals hold
    it.
    """
    errors, sizes, holds = [], [], []
    for seed in range(draws):
        recording, block = record(seed, lines, n_block)
        (fit,) = identify(
            measure([recording], FrfSettings("random", block=block, band=(45.0, 75.0), **method)),
            FitSettings("sdof", mass=1.0, band=(52.0, 68.0)),
        )
        found = [fit.parameter(name) for name in ("k", "c")]
        errors.append([p.value / true - 1 for p, true in zip(found, TRUTH, strict=True)])
        sizes.append([p.std_error / true for p, true in zip(found, TRUTH, strict=True)])
        holds.append([p.ci95[0] < true < p.ci95[1] for p, true in zip(found, TRUTH, strict=True)])
    return np.array(errors), np.array(sizes), np.array(holds)


def test_there_is_far_less_leakage_than_with_a_window() -> None:
    """4 blocks of 8 lines in the half-power width: error of the FRF within three such widths of the peak,
    over 6 records.
    """
    squares = {"hann": 0.0, "local": 0.0}
    for seed in range(6):
        recording, block = record(seed, 8.0, 4)
        for name, method in (("hann", {}), ("local", LOCAL)):
            response = measure([recording], FrfSettings("random", block=block, band=(58.0, 62.0), **method))
            w = 2 * np.pi * response.frequency
            exact = 1 / (W_N**2 - w**2 + 2j * ZETA * W_N * w)
            near = np.abs(response.frequency - F_N) < 6 * ZETA * F_N
            squares[name] += float(np.mean(np.abs(response.matrix[near, 0, 0] / exact[near] - 1) ** 2))
    assert squares["local"] < squares["hann"] / 4


@pytest.mark.parametrize(
    ("estimator", "degree", "lines", "warned"),
    [
        ("ls", 2, 12.0, True),
        ("ls", 4, 6.0, True),
        ("ls", 2, 18.0, False),
        ("ls", 4, 9.0, False),
        ("ml", 2, 2.0, True),
        ("ml", 4, 2.0, True),
        ("ml", 2, 4.0, False),
        ("ml", 4, 4.0, False),
    ],
)
def test_a_peak_too_narrow_for_the_polynomials_is_warned_of(
    estimator: str, degree: int, lines: float, warned: bool
) -> None:
    """30 lines over the degree, or 3 where the model is smeared as the polynomials smear the FRF."""
    recording, block = record(1, lines, 6)
    response = measure(
        [recording], FrfSettings("random", block=block, band=(45.0, 75.0), local="polynomial", degree=degree)
    )
    (fit,) = identify(response, FitSettings("sdof", estimator=estimator, mass=1.0, band=(52.0, 68.0)))
    messages = [f.message for f in fit.findings if f.code == "leakage"]
    assert bool(messages) == warned and all(
        "do not follow its peak; use blocks of at least" in message for message in messages
    )


@pytest.mark.long
@pytest.mark.parametrize(("lines", "n_block", "draws"), [(8.0, 4, 40)])
def test_intervals_are_narrower_and_hold_the_truth(lines: float, n_block: int, draws: int) -> None:
    errors, sizes, holds = fits(LOCAL, lines, n_block, draws)
    hann_errors, hann_sizes, _ = fits({}, lines, n_block, draws)
    assert np.all(holds.mean(axis=0) > 0.95 - 3 * np.sqrt(0.05 * 0.95 / draws))
    assert np.all(np.sqrt(np.mean(errors**2, axis=0)) < 0.5 * np.sqrt(np.mean(hann_errors**2, axis=0)))
    # The intervals are on the safe side, by no more than two fifths.
    ratio = np.sqrt(np.mean(errors**2, axis=0) / np.mean(sizes**2, axis=0))
    assert np.all(ratio < 1.0 + 3 / np.sqrt(2 * draws)) and np.all(ratio > 0.7 - 3 / np.sqrt(2 * draws))
    assert np.all(sizes.mean(axis=0) < hann_sizes.mean(axis=0) / 2)


@pytest.mark.long
@pytest.mark.parametrize(("degree", "lines", "n_block"), [(2, 4.0, 8), (4, 4.0, 8), (2, 2.0, 16)])
def test_peaks_that_no_polynomial_follows_are_held_by_models_smeared_alike(
    degree: int, lines: float, n_block: int
) -> None:
    """87 and 70 % of degrees 2 and 4 held by the model as it is."""
    errors, sizes, holds = fits({"local": "polynomial", "degree": degree}, lines, n_block, 40)
    assert np.all(holds.mean(axis=0) > 0.95 - 3 * np.sqrt(0.05 * 0.95 / 40))
    assert np.all(np.abs(errors.mean(axis=0)) < 0.6 * np.sqrt(np.mean(sizes**2, axis=0)))
