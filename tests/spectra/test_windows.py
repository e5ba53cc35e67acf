"""Windows against sums written out.

The printed figures of Harris (1978) are in the validation manual (tests/validation/frf.py).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import fftconvolve

from labpipe.errors import ConfigError
from labpipe.records.recording import Channel, Recording
from labpipe.records.response import Blocks
from labpipe.spectra.local import local_polynomials
from labpipe.spectra.random import with_bursts
from labpipe.spectra.welch import CrossSpectra
from labpipe.spectra.windows import (
    POINTS,
    amplitude_correlation,
    effective_averages,
    kernel_of,
    line_correlation,
    noise_bandwidth,
    overlap_correlation,
    window_values,
)


@pytest.mark.parametrize("name", ["hann", "hamming"])
def test_cosine_windows_have_closed_forms(name: str) -> None:
    # w = a - (1 - a) cos: sum w^2 = n (a^2 + b^2/2); at half overlap cos turns its sign: sum = n (a^2/2 -
    # b^2/4), the mixed terms cancel. Harris prints 23.5 % for Hamming where this gives 23.4.
    a = {"hann": 0.5, "hamming": 0.54}[name]
    b, window = 1 - a, window_values(name, 1024)
    assert noise_bandwidth(window) == pytest.approx((a**2 + b**2 / 2) / a**2, rel=1e-12)
    expected = (a**2 / 2 - b**2 / 4) / (a**2 + b**2 / 2)
    assert np.sqrt(overlap_correlation(window, 512)[0]) == pytest.approx(expected, rel=1e-10)


def test_overlap_correlation_is_the_sum_written_out() -> None:
    window = window_values("blackman", 32)
    expected = (sum(window[n] * window[n + 12] for n in range(20)) / sum(value**2 for value in window)) ** 2
    correlation = overlap_correlation(window, 12)
    assert correlation.size == 2
    assert correlation[0] == pytest.approx(expected, rel=1e-12)


def test_a_window_s_parameter_stands_behind_its_name() -> None:
    np.testing.assert_array_equal(window_values("tukey 0", 16), np.ones(16))
    assert noise_bandwidth(window_values("kaiser 8.6", 4096)) == pytest.approx(
        1.72, abs=0.01
    )  # Kaiser-Bessel, Harris' alpha = 8.6 / pi
    for wrong in ("hannn", "kaiser", "hann x", "tukey 1 2 3"):
        with pytest.raises(ConfigError, match=f"unknown window '{wrong}'"):
            window_values(wrong, 16)
    # Its shape over 512 samples, from which leakage is known, is not that over a block.
    with pytest.raises(ConfigError, match="'gaussian 100' counts samples"):
        window_values("gaussian 100", 1000)


@pytest.mark.parametrize("share", [0.25, 0.5, 1.0])
def test_what_a_block_shows_of_an_impulse_response_after_a_burst(share: float) -> None:
    """Of a force over the first share s of a block T the product with the response a lag later is complete up
    to (1 - s) T and falls to none at T: min(1, (1 - lag / T) / s), away from its corners.
    """
    parts = 64
    course = tuple(1.0 if n < share * parts else 0.0 for n in range(parts))
    kernel = kernel_of(Blocks(2.0, "boxcar", 0.0, 10, "H1", bursts=course))
    assert kernel is not None
    for lag in (0.1, 0.4, 0.6, 0.8, 0.95):
        seen = kernel.weights @ np.exp(-2j * np.pi * lag * kernel.offsets / POINTS)
        assert seen == pytest.approx(min(1.0, (1 - lag) / share), abs=1e-3)


@pytest.mark.parametrize("course", [(1.0,) * 20 + (0.0,) * 44, (0.0,) * 32 + (1.0,) * 20 + (0.0,) * 12])
@pytest.mark.parametrize("window", ["boxcar", "hann"])
@pytest.mark.parametrize("width", [0.8, 5.0])
def test_what_blocks_of_bursts_show_of_a_mode(course: tuple[float, ...], window: str, width: float) -> None:
    """The transform of h times what a block holds of it, each summed over 20,000 samples of the block: a mode
    *width* lines wide (half power) at line 66. A sum of cosines cut off at 64 lines was wrong by 1.6 %.
    """
    n, decay, w = 20_000, np.pi * width, 2 * np.pi * 66.0
    t, lines = np.arange(n) / n, np.arange(23, 110)
    taper = np.ones(n) if window == "boxcar" else 0.5 - 0.5 * np.cos(2 * np.pi * t)
    force = np.array(course)[np.arange(n) * 64 // n]
    seen = fftconvolve(taper, (taper * force)[::-1])[n - 1 :]
    h = np.exp(-decay * t) * np.sin(w * t) * seen / seen[0]
    shown = np.trapezoid(h * np.exp(-2j * np.pi * lines[:, None] * t), t, axis=1)
    kernel = kernel_of(Blocks(1.0, window, 0.0, 10, "H1", bursts=course))
    assert kernel is not None
    s = 2j * np.pi * (lines[:, None] + kernel.offsets / POINTS)
    assert np.max(np.abs((w / ((s + decay) ** 2 + w**2)) @ kernel.weights / shown - 1)) < 0.005


def test_bursts_are_seen_however_a_file_is_read() -> None:
    """Text comes in pieces that are no whole blocks: eleven blocks of 1,000 samples in pieces of 2,500."""

    class InPieces(Recording):
        def blocks(self, n_sample: int) -> Iterator[np.ndarray]:
            for start in range(0, self.n_sample, 2500):
                yield from Recording.blocks(
                    replace(self, samples=self.samples[start : start + 2500]), n_sample
                )

    rests = np.arange(1000) >= 400
    force = np.random.default_rng(5).normal(size=(11, 1000)) * ~rests
    source = InPieces((Channel("f", "force", "input", "x"),), force.reshape(-1, 1), 1000.0, "text")
    spectra = [CrossSpectra(np.arange(2.0), np.zeros((1, 1, 2)), 11, 11.0)]
    course = with_bursts(Blocks(1.0, "boxcar", 0.0, 11, "H1"), spectra, [source]).bursts
    assert [power > 0 for power in course] == [part < 103 for part in range(256)]
    # Of 21 blocks that overlap by half, 11 begin with a burst and 10 half a period after it.
    spectra[0] = replace(spectra[0], n_block=21)
    course = with_bursts(Blocks(1.0, "hann", 0.5, 21, "H1"), spectra, [source]).bursts
    assert sum(course[:103]) / sum(course[128:231]) == pytest.approx(11 / 10)


@pytest.mark.parametrize(("degree", "half_width"), [(2, 5), (3, 6), (4, 8)])
def test_local_polynomials_of_rough_forces_weigh_lines_as_their_kernel(degree: int, half_width: int) -> None:
    """A polynomial of that degree comes back, and the mean FRF of 4,000 blocks of white forces is the
    kernel's of a peak that no polynomial follows.
    """
    rng, blocks = np.random.default_rng(8), Blocks(1.0, "none", 0.0, 8, "H1", degree, half_width=half_width)
    kernel = kernel_of(blocks)
    assert kernel is not None and kernel_of(replace(blocks, estimator="H2")) is None
    r = kernel.offsets / POINTS
    for power in range(degree + 1):
        assert kernel.weights @ r**power == pytest.approx(float(power == 0), abs=1e-12 * half_width**power)
    h = 1 / (1 + 1j * (np.arange(2 * half_width + 1) - half_width))
    forces = rng.normal(size=(2, 4000, h.size, 1)) @ np.ones(1)
    force = (forces[0] + 1j * forces[1])[..., None]
    fitted = local_polynomials(force, force * h[:, None], degree, half_width)
    assert fitted.matrix[0, 0, 0] == pytest.approx(complex(kernel.weights @ h), abs=0.01)


def test_without_overlap_every_block_counts() -> None:
    assert overlap_correlation(np.ones(64), 64).size == 0
    assert effective_averages(np.ones(64), 64, 7) == pytest.approx(7.0)


def correlation_written_out(window: np.ndarray, step: int, n_block: int, apart: int) -> float:
    """sum over pairs of blocks of |sum_t w(t - m step) w(t - n step) exp(-2 pi j d t / N)|^2, over the same
    at d = 0.
    """
    n = window.size
    t = np.arange((n_block - 1) * step + n)
    blocks = [
        np.concatenate([np.zeros(b * step), window, np.zeros(t.size - n - b * step)]) for b in range(n_block)
    ]
    turn = np.exp(-2j * np.pi * apart * t / n)
    products = {
        d: sum(abs(np.sum(one * other * turn**d)) ** 2 for one in blocks for other in blocks) for d in (0, 1)
    }
    return products[1] / products[0]


@pytest.mark.parametrize(
    ("name", "overlap"), [("hann", 0.5), ("hann", 0.75), ("hamming", 0.3), ("boxcar", 0.5), ("flattop", 0.6)]
)
def test_line_correlation_is_the_sum_over_pairs_of_blocks(name: str, overlap: float) -> None:
    window = window_values(name, 60)
    step = round(60 * (1 - overlap))
    found = line_correlation(window, step, 5)
    expected = [correlation_written_out(window, step, 5, apart) for apart in range(1, len(found) + 1)]
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)


def test_amplitudes_share_noise_through_a_window() -> None:
    """w^2 of Hann is 3/8 - cos / 2 + cos(2 x) / 8: -1/4 and 1/16 over 3/8."""
    assert amplitude_correlation("hann") == pytest.approx((-2 / 3, 1 / 6), rel=1e-9)
    assert amplitude_correlation("boxcar") == ()
    with pytest.raises(ConfigError, match="unknown window"):
        amplitude_correlation("hahn")


def test_line_correlation_closed_forms() -> None:
    assert line_correlation(window_values("boxcar", 64), 64, 10) == ()
    # Blocks apart: of w^2 = 3/8 - cos/2 + cos(2 .)/8 the lines are 3/8, 1/4, 1/16.
    assert line_correlation(window_values("hann", 64), 64, 10) == pytest.approx(
        ((2 / 3) ** 2, (1 / 6) ** 2), rel=1e-9
    )


@pytest.mark.parametrize(("name", "overlap"), [("hann", 0.5), ("hamming", 0.0)])
def test_the_noise_of_an_frf_is_shared_as_predicted(
    name: str, overlap: float, rng: np.random.Generator
) -> None:
    n, n_record = 32, 3000
    window, step = window_values(name, n), round(n * (1 - overlap))
    starts = np.arange(6) * step
    force, noise = rng.standard_normal((2, n_record, starts[-1] + n))
    u, e = (
        np.fft.rfft(np.stack([x[:, s : s + n] * window for s in starts], 1))[:, :, 3:14]
        for x in (force, noise)
    )
    error = np.sum(e * u.conj(), axis=1)
    power = np.mean(np.abs(error) ** 2)
    predicted = line_correlation(window, step, 6)
    for apart in (1, 2):
        found = np.mean(error[:, apart:] * error[:, :-apart].conj()) / power
        # 3000 records of about 10 pairs of lines: standard error about 0.01.
        assert abs(found - predicted[apart - 1]) < 0.03
