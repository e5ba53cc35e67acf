"""Cross-products of segments against sums written out with numpy.fft."""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.spectra import welch
from labpipe.spectra.welch import SegmentProducts, trend_basis
from labpipe.spectra.windows import window_values


@pytest.mark.parametrize("n_channel", [1, 2, 3, 4])
@pytest.mark.parametrize("lines", [range(1, 33), range(1, 32), range(5, 12)])
@pytest.mark.parametrize(("n", "step"), [(64, 64), (64, 24), (65, 24)])
def test_sums_are_those_written_out(
    rng: np.random.Generator, n: int, step: int, lines: range, n_channel: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Literal twin: the trend is taken out of every segment before the window, X_a X_b* is summed segment by
    # segment. Room for four segments that are transformed two at a time, so that the sums are added twice.
    monkeypatch.setattr(welch, "CACHED_SAMPLES", 2 * n * n_channel)
    monkeypatch.setattr(welch, "MOST_AMPLITUDES", 4 * 33 * n_channel)
    window, basis = window_values("hann", n), trend_basis("linear", n)
    samples = rng.normal(size=(6 * step + n, n_channel)) + 3.0
    segments = np.lib.stride_tricks.sliding_window_view(samples, n, axis=0)[::step].swapaxes(1, 2)
    trend = np.fft.rfft(window * basis, axis=1)[:, lines.start : lines.stop]
    products = SegmentProducts(window, step, lines, n_channel, trend)
    first = 0
    for end in (3, 7):
        while first < end:
            number = min(products.room, end - first)
            products.put(samples[first * step :], basis @ segments[first : first + number])
            first += number
    products.flush()
    left = segments - np.einsum("pn,spc->snc", basis, basis @ segments)
    spectra = np.fft.rfft(left * window[:, None], axis=1)[:, lines.start : lines.stop]
    expected = np.einsum("sla,slb->lab", spectra, spectra.conj())
    matrix = products.matrix()
    np.testing.assert_allclose(matrix, expected, rtol=0, atol=1e-12 * np.max(np.abs(expected)))
    np.testing.assert_array_equal(matrix, matrix.conj().swapaxes(1, 2))
    np.testing.assert_array_equal(products.matrix([n_channel - 1, 0]), matrix[:, :, [n_channel - 1, 0]])
    assert products.n_block == 7
