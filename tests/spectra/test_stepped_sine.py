"""A stepped sine on an oscillator whose motion is known in closed form, transients included."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import signal

from labpipe.errors import ConfigError, DataError
from labpipe.records.recording import Channel, Recording
from labpipe.spectra.measurement import measure
from labpipe.spectra.settings import FrfSettings, MaskSettings
from labpipe.spectra.stepped import LEFT, frequency_variance, sine_frequency, steady_part, transient_allowance
from labpipe.spectra.sweeps import find_dwells
from tests.spectra.stepped_oscillator import CHANNELS, POLE, RATE, STEPS, motion, receptance, record

STEPPED = FrfSettings("stepped-sine")


def test_the_motion_is_the_convolution_with_the_impulse_response() -> None:
    """Independent of the closed form: x = h * f, h = Im(e^(pt)) / Im(p), by the trapezium rule, error of
    order dt^2 / 12 h'(0) f.
    """
    rate = 10e3
    force, x = motion([40.0, 41.3], [0.4003, 0.5], rate)
    h = np.exp(POLE * np.arange(force.size) / rate).imag / POLE.imag
    np.testing.assert_allclose(
        x, (signal.fftconvolve(force, h)[: force.size] - 0.5 * force[0] * h) / rate, atol=1e-3 * np.std(x)
    )


@pytest.mark.parametrize("order", [1, -1])
def test_dwells_of_any_length_are_found_rising_and_falling(order: int) -> None:
    """Their limits to two periods, their frequencies to a thousandth, with 5 % of noise."""
    steps, lengths = STEPS[::order], 0.5 + 0.07 * np.arange(STEPS.size)
    force = record(2, tuple(steps), tuple(lengths), (0.05, 0.0)).samples[:, 0]
    dwells = find_dwells(force)
    np.testing.assert_allclose([dwell.frequency * RATE for dwell in dwells], steps, rtol=1e-3)
    limits = np.concatenate([[0.0], np.cumsum(lengths)])
    assert np.max(np.abs([dwell.start / RATE for dwell in dwells] - limits[:-1]) * steps) < 2.1
    assert np.max(np.abs([dwell.stop / RATE for dwell in dwells] - limits[1:]) * steps) < 2.1


def test_pauses_and_jumps_of_phase_and_level_between_dwells() -> None:
    rng = np.random.default_rng(4)
    t = np.arange(1500) / RATE
    pause = np.zeros(400)
    levels = [1.0, 0.2, 2.0, 0.7]
    sines = [
        level * np.sin(2 * np.pi * f * t + phase)
        for level, f, phase in zip(levels, (20, 55, 30, 31), (0, 2, 4, 1), strict=True)
    ]
    force = np.concatenate([part for sine in sines for part in (pause, sine)])
    dwells = [d for d in find_dwells(force + 0.002 * rng.normal(size=force.size)) if d.stop - d.start > 1000]
    np.testing.assert_allclose([dwell.frequency * RATE for dwell in dwells], [20, 55, 30, 31], rtol=1e-3)


@pytest.mark.long
def test_the_frequency_has_the_least_variance_there_can_be() -> None:
    """400 draws against the bound of Cramer and Rao for frequency, amplitude, phase and offset of 700
    samples.
    """
    rng = np.random.default_rng(5)
    clean = 3 + 2 * np.cos(2 * np.pi * 0.0431 * np.arange(700) + 0.4)
    found = np.array([sine_frequency(clean + 0.3 * rng.normal(size=700), 0.0432) for _ in range(400)])
    bound = 6 * 0.3**2 / (np.pi**2 * 2.0**2 * 700**3)
    assert np.var(found) == pytest.approx(bound, rel=4 * np.sqrt(2 / 400))
    assert abs(found.mean() - 0.0431) < 4 * np.sqrt(bound / 400)
    assert frequency_variance(clean + 0.3 * rng.normal(size=700), 0.0431) == pytest.approx(bound, rel=0.25)


def test_the_transient_is_left_out_as_long_as_it_lasts() -> None:
    """1 % of noise and a time constant of 0.2 s: the states' difference has decayed to the noise of a line
    within 1 to 2 s.
    """
    response = measure([record(1)], STEPPED)
    (message,) = [finding.message for finding in response.findings if finding.code == "dwells"]
    settle = float(message.split("Hz; ")[1].split(" s ")[0])
    assert 1.0 < settle < 2.0 and "19 frequencies, 30.9999-49 Hz" in message
    np.testing.assert_allclose(response.frequency, STEPS, rtol=3e-5)
    error = np.abs(response.matrix[:, 0, 0] - receptance(response.frequency)) / np.sqrt(
        response.variance[:, 0, 0]
    )
    assert np.max(error) < 4
    hasty = measure([record(1)], dataclasses.replace(STEPPED, settle=0.1))
    error = np.abs(hasty.matrix[:, 0, 0] - receptance(hasty.frequency)) / np.sqrt(response.variance[:, 0, 0])
    assert np.max(error) > 10


@pytest.mark.long
def test_a_transient_that_outlasts_half_a_dwell_may_be_over_in_its_last_quarter() -> None:
    """Thirteen time constants at .05 % of noise: the step is seen for some eight of them, beyond .6 of the
    dwell, and seven of eight records were refused. The mean square of 8 x 2 x 19 parts errs by .08.
    """
    errors = []
    for seed in range(8):
        response = measure([record(seed, lengths=-13 / POLE.real, noise=(5e-4, 5e-4))], STEPPED)
        off = response.matrix[:, 0, 0] - receptance(response.frequency)
        errors.append(off / np.sqrt(response.variance[:, 0, 0]))
    assert np.mean(np.abs(errors) ** 2) == pytest.approx(1, abs=0.25)
    assert np.abs(np.mean(errors)) < 0.3


GAINS = np.array([[1.0, -0.2], [0.3, 0.8]])


def along(dof: str, seed: int, steps: tuple[float, ...]) -> Recording:
    """Two responses to one force: the oscillator's times a column of GAINS."""
    one = record(seed, steps, noise=(0.0, 0.0)).samples
    rng = np.random.default_rng([6, seed])
    x = one[:, [1]] * GAINS[:, "xy".index(dof)]
    channels = (
        dataclasses.replace(CHANNELS[0], dof=dof),
        *(Channel(c, "displacement", "output", c, 0.0) for c in "xy"),
    )
    samples = np.column_stack([one[:, 0], x])
    return Recording(
        channels, samples + 0.01 * samples.std(axis=0) * rng.normal(size=samples.shape), RATE, dof
    )


