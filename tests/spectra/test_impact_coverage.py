"""Hammer hits on a simulated oscillator: intervals of a fit hold the truth in 95 % of tests, whatever window
and number of hits.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal

from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import FitSettings
from labpipe.records.identification import Fit
from labpipe.records.recording import Channel, Recording
from labpipe.spectra.measurement import measure
from labpipe.spectra.settings import FrfSettings, ImpactSettings

RATE, F_N, BAND = 1024.0, 60.0, (40.0, 80.0)
CHANNELS = (Channel("f", "force", "input", "x", 0.0), Channel("x", "displacement", "output", "x", 0.0))
W_N = 2 * np.pi * F_N
# Damping ratio, time constant [s], block [s], hits.
CASES = [(0.006, 0.15, 1.0, 3), (0.05, 0.15, 2.0, 10)]


def displacement(force: np.ndarray, zeta: float) -> np.ndarray:
    """Response of a mass of 1 kg: the sampled impulse response, less what sampling adds to its receptance, a
    + b w^2 in the band.
    """
    pole = -zeta * W_N + 1j * W_N * np.sqrt(1 - zeta**2)
    z = np.exp(pole / RATE)
    system = [0.0, float(z.imag) / (pole.imag * RATE)], [1.0, -2 * float(z.real), float(abs(z) ** 2)]
    frequency = np.linspace(*BAND, 9)
    w = 2 * np.pi * frequency
    excess = signal.freqz(*system, worN=frequency, fs=RATE)[1] - 1 / (W_N**2 - w**2 + 2j * zeta * W_N * w)
    slope, level = np.polyfit(w**2, excess.real, 1)
    second_derivative = np.convolve(force, [1.0, -2.0, 1.0], "same") * RATE**2
    return signal.lfilter(*system, force) - level * force + slope * second_derivative


def hammered(rng: np.random.Generator, zeta: float, block: float, hits: int) -> Recording:
    """Hits of various strength, each after the last one's response has died away.

    1 % of the largest displacement as noise.
    """
    n = round(block * RATE)
    gap = n + int(7 / (zeta * W_N) * RATE)
    force = np.zeros(gap * hits + n)
    for hit in range(hits):
        begin = n // 10 + hit * gap + int(rng.integers(0, 20))
        force[begin : begin + 4] = 100 * rng.uniform(0.8, 1.2) * np.sin(np.pi * (np.arange(4) + 0.5) / 4)
    x = displacement(force, zeta)
    return Recording(
        CHANNELS, np.column_stack([force, x + 0.01 * np.abs(x).max() * rng.normal(size=x.size)]), RATE, "taps"
    )


def fitted(rng: np.random.Generator, zeta: float, decay: float, block: float, hits: int) -> Fit:
    settings = FrfSettings(
        excitation="impact", block=block, band=(30.0, 100.0), impact=ImpactSettings(decay=decay)
    )
    (fit,) = identify(
        measure([hammered(rng, zeta, block, hits)], settings), FitSettings("sdof", mass=1.0, band=BAND)
    )
    return fit


@pytest.mark.parametrize("case", CASES)
@pytest.mark.long
def test_intervals_hold_the_truth(rng: np.random.Generator, case: tuple[float, float, float, int]) -> None:
    runs, zeta = 60, case[0]
    truth = {"k": W_N**2, "c": 2 * zeta * W_N}
    fits = [fitted(rng, *case) for _ in range(runs)]
    for name, value in truth.items():
        parameters = [fit.parameter(name) for fit in fits]
        inside = np.mean([p.ci95 is not None and p.ci95[0] <= value <= p.ci95[1] for p in parameters])
        # Three standard errors of a share of 95 % about 93-97 %.
        tolerance = 3 * np.sqrt(0.05 * 0.95 / runs)
        assert 0.93 - tolerance < inside < 0.97 + tolerance
        errors = np.array([(p.value - value, p.std_error) for p in parameters], float)
        # The standard error of a standard deviation.
        assert errors[:, 0].std() / np.sqrt(np.mean(errors[:, 1] ** 2)) == pytest.approx(
            1.0, abs=0.1 + 3 / np.sqrt(2 * runs)
        )
    uncertain = sum(any(finding.code == "model-mismatch" for finding in fit.findings) for fit in fits)
    assert uncertain <= 1 + 0.02 * runs
