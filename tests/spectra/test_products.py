"""Cross-products of segments: against sums written out with numpy.fft."""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.spectra.welch import RowProducts, SegmentProducts, WelchAverage, trend_basis
from labpipe.spectra.windows import window_values


@pytest.mark.parametrize("lines", [range(1, 33), range(1, 32), range(5, 12)])
@pytest.mark.parametrize(("n", "step"), [(64, 64), (64, 24), (65, 24)])
@pytest.mark.parametrize("n_channel", [1, 2, 3, 4])
@pytest.mark.parametrize("way", [SegmentProducts, RowProducts])
def test_sums_are_those_written_out(
    rng: np.random.Generator,
    way: type[SegmentProducts | RowProducts],
    n: int,
    step: int,
    lines: range,
    n_channel: int,
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
    products = SegmentProducts(window, lines, 8, np.empty((0, 1), complex))
    segments = rng.normal(size=(2 * products.room + 7, 512, 8))
    for start in range(0, len(segments), products.room):
        some = segments[start : start + products.room]
        products.put(some, np.empty((len(some), 0, 8)))
    products.flush()
    spectra = np.fft.rfft(segments * window[:, None], axis=1)[:, lines.start : lines.stop]
    expected = np.einsum("sla,slb->lab", spectra, spectra.conj())
    np.testing.assert_allclose(products.matrix(), expected, rtol=0, atol=1e-12 * np.max(np.abs(expected)))


@pytest.mark.parametrize("n_channel", [2, 5])
def test_two_threads_change_no_byte(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch, n_channel: int
) -> None:
    """Blocks of uneven numbers of segments, long enough for several chunks of lines."""
    samples, matrices = rng.normal(size=(180_000, n_channel)), []
    for n_thread in (1, 2):
        monkeypatch.setattr("labpipe.spectra.welch.threads", lambda n_thread=n_thread: n_thread)
        average = WelchAverage(window_values("hann", 20_000), 7_000, n_channel)
        for start in range(0, samples.shape[0], 50_000):
            average.add(samples[start : start + 50_000])
        matrices.append(average.spectra(1.0).matrix)
    np.testing.assert_array_equal(*matrices)


@pytest.mark.parametrize(("n", "n_channel"), [(512, 2), (20_000, 2), (20_000, 4)])
def test_a_displacement_beside_a_force_is_no_less_exact(
    rng: np.random.Generator, n: int, n_channel: int
) -> None:
    # Powers of two are exact in every product and sum: newtons beside nanometres, to the last digit as alike.
    samples, factors = rng.normal(size=(6 * n, n_channel)), np.exp2([10.0, -30.0] * (n_channel // 2))
    matrices = []
    for scaled in (samples, samples * factors):
        average = WelchAverage(window_values("hann", n), n // 2, n_channel)
        average.add(scaled)
        matrices.append(average.spectra(1.0).matrix)
    np.testing.assert_array_equal(matrices[1], matrices[0] * np.multiply.outer(factors, factors))
