"""The running fit and its charts against an independent calculation, and against what chance allows."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from labpipe.estimation.model import DynamicModel, Equation, entry_term, fixed_matrices
from labpipe.methods.live.charts import (
    Charts,
    cusum_limit,
    forecast,
    half_of_noise,
    no_longer_falls,
    sequence_factor,
)
from labpipe.methods.live.cutters import HitCutter, PeriodCutter
from labpipe.methods.live.running_fit import Directions, HitSums, PeriodSums, RunningFit, moving_mean
from labpipe.records.recording import Channel
from labpipe.spectra.settings import FrfSettings, ImpactSettings

# Estimates relative to the truth, standard errors, degrees of freedom, half-widths and chi-square per degree
# of freedom of k, c, m after n periods: an independent implementation of the method, on the stream below.
GOLDEN = {
    2: (
        0.9742840876,
        1.056312518,
        0.9740112725,
        0.05486070844,
        0.05891047596,
        0.05494218251,
        72.44229863,
        35.87444008,
        72.44778013,
        0.1108506364,
        0.1227761296,
        0.1110150061,
        0.9546514426,
    ),
    3: (
        0.9818274717,
        1.026028967,
        0.9821677754,
        0.04091303871,
        0.04410085725,
        0.04094659705,
        144.0202658,
        71.85166661,
        144.0851328,
        0.08142716129,
        0.08913173893,
        0.08149338866,
        1.267847799,
    ),
}
# Whitened shifts and energy of the third and the eighth period against the fit before it.
MONITORS = {
    3: (0.1003461647, -0.7345797417, 1.943927296, 0.9235947807),
    8: (1.962337877, -1.715041571, -0.5317431736, 1.03462411),
}
N_LINE, STIFFNESS, NATURAL, ZETA = 61, 2e7, 65.0, 0.006
OMEGA = 2 * np.pi * (60 + np.arange(N_LINE) / 6)
MASS = STIFFNESS / (2 * np.pi * NATURAL) ** 2
TRUTH = np.array([STIFFNESS, 2 * ZETA * np.sqrt(STIFFNESS * MASS), MASS])
H = 1 / (TRUTH[0] + 1j * OMEGA * TRUTH[1] - OMEGA**2 * TRUTH[2])


def model():
    """k, c and m of one mass."""
    kinds = {"k": "stiffness", "c": "damping", "m": "mass"}
    terms = tuple(entry_term(name, kind, [(0, 0)], (1, 1)) for name, kind in kinds.items())
    return DynamicModel("sdof", terms, fixed_matrices(np.zeros((1, 1)), np.ones((1, 1))))


def stream(seed, n, response=H):
    """Amplitudes (n_line, 1, 2) of displacement and force of *n* periods with noise on both."""
    rng = np.random.default_rng(seed)

    def noise(size):
        return size * (rng.standard_normal(N_LINE) + 1j * rng.standard_normal(N_LINE)) / np.sqrt(2)

    for _ in range(n):
        motion = response + noise(0.5 * np.sqrt(np.mean(np.abs(H) ** 2)))
        yield np.stack([motion, 1 + noise(0.1)], axis=1)[:, None]


def test_estimates_and_monitors_of_an_independent_calculation():
    fit, sums, before = RunningFit(Equation(model(), OMEGA)), Directions(hits=False), None
    charts = Charts(fit)
    for number, z in enumerate(stream(20261123, 12), 1):
        if number in MONITORS:
            shift, energy = charts.monitors(z, sums.of(0), before)
            # After few steps each the two descents are this near to the common minimum.
            np.testing.assert_allclose([*shift, energy], MONITORS[number], atol=5e-6)
        sums.of(0).add(z)
        if number < 2:
            continue
        before = fit.update(sums)
        if number in GOLDEN:
            relative = [*before.values / TRUTH, *before.std_error / TRUTH]
            half = half_of_noise(before.std_error, before.dof)
            stated = [*relative, *before.dof, *half / TRUTH, before.reduced]
            np.testing.assert_allclose(stated, GOLDEN[number], rtol=3e-5)


def test_wanted_5_percent_k_is_enough_after_8_periods_and_c_after_9():
    fit, sums, enough = RunningFit(Equation(model(), OMEGA)), Directions(hits=False), {}
    for z in stream(20261123, 12):
        sums.of(0).add(z)
        if sums.of(0).n >= 2:
            estimate = fit.update(sums)
            halves = half_of_noise(estimate.std_error, estimate.dof)
            for name, value, half in zip("kc", estimate.values, halves, strict=False):
                if estimate.judged and half <= 0.05 * value:
                    enough.setdefault(name, sums.of(0).n)
    assert enough == {"k": 8, "c": 9}


def test_hits_weigh_by_their_energy_as_h1_does():
    rng = np.random.default_rng(7)
    forces = rng.uniform(0.3, 2.0, 6)
    motions = [H * force + 1e-9 * rng.standard_normal(N_LINE) for force in forces]
    sums = HitSums()
    for force, motion in zip(forces, motions, strict=True):
        sums.add(np.stack([motion, np.full(N_LINE, force, complex)], axis=1)[:, None])
    h1 = np.sum([m * f for m, f in zip(motions, forces, strict=True)], axis=0) / np.sum(forces**2)
    np.testing.assert_allclose(sums.mean[:, 0, 0], h1, rtol=1e-12)
    residual = np.array([m - h1 * f for m, f in zip(motions, forces, strict=True)])
    power = moving_mean(np.sum(np.abs(residual) ** 2, axis=0) / 5) / np.sum(forces**2)
    np.testing.assert_allclose(sums.covariance()[:, 0, 0, 0].real, power, rtol=1e-4)


def test_noise_of_the_force_follows_the_response_and_makes_it_low():
    """var(x - H f) = v_x + |H|^2 v_f, line by line: the mean over 15 lines was a third of it at the peak.
    H1 is low by v_f / |f|^2, here 0.04 %.
    """
    rng, n, force = np.random.default_rng(11), 100, 0.02
    z = np.stack([np.tile(H, (n, 1)), np.ones((n, N_LINE))], axis=2).astype(complex)
    size = np.array([0.5 * force * np.mean(np.abs(H)), force])
    z += size * (rng.standard_normal(z.shape) + 1j * rng.standard_normal(z.shape)) / np.sqrt(2)
    sums, more = HitSums(), HitSums()
    for average in z:
        sums.add(average[:, None])
        sums.add_noise(np.full(N_LINE, 1e-3 * force**2))
        more.add(average[:, None])
        more.add_noise(np.full(N_LINE, force**2))
    right = (size[0] ** 2 + np.abs(H) ** 2 * force**2) / sums.force_power[:, 0]
    ratio = sums.covariance()[:, 0, 0, 0].real / right
    # Each is the mean of 15 x 99 squares.
    np.testing.assert_allclose(ratio, 1.0, atol=0.15)
    (finding,) = more.findings("s")
    assert "makes H low by 0.04 % (median" in finding.message and "taken off" in finding.message
    np.testing.assert_allclose(more.mean[..., 0] / sums.mean[..., 0], 1 + 0.99 * force**2, rtol=2e-5)
    assert sums.findings("s") == []


def test_a_period_of_another_level_of_noise_is_a_jump_and_a_drift_a_change():
    fit, sums = RunningFit(Equation(model(), OMEGA)), Directions(hits=False)
    charts, estimate = Charts(fit), None
    moved = 1 / (0.997 * TRUTH[0] + 1j * OMEGA * TRUTH[1] - OMEGA**2 * TRUTH[2])
    verdicts = {}
    sound, drifted = stream(5, 20), stream(6, 40, moved)
    for number in range(1, 40):
        z = next(sound) if number <= 20 else next(drifted)
        if number == 12:
            z = 3 * z - 2 * z.mean(axis=0)
        verdicts[number] = charts.judge(z, sums.of(0), estimate, 1.0) if estimate else None
        if verdicts[number] is not None and verdicts[number].jump:
            continue
        sums.of(0).add(z)
        estimate = fit.update(sums) if sums.of(0).n >= 2 else None
    jumps = [number for number, verdict in verdicts.items() if verdict and verdict.jump]
    assert jumps == [12]
    since = next(verdict.change for number, verdict in verdicts.items() if verdict and verdict.change)
    assert 15 <= since <= 26


@pytest.mark.parametrize("alarm", [0.02, 0.05])
def test_the_limit_of_a_cumulative_sum_is_passed_as_often_as_is_said(alarm):
    steps = np.clip(np.random.default_rng(11).standard_normal((40000, 50)), -4, 4)
    up, down, passed = np.zeros(40000), np.zeros(40000), np.zeros(40000, bool)
    for column in steps.T:
        up, down = np.maximum(up + column - 0.5, 0), np.maximum(down - column - 0.5, 0)
        passed |= np.maximum(up, down) > cusum_limit(alarm)
    # The formula counts alarms of a process that runs for long: one that has begun at zero raises fewer.
    assert 0.6 * alarm < passed.mean() <= 1.05 * alarm


def test_forecast_of_noise_alone_is_the_square_of_the_widths():
    fit, sums = RunningFit(Equation(model(), OMEGA)), Directions(hits=False)
    for z in stream(3, 10):
        sums.of(0).add(z)
    estimate = fit.update(sums)
    half = half_of_noise(estimate.std_error, estimate.dof)[0]
    ahead = forecast(estimate, 0, half / 2)
    # Four times as many averages but for the degrees of freedom, which make them fewer.
    assert 36 <= ahead.expected <= 40
    assert ahead.low < ahead.expected < ahead.high
    assert forecast(estimate, 0, half).expected == 10
    assert forecast(estimate, 0, 0.0).expected is None


def test_a_coefficient_near_zero_has_a_forecast_without_a_latest_end():
    """Its relative error is without bound, and so is the upper end of when a goal is reached."""
    noise = {"std_error": np.array([1.0]), "dof": np.array([100.0]), "values": np.array([1e-9])}
    ahead = forecast(SimpleNamespace(n=5, **noise), 0, 0.5)
    # The half-width of 5 averages is 2.0, a quarter takes 16 times as many; t and its widening add little.
    assert ahead.expected is not None and 60 < ahead.expected < 100
    assert ahead.low == 6 and ahead.high is None


def test_a_width_that_model_error_holds_up_no_longer_falls():
    n = np.arange(1, 33)
    assert not no_longer_falls(list(1 / np.sqrt(n)))
    assert no_longer_falls(list(np.sqrt(1 / n + 0.2)))


def test_factor_of_the_confidence_sequence():
    # Normal mixture (Robbins 1970) in the limit of many degrees of freedom: factor^2 = (1 + rho / n) log((n +
    # rho) / (rho alpha^2)), 3.03 at the number of averages that it is tuned to.
    assert sequence_factor(25, 25, 1e7) == pytest.approx(3.03, abs=0.01)
    assert sequence_factor(25, 25, 5) > sequence_factor(25, 25, 500) > 3.03


@pytest.mark.parametrize("kind", [PeriodSums, HitSums])
def test_an_average_that_is_taken_out_leaves_the_sums_of_the_others(kind):
    rng = np.random.default_rng(1)
    averages = rng.normal(size=(6, 20, 1, 2)) + 1j * rng.normal(size=(6, 20, 1, 2))
    sums, others = kind(), kind()
    for number, z in enumerate(averages):
        sums.add(z)
        if number != 1:
            others.add(z)
    sums.add(averages[1], -1)
    assert sums.n == 5
    np.testing.assert_allclose(sums.mean, others.mean, atol=1e-14)
    np.testing.assert_allclose(sums.covariance(), others.covariance(), atol=1e-14)


def test_a_period_that_begins_elsewhere_is_turned_to_the_phases_of_the_first():
    """By a delay of 123.4 samples as by phases of another signal: force and response as they were, to what
    the transform of a period rounds; the ratio of both stays where other phases answer.
    """
    n, rng = 1000, np.random.default_rng(7)
    channels = (Channel("f", "force", "input", "y"), Channel("y", "displacement", "output", "y"))
    settings = FrfSettings("periodic", period=1.0, skip=0, band=(20, 150))
    lines, w = slice(20, 151), 2j * np.pi * np.arange(n // 2 + 1)
    response = 1 / (80e3 + 6 * w + 0.5 * w**2)

    def period(spectrum):
        return np.fft.irfft([spectrum, spectrum * response], n, axis=1).T

    first, other = np.zeros((2, n // 2 + 1), complex)
    first[lines], other[lines] = np.exp(2j * np.pi * rng.random((2, 131))) * n / 2
    for second, tolerance in ((first * np.exp(w * 123.4 / n), 1e-12), (other, 1e-12)):
        cutter = PeriodCutter(channels, float(n), settings)
        before, after = (list(cutter.add(period(first))), cutter.restart(), list(cutter.add(period(second))))[
            ::2
        ]
        np.testing.assert_allclose(after[0].amplitude, before[0].amplitude, rtol=0, atol=tolerance)
        assert np.abs(before[0].amplitude[:, 0]) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("trigger", "faults"), [(0.1, ["", ""]), (0.05, ["", "weak: 7 % of the usual force", ""])]
)
def test_what_is_a_hit_and_what_is_too_weak_goes_by_the_hits_so_far(trigger, faults):
    """Pulses of 5 ms and 100, 7 and 100 N: below a tenth of the largest there is no hit, with a lower trigger
    a weak one.
    """
    rate, pulse = 1000.0, np.sin(np.pi * np.arange(5) / 5)
    samples = 1e-3 * np.random.default_rng(1).normal(size=(3000, 2))
    for start, size in ((400, 100.0), (1200, 7.0), (2000, 100.0)):
        samples[start : start + pulse.size, 0] += size * pulse
    channels = (Channel("f", "force", "input", "x"), Channel("y", "displacement", "output", "x"))
    settings = FrfSettings("impact", block=0.5, impact=ImpactSettings(trigger=trigger))
    hits = list(HitCutter(channels, rate, settings).add(samples))
    assert [hit.fault for hit in hits] == faults
    assert [hit.number for hit in hits] == list(range(1, len(faults) + 1))


@pytest.mark.parametrize("delay", [0.0, 0.1])
def test_hits_of_a_late_channel_are_those_of_a_prompt_one(delay: float) -> None:
    """A chain that is late by 0.1 s shows the same motion later: blocks of 0.5 s hold the same hit."""
    rate, late = 1000.0, round(1000 * delay)
    samples = 1e-3 * np.random.default_rng(1).normal(size=(2000, 2))
    samples[400:405, 0] += 100.0
    samples[400:, 1] += np.exp(-np.arange(1600) / 200)
    shown = np.column_stack([samples[:, 0], np.roll(samples[:, 1], late)])
    y = Channel("y", "displacement", "output", "x", delay=delay)
    cutter = HitCutter((Channel("f", "force", "input", "x"), y), rate, FrfSettings("impact", block=0.5))
    prompt = HitCutter(
        (cutter.channels[0], Channel("y", "displacement", "output", "x")),
        rate,
        FrfSettings("impact", block=0.5),
    )
    (hit,) = [hit for block in np.split(shown, 4) for hit in cutter.add(block)]
    (expected,) = prompt.add(samples)
    np.testing.assert_allclose(hit.amplitude, expected.amplitude, rtol=0, atol=1e-5)
    assert cutter.channels[1].delay == 0.0


def test_periods_of_noise_that_goes_through_the_structure_are_as_sharp_as_its_resonance() -> None:
    """A disturbance of .1 of the force on every line of 8 periods: the mean has the variance .01 |H|^2 / 8,
    at a resonance of three lines as beside it (medians of 20 draws of 6 lines, 7 degrees of freedom each).
    """
    rng, frequency = np.random.default_rng(5), np.arange(15.0, 30.0, 0.25)
    h = 1 / (22.5**2 - frequency**2 + 2j * 0.015 * 22.5 * frequency)
    ratios = []
    for _ in range(20):
        sums = PeriodSums()
        for drawn in 0.1 * (rng.normal(size=(8, h.size)) + 1j * rng.normal(size=(8, h.size))) / np.sqrt(2):
            sums.add(np.stack([h * (1 + drawn), np.ones_like(h)], axis=1)[:, None])
        ratios.append(sums.covariance()[:, 0, 0, 0].real / np.abs(h) ** 2 * 8 / 0.01)
    np.testing.assert_allclose(np.median(ratios, axis=0), 1.0, atol=5 * 1.25 / np.sqrt(20 * 6 * 7))


def test_the_transient_of_another_direction_is_dropped():
    """The first period in y after three in x begins with the motion from before, by hand; so does x after y,
    not what is shaken by turns, period by period, nor two forces of one size that change places by noise.
    """
    n, rng = 100, np.random.default_rng(3)
    channels = tuple(Channel(f"f{dof}", "force", "input", dof) for dof in "xy")
    channels = (*channels, Channel("y", "displacement", "output", "y"))
    settings = FrfSettings("periodic", period=1.0, skip=1, band=(2, 40))
    push = rng.standard_normal(n)

    def kept(shaken):
        cutter = PeriodCutter(channels, float(n), settings)
        sizes = np.repeat([[fx, fy, 1.0] for fx, fy in shaken], n, axis=0)
        return [average.start // n for average in cutter.add(np.tile(push, len(shaken))[:, None] * sizes)]

    x, y = (1.0, 0.05), (0.05, 1.0)
    assert kept([x, x, x, y, y, y, x, y, x, x, y, y]) == [1, 2, 4, 5, 7, 8, 9, 11]
    assert kept([(1.0, 0.99), (1.0, 0.98), (0.99, 1.0), (1.0, 0.98), (1.0, 0.99)]) == [1, 2, 3, 4]


def test_forces_at_once_are_directions_by_their_proportion(rng):
    """Two shakers at once, then one of them reversed, then as at first but elsewhere in the period:
    directions 0, 1 and 0, with the phases that each had first. By the strongest force all were one
    direction, whose mean the second part contradicts.
    """
    n, settings = 128, FrfSettings("periodic", period=1.0, skip=0, band=(2, 60))
    channels = tuple(Channel(f"f{dof}", "force", "input", dof) for dof in "xy")
    x, y = rng.standard_normal((2, n))
    cutter, found = PeriodCutter((*channels, Channel("y", "displacement", "output", "y")), n, settings), []
    for sign, shift in ((1, 0), (-1, 0), (1, 31)):
        period = np.roll(np.column_stack([x, sign * y, x + 2 * sign * y]), shift, axis=0)
        noise = 0.05 * rng.standard_normal((3 * n, 3))
        cutter.restart()
        found += list(cutter.add(np.tile(period, (3, 1)) + noise))
    assert [average.direction for average in found] == [0, 0, 0, 1, 1, 1, 0, 0, 0]
    first, again = (np.mean([a.amplitude for a in found[at : at + 3]], axis=0) for at in (0, 6))
    np.testing.assert_allclose(again, first, atol=0.05)
