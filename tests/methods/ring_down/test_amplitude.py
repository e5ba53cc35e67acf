"""Damping over amplitude: the law against an integration of its equation, what is seen of it, and false
alarms.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import FitSettings
from labpipe.methods.ring_down.amplitude_law import amplitude, evaluate_over_amplitude, fitted_law, travel
from labpipe.methods.ring_down.fit import peak_decrement, trace
from labpipe.methods.ring_down.likelihood import judge, most_likely, pieces_of, portmanteau
from labpipe.records.spectra import FreeDecays
from labpipe.records.uncertain import ChannelUncertainty, Uncertainty
from tests.methods.ring_down.records_of_decay import RATE, motion, record, times

OMEGA = 2 * np.pi * 40
LAW = (OMEGA, 0.0036, 0.003)
TURN = -0.5


def slipping(first: float, phase: float) -> np.ndarray:
    t = times()
    return amplitude(t, first, *LAW) * np.cos(OMEGA * t + TURN * travel(t, first, *LAW) + phase)


def noisy(columns: list[np.ndarray], seed: int, sigma: float = 0.01) -> list[np.ndarray]:
    rng = np.random.default_rng([21, seed])
    return [column + 0.1 + sigma * rng.standard_normal(column.size) for column in columns]


def fit_of(columns: list[np.ndarray], n_mode: int = 1):
    decays = record(columns).decays
    pieces = pieces_of(decays, [0], RATE, None)
    return pieces, most_likely(decays, [0], pieces, RATE, None, n_mode)


@pytest.mark.parametrize(("rest", "slope"), [(0.0036, 0.003), (0.0, 0.004), (0.005, 0.0), (0.004, -0.002)])
def test_the_law_solves_its_equation(rest: float, slope: float) -> None:
    """A' = -w (z0 + z1 A) A and the integral of A, integrated numerically to 1e-10."""
    t = times(2.0)
    exact = solve_ivp(
        lambda _, y: [-OMEGA * (rest + slope * y[0]) * y[0], y[0]],
        (0, t[-1]),
        [0.8, 0.0],
        t_eval=t,
        rtol=1e-10,
        atol=1e-12,
    ).y
    np.testing.assert_allclose(amplitude(t, 0.8, OMEGA, rest, slope), exact[0], rtol=1e-7)
    np.testing.assert_allclose(travel(t, 0.8, OMEGA, rest, slope), exact[1], rtol=1e-7, atol=1e-9)


def test_damping_over_amplitude_is_seen_and_its_law_found() -> None:
    """Two hits of 1.0 and 0.6: one exponential leaves a residual that no noise leaves, the law leaves noise
    and holds the truth.
    """
    pieces, fit = fit_of(noisy([slipping(1.0, 0.3), slipping(0.6, 2.0)], 1))
    tested = judge(pieces, fit, RATE)
    assert tested.amplitude < 1e-6 and tested.white < 1e-6 and abs(tested.strongest - 40) < 0.5
    law = fitted_law(pieces, fit, 0, 0)
    values = np.array([law.law.zeta_rest, law.law.zeta_slope, law.law.frequency_slope, law.law.omega])
    ratios = (values - [0.0036, 0.003, TURN, OMEGA]) / np.sqrt(np.diag(law.covariance))
    assert law.converged and np.abs(ratios).max() < 3.5 and law.law.p_value > 0.01
    assert np.sqrt(law.covariance[1, 1]) < 0.1 * 0.003


def squared_decay(seed: int) -> FreeDecays:
    """z = 0.003 + 0.003 A^2 from A = 1, its amplitude integrated to 1e-9, with noise of 0.2 %."""
    t = times()
    course = solve_ivp(
        lambda _, y: [-OMEGA * (0.003 + 0.003 * y[0] ** 2) * y[0]],
        (0, t[-1]),
        [1.0],
        t_eval=t,
        rtol=1e-9,
        atol=1e-12,
    ).y[0]
    return record(noisy([course * np.cos(OMEGA * t + 0.3)], seed, 0.002))


