"""What kind a force is of, told from its samples alone; the truth is how it was made."""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.raw_files.first_look import find_period, hit_starts, look, round_down

RATE = 1000.0


def multisine(period: int, n_sample: int, lines: range) -> np.ndarray:
    """Equal lines with Schroeder's phases."""
    n = np.arange(n_sample)
    phases = [-np.pi * k * (k - 1) / len(lines) for k in range(len(lines))]
    return sum(
        np.cos(2 * np.pi * line * n / period + phase) for line, phase in zip(lines, phases, strict=True)
    )


@pytest.mark.parametrize("noise", [0.0, 0.05])
@pytest.mark.parametrize(
    ("period", "n_sample", "lines"),
    [(1000, 5000, range(1, 101)), (2000, 9000, range(20, 60)), (333, 1000, range(1, 20))],
)
def test_a_multisine_shows_its_period_and_its_lines(
    rng, period: int, n_sample: int, lines: range, noise: float
) -> None:
    force = multisine(period, n_sample, lines)
    found = look(3 + force + noise * np.std(force) * rng.normal(size=n_sample), RATE)
    assert (found.kind, found.length, found.repeats) == ("periodic", period, n_sample // period)
    assert found.band == pytest.approx((lines[0] * RATE / period, lines[-1] * RATE / period))


def test_a_sine_is_periodic_by_one_turn() -> None:
    assert find_period(np.sin(2 * np.pi * np.arange(1000) / 40)) == 40


@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_a_period_between_two_samples_is_that_of_whole_samples(rng, noise: float) -> None:
    """Lines at multiples of 5 Hz at 8192 Hz repeat after 1638.4 samples, whole ones after 8192."""
    force = multisine(8192, 12 * 8192, range(20, 1001, 5))
    assert find_period(force + noise * np.std(force) * rng.standard_normal(force.size)) == 8192


def test_noise_has_no_period_and_is_cut_into_blocks(rng) -> None:
    force = rng.normal(size=40_000)
    found = look(force, RATE)
    assert (found.kind, found.length, found.repeats) == ("random", 2000, 20)
    assert found.band[0] < 1 and found.band[1] == pytest.approx(400)


def test_band_limited_noise_shows_its_band(rng) -> None:
    """White noise through an ideal filter: lines 50-120 Hz only."""
    spectrum = np.zeros(20_001, complex)
    spectrum[2000:4800] = np.exp(2j * np.pi * rng.random(2800))
    found = look(np.fft.irfft(spectrum, 40_000), RATE)
    assert found.kind == "random"
    assert found.band == pytest.approx((50, 120), abs=2.5)


def test_hits_of_a_hammer_are_counted(rng) -> None:
    force = 0.001 * rng.normal(size=50_000) + 0.4
    for start in (1000, 13_300, 25_600, 37_500):
        force[start : start + 12] += np.sin(np.pi * np.arange(12) / 12)
    found = look(force, RATE)
    assert (found.kind, found.repeats) == ("impact", 4)
    # 95 % of the shortest distance, 11,900 samples, in two digits.
    assert found.length == 11_000
    assert list(np.round(hit_starts(force - 0.4), -1)) == [1000, 13_300, 25_600, 37_500]


@pytest.mark.parametrize("bounce", [0.0, 0.3])
def test_a_hit_in_the_first_samples_beside_a_drift_has_its_own_band(bounce: float) -> None:
    """Half a sine of T = 10 ms: |F| ~ |cos(pi f T) / (1 - (2 f T)^2)| is -23.5 dB at 200 Hz. A trigger
    cut its first samples off, as analysers do.
    """
    push = np.sin(np.pi * np.arange(2, 11) / 10)
    force = -0.02 * np.exp(-np.arange(10_000) / 5_000)
    force[: push.size] += push
    force[200 : 200 + push.size] += bounce * push
    found = look(force, RATE)
    assert (found.kind, found.repeats, found.length) == ("impact", 1, 10_000)
    assert found.band[0] < 1 and found.band[1] > 200


@pytest.mark.parametrize("signal", [np.zeros(100), np.ones(100) - 1, np.arange(6.0)])
def test_silence_has_no_period(signal: np.ndarray) -> None:
    assert find_period(signal) == 0


@pytest.mark.parametrize(
    ("samples", "rounded"), [(1, 1), (9, 5), (10, 10), (49, 20), (2500, 2000), (99_999, 50_000)]
)
def test_lengths_are_round(samples: int, rounded: int) -> None:
    assert round_down(samples) == rounded
