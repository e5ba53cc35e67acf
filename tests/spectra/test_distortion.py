"""Nonlinear distortion of systems without memory, whose best linear approximation has a closed form."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from labpipe.errors import DataError
from labpipe.records.recording import Channel, Recording
from labpipe.spectra.measurement import measure
from labpipe.spectra.period_average import LineSpectrum, PeriodAverage
from labpipe.spectra.periodic import LeftOutLines, left_out_lines, robust_distortion
from labpipe.spectra.settings import FrfSettings

N = 1024
FORCE, X = Channel("f", "force", "input", "x", 0.0), Channel("x", "displacement", "output", "x", 0.0)
SETTINGS = FrfSettings(excitation="periodic", period=1.0, skip=0, smooth=0, band=(1.0, 160.0))
# Odd lines of which every fourth is left out.
LINES = np.array([k for k in range(1, 160, 2) if k % 8 != 7])


def force(rng: np.random.Generator, rms: float, lines: np.ndarray = LINES) -> np.ndarray:
    spectrum = np.zeros(N // 2 + 1, complex)
    spectrum[lines] = np.exp(2j * np.pi * rng.uniform(size=lines.size))
    period = np.fft.irfft(spectrum, N)
    return period * rms / np.std(period)


def recording(
    rng: np.random.Generator, rms: float, square: float, cube: float, noise: float, lines: np.ndarray = LINES
) -> Recording:
    """Six periods of y = u + square u^2 + cube u^3 with noise on y."""
    u = np.tile(force(rng, rms, lines), 6)
    y = u + square * u**2 + cube * u**3 + noise * rng.normal(size=u.size)
    return Recording((FORCE, X), np.column_stack([u, y]), float(N), "run")


def spectrum(source: Recording) -> LineSpectrum:
    average = PeriodAverage(N, 2, 0, slice(1, 200))
    average.add(source.samples)
    return average.spectrum(float(N))


def left_out(source: Recording) -> dict[str, LeftOutLines]:
    """Of y = u + ..., whose H is 1."""
    found = spectrum(source)
    excited = np.isin(np.round(found.frequency).astype(int), LINES)
    return left_out_lines(found, excited, np.ones((found.frequency.size, 1, 1), complex), 0, 1.0)


def lines_of(rng: np.random.Generator, square: float, cube: float) -> dict[str, LeftOutLines]:
    return left_out(recording(rng, 0.5, square, cube, 1e-3))


def test_a_square_answers_at_even_lines_and_a_cube_at_odd_ones(rng: np.random.Generator) -> None:
    linear, square, cube = (lines_of(rng, *terms) for terms in ((0.0, 0.0), (0.05, 0.0), (0.0, 0.05)))
    # Noise alone: |Y|^2 / s^2 has mean 1 and variance 1, over 79 even and 19 odd lines.
    for kind in ("odd", "even"):
        assert np.mean((linear[kind].level / linear[kind].noise) ** 2) == pytest.approx(1.0, abs=0.8)
    assert square["even"].distortion > 20 * np.median(square["even"].noise)
    assert square["odd"].distortion < 2 * np.median(square["odd"].noise)
    assert cube["odd"].distortion > 20 * np.median(cube["odd"].noise)
    assert cube["even"].distortion < 2 * np.median(cube["even"].noise)
    assert set(np.round(square["even"].frequency).astype(int) % 2) == {0}


def test_the_level_at_even_lines_is_that_of_the_square(rng: np.random.Generator) -> None:
    # u^2 of N_l unit amplitudes A: closed form by its own spectrum, computed without noise.
    source = recording(rng, 0.5, 0.05, 0.0, 0.0)
    square = 0.05 * source.samples[:N, 0] ** 2
    amplitude = np.abs(np.fft.rfft(square - square.mean())) * 2 / N
    even = left_out(source)["even"]
    np.testing.assert_allclose(even.level, amplitude[np.round(even.frequency).astype(int)], atol=1e-12)
    assert even.distortion == pytest.approx(np.sqrt(np.mean(even.level**2)), rel=1e-6)


def test_the_best_linear_approximation_of_a_cube(rng: np.random.Generator) -> None:
    # Bussgang: y = u + a u^3 of a Gaussian force of variance s^2 has the gain 1 + 3 a s^2; a multisine of F
    # lines has it up to 1/F.
    runs = [measure([recording(rng, 0.5, 0.0, 0.2, 1e-3)], SETTINGS) for _ in range(30)]
    found = robust_distortion(runs)
    assert np.mean(found.gain.real) == pytest.approx(1 + 3 * 0.2 * 0.25, rel=0.01)
    assert np.max(np.abs(np.mean(found.gain.imag))) < 0.005
    assert np.median(found.nonlinear) > 10 * np.median(found.noise)


def test_distortion_grows_with_the_square_of_the_level() -> None:
    # The same phases at both levels: u^3 / u grows as the square of u, exactly.
    levels = []
    for rms in (0.25, 0.5):
        rng = np.random.default_rng(51)
        found = robust_distortion(
            [measure([recording(rng, rms, 0.0, 0.2, 1e-6)], SETTINGS) for _ in range(25)]
        )
        levels.append(np.sqrt(np.mean(found.nonlinear**2)))
    assert levels[1] / levels[0] == pytest.approx(4.0, rel=1e-4)


def test_a_linear_rig_shows_noise_only(rng: np.random.Generator) -> None:
    found = robust_distortion([measure([recording(rng, 0.5, 0.0, 0.0, 0.01)], SETTINGS) for _ in range(40)])
    assert np.mean(found.total**2) / np.mean(found.noise**2) == pytest.approx(1.0, abs=0.1)
    # What is left of the noise where total and noise are both estimated: well below it in the mean of the
    # band.
    assert abs(np.mean(found.total**2 - found.noise**2)) < 0.1 * np.mean(found.noise**2)


def test_what_shows_no_distortion_is_refused(rng: np.random.Generator) -> None:
    one = measure([recording(rng, 0.5, 0.0, 0.0, 0.01)], SETTINGS)
    with pytest.raises(DataError, match="at least two realisations"):
        robust_distortion([one])
    other = measure([recording(rng, 0.5, 0.0, 0.0, 0.01, LINES[:-1])], SETTINGS)
    with pytest.raises(DataError, match="has other lines"):
        robust_distortion([one, other])


def notes(source: Recording) -> list[str]:
    return [f.message for f in measure([source], SETTINGS).findings if f.code == "lines-left-out"]


def test_a_measurement_names_what_moves_where_no_force_acts(rng: np.random.Generator) -> None:
    """The share of the square's lines in closed form, by its own spectrum; a cube at odd lines; hum by its
    line; every line excited, nothing left out.
    """
    source = recording(rng, 0.5, 0.05, 0.0, 1e-3)
    (text,) = notes(source)
    own = np.abs(np.fft.rfft(0.05 * source.samples[:N, 0] ** 2)) * 2 / N
    even = np.sqrt(np.mean(own[LINES[0] + 1 : LINES[-1] : 2] ** 2))
    forced = np.sqrt(np.mean(np.abs(np.fft.rfft(source.samples[:N, 1])[LINES] * 2 / N) ** 2))
    share = float(re.search(r"by ([\d.]+) %", text)[1])
    assert "at even lines" in text and share == pytest.approx(100 * even / forced, rel=0.03)
    (cubic,) = notes(recording(rng, 0.5, 0.0, 0.05, 1e-3))
    assert "at odd lines" in cubic
    linear = recording(rng, 0.5, 0.0, 0.0, 1e-3)
    hum = 0.01 * np.sin(2 * np.pi * 50 * np.arange(linear.samples.shape[0]) / N)
    (named,) = notes(replace(linear, samples=linear.samples + np.stack([0 * hum, hum], axis=1)))
    assert "most at 50 Hz" in named and "or hum" in named
    assert notes(recording(rng, 0.5, 0.05, 0.05, 1e-3, np.arange(1, 160))) == []


@pytest.mark.long
def test_noise_alone_is_no_distortion() -> None:
    """Of 100 linear runs with noise of 3 % on both channels none; each fails once in 50,000 (two kinds), and
    one in 45 would be seen in nine of ten.
    """
    for seed in range(100):
        drawn = np.random.default_rng(seed)
        source = recording(drawn, 0.5, 0.0, 0.0, 0.015)
        noisy = source.samples + np.stack(
            [0.015 * drawn.normal(size=len(source.samples)), 0 * source.samples[:, 0]], axis=1
        )
        assert notes(replace(source, samples=noisy)) == []