def test_intervals_of_a_law_of_another_form_hold_the_damping_at_rest() -> None:
    """The line z0 + z1 A is no such law. Its z0 was known to 2e-6, and lay 2.5e-4 too low."""
    (fit,) = identify(squared_decay(3), FitSettings("decay", name="d"))
    rest, slope, turn = (fit.parameter(name) for name in ("zeta_rest_1", "zeta_slope_1", "f_slope_1"))
    assert abs(rest.value - 0.003) > 20 * rest.std_error
    assert rest.ci95[0] < 0.003 < rest.ci95[1] and rest.interval.discrepancy < 0.1 * 0.003
    # Tangents of the law at the largest amplitude and at rest have the slopes 0.006 and 0.
    assert 0 < slope.ci95[0] < slope.ci95[1] < 0.006
    assert turn.ci95[0] < 0 < turn.ci95[1]


def test_what_a_law_leaves_is_no_noise_of_the_stretches() -> None:
    """In a band the errors of the stretches were ten times too large, so that nothing was left of the course
    of the damping for the interval of its mean: 3.50 to 3.60e-3 of a damping that falls from 4.5 to 3.0e-3.
    """
    (fit,) = identify(squared_decay(3), FitSettings("decay", name="d", band=(30, 50)))
    (curve,), mean = fit.details[0].modes, fit.parameter("zeta_1")
    off = (curve.damping - 0.003 - 0.003 * curve.amplitude**2) / curve.damping_std_error
    assert 0.4 < np.sqrt(np.mean(off**2)) < 1.5
    for size in (0.13, 0.44):
        assert mean.ci95[0] < 0.003 + 0.003 * size**2 < mean.ci95[1]


def test_the_law_goes_as_one_over_the_sensor_s_gain() -> None:
    """1 % of a gain is 1 % of what is per amplitude, as a refit of samples 1 % too small says.

    Poles and the law at rest do not know it.
    """
    plain = record(noisy([slipping(1.0, 0.3), slipping(0.6, 2.0)], 1))
    gain = ChannelUncertainty("gain", Uncertainty("probe", 0.01, "1"))
    settings = FitSettings("decay", mass="2 kg +- 1 %", name="d")  # type: ignore[arg-type]
    (fit,) = identify(replace(plain, outputs=(replace(plain.outputs[0], uncertainties=(gain,)),)), settings)
    small = replace(
        plain, decays=tuple(replace(decay, samples=0.99 * decay.samples) for decay in plain.decays)
    )
    (refit,) = identify(small, settings)
    assert fit.budget is not None and [source.source for source in fit.budget.sources] == [
        "mass 2 kg",
        "probe",
    ]
    for name in ("zeta_slope_1", "f_slope_1"):
        moved = refit.parameter(name).value - fit.parameter(name).value
        assert fit.budget.change_by("probe", name) == pytest.approx(moved, rel=0.02)
        assert fit.parameter(name).systematic == pytest.approx(0.01 * abs(fit.parameter(name).value))
    assert fit.parameter("zeta_rest_1").systematic == 0


def test_stretches_show_the_law() -> None:
    """Without noise the local damping ratio is z0 + z1 A and the local frequency w + s A, but for the change
    within a stretch.
    """
    pieces, fit = fit_of([slipping(1.0, 0.3) + 1e-9 * np.random.default_rng(1).standard_normal(times().size)])
    course = evaluate_over_amplitude(pieces, fit, 0, 0)
    assert course.amplitude.size > 10 and np.all(np.diff(course.amplitude) > 0)
    np.testing.assert_allclose(course.damping, 0.0036 + 0.003 * course.amplitude, rtol=0.03)
    np.testing.assert_allclose(course.frequency, 40 + TURN * course.amplitude / (2 * np.pi), rtol=2e-4)


