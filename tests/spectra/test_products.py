"""Cross-products of segments against sums written out with numpy.fft."""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.spectra.welch import SAMPLES_OF_SHORT, SegmentProducts, WelchAverage, trend_basis
from labpipe.spectra.windows import window_values


@pytest.mark.parametrize("lines", [range(1, 33), range(1, 32), range(5, 12)])
@pytest.mark.parametrize(("n", "step"), [(64, 64), (64, 24), (65, 24)])
@pytest.mark.parametrize("n_channel", [1, 2, 3, 4])
def test_sums_are_those_written_out(
    rng: np.random.Generator, n: int, step: int, lines: range, n_channel: int
) -> None:
    # Literal twin: the trend is taken out of every segment before the window, X_a X_b* is summed segment by
    # segment.
    window, basis = window_values("hann", n), trend_basis("linear", n)
    samples = rng.normal(size=(6 * step + n, n_channel)) + 3.0
    segments = np.lib.stride_tricks.sliding_window_view(samples, n, axis=0)[::step].swapaxes(1, 2)
    trend = np.fft.rfft(window * basis, axis=1)[:, lines.start : lines.stop]
    products = SegmentProducts(window, lines, n_channel, trend)
    for chunk in (segments[:3], segments[3:]):
        while chunk.shape[0]:
            number = min(products.room, chunk.shape[0])
            products.put(chunk[:number], basis @ chunk[:number])
            chunk = chunk[number:]
    products.flush()
    left = segments - np.einsum("pn,spc->snc", basis, basis @ segments)
    spectra = np.fft.rfft(left * window[:, None], axis=1)[:, lines.start : lines.stop]
    expected = np.einsum("sla,slb->lab", spectra, spectra.conj())
    matrix = products.matrix()
    np.testing.assert_allclose(matrix, expected, rtol=0, atol=1e-12 * np.max(np.abs(expected)))
    np.testing.assert_array_equal(matrix, matrix.conj().swapaxes(1, 2))
    np.testing.assert_array_equal(products.matrix([n_channel - 1, 0]), matrix[:, :, [n_channel - 1, 0]])
    assert products.n_block == 7


@pytest.mark.parametrize("n_channel", [2, 5])
def test_two_threads_change_no_byte(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch, n_channel: int
) -> None:
    """Blocks of uneven numbers of segments, long enough for several chunks of lines."""
    n, matrices = SAMPLES_OF_SHORT // n_channel + 1, []
    samples = rng.normal(size=(9 * n, n_channel))
    for n_thread in (1, 2):
        monkeypatch.setattr("labpipe.spectra.welch.threads", lambda n_thread=n_thread: n_thread)
        average = WelchAverage(window_values("hann", n), n // 3, n_channel)
        for start in range(0, samples.shape[0], 50_000):
            average.add(samples[start : start + 50_000])
        assert average._products._n_thread == n_thread
        matrices.append(average.spectra(1.0).matrix)
    np.testing.assert_array_equal(*matrices)


def test_short_blocks_have_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("labpipe.spectra.welch.threads", lambda: 2)
    trend = np.empty((0, 1), complex)
    for n, n_thread in ((SAMPLES_OF_SHORT // 2, 1), (SAMPLES_OF_SHORT // 2 + 1, 2)):
        assert SegmentProducts(np.ones(n), range(1, 4), 2, trend)._n_thread == n_thread
