"""Cross-spectra of random data against scipy.signal.csd, and their invariants."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy import signal

from labpipe.errors import ConfigError, DataError
from labpipe.spectra.welch import WelchAverage
from labpipe.spectra.windows import effective_averages, window_values


def averaged(samples: np.ndarray, n: int, step: int, block: int, window: str = "hann") -> np.ndarray:
    average = WelchAverage(window_values(window, n), step, samples.shape[1])
    for start in range(0, samples.shape[0], block):
        average.add(samples[start : start + block])
    return average.spectra(100.0).matrix


@pytest.mark.parametrize(
    ("window", "step"), [("hann", 32), ("boxcar", 64), ("blackman", 16), ("flattop", 21)]
)
def test_equals_scipy_pair_by_pair(rng: np.random.Generator, window: str, step: int) -> None:
    # scipy conjugates the first argument: csd(a, b) = E[A* B].
    samples = rng.normal(size=(1000, 3))
    matrix = averaged(samples, 64, step, 1000, window)
    for a in range(3):
        for b in range(3):
            _, expected = signal.csd(
                samples[:, b],
                samples[:, a],
                fs=100.0,
                window=window,
                nperseg=64,
                noverlap=64 - step,
                detrend="constant",
            )
            # scipy does not double the line at half the sampling rate; no measurement uses it.
            np.testing.assert_allclose(matrix[:-1, a, b], expected[1:-1], rtol=1e-10, atol=1e-14)


@settings(derandomize=True, max_examples=25, deadline=None)
@given(block=st.integers(1, 700), step=st.integers(1, 64))
def test_block_size_changes_nothing_but_rounding(block: int, step: int) -> None:
    samples = np.random.default_rng(1).normal(size=(650, 2))
    np.testing.assert_allclose(
        averaged(samples, 64, step, block), averaged(samples, 64, step, 650), rtol=1e-10
    )


def test_effective_averages_closed_forms() -> None:
    # Boxcar without overlap: all blocks are independent. Hann at 50 %: rho_1 = (1/6)^2 (Welch 1967), so K=2:
    # 2/(1 + 2/2 /36).
    assert effective_averages(np.ones(64), 64, 10) == pytest.approx(10.0)
    assert effective_averages(window_values("hann", 4096), 2048, 2) == pytest.approx(
        2 / (1 + 1 / 36), rel=1e-6
    )


@pytest.mark.long
@pytest.mark.parametrize(
    ("window", "overlap"), [("hann", 0.5), ("hann", 0.75), ("boxcar", 0.5), ("blackman", 0.5)]
)
def test_effective_averages_predict_the_scatter_of_a_spectrum(window: str, overlap: float) -> None:
    # The variance of an averaged power spectrum of white noise is S^2 / n_e.
    rng = np.random.default_rng(5)
    n, step = 32, round(32 * (1 - overlap))
    powers = []
    for _ in range(30):
        average = WelchAverage(window_values(window, n), step, 20)
        average.add(rng.normal(size=(320, 20)))
        spectra = average.spectra(1.0)
        powers.extend(np.einsum("lcc->cl", spectra.matrix[4:12]).real)
    relative = np.mean(np.var(powers, axis=0) / np.mean(powers, axis=0) ** 2)
    assert relative * spectra.averages == pytest.approx(1.0, abs=0.08)


def test_the_window_is_periodic_not_symmetric() -> None:
    # The periodic Hann window sums to n/2 exactly and overlaps to 1; the symmetric one does not.
    window = window_values("hann", 64)
    np.testing.assert_allclose(window[:32] + window[32:], 1.0, atol=1e-15)


def test_too_short_and_unknown_window() -> None:
    average = WelchAverage(np.ones(64), 32, 1)
    average.add(np.zeros((63, 1)))
    with pytest.raises(DataError, match=r"0\.63 s long, too short for one block of 0\.64 s"):
        average.spectra(100.0)
    with pytest.raises(ConfigError, match="unknown window 'hannn'"):
        window_values("hannn", 8)


def test_a_band_keeps_its_lines_as_they_are(rng: np.random.Generator) -> None:
    samples = rng.normal(size=(1000, 2))
    kept = WelchAverage(window_values("hann", 64), 32, 2, slice(5, 12))
    kept.add(samples)
    spectra = kept.spectra(100.0)
    np.testing.assert_allclose(spectra.frequency, np.arange(5, 12) * 100 / 64)
    np.testing.assert_allclose(spectra.matrix, averaged(samples, 64, 32, 1000)[4:11], rtol=1e-12)


@pytest.mark.parametrize(
    ("detrend", "theirs"), [("constant", "constant"), ("linear", "linear"), ("none", False)]
)
@pytest.mark.parametrize(("window", "step"), [("hann", 32), ("boxcar", 20), ("kaiser 5", 48)])
def test_detrending_is_that_of_scipy(
    rng: np.random.Generator, detrend: str, theirs: str | bool, window: str, step: int
) -> None:
    # An offset and a drift far above the noise.
    samples = rng.normal(size=(700, 2)) + 1e3 + np.arange(700)[:, None] * [1.0, -3.0]
    average = WelchAverage(window_values(window, 64), step, 2, detrend=detrend)
    average.add(samples)
    _, expected = signal.csd(
        samples[:, 0],
        samples[:, 1],
        fs=100.0,
        window=window_values(window, 64),
        nperseg=64,
        noverlap=64 - step,
        detrend=theirs,
    )
    matrix = average.spectra(100.0).matrix[:, 1, 0]
    np.testing.assert_allclose(matrix[:-1], expected[1:-1], rtol=1e-8, atol=1e-11 * np.abs(expected).max())


def test_an_unknown_trend_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"unknown trend 'square'.*known: constant, linear, none"):
        WelchAverage(np.ones(8), 8, 1, detrend="square")


def test_blocks_shorter_than_a_segment_and_in_columns_are_taken(rng: np.random.Generator) -> None:
    samples = np.asfortranarray(rng.normal(size=(1000, 3)).astype(np.float32))
    np.testing.assert_allclose(
        averaged(samples, 64, 30, 7), averaged(np.ascontiguousarray(samples), 64, 30, 1000), rtol=1e-10
    )


def test_the_matrix_is_hermitian_to_the_last_digit(rng: np.random.Generator) -> None:
    matrix = averaged(rng.normal(size=(1000, 3)), 64, 32, 1000)
    np.testing.assert_array_equal(matrix, matrix.conj().swapaxes(1, 2))
