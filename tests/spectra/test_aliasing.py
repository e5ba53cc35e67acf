"""Anti-alias check and frequency response of sensors, on recordings whose spectra are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from labpipe.errors import DataError
from labpipe.records.recording import Channel, Recording
from labpipe.spectra.measurement import measure
from labpipe.spectra.quality import AliasingMonitor, aliasing_findings
from labpipe.spectra.settings import FrfSettings

RATE, N = 1024.0, 40960
FORCE, X = Channel("f", "force", "input", "x", 0.0), Channel("x", "displacement", "output", "x", 0.0)
SETTINGS = FrfSettings(excitation="random", block=1.0, band=(20.0, 200.0))


def recording(rng: np.random.Generator, cut: float | None, noise: float = 1e-3) -> Recording:
    force = rng.normal(size=N)
    if cut is not None:
        force = signal.sosfiltfilt(signal.butter(6, cut, fs=RATE, output="sos"), force)
    return Recording((FORCE, X), np.column_stack([force, force + noise * rng.normal(size=N)]), RATE, "run")


def codes(source: Recording, settings: FrfSettings = SETTINGS) -> list[str]:
    return [finding.code for finding in measure([source], settings).findings]


def test_power_next_to_half_the_rate_is_a_warning(rng: np.random.Generator) -> None:
    response = measure([recording(rng, None)], SETTINGS)
    (finding,) = response.findings
    assert (
        (finding.code, finding.level) == ("aliasing", "warning")
        and "channel x" in finding.message
        and "512 Hz" in finding.message
    )
    assert codes(recording(rng, 400.0)) == []


def test_a_channel_of_noise_alone_is_not_accused(rng: np.random.Generator) -> None:
    assert "aliasing" not in codes(recording(rng, 400.0, noise=10.0))


def test_powers_are_those_of_white_noise(rng: np.random.Generator) -> None:
    watched = AliasingMonitor(recording(rng, None))
    blocks = list(watched.blocks(2048))
    np.testing.assert_array_equal(
        np.concatenate(blocks), recording(np.random.default_rng(20240917), None).samples
    )
    # White noise of variance 1 has the same power on every line; 20 segments of 25 and 180 lines.
    np.testing.assert_allclose(watched.powers((20.0, 200.0)), 1.0, rtol=0.2)
    assert np.all(AliasingMonitor(recording(rng, None)).powers(None) == 0)


def test_the_share_is_that_of_the_mean_powers_per_line() -> None:
    time = np.arange(N) / RATE
    # Lines of 1 Hz: 181 from 20 to 200 Hz, 25 from 487 to 511 Hz. The second sine has half the power per line
    # of the first.
    x = np.sin(2 * np.pi * 100 * time) + np.sqrt(0.5 * 25 / 181) * np.sin(2 * np.pi * 500 * time)
    watched = AliasingMonitor(Recording((FORCE, X), np.column_stack([np.zeros(N), x]), RATE, "run"))
    list(watched.blocks(4096))
    (finding,) = aliasing_findings([watched], (20.0, 200.0), {"x"})
    assert "is 50 % of that in the band" in finding.message


def test_a_sensor_s_frequency_response_is_taken_out(rng: np.random.Generator) -> None:
    clean = recording(rng, 400.0, noise=0.0)
    # A first-order low pass at 100 Hz shows y' = y / (1 + j f / 100 Hz), applied to the whole record at once.
    frequency = np.fft.rfftfreq(N, 1 / RATE)
    shown = np.fft.irfft(np.fft.rfft(clean.samples[:, 1]) / (1 + 1j * frequency / 100), N)
    at = np.arange(0.0, 300.0, 1.0)
    table = tuple(zip(at, 1 / np.hypot(1, at / 100), -np.arctan(at / 100), strict=True))
    sensed = replace(
        clean,
        channels=(FORCE, replace(X, response=table)),
        samples=np.column_stack([clean.samples[:, 0], shown]),
    )
    response = measure([sensed], SETTINGS)
    # Leakage of one-second blocks is what is left.
    np.testing.assert_allclose(response.matrix[:, 0, 0], 1.0, atol=5e-3)
    shaker = replace(
        clean,
        channels=(replace(FORCE, response=table), X),
        samples=np.column_stack([shown, clean.samples[:, 1]]),
    )
    np.testing.assert_allclose(measure([shaker], SETTINGS).matrix[:, 0, 0], 1.0, atol=5e-3)


def test_a_table_that_ends_within_the_band_is_refused(rng: np.random.Generator) -> None:
    clean = recording(rng, 400.0)
    short = replace(clean, channels=(FORCE, replace(X, response=((0.0, 1.0, 0.0), (150.0, 1.0, 0.0)))))
    with pytest.raises(DataError, match=r"leaves the table of channel 'x' \(0-150 Hz\)"):
        measure([short], SETTINGS)
