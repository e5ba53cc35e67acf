"""Noise of hammer hits under an exponential window: correlation of lines, its way through the damping
correction, few hits.
"""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.records.recording import Channel, Recording
from labpipe.spectra.covariance import pooled_residual
from labpipe.spectra.damping import correlation_matrix, covariance_without_damping, without_added_damping
from labpipe.spectra.measurement import measure
from labpipe.spectra.settings import FrfSettings, ImpactSettings
from labpipe.spectra.windows import exponential_correlation, exponential_window


@pytest.mark.parametrize(("length", "constant"), [(4096, 300.0), (4096, 600.0), (2000, 150.0)])
def test_lines_of_an_exponential_window_are_correlated_as_its_square_transforms(
    length: int, constant: float
) -> None:
    found = exponential_correlation(exponential_window(length, constant), 0.0)
    # sum w^2 exp(-2 pi j d t / N) of a window that has died away: 1 / (1 + j pi d tau / T), but for the
    # sampling.
    closed = 1 / (1 + 1j * np.pi * np.arange(1, found.size + 1) * constant / length)
    np.testing.assert_allclose(found, closed, atol=0.01)
    assert (
        abs(closed[-1]) > 0.019 and abs(1 / (1 + 1j * np.pi * (found.size + 1) * constant / length)) < 0.021
    )


def test_the_correlation_counts_from_the_hit(rng: np.random.Generator) -> None:
    # White noise, windowed, divided by the force of a hit at sample 40: 3000 records.
    window, origin = exponential_window(256, 60.0), 40
    lines = np.arange(20, 30)
    force = np.exp(-2j * np.pi * lines * origin / 256)
    noise = np.fft.fft(rng.normal(size=(3000, 256)) * window, axis=1)[:, lines] / force
    measured = noise.T @ noise.conj() / np.sum(np.abs(noise[:, 0]) ** 2)
    predicted = correlation_matrix(lines, exponential_correlation(window, float(origin)))
    # 3000 records: 1.8 % on a correlation, 2.6 % on a variance.
    np.testing.assert_allclose(measured, predicted, atol=0.1)
    assert np.max(np.abs(measured - correlation_matrix(lines, exponential_correlation(window, 0.0)))) > 0.5


def one_mode(frequency: np.ndarray, decay: float) -> np.ndarray:
    s = 2j * np.pi * frequency + 1 / decay
    return (1 / (s**2 + 4.0 * s + (2 * np.pi * 45.3) ** 2))[:, None, None]


def test_gains_are_the_slopes_of_the_correction() -> None:
    frequency, decay = np.arange(20.0, 70.0), 0.3
    matrix = one_mode(frequency, decay)
    undamped = without_added_damping(frequency, matrix, decay)
    for line in (5, 24, 25, 26, 40):
        for part in (1.0, 1j):
            moved = matrix.copy()
            step = 1e-6 * part * abs(matrix[line, 0, 0])
            moved[line] += step
            slope = (without_added_damping(frequency, moved, decay).matrix - undamped.matrix)[:, 0, 0] / step
            for place, gain in ((line + 4 - j, undamped.gains[line + 4 - j, j, 0, 0]) for j in range(9)):
                # Lines nearer to the ends than four have neighbours to one side.
                if 4 <= place < 46:
                    assert slope[place] == pytest.approx(gain, rel=1e-3, abs=1e-3)


def test_lines_without_enough_neighbours_stand_alone() -> None:
    undamped = without_added_damping(np.arange(3.0), np.ones((3, 1, 1), np.complex128), 0.3)
    np.testing.assert_array_equal(undamped.gains[:, :, 0, 0], np.eye(9)[[4, 4, 4]])


@pytest.mark.long
def test_variance_of_the_corrected_response_is_that_of_its_neighbours(rng: np.random.Generator) -> None:
    frequency, decay = np.arange(20.0, 70.0), 0.3
    matrix = one_mode(frequency, decay)
    correlation = exponential_correlation(exponential_window(512, 512 * decay), 10.0)
    root = np.linalg.cholesky(correlation_matrix(np.arange(50), correlation) + 1e-9 * np.eye(50))
    size = 1e-3 * np.abs(matrix).max()
    drawn = [
        size * (root @ (rng.normal(size=50) + 1j * rng.normal(size=50))) / np.sqrt(2) for _ in range(600)
    ]
    corrected = np.array(
        [
            without_added_damping(frequency, matrix + noise[:, None, None], decay).matrix[:, 0, 0]
            for noise in drawn
        ]
    )
    covariance = np.full((50, 1, 1), size**2, np.complex128)
    predicted = covariance_without_damping(
        without_added_damping(frequency, matrix, decay).gains, covariance, correlation
    )[:, 0, 0].real
    around = slice(18, 33)
    # 600 draws: 4 % on a variance.
    np.testing.assert_allclose(corrected.var(axis=0)[around], predicted[around], rtol=0.2)
    assert np.ptp(np.log(predicted[around])) > 1.0


def test_noise_of_few_hits_is_averaged_over_lines(rng: np.random.Generator) -> None:
    flat = rng.exponential(size=(400, 1, 1)).astype(np.complex128)
    peak = (1 / (1 + 1j * (np.arange(400) - 200.0) / 30))[:, None, None]
    averaged = pooled_residual(flat, peak, 10)
    assert averaged[10:390, 0, 0].real == pytest.approx(
        [flat[k - 10 : k + 11].real.mean() for k in range(10, 390)]
    )
    np.testing.assert_array_equal(pooled_residual(flat, peak, 0), flat)