def test_recordings_of_two_forces_give_one_matrix_at_the_frequencies_they_share() -> None:
    steps = (36.0, 38.0, 39.0, 40.0, 42.0)
    response = measure([along("x", 1, (*steps, 44.0)), along("y", 2, (34.0, *steps))], STEPPED)
    np.testing.assert_allclose(response.frequency, steps, rtol=3e-5)
    truth = receptance(response.frequency)[:, None, None] * GAINS
    assert np.max(np.abs(response.matrix - truth) / np.sqrt(response.variance)) < 4
    assert [f.message for f in response.findings if f.code == "dwells-left-out"] == [
        "2 dwell(s) are left out: not every recording has their frequency"
    ]


def test_a_reference_channel_has_no_say_in_what_has_settled() -> None:
    """A temperature that wanders all the time never settles; the FRF is that without it, up to where the
    search for a pole ends.
    """
    plain = record(1, (36.0, 38.0, 40.0, 42.0, 44.0))
    wandering = np.cumsum(np.random.default_rng(9).normal(size=plain.samples.shape[0]))
    channels = (*CHANNELS, Channel("t", "temperature", "reference", "", 0.0))
    both = dataclasses.replace(plain, channels=channels, samples=np.column_stack([plain.samples, wandering]))
    np.testing.assert_allclose(measure([both], STEPPED).matrix, measure([plain], STEPPED).matrix, rtol=1e-9)


def test_dwells_at_one_frequency_are_averaged() -> None:
    """Three dwells at each frequency: a third of the variance, three times the degrees of freedom."""
    steps = (36.0, 38.0, 40.0, 42.0, 44.0)
    settled = dataclasses.replace(STEPPED, settle=1.6, smooth=0)
    once, thrice = measure([record(3, steps)], settled), measure([record(3, steps * 3)], settled)
    assert thrice.n_frequency == 5 and thrice.covariance_dof > 2.5 * once.covariance_dof
    assert np.mean(thrice.variance / once.variance) == pytest.approx(1 / 3, rel=0.35)
    assert (
        np.max(
            np.abs(thrice.matrix[:, 0, 0] - receptance(thrice.frequency)) / np.sqrt(thrice.variance[:, 0, 0])
        )
        < 4
    )


