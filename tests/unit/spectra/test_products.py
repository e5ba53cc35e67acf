"""Cross-products of segments: both ways against sums written out with numpy.fft."""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.spectra.products import LONG_BLOCK, LineProducts, PackedProducts, SegmentProducts, segment_products
from labpipe.spectra.welch import trend_basis
from labpipe.spectra.windows import window_values


@pytest.mark.parametrize("n_channel", [1, 2, 3, 4])
@pytest.mark.parametrize("lines", [range(1, 33), range(1, 32), range(5, 12)])
@pytest.mark.parametrize("way", [LineProducts, PackedProducts])
def test_sums_are_those_written_out(rng: np.random.Generator, way: type[SegmentProducts], lines: range, n_channel: int) -> None:
    # Literal twin: the trend is taken out of every segment before the window, X_a X_b* is summed segment by segment.
    n = 64
    window, basis = window_values("hann", n), trend_basis("linear", n)
    segments = rng.normal(size=(7, n, n_channel)) + 3.0
    trend = np.fft.rfft(window * basis, axis=1)[:, lines.start : lines.stop]
    products = way(window, lines, n_channel, trend)
    for chunk in (segments[:3], segments[3:]):
        while chunk.shape[0]:
            number = min(products.room, chunk.shape[0])
            products.put(chunk[:number], basis @ chunk[:number])
            chunk = chunk[number:]
    products.flush()
    left = segments - np.einsum("pn,spc->snc", basis, basis @ segments)
    spectra = np.fft.rfft(left * window[:, None], axis=1)[:, lines.start : lines.stop]
    expected = np.einsum("sla,slb->lab", spectra, spectra.conj())
    np.testing.assert_allclose(products.matrix(), expected, rtol=0, atol=1e-12 * np.max(np.abs(expected)))
    assert products.n_block == 7


def test_long_blocks_are_packed() -> None:
    trend = np.empty((0, 1), complex)
    for n, way in ((LONG_BLOCK, PackedProducts), (LONG_BLOCK - 1, LineProducts)):
        assert isinstance(segment_products(np.ones(n), range(1, 4), 2, trend), way)
