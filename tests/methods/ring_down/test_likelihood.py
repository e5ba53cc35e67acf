"""Poles of free decays against exact decays, a Fisher matrix made another way, and drawn noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from labpipe.errors import FitError
from labpipe.methods.ring_down.fit import mode_parameters
from labpipe.methods.ring_down.likelihood import (
    Judged,
    ending_of,
    maximum_likelihood,
    most_likely,
    pencil_poles,
    pieces_of,
    rows_by_samples,
    rows_by_sums,
    solve,
)
from labpipe.records.spectra import FreeDecay
from tests.methods.ring_down.records_of_decay import RATE, Modes, bound, motion, record, times

ONE = ((40.0, 0.005, 1.0, 0.3),)
TWO = ((40.0, 0.005, 1.0, 0.3), (40.4, 0.005, 0.7, 1.9))
APART = ((40.0, 0.005, 1.0, 0.3), (42.0, 0.005, 0.7, 1.9))


def poles_of(modes: Modes) -> np.ndarray:
    f, z = np.array([mode[:2] for mode in modes]).T
    return 2 * np.pi * f * (-z + 1j * np.sqrt(1 - z**2))


def fitted(columns: list[np.ndarray], n_mode: int, band: tuple[float, float] | None = None):
    decays = record(columns).decays
    pieces = pieces_of(decays, [0], RATE, band)
    return most_likely(decays, [0], pieces, RATE, band, n_mode)


@pytest.mark.parametrize("modes", [ONE, TWO, APART], ids=["one", "1 % apart", "5 % apart"])
def test_a_decay_without_noise_gives_its_poles(modes: Modes) -> None:
    """Closed form; the offset of 3 is not a mode."""
    fit = fitted([motion(modes, times()) + 3.0], len(modes))
    np.testing.assert_allclose(fit.poles, poles_of(modes), rtol=1e-9)


def test_hits_of_unlike_amplitude_phase_and_length_share_their_poles() -> None:
    hits = [
        motion(((40.0, 0.005, a, p),), times(d)) + o
        for a, p, d, o in ((1.0, 0.1, 4.0, 0.0), (0.3, 2.0, 2.5, 1.0), (0.7, 4.0, 3.1, -2.0))
    ]
    np.testing.assert_allclose(fitted(hits, 1).poles, poles_of(ONE), rtol=1e-9)


def test_a_long_lightly_damped_record_keeps_its_phase() -> None:
    """2400 turns: the start from the first 600 samples alone would be off by whole turns."""
    modes = ((40.0, 5e-5, 1.0, 0.3),)
    noise = 0.02 * np.random.default_rng(7).standard_normal(times(60.0).size)
    fit = fitted([motion(modes, times(60.0)) + noise], 1)
    assert abs(fit.poles[0].imag - poles_of(modes)[0].imag) < 4 * np.sqrt(fit.covariance[1, 1]) < 1e-3


@pytest.mark.parametrize("modes", [ONE, TWO], ids=["one", "two"])
def test_the_covariance_is_the_inverse_fisher_matrix(modes: Modes) -> None:
    """Against all parameters at once, by differences, in f and zeta.

    The noise's size is that of the residual.
    """
    t, sigma = times(), 0.01
    y = motion(modes, t) + sigma * np.random.default_rng(3).standard_normal(t.size)
    fit = fitted([y], len(modes))
    errors = [p.std_error for p in mode_parameters(fit, None) if not p.derived]
    np.testing.assert_allclose(errors, bound(modes, t, float(np.sqrt(fit.variance[0, 0]))), rtol=0.02)
    assert fit.dof == t.size - 1 - 4 * len(modes)


def test_the_minimum_is_that_of_a_plain_search() -> None:
    """A readable twin: scipy's least squares over f, zeta, amplitude, phase and offset."""
    t = times()
    y = motion(ONE, t) + 0.5 + 0.05 * np.random.default_rng(4).standard_normal(t.size)
    twin = least_squares(
        lambda x: motion([tuple(x[:4])], t) + x[4] - y,
        [40.01, 0.0051, 1.0, 0.3, 0.5],
        x_scale=[40, 0.005, 1, 1, 1],
        xtol=1e-14,
    )
    f_n, zeta, _ = mode_parameters(fitted([y], 1), None)
    assert f_n.value == pytest.approx(twin.x[0], rel=1e-8) and zeta.value == pytest.approx(
        twin.x[1], rel=1e-6
    )


def test_the_residual_is_orthogonal_to_the_tangent() -> None:
    piece = pieces_of(record([motion(ONE, times())]).decays, [0], RATE, None)[0]
    solved = solve(piece, poles_of(ONE) * 1.001)
    np.testing.assert_allclose(solved.range_.T @ solved.tangent, 0, atol=1e-9)
    np.testing.assert_allclose(solved.range_.T @ solved.residual, 0, atol=1e-9)


def test_a_band_keeps_another_mode_out() -> None:
    """A strong mode at 95 Hz and hum at 50 Hz outside 35-45 Hz.

    The error stays within four standard errors of the truth.
    """
    t = times()
    noise = 0.01 * np.random.default_rng(5).standard_normal(t.size)
    y = motion((*ONE, (95.0, 0.01, 3.0, 1.0)), t) + 0.2 * np.cos(2 * np.pi * 50 * t + 1) + noise
    f_n, zeta, _ = mode_parameters(fitted([y], 1, (35.0, 45.0)), None)
    assert (
        abs(f_n.value - 40) < 4 * f_n.std_error < 0.01 and abs(zeta.value - 0.005) < 4 * zeta.std_error < 2e-4
    )
    assert 0.9 < f_n.std_error / bound(ONE, t, 0.01)[0] < 1.3