def of_force(force: np.ndarray) -> Recording:
    return Recording(CHANNELS, np.column_stack([force, np.convolve(force, [1.0, 0.5], "same")]), RATE, "r")


def sweep(length: float, low: float, high: float) -> np.ndarray:
    t = np.arange(0, length, 1 / RATE)
    return np.sin(2 * np.pi * (low * t + (high - low) * t**2 / (2 * length))) + 0.01 * np.random.default_rng(
        8
    ).normal(size=t.size)


@pytest.mark.parametrize(
    ("force", "message"),
    [
        (np.random.default_rng(7).normal(size=5000), "'r': the force is not a sine"),
        (
            sweep(20.0, 20.0, 60.0),
            "'r': (the frequency of the force keeps changing: a sweep|the force stays at no frequency)",
        ),
        (sweep(200.0, 20.0, 60.0), "'r': the frequency of the force keeps changing: a sweep"),
        (np.sin(np.arange(300) * 0.1), "'r': the force has 4 periods, too few"),
    ],
)
def test_a_recording_without_dwells_is_refused(force: np.ndarray, message: str) -> None:
    with pytest.raises(DataError, match=message):
        measure([of_force(force)], STEPPED)


def test_dwells_too_short_and_steps_without_a_frequency_in_common_are_refused() -> None:
    with pytest.raises(
        DataError,
        match=r"the dwell of 'steps' at 30.9979 Hz lasts 0.45 s, 0.694 s are needed: 0.5 s for its transient",
    ):
        measure([record(1, lengths=0.5)], dataclasses.replace(STEPPED, settle=0.5))
    with pytest.raises(DataError, match=r"lasts 0\.547 s, 0\.79.* s are needed: 0\.3.* s for its transient"):
        measure([record(1, lengths=0.6)], STEPPED)
    with pytest.raises(DataError, match="dwell at no frequency in common"):
        measure([along("x", 1, (36.0, 38.0)), along("y", 2, (37.0, 39.0))], STEPPED)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"excitation": "random", "block": "1 s", "settle": "1 s"}, "'settle' is not for random excitation"),
        ({"settle": "-1 s"}, "settle must not be negative"),
        ({"mask": MaskSettings(speed=50.0)}, "'mask' needs its 'width' with stepped-sine"),
        ({"block": "1 s"}, "'block' is not for stepped-sine"),
    ],
)
def test_settings_that_contradict_each_other_are_refused(change: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        FrfSettings(**{"excitation": "stepped-sine", **change})


@pytest.mark.parametrize(("tau", "blocks"), [(0.1, 1.0), (1.0, 1.0), (3.0, 3.0)])
def test_a_decay_may_leave_a_share_of_a_standard_error_in_the_mean(tau: float, blocks: float) -> None:
    """a exp(-t / tau) over the n blocks of 1 s that are left adds a tau / n to their mean, a / n where it is
    gone within one, beside its standard error s / n^.5.
    """
    largest = np.sqrt(transient_allowance(SimpleNamespace(times=np.arange(100.0)), tau, 59.5))
    assert largest * blocks / 40 == pytest.approx(LEFT / 40**0.5)


def test_a_decaying_motion_beside_a_sine_is_exact_without_noise() -> None:
    """X of X + C z^b + D conj(z)^b, as whole periods of a sine see a free decay."""
    pole, steady = -0.12 + 0.4j, np.array([3.0, 0.2 - 1.1j])
    number = np.arange(28)[:, None]
    free = [0.5 - 0.2j, 4.0] * np.exp(pole * number) + [0.1j, 1.0 + 2j] * np.exp(np.conj(pole) * number)
    mean, covariance, dof = steady_part(steady + free, 0.15, [0, 1])
    np.testing.assert_allclose(mean, steady, rtol=1e-3)
    assert dof == 24 and np.all(np.diag(covariance).real < 1e-6)


def test_dwells_too_short_to_settle_give_unbiased_lines() -> None:
    """10 time constants and .1 % noise: 6.9 of them until the transient is in the noise of a period, 8.7
    until it is a fifth of a standard error of what would be left. Closed form of the receptance.
    """
    lines = [measure([record(seed, lengths=2.0, noise=(1e-3, 1e-3))], STEPPED) for seed in range(4)]
    (said,) = [finding.message for finding in lines[0].findings if finding.code == "dwells"]
    assert "after each step, of 19 short dwell(s) 1.38 s, the rest of their transient is modelled; " in said
    error = [
        (line.matrix[:, 0, 0] - receptance(line.frequency)) / np.sqrt(line.variance[:, 0, 0])
        for line in lines
    ]
    power = np.abs(error) ** 2
    # Mean and median of |z|^2, exponential for a complex normal z: 1 and ln 2, over 76 lines.
    assert 0.6 < power.mean() < 1.4 and 0.4 < np.median(power) < 1.0
    assert np.abs(np.mean(error)) < 3 / np.sqrt(power.size)


def test_recordings_of_one_force_are_repeats() -> None:
    """Each is the matrix of its recording alone, although the frequencies of their dwells differ by noise."""
    sources = [record(seed, (37.0, 40.0, 43.0)) for seed in range(2)]
    response = measure(sources, FrfSettings(excitation="stepped-sine"))
    assert response.repeats is not None and response.repeats_are == "recordings"
    for source, matrix in zip(sources, response.repeats, strict=True):
        np.testing.assert_array_equal(
            matrix, measure([source], FrfSettings(excitation="stepped-sine")).matrix
        )


def test_a_quiet_force_of_few_samples_per_period_keeps_its_dwells() -> None:
    """A straight line through n samples per period misses a crossing by up to .3 / n^2 periods: of a
    generator's sine that was taken for steps, and there were ten times as many dwells.
    """
    steps = np.arange(50.0, 120.0, 5.0)
    time = np.arange(4000) / 1000
    dwells = find_dwells(np.concatenate([np.sin(2 * np.pi * f * time) for f in steps]))
    np.testing.assert_allclose([1000 * dwell.frequency for dwell in dwells], steps, rtol=1e-4)


def test_single_dwells_too_short_to_settle_are_left_out_and_named() -> None:
    """Two dwells of three time constants among seventeen of twenty: the other lines have the receptance of
    the closed form, of errors with the variance that is stated.
    """
    lengths = np.full(STEPS.size, 4.0)
    lengths[[4, 12]] = 0.6
    errors = []
    for seed in range(6):
        response = measure([record(seed, lengths=lengths)], STEPPED)
        np.testing.assert_allclose(response.frequency, np.delete(STEPS, [4, 12]), rtol=3e-5)
        off = response.matrix[:, 0, 0] - receptance(response.frequency)
        errors.append(off / np.sqrt(response.variance[:, 0, 0]))
        (message,) = (f.message for f in response.findings if f.code == "dwells-left-out")
        assert message.startswith("2 dwell(s) too short are left out: the dwell of 'steps' at ")
        places = [float(part.split(" Hz")[0]) for part in message.split(" at ")[1:]]
        np.testing.assert_allclose(places, STEPS[[4, 12]], rtol=1e-3)
        assert message.count("s are needed") == 2
    # Of 102 lines: a tenth each.
    assert np.mean(np.abs(errors) ** 2) == pytest.approx(1, abs=0.3)


def test_one_long_dwell_does_not_make_the_transient_of_the_others_longer() -> None:
    """e^(-t / tau), tau = 1 / (zeta w_n) = .2 s, falls from the response, 1 % sqrt(2 / 2,000) of which is a
    standard error of a line, 3,000 of them, below a fifth of one within ln 15,000 = 9.6 tau. Among dwells of
    2.5 s one of 60 s gave bins of 1.5 s, and 40 tau, so that the record was refused.
    """
    lengths = np.full(STEPS.size, 2.5)
    lengths[5] = 60.0

    def settled(lengths: np.ndarray) -> float:
        findings = measure([record(1, lengths=lengths)], STEPPED).findings
        message = next(finding.message for finding in findings if finding.code == "dwells")
        return float(message.split("Hz; ")[1].split(" s are")[0]) * -POLE.real

    assert settled(lengths) == pytest.approx(settled(np.full(STEPS.size, 2.5)), rel=0.2)
    assert settled(lengths) == pytest.approx(np.log(15_000), rel=0.2)