def test_a_residual_as_large_as_the_response_is_not_smeared() -> None:
    peak = (1 / (1 + 1j * (np.arange(400) - 200.0) / 3))[:, None, None]
    both = 0.1 + np.abs(peak) ** 2
    np.testing.assert_allclose(pooled_residual(both.astype(np.complex128), peak, 10), both, rtol=1e-6)


def test_a_loud_recording_does_not_hide_how_well_the_noise_is_known(rng: np.random.Generator) -> None:
    """Two forces, the recordings of one six times as noisy. With a covariance of nu degrees of freedom the
    whitened error of n responses is nu / (nu - n) in the mean (complex Wishart; Goodman 1963).
    """
    n, n_hit, outputs = 512, 5, 6
    recordings = []
    for place, size in (("a", 0.01), ("b", 0.06)):
        force = np.zeros(n * n_hit)
        force[20::n] = 1.0
        motion = force[:, None] + size * rng.normal(size=(force.size, outputs))
        channels = (
            Channel("f", "force", "input", place),
            *(Channel(f"x{k}", "displacement", "output", f"p{k}") for k in range(outputs)),
        )
        recordings.append(Recording(channels, np.column_stack([force, motion]), 512.0, place))
    response = measure(recordings, FrfSettings("impact", block=1.0, band=(2.0, 250.0)))
    errors = (response.matrix - 1.0).reshape(-1, 2 * outputs)
    covariance = response.covariance
    assert covariance is not None
    squares = np.einsum("fa,fab,fb->f", errors.conj(), np.linalg.inv(covariance), errors).real
    dof = response.covariance_dof
    assert squares.mean() / (2 * outputs) == pytest.approx(dof / (dof - outputs), rel=0.05)


@pytest.mark.parametrize(("n_hit", "decay"), [pytest.param(9, None, marks=pytest.mark.long), (3, 0.3)])
def test_noise_of_the_force_is_that_of_each_points_own_response(
    rng: np.random.Generator, n_hit: int, decay: float | None
) -> None:
    """A mode struck at its largest point and near its node, with noise of the hammer: dH = -H N / F, so that
    both columns are known to the same share at the peak, and errors over their variance are nu / (nu - 1).
    Nine hits of a point tell its noise; three whose window lets lines share theirs do not, and those of all
    points tell the law that it follows.
    """
    n = 2048
    frequency = np.arange(n // 2 + 1.0)
    mode = 1 / (60.0**2 - frequency**2 + 2j * 0.05 * 60.0 * frequency) * 360.0
    at_peak = slice(57 - 2, 64 - 2)
    squares = []
    for _ in range(48):
        recordings = []
        for place, size in (("a", 1.0), ("b", 0.05)):
            force = np.zeros(n)
            force[40:43] = 1.0, 2.0, 1.0
            motion = np.fft.irfft(size * mode * np.fft.rfft(force), n)
            samples = np.tile(np.column_stack([force, motion]), (n_hit, 1))
            samples += np.array([5e-3, 2e-4]) * rng.normal(size=samples.shape)
            channels = Channel("f", "force", "input", place), Channel("x", "displacement", "output", "p")
            recordings.append(Recording(channels, samples, float(n), place))
        impact = ImpactSettings() if decay is None else ImpactSettings(decay=decay)
        response = measure(recordings, FrfSettings("impact", block=1.0, band=(2.0, 200.0), impact=impact))
        errors = (response.matrix[:, 0] - mode[2:201, None] * np.array([1.0, 0.05]))[at_peak]
        variance = response.variance
        assert variance is not None
        squares.append(np.abs(errors) ** 2 / variance[at_peak, 0])
    dof = response.covariance_dof
    # 48 draws of seven lines, of which three may share their noise: 9 %.
    assert np.mean(squares, axis=(0, 1)) == pytest.approx([dof / (dof - 1)] * 2, rel=0.3)


def test_a_recording_without_any_noise_beside_others_is_no_fault(rng: np.random.Generator) -> None:
    """Under a force window hits are aligned: one whose responses scatter by nothing had infinite weights, and
    pulses of samples 1, 2, 1 have no power at half the sampling rate.
    """
    rate, n = 512.0, 20 * 512
    force = np.zeros(2 * n)
    for begin in range(150, n - 600, 1024):
        force[begin : begin + 3] = 50.0, 100.0, 50.0
    w = 2 * np.pi * np.fft.rfftfreq(2 * n, 1 / rate)
    receptance = 1 / (180e3 - 0.92 * w**2 + 120j * w)
    clean = np.column_stack([force, np.fft.irfft(np.fft.rfft(force) * receptance, 2 * n)])[:n]
    channels = (Channel("f", "force", "input", "x"), Channel("x", "displacement", "output", "x"))
    runs = [
        Recording(channels, clean + noise * np.std(clean, axis=0) * rng.normal(size=clean.shape), rate, "run")
        for noise in (0.003, 0.0)
    ]
    hits = ImpactSettings(force_window=0.05)
    response = measure(runs, FrfSettings("impact", block=1.0, impact=hits))
    assert "force-noise" in [finding.code for finding in response.findings]
    omega = 2 * np.pi * response.frequency
    off = response.matrix[:, 0, 0] * (180e3 - 0.92 * omega**2 + 120j * omega) - 1
    assert np.max(np.abs(off[(omega > 200) & (omega < 900)])) < 0.05