def test_stretches_of_a_linear_mode_agree_with_it_within_their_errors() -> None:
    pieces, fit = fit_of(noisy([motion(((40.0, 0.005, 1.0, 0.3),), times())], 2))
    course = evaluate_over_amplitude(pieces, fit, 0, 0)
    ratios = np.concatenate(
        [
            (course.damping - 0.005) / course.damping_std_error,
            (course.frequency - 40) / course.frequency_std_error,
        ]
    )
    assert 0.6 < np.sqrt(np.mean(ratios**2)) < 1.5


def alarms(modes: tuple[tuple[float, float, float, float], ...], draws: int) -> np.ndarray:
    """Chances of every draw's residual, (draw, 2): over amplitude, white."""
    chances = []
    for seed in range(draws):
        pieces, fit = fit_of(noisy([motion(modes, times())], seed), len(modes))
        tested = judge(pieces, fit, RATE)
        chances.append((tested.amplitude, tested.white))
    return np.array(chances)


@pytest.mark.long
def test_white_noise_seldom_alarms() -> None:
    """At 1 % each test: 100 draws give at most 5 alarms in 99.8 % of such series (binomial), at 10 % in 6."""
    chances = alarms(((40.0, 0.005, 1.0, 0.3),), 100)
    assert np.all(np.sum(chances < 0.01, axis=0) <= 5)
    # Chances of a test whose null is right are uniform: the share below one half is within four standard
    # deviations of it.
    assert np.all(np.abs(np.mean(chances < 0.5, axis=0) - 0.5) < 4 * 0.5 / np.sqrt(100) + 0.06)


def test_hum_is_seen_at_its_frequency() -> None:
    hum = 0.004 * np.cos(2 * np.pi * 50 * times())
    pieces, fit = fit_of(noisy([motion(((40.0, 0.005, 1.0, 0.3),), times()) + hum], 3))
    tested = judge(pieces, fit, RATE)
    assert tested.white < 1e-6 and tested.strongest == pytest.approx(50, abs=0.3) and tested.amplitude > 0.01


def test_the_portmanteau_statistic_is_that_of_ljung_and_box() -> None:
    """By hand for series 1, -1, 1, ... of 16 values and two lags: r = -15/16, 14/16.

    Q = 16 18 (r_1^2 / 15 + r_2^2 / 14).
    """
    series = np.where(np.arange(16) % 2 == 0, 1.0, -1.0)[:, None].astype(complex)
    q = 16 * 18 * ((15 / 16) ** 2 / 15 + (14 / 16) ** 2 / 14)
    # chi-square of two degrees of freedom: P = exp(-Q / 2).
    assert portmanteau([series], real=True) == pytest.approx(np.exp(-q / 2), rel=1e-9)


@pytest.mark.parametrize(
    ("sigma", "low", "high"), [(0.0, -0.002, 0.001), (0.01, -0.035, -0.025), (0.05, -0.25, -0.19)]
)
def test_peaks_are_biased_low_by_noise(sigma: float, low: float, high: float) -> None:
    """Mean of 60 draws, down to a tenth of the first peak: about -3 % at 1 % noise, -22 % at 5 %."""
    truth = 2 * np.pi * 0.005 / np.sqrt(1 - 0.005**2)
    rng = np.random.default_rng(9)
    read = [
        peak_decrement(
            motion(((40.0, 0.005, 1.0, float(rng.uniform(0, 6))),), times())
            + sigma * rng.standard_normal(times().size),
            RATE,
            40.0,
        )
        for _ in range(60)
    ]
    assert low < np.mean(read) / truth - 1 < high


def test_too_few_peaks_give_no_decrement() -> None:
    assert peak_decrement(np.exp(-np.arange(100.0)), 100.0, 10.0) is None


def test_a_long_record_keeps_its_extremes_when_it_is_thinned() -> None:
    t = np.arange(5000) / 1000
    y = np.sin(2 * np.pi * 40 * t)
    y[3333] = 7.0
    time, shown = trace(t, y)
    assert (
        time.size == shown.size < 1500
        and shown.max() == 7.0
        and shown.min() == y.min()
        and np.all(np.diff(time) > 0)
    )
    assert trace(t[:100], y[:100])[1].size == 100
