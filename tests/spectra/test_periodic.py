"""Averages over whole periods and their noise, against literal twins and simulation."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy import signal

from labpipe.errors import ConfigError, DataError
from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import FitSettings
from labpipe.records.recording import Channel, Recording
from labpipe.spectra.measurement import measure
from labpipe.spectra.period_average import (
    LineSpectrum,
    PeriodAverage,
    excited_lines,
    samples_per_period,
    smoothed_noise,
)
from labpipe.spectra.settings import FrfSettings

N = 64


def spectrum_of(samples: np.ndarray, block: int = 10_000, skip: int = 0) -> LineSpectrum:
    average = PeriodAverage(N, samples.shape[1], skip)
    for start in range(0, samples.shape[0], block):
        average.add(samples[start : start + block])
    return average.spectrum(float(N))


def test_mean_and_noise_equal_the_literal_twin(rng: np.random.Generator) -> None:
    samples = rng.normal(size=(5 * N, 2))
    spectrum = spectrum_of(samples)
    for line in range(1, N // 2 + 1):
        rotation = np.exp(-2j * np.pi * line * np.arange(N) / N)
        amplitudes = [2 / N * (rotation @ samples[p * N : (p + 1) * N]) for p in range(5)]
        mean = sum(amplitudes) / 5
        scatter = sum(np.outer(a - mean, (a - mean).conj()) for a in amplitudes)
        np.testing.assert_allclose(spectrum.mean[line - 1], mean, atol=1e-13)
        np.testing.assert_allclose(spectrum.noise[line - 1], scatter / (5 * 4), atol=1e-13)
    assert spectrum.dof == 4


@settings(derandomize=True, max_examples=25, deadline=None)
@given(block=st.integers(1, 400))
def test_block_size_changes_nothing(block: int) -> None:
    samples = np.random.default_rng(2).normal(size=(5 * N + 17, 2))
    np.testing.assert_array_equal(spectrum_of(samples, block, skip=1).mean, spectrum_of(samples, skip=1).mean)


def test_a_transient_period_is_skipped() -> None:
    t = np.arange(4 * N) / N
    samples = np.cos(2 * np.pi * 3 * t)[:, None]
    samples[:N] += 100.0
    samples[5] = 1e6
    assert abs(spectrum_of(samples, skip=1).mean[2, 0]) == pytest.approx(1.0, abs=1e-12)


def test_small_noise_on_a_large_signal_is_not_lost_to_cancellation(rng: np.random.Generator) -> None:
    t = np.arange(200 * N) / N
    noise = 1e-9 * rng.normal(size=t.size)
    spectrum = spectrum_of((1e3 * np.cos(2 * np.pi * 3 * t) + noise)[:, None])
    # E|X|^2 of white noise of variance s^2 is 4 s^2 / N per period.
    assert spectrum.noise[2, 0, 0].real * 200 == pytest.approx(4e-18 / N, rel=0.3)


def test_smoothing_gives_the_noise_more_degrees_of_freedom(rng: np.random.Generator) -> None:
    spectrum = spectrum_of(rng.normal(size=(5 * N, 1)))
    smooth = smoothed_noise(spectrum, 5)
    expected = 4 / N / 5
    assert np.std(smooth.noise[:, 0, 0].real) < 0.45 * np.std(spectrum.noise[:, 0, 0].real)
    assert np.mean(smooth.noise[:, 0, 0].real) == pytest.approx(expected, rel=0.25)
    # So many lines are within five of each; what estimated weights cost goes with the mean of 1 / dof.
    counts = np.convolve(np.ones(N // 2), np.ones(11), "same")
    assert smooth.dof == pytest.approx(4 / np.mean(1 / counts))


def test_a_disturbed_line_keeps_its_own_noise_and_spares_its_neighbours(rng: np.random.Generator) -> None:
    samples = rng.normal(size=(5 * N, 1))
    # A shaft-speed line whose phase differs from period to period: it is not a broadband noise.
    for p in range(5):
        samples[p * N : (p + 1) * N, 0] += 50 * np.cos(2 * np.pi * 12 * np.arange(N) / N + 2.4 * p)
    spectrum = spectrum_of(samples)
    smooth = smoothed_noise(spectrum, 5)
    np.testing.assert_allclose(smooth.noise[11], spectrum.noise[11])
    others = np.delete(smooth.noise[:, 0, 0].real, 11)
    assert np.max(others) < 4 * 4 / N / 5


def test_excited_lines_are_found_with_and_without_noise(rng: np.random.Generator) -> None:
    t = np.arange(6 * N) / N
    clean = sum(np.cos(2 * np.pi * line * t + line) for line in (3, 5, 7))
    for noise in (0.0, 0.05):
        spectrum = smoothed_noise(spectrum_of((clean + noise * rng.normal(size=t.size))[:, None]), 5)
        assert np.flatnonzero(excited_lines(spectrum, [0])).tolist() == [2, 4, 6]


def test_a_period_holds_whole_samples() -> None:
    assert samples_per_period(0.5, 1000.0) == 500
    assert samples_per_period(1 / 3, 3000.0) == 1000
    with pytest.raises(ConfigError, match="not a whole number") as caught:
        samples_per_period(0.1234567, 1000.0)
    assert caught.value.hint == "the nearest period that does is 0.123 s"
    # 1638.4 samples: lines at multiples of 5 Hz.
    with pytest.raises(ConfigError, match=r"holds 1638\.4 samples") as caught:
        samples_per_period(0.2, 8192.0)
    assert caught.value.hint == "5 of them do: period: 1 s"


def test_too_short_for_one_period() -> None:
    with pytest.raises(DataError, match="too short for one period"):
        spectrum_of(np.zeros((2 * N, 1)), skip=2)


def test_a_band_keeps_its_lines_as_they_are(rng: np.random.Generator) -> None:
    samples = rng.normal(size=(5 * N, 2))
    kept = PeriodAverage(N, 2, 0, slice(4, 9))
    kept.add(samples)
    whole, part = spectrum_of(samples), kept.spectrum(float(N))
    assert part.frequency.tolist() == [4, 5, 6, 7, 8]
    np.testing.assert_array_equal(part.mean, whole.mean[3:8])
    np.testing.assert_array_equal(part.noise, whole.noise[3:8])


def line_noise(power: np.ndarray, dof: float) -> LineSpectrum:
    n = power.size
    return LineSpectrum(
        np.arange(1.0, n + 1),
        np.zeros((n, 1), complex),
        power[:, None, None].astype(complex),
        5,
        np.full(n, dof),
    )


def test_leakage_beside_a_shaft_speed_line_is_left_out_too() -> None:
    # Leakage falls with the square of the distance; the strongest line hides the weaker ones in the first
    # pass.
    power = np.ones(60)
    power[28:33] = [25.0, 100.0, 1e4, 100.0, 25.0]
    smooth = smoothed_noise(line_noise(power, 4.0), 5).noise[:, 0, 0].real
    np.testing.assert_array_equal(smooth[28:33], power[28:33])
    np.testing.assert_allclose(np.delete(smooth, range(28, 33)), 1.0, rtol=1e-12)


def test_one_huge_line_does_not_swallow_small_noise() -> None:
    power = np.full(60, 1e-20)
    power[30] = 1e3
    smooth = smoothed_noise(line_noise(power, 4.0), 5).noise[:, 0, 0].real
    assert smooth[30] == 1e3
    np.testing.assert_allclose(np.delete(smooth, 30), 1e-20, rtol=1e-12)


def test_few_broadband_lines_are_taken_for_disturbed_ones() -> None:
    # Recipe: 20,000 lines of chi-square noise with 2 x 4 degrees of freedom; the F-test is made at 0.1 %.
    power = np.random.default_rng(8).chisquare(8, 20_000) / 8
    smooth = smoothed_noise(line_noise(power, 4.0), 5).noise[:, 0, 0].real
    assert 0.0003 < np.mean(smooth == power) < 0.002


def creeping(levels: np.ndarray, periods: int = 12) -> np.ndarray:
    """Two cosines, (n, 2), the second on a rest position along the polynomial *levels* of time in periods."""
    t = np.arange(periods * N) / N
    wave = np.cos(2 * np.pi * 3 * t + 0.4) + 0.1 * np.cos(2 * np.pi * t)
    return np.stack([wave, wave + np.polyval(levels, t)], axis=1)


@pytest.mark.parametrize("levels", [[3.0, 0.0], [-0.2, 3.0, 1.0]])
def test_a_rest_position_along_a_parabola_is_taken_out_exactly(levels: list[float]) -> None:
    samples = creeping(np.array(levels))
    plain, still = spectrum_of(samples), spectrum_of(creeping(np.zeros(1)))
    assert abs(plain.mean[0, 1] - still.mean[0, 1]) > 0.1
    average = PeriodAverage(N, 2, 0)
    average.add(samples)
    motion = average.creep(plain)
    assert np.all(motion.slope[:, 0] == 0) and np.all(motion.bend[:, 0] == 0)
    again = PeriodAverage(N, 2, 0, creep=motion)
    again.add(samples)
    np.testing.assert_allclose(again.spectrum(float(N)).mean, still.mean, atol=1e-11)
    assert np.max(np.abs(again.spectrum(float(N)).noise)) < 1e-20


def test_a_cart_that_creeps_unevenly_is_less_noise_without_it(rng: np.random.Generator) -> None:
    """A position that moves on by 3 to 7 in a period, evenly within each."""
    rises = np.repeat(5 + 2 * np.cos(np.arange(12) / 2), N) / N
    samples = creeping(np.zeros(1)) + 0.01 * rng.normal(size=(12 * N, 2))
    samples[:, 1] += np.cumsum(rises)
    average = PeriodAverage(N, 2, 0)
    average.add(samples)
    plain = average.spectrum(float(N))
    again = PeriodAverage(N, 2, 0, creep=average.creep(plain))
    again.add(samples)
    without = again.spectrum(float(N))
    assert without.noise[2, 1, 1].real < 0.1 * plain.noise[2, 1, 1].real
    truth = spectrum_of(creeping(np.zeros(1)))
    error = np.abs(without.mean[:5, 1] - truth.mean[:5, 1]) / np.sqrt(without.noise[:5, 1, 1].real)
    assert np.all(error < 3.5) and abs(plain.mean[2, 1] - truth.mean[2, 1]) > 0.3


@pytest.mark.parametrize("periods", [2, 3, 10])
def test_noise_alone_is_no_rest_position_that_creeps(periods: int, rng: np.random.Generator) -> None:
    seen = 0
    for _ in range(200):
        average = PeriodAverage(N, 1, 0)
        average.add(rng.normal(size=(periods * N, 1)))
        seen += average.creep(average.spectrum(float(N))) is not None
    assert seen <= 2


def beside(samples: np.ndarray, n_beside: int = 0, lines: slice = slice(1, None)) -> PeriodAverage:
    due = samples.shape[0] // N
    average = PeriodAverage(N, samples.shape[1], 0, lines, n_due=due, n_beside=n_beside)
    average.add(samples)
    return average


def test_noise_between_the_lines_is_that_of_the_whole_record(rng: np.random.Generator) -> None:
    """Bins 12 k + m of one transform of all twelve periods, whatever repeats in them."""
    t = np.arange(12 * N) / N
    noise = rng.normal(size=(12 * N, 2)).cumsum(axis=0)
    spectrum = beside(noise + 1e3 * np.cos(2 * np.pi * 5 * t)[:, None], 3).spectrum(float(N))
    whole = 2 / (12 * N) * np.fft.rfft(noise, axis=0)
    for line in range(1, N // 2):
        near = whole[[12 * line + m for m in (-3, -2, -1, 1, 2, 3)]]
        expected = np.einsum("ma,mb->ab", near, near.conj()) / 6
        np.testing.assert_allclose(spectrum.noise[line - 1], expected, rtol=1e-8, atol=1e-18)
    assert spectrum.dof == 6


def oscillation(rng: np.random.Generator, periods: int, decay: float, line: float = 8.1) -> np.ndarray:
    """A mode at *line* that white noise drives, of so much decay in a period, and noise of a probe."""
    pole = np.exp((2j * np.pi * line - decay) / N)
    settled = 40 * N
    driven = rng.normal(size=settled + periods * N)
    motion = signal.lfilter([1.0], [1.0, -2 * pole.real, abs(pole) ** 2], driven)[settled:]
    return motion[:, None] + 0.1 * rng.normal(size=(periods * N, 1))


def test_noise_that_goes_on_is_told_and_independent_noise_and_drift_are_not() -> None:
    rng = np.random.default_rng(6)
    drift = np.linspace(0, 1, 12 * N)[:, None] * np.tile(rng.normal(size=(N, 1)), (12, 1))
    goes_on = [beside(oscillation(rng, 12, 0.4, 8.3)).lines_beside() for _ in range(40)]
    white = [beside(rng.normal(size=(12 * N, 3))).lines_beside() for _ in range(400)]
    drifts = [beside(drift + 0.01 * rng.normal(size=(12 * N, 1))).lines_beside() for _ in range(40)]
    assert sum(n == 3 for n in goes_on) >= 36 and max(drifts) == 0
    # Expected by chance: 400 x 3 channels x 2 tests at 1e-3.
    assert sum(n > 0 for n in white) <= 8
    # What two channels share hides what the second has beyond it.
    shared = [
        np.hstack([w := rng.normal(size=(12 * N, 1)), w + 1e-3 * oscillation(rng, 12, 0.4, 8.3)])
        for _ in range(40)
    ]
    assert sum(beside(both).lines_beside() == 3 for both in shared) >= 36


@pytest.mark.parametrize("size", [1e2, 1e5, 1e8])
def test_a_channel_that_is_another_one_times_a_number_is_no_noise_of_its_own(size: float) -> None:
    """A force that is a mass times an acceleration beside a signal of so many times the noise: its rounding
    was no positive definite matrix. Noise that goes on is told all the same.
    """
    rng, periodic = np.random.default_rng(8), np.tile(np.random.default_rng(9).normal(size=(N, 1)), (12, 1))

    def lines(noise: np.ndarray) -> int:
        a = size * periodic + noise
        return beside(np.hstack([a, 4.982 * a, periodic + rng.normal(size=a.shape) / size])).lines_beside()

    assert sum(lines(rng.normal(size=(12 * N, 1))) > 0 for _ in range(40)) <= 2
    assert sum(lines(oscillation(rng, 12, 0.4, 8.3)) == 3 for _ in range(20)) >= 18


def test_noise_of_the_mean_is_that_between_the_lines_at_and_beside_a_resonance() -> None:
    """Twelve periods of 400 records; the scatter is told as of independent periods."""
    rng = np.random.default_rng(7)
    records = [oscillation(rng, 12, 1.0) for _ in range(400)]
    true = np.mean([np.abs(spectrum_of(record).mean[:, 0]) ** 2 for record in records], axis=0)
    scatter, between = (
        np.mean([average(record).spectrum(float(N)).noise[:, 0, 0].real for record in records], axis=0) / true
        for average in (beside, lambda record: beside(record, 3))
    )
    away = [3, 5, 6, 8, 9, 11, 14]
    assert scatter[7] < 0.5 and np.all(scatter[away] > 1.25)
    # Three lines to either side reach over the peak, which is as wide.
    assert 0.6 < between[7] < 1
    np.testing.assert_allclose(between[away], 1.0, atol=0.25)


@pytest.mark.long
def test_intervals_hold_beside_a_disturbance_that_goes_through_the_rig() -> None:
    """H of a mode under white forces besides the known one; the motion that they drive is cut out of
    four times as long a record.
    """
    rate, period, f_n, zeta, draws = 512, 512, 66.3, 0.03, 160
    rng, count = np.random.default_rng(3), 11 * period

    def receptance(frequency: np.ndarray) -> np.ndarray:
        return 1 / (f_n**2 - frequency**2 + 2j * zeta * f_n * frequency) / (2 * np.pi) ** 2

    lines, every = np.fft.rfftfreq(period, 1 / rate), np.fft.rfftfreq(4 * count, 1 / rate)
    off, held = [], []
    for _ in range(draws):
        amplitude = np.where((lines >= 20) & (lines <= 150), period / 2 / np.sqrt(131), 0)
        amplitude = amplitude * np.exp(2j * np.pi * rng.random(lines.size))
        pushed = np.fft.rfft(0.3 * rng.normal(size=4 * count)) * receptance(every)
        motion = (
            np.tile(np.fft.irfft(amplitude * receptance(lines), period), 11) + np.fft.irfft(pushed)[:count]
        )
        motion += 0.002 * abs(receptance(np.array(f_n))) * rng.normal(size=count)
        channels = Channel("f", "force", "input", "x", 0.0), Channel("y", "displacement", "output", "x", 0.0)
        samples = np.column_stack([np.tile(np.fft.irfft(amplitude, period), 11), motion])
        response = measure(
            [Recording(channels, samples, float(rate), "run")],
            FrfSettings("periodic", period=1.0, skip=1, band=(20.0, 150.0)),
        )
        (fit,) = identify(response, FitSettings("sdof", bands=((50.0, 90.0),), estimator="ml"))
        found = {p.name: p for p in fit.parameters}
        for name, true in (("k", (2 * np.pi * f_n) ** 2), ("c", 4 * np.pi * zeta * f_n)):
            off.append((found[name].value - true) / found[name].std_error)
            held.append(found[name].ci95[0] <= true <= found[name].ci95[1])
    k, c = np.reshape(off, (draws, 2)).T
    # 1.32 for c, and 86 % of its intervals, where noise is averaged over lines as if it were even.
    assert 0.85 < np.std(k) < 1.15 and 0.85 < np.std(c) < 1.15
    assert abs(np.mean(k)) < 0.25 and abs(np.mean(c)) < 0.25
    assert np.all(np.mean(np.reshape(held, (draws, 2)), axis=0) > 0.91)


def test_noise_that_goes_through_the_structure_is_as_sharp_as_its_resonance(rng: np.random.Generator) -> None:
    """A disturbance d of .1 of the force on every line of 8 periods: var(H) / |H|^2 = .01 / 8 on all of them,
    at a resonance of three lines as beside it. Averaged over 11 lines it was a third of that at the peak, and
    16 times beside it.
    """
    rate, n, lines = 128.0, 512, np.arange(60, 121)
    frequency = lines * rate / n
    h = 1 / (22.5**2 - frequency**2 + 2j * 0.015 * 22.5 * frequency)
    force = np.exp(2j * np.pi * rng.random(lines.size))
    channels = (Channel("f", "force", "input", "x"), Channel("x", "displacement", "output", "x"))
    ratios = []
    for _ in range(20):
        spectra = np.zeros((8, n // 2 + 1, 2), np.complex128)
        drawn = 0.1 * (rng.normal(size=(8, lines.size)) + 1j * rng.normal(size=(8, lines.size))) / np.sqrt(2)
        spectra[:, lines, 0], spectra[:, lines, 1] = force, h * (force + drawn)
        samples = np.fft.irfft(spectra, axis=1).reshape(-1, 2)
        recording = Recording(channels, samples, rate, "disturbed")
        response = measure([recording], FrfSettings("periodic", period=n / rate, skip=0, band=(15.0, 30.0)))
        ratios.append(response.variance[:, 0, 0] / np.abs(response.matrix[:, 0, 0]) ** 2 * 8 / 0.01)
    # Medians of 20 draws of 6 lines (at the ends) and 7 degrees of freedom each: outliers keep their own.
    np.testing.assert_allclose(np.median(ratios, axis=0), 1.0, atol=5 * 1.25 / np.sqrt(20 * 6 * 7))


def oscillator_periods(rng: np.random.Generator, n_period: int = 12) -> np.ndarray:
    """Samples (512 n, 2) of force and displacement of a steady oscillator of 30 Hz, 512 Hz, beside noise."""
    frequency = np.fft.rfftfreq(512, 1 / 512)
    phase = np.exp(2j * np.pi * rng.random(frequency.size))
    lines = np.where((frequency >= 5) & (frequency <= 90), phase, 0)
    response = lines / (1 - (frequency / 30) ** 2 + 0.04j * frequency / 30)
    steady = np.fft.irfft(np.column_stack([lines, response]), 512, axis=0)
    samples = np.tile(steady / steady.std(axis=0), (n_period, 1))
    return samples + 0.01 * rng.normal(size=samples.shape)


def jumps(samples: np.ndarray) -> list[str]:
    channels = (Channel("f", "force", "input", "x"), Channel("x", "displacement", "output", "x"))
    recorded = Recording(channels, samples, 512.0, "run")
    found = measure([recorded], FrfSettings("periodic", period=1.0, skip=1)).findings
    return [finding.message for finding in found if finding.code == "jump"]


def test_lost_samples_and_lost_signals_are_named_with_their_place(rng: np.random.Generator) -> None:
    """Three samples lost at 6.25 s; a connector off from 8 s on; peaks cut off in 3 s to 5 s."""
    whole = oscillator_periods(rng)
    (lost,) = jumps(np.delete(whole, slice(3200, 3203), axis=0))
    assert "periods of f, x change at once near 6 s" in lost and "samples were lost" in lost
    off = whole.copy()
    off[8 * 512 :, 1] = 0.01 * rng.normal(size=4 * 512)
    (gone,) = jumps(off)
    assert "periods of x change at once near 8 s, x by 1 times" in gone and "a connector" in gone
    cut = whole.copy()
    cut[3 * 512 : 5 * 512, 1] = np.clip(cut[3 * 512 : 5 * 512, 1], -1.2, 1.2)
    (clipped,) = jumps(cut)
    assert "periods of x change at once near" in clipped


def test_noise_drift_and_a_start_from_rest_are_no_jump(rng: np.random.Generator) -> None:
    """None in 60 records: noise of all sizes, hum, a gain that drifts by 10 %, motion that dies away."""
    time = np.arange(12 * 512) / 512
    for number in range(15):
        steady = oscillator_periods(rng)
        free = np.exp(-1.2 * time) * np.sin(60 * np.pi * time)
        beside = (
            10.0 ** (-number / 5) * rng.normal(size=steady.shape),
            np.outer(np.sin(2 * np.pi * 50.3 * time), [0.1, 0.3]),
            steady * np.outer(0.1 * time / 12, [0, 1]),
            np.outer(free, [0, 3]),
        )
        assert not any(jumps(steady + extra) for extra in beside)
