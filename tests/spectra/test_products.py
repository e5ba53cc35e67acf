"""Cross-products of segments: both ways against sums written out with numpy.fft."""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.spectra.welch import (
    MOST_PACKED,
    PACKED_FROM,
    LineProducts,
    PackedProducts,
    SegmentProducts,
    WelchAverage,
    segment_products,
    trend_basis,
)
from labpipe.spectra.windows import window_values


@pytest.mark.parametrize("lines", [range(1, 33), range(1, 32), range(5, 12)])
@pytest.mark.parametrize(("n", "step"), [(64, 64), (64, 24), (65, 24)])
@pytest.mark.parametrize(
    ("way", "n_channel"), [*((LineProducts, n) for n in (1, 2, 3, 4)), *((PackedProducts, n) for n in (2, 4))]
)
def test_sums_are_those_written_out(
    rng: np.random.Generator, way: type[SegmentProducts], n: int, step: int, lines: range, n_channel: int
) -> None:
    # Literal twin: the trend is taken out of every segment before the window, X_a X_b* is summed segment by
    # segment.
    window, basis = window_values("hann", n), trend_basis("linear", n)
    samples = rng.normal(size=(6 * step + n, n_channel)) + 3.0
    segments = np.lib.stride_tricks.sliding_window_view(samples, n, axis=0)[::step].swapaxes(1, 2)
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
    matrix = products.matrix()
    np.testing.assert_allclose(matrix, expected, rtol=0, atol=1e-12 * np.max(np.abs(expected)))
    np.testing.assert_array_equal(matrix, matrix.conj().swapaxes(1, 2))
    np.testing.assert_array_equal(products.matrix([n_channel - 1, 0]), matrix[:, :, [n_channel - 1, 0]])
    assert products.n_block == 7


def test_short_segments_of_several_rooms_are_summed_as_one_by_one(rng: np.random.Generator) -> None:
    # Literal twin: X_a X_b* of every segment; two full rooms, whose transforms are not copied, and a rest.
    window, lines = window_values("hann", 512), range(1, 200)
    products = LineProducts(window, lines, 8, np.empty((0, 1), complex))
    segments = rng.normal(size=(2 * products.room + 7, 512, 8))
    for start in range(0, len(segments), products.room):
        some = segments[start : start + products.room]
        products.put(some, np.empty((len(some), 0, 8)))
    products.flush()
    spectra = np.fft.rfft(segments * window[:, None], axis=1)[:, lines.start : lines.stop]
    expected = np.einsum("sla,slb->lab", spectra, spectra.conj())
    np.testing.assert_allclose(products.matrix(), expected, rtol=0, atol=1e-12 * np.max(np.abs(expected)))


def test_long_blocks_are_packed_where_channels_are_few_and_in_pairs() -> None:
    trend = np.empty((0, 1), complex)
    for n, n_channel, way in (
        (2 * PACKED_FROM, 2, PackedProducts),
        (2 * PACKED_FROM - 1, 2, LineProducts),
        (MOST_PACKED * PACKED_FROM, MOST_PACKED, PackedProducts),
        (MOST_PACKED * PACKED_FROM, MOST_PACKED - 1, LineProducts),
    ):
        assert isinstance(segment_products(np.ones(n), range(1, 4), n_channel, trend), way)


@pytest.mark.parametrize(("n_channel", "way"), [(2, PackedProducts), (5, LineProducts)])
def test_two_threads_change_no_byte(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch, n_channel: int, way: type[SegmentProducts]
) -> None:
    """Blocks of uneven numbers of segments, long enough for several chunks of lines."""
    samples, matrices = rng.normal(size=(180_000, n_channel)), []
    for n_thread in (1, 2):
        monkeypatch.setattr("labpipe.spectra.welch.threads", lambda n_thread=n_thread: n_thread)
        average = WelchAverage(window_values("hann", 20_000), 7_000, n_channel)
        for start in range(0, samples.shape[0], 50_000):
            average.add(samples[start : start + 50_000])
        assert isinstance(average._products, way)
        matrices.append(average.spectra(1.0).matrix)
    np.testing.assert_array_equal(*matrices)
