"""White noise on a simulated oscillator with short blocks: damping without bias, standard errors as large as
the scatter, p uniform.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal, stats

from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import FitSettings
from labpipe.records.identification import Fit
from labpipe.records.recording import Channel, Recording
from labpipe.spectra.measurement import measure
from labpipe.spectra.settings import FrfSettings

RATE, F_N, ZETA, N_BLOCK, BAND = 1024.0, 60.0, 0.01, 100, (40.0, 80.0)
W_N = 2 * np.pi * F_N
TRUTH = {"k": W_N**2, "c": 2 * ZETA * W_N}
CHANNELS = (Channel("f", "force", "input", "x", 0.0), Channel("x", "displacement", "output", "x", 0.0))
# Samples before the record: the oscillator has forgotten its rest.
BEFORE = 8000


def displacement(force: np.ndarray) -> np.ndarray:
    """Response of a mass of 1 kg: the sampled impulse response, less what sampling adds to its receptance, a
    + b w^2 in the band.
    """
    pole = -ZETA * W_N + 1j * W_N * np.sqrt(1 - ZETA**2)
    z = np.exp(pole / RATE)
    system = [0.0, float(z.imag) / (pole.imag * RATE)], [1.0, -2 * float(z.real), float(abs(z) ** 2)]
    frequency = np.linspace(*BAND, 9)
    w = 2 * np.pi * frequency
    excess = signal.freqz(*system, worN=frequency, fs=RATE)[1] - 1 / (W_N**2 - w**2 + 2j * ZETA * W_N * w)
    slope, level = np.polyfit(w**2, excess.real, 1)
    return (
        signal.lfilter(*system, force)
        - level * force
        + slope * np.convolve(force, [1.0, -2.0, 1.0], "same") * RATE**2
    )


def fitted(rng: np.random.Generator, lines: float, gain_slope: float = 0.0) -> Fit:
    """The fit of a record with *lines* in the half-power width; *gain_slope*: change of the gain over the
    band [1].
    """
    n = round(lines / (2 * ZETA * F_N) * RATE)
    force = rng.normal(size=BEFORE + n * (N_BLOCK + 1) // 2 + 1)
    x = displacement(force)[BEFORE:]
    samples = np.column_stack([force[BEFORE:], x + 0.01 * x.std() * rng.normal(size=x.size)])
    settings = FrfSettings(excitation="random", block=n / RATE, band=(20.0, 120.0))
    response = measure([Recording(CHANNELS, samples, RATE, "noise")], settings)
    if gain_slope:
        gain = 1 + gain_slope * (response.frequency - F_N) / (BAND[1] - BAND[0])
        object.__setattr__(response, "matrix", response.matrix * gain[:, None, None])
    (fit,) = identify(response, FitSettings("sdof", mass=1.0, band=BAND))
    return fit


@pytest.mark.long
@pytest.mark.parametrize(("lines", "runs"), [(2.0, 60), (8.0, 40)])
def test_fits_of_short_blocks_are_what_they_say(rng: np.random.Generator, lines: float, runs: int) -> None:
    fits = [fitted(rng, lines) for _ in range(runs)]
    for name, value in TRUTH.items():
        errors = np.array(
            [(f.parameter(name).value - value, f.parameter(name).std_error) for f in fits], float
        )
        size = np.sqrt(np.mean(errors[:, 1] ** 2))
        # Three standard errors of a mean, and of a standard deviation.
        assert abs(errors[:, 0].mean()) < (0.1 + 3 / np.sqrt(runs)) * size
        assert errors[:, 0].std() / size == pytest.approx(1.0, abs=0.05 + 3 / np.sqrt(2 * runs))
    p_values = [fit.gof.chi2_p for fit in fits]
    assert stats.kstest(p_values, "uniform").pvalue > 1e-3
    assert not [
        finding for fit in fits for finding in fit.findings if finding.code in ("leakage", "model-mismatch")
    ][1 + runs // 30 :]


@pytest.mark.long
def test_a_gain_that_changes_over_the_band_is_seen(rng: np.random.Generator) -> None:
    uncertain = [
        fit
        for fit in (fitted(rng, 8.0, 0.03) for _ in range(6))
        if any(f.code == "model-mismatch" for f in fit.findings)
    ]
    assert len(uncertain) >= 5
