"""What FRF programs are known to get wrong, each against a closed form: units, windows, scales, signs,
clipping, coherence.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal

from labpipe.errors import DataError
from labpipe.raw_files.screening import ChannelScreen
from labpipe.records.recording import Channel, Recording
from labpipe.records.response import FrequencyResponse, Port
from labpipe.spectra.convert import convert
from labpipe.spectra.measurement import measure
from labpipe.spectra.random import h2, hv
from labpipe.spectra.settings import FrfSettings
from labpipe.spectra.windows import window_values

FORCE = Channel("f", "force", "input", "x", 0.0)
X = Channel("x", "displacement", "output", "x", 0.0)


def noisy_gain(gain: float, share: float, rate: float = 256.0, n: int = 40_000) -> Recording:
    """y = gain u, both sensors with noise of *share* of their rms; unit white force."""
    rng = np.random.default_rng(31)
    u = rng.normal(size=n)
    noise = share * rng.normal(size=(n, 2))
    return Recording((FORCE, X), np.column_stack([u + noise[:, 0], gain * (u + noise[:, 1])]), rate, "run")


def test_hv_is_unbiased_in_newtons_as_in_metres() -> None:
    # Equal shares of noise on both sides; in metres, with H1 and H2 beside it, it is a row of the validation
    # manual.
    response = measure([noisy_gain(1.0, 0.5)], FrfSettings(excitation="random", block=1.0, estimator="Hv"))
    assert np.mean(response.matrix.real) == pytest.approx(1.0, abs=0.01)


def test_hv_of_two_forces_in_mixed_units() -> None:
    # Forces in N and kN, response in micrometres: each column scales by its own unit and nothing else.
    rng = np.random.default_rng(32)
    u = rng.normal(size=(2, 300)) + 1j * rng.normal(size=(2, 300))
    y = np.array([[1.0, 0.5j]]) @ u + 0.3 * rng.normal(size=(1, 300))
    plain = hv(*(np.array([a @ b.conj().T]) for a, b in ((u, u), (y, u), (y, y))))
    units = np.array([[1.0], [1e-3]])
    v, w = units * u, 1e6 * y
    scaled = hv(*(np.array([a @ b.conj().T]) for a, b in ((v, v), (w, v), (w, w))))
    np.testing.assert_allclose(scaled, plain * 1e6 / units.T, rtol=1e-9)


def test_the_hann_window_is_periodic() -> None:
    # A sine on a line leaks into exactly one line to either side with the periodic window: 1, 1/2, 0.
    n = 64
    line = np.abs(np.fft.rfft(window_values("hann", n) * np.cos(2 * np.pi * 10 * np.arange(n) / n)))
    np.testing.assert_allclose(line[[8, 9, 10, 11, 12]] / line[10], [0, 0.5, 1, 0.5, 0], atol=1e-14)


def test_a_clipped_second_response_is_seen() -> None:
    rng = np.random.default_rng(33)
    samples = rng.normal(size=(5000, 3))
    samples[:, 2] = np.clip(samples[:, 2], -1.5, 1.5)
    screen = ChannelScreen(["f", "x", "y"])
    screen.add(samples)
    assert [(finding.code, finding.message[:9]) for finding in screen.findings()] == [
        ("clipped", "channel y")
    ]


@pytest.mark.parametrize("rate", [1000 / 3, 51_200 / 7, 0.1])
def test_a_sampling_rate_that_is_no_whole_number(rate: float) -> None:
    rng = np.random.default_rng(34)
    u = rng.normal(size=8000)
    recording = Recording((FORCE, X), np.column_stack([u, np.roll(u, 1)]), rate, "run")
    response = measure([recording], FrfSettings(excitation="random", block=100 / rate))
    np.testing.assert_allclose(response.frequency, np.arange(1, 51) * rate / 100, rtol=1e-12)
    # One sample of delay; within a block one sample of 100 is not the force's own.
    np.testing.assert_allclose(
        response.matrix[:, 0, 0], np.exp(-2j * np.pi * response.frequency / rate), atol=0.05
    )


def test_accelerance_at_0_hz_is_no_receptance() -> None:
    port = (Port("a", "a", "a"),)
    accelerance = FrequencyResponse(np.array([0.0, 1.0]), np.ones((2, 1, 1)), port, port, form="accelerance")
    with pytest.raises(DataError, match="0 Hz"):
        convert(accelerance, "receptance")


def test_h2_of_a_matrix_that_is_not_symmetric() -> None:
    # S_uy is not Hermitian: noise-free spectra of H = [[1, 2], [0, 1j]] give H back only by a general
    # inverse.
    h = np.array([[[1.0, 2.0], [0.0, 1.0j]]])
    s_uu = np.array([[[2.0, 0.3j], [-0.3j, 1.0]]])
    s_yu = h @ s_uu
    np.testing.assert_allclose(h2(s_uu, s_yu, s_yu @ h.conj().swapaxes(1, 2)), h, atol=1e-14)


@pytest.mark.parametrize("excitation", ["random", "periodic", "impact"])
def test_no_scale_changes_a_result(excitation: str) -> None:
    rng = np.random.default_rng(36)
    n = 8192
    u = (
        np.tile(rng.normal(size=512), 16)
        if excitation != "impact"
        else (np.arange(n) % 1024 == 200).astype(float)
    )
    y = signal.lfilter([1.0], [1.0, -0.5], u) + 1e-3 * rng.normal(size=n)
    length = {"period" if excitation == "periodic" else "block": 1.0}
    settings = FrfSettings(excitation=excitation, band=(5.0, 100.0), **length)
    plain, tiny = (
        measure([Recording((FORCE, X), np.column_stack([u, y]) * scale, 512.0, "run")], settings)
        for scale in (1.0, 1e-12)
    )
    np.testing.assert_allclose(tiny.matrix, plain.matrix, rtol=1e-9)
    np.testing.assert_allclose(tiny.covariance, plain.covariance, rtol=1e-6)
    assert [finding.code for finding in tiny.findings] == [finding.code for finding in plain.findings]


@pytest.mark.parametrize("share", [0.0, 1e-9, 30.0])
def test_coherence_stays_within_0_and_1(share: float) -> None:
    response = measure([noisy_gain(1e-6, share, n=3000)], FrfSettings(excitation="random", block=1.0))
    assert response.coherence is not None and response.multiple_coherence is not None
    for values in (response.coherence, response.multiple_coherence):
        assert values.min() >= 0 and values.max() <= 1
    assert response.variance is None or response.variance.min() >= 0