def test_a_band_of_few_lines_and_a_short_decay_are_refused() -> None:
    with pytest.raises(FitError, match="2 lines of a decay of 4 s lie in the band"):
        fitted([motion(ONE, times())], 1, (39.8, 40.3))
    with pytest.raises(FitError, match="samples of its highest frequency long"):
        pencil_poles([np.ones(9)], RATE, 1, 2)
    with pytest.raises(FitError, match="became one"):
        maximum_likelihood(
            pieces_of((FreeDecay("a", 0.0, motion(ONE, times())[:, None]),), [0], RATE, None),
            np.repeat(poles_of(ONE), 2),
        )


def drawn(modes: Modes, sigma: float, bits: int, draws: int) -> tuple[np.ndarray, np.ndarray]:
    """Errors over the Cramer-Rao bound, and whether the intervals hold the truth, (draw, f_1 zeta_1 f_2 ...);
    seeds pinned.

    8 bits: steps of 5/256 of the first amplitude, whose own variance, step^2 / 12, counts as noise.
    """
    t, truth = times(), np.array([value for mode in modes for value in mode[:2]])
    step = 5.0 / 2**bits if bits else 0.0
    ratios, holds = [], []
    for seed in range(draws):
        rng = np.random.default_rng([11, seed])
        phased = [(f, z, a, float(rng.uniform(0, 2 * np.pi))) for f, z, a, _ in modes]
        y = motion(phased, t) + 0.1 + sigma * rng.standard_normal(t.size)
        fit = fitted([np.round(y / step) * step if bits else y], len(modes))
        values = [p for p in mode_parameters(fit, None) if not p.derived]
        errors = np.array([p.value for p in values]) - truth
        ratios.append(errors / bound(phased, t, float(np.hypot(sigma, step / np.sqrt(12)))))
        holds.append([p.ci95[0] <= true <= p.ci95[1] for p, true in zip(values, truth, strict=True)])
    return np.array(ratios), np.array(holds)


CASES = pytest.mark.parametrize("bits", [0, 8], ids=["exact", "8 bit"])
PAIRS = pytest.mark.parametrize("modes", [ONE, TWO, APART], ids=["one mode", "1 % apart", "5 % apart"])


@pytest.mark.long
@CASES
@PAIRS
def test_the_bound_is_reached_and_intervals_hold_the_truth(modes: Modes, bits: int) -> None:
    """40 draws: root mean square error within 1.1 of the Cramer-Rao bound beside two of its deviations,
    intervals within three binomial deviations of 95 % (80 % would fail in 94 of 100), none is lost.
    """
    ratios, holds = drawn(modes, 0.01, bits, 40)
    frequency, damping = ratios[:, 0::2], ratios[:, 1::2]
    size = 1.1 + 2 / np.sqrt(2 * frequency.size)
    assert np.sqrt(np.mean(frequency**2)) < size and np.sqrt(np.mean(damping**2)) < size
    chance = 3 * np.sqrt(0.95 * 0.05 / frequency.size)
    assert all(abs(share - 0.95) < chance for share in (holds[:, 0::2].mean(), holds[:, 1::2].mean()))
    assert np.abs(ratios).max() < 5


def test_a_residual_goes_on_where_its_end_is_as_large_as_its_beginning() -> None:
    """Mean squares of the last third over the first, of series that weigh alike: 3^2, its inverse, and both
    together, 1.
    """
    sign = np.tile([1.0, -1.0], 50)
    grows = np.concatenate([1 * sign, 2 * sign, 3 * sign])[:, None].astype(complex)
    assert ending_of([grows]) == pytest.approx(9) and ending_of([1e-6 * grows[::-1]]) == pytest.approx(1 / 9)
    assert ending_of([grows, 1e3 * grows[::-1]]) == pytest.approx(1)
    plain = Judged(amplitude=1.0, white=1.0, strongest=0.0, ending=0.0)
    assert [replace(plain, ending=size).goes_on for size in (0.1, 9.0)] == [False, True]


@pytest.mark.parametrize(("n", "band"), [(4096, (30.0, 50.0)), (4001, (5.0, 400.0)), (683, (20.0, 90.0))])
def test_sums_of_a_band_are_the_transforms_of_the_samples(n: int, band: tuple[float, float]) -> None:
    """Equation (decay-sums) against transforms of e^(lambda t) and t e^(lambda t), of a growing pole too."""
    (piece,) = pieces_of(record([np.random.default_rng(1).normal(size=n)]).decays, [0], RATE, band)
    poles = np.array([-1.3 + 2j * np.pi * 38.0, -0.01 + 2j * np.pi * 41.7, 0.05 + 2j * np.pi * 33.0])
    sums, samples = rows_by_sums(piece, poles), rows_by_samples(piece, poles)
    assert sums is not None
    for by_sums, by_samples in zip(sums, samples, strict=True):
        np.testing.assert_allclose(by_sums, by_samples, rtol=0, atol=1e-10 * np.abs(by_samples).max())
    assert rows_by_sums(piece, np.array([2j * np.pi * RATE * piece.lines[3] / n])) is None
