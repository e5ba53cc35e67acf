"""Run-ups from tracked orders and the vector difference of two runs, against phasors that are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from labpipe.errors import DataError
from labpipe.methods.run_ups.joint import fit_jointly
from labpipe.methods.run_ups.measured import difference, interpolate_run, run_up_of, weight_effect
from labpipe.methods.run_ups.methods import fit_points
from labpipe.methods.run_ups.misfit import ExcitedRun, scales, shared_noise
from labpipe.methods.run_ups.records import RunUp, Shaker
from labpipe.methods.run_ups.rotor import PRIOR, as_eight
from labpipe.records.recording import Channel, Recording
from labpipe.spectra.orders import cascade_spectra, track_order
from labpipe.spectra.settings import ShaftLines
from tests.methods.run_ups.run_up_cases import RIG, trained

RATE = 2000.0
LINES = ShaftLines(tacho="tacho", harmonics=2)
X, Y = 2e-5 * np.exp(0.3j), 1e-5 * np.exp(-1.2j)


def sweep(seconds: float = 30.0, rng: np.random.Generator | None = None, turned: float = 0.0) -> Recording:
    """A shaft from 10 to 40 Hz; x and y of one plane, read by probes at *turned* and a quarter turn further.

    Phasors X, Y at all speeds.
    """
    time = np.arange(round(seconds * RATE)) / RATE
    revolutions = 10 * time + 15 * time**2 / seconds
    turn = np.exp(2j * np.pi * revolutions)
    x, y = np.real(X * turn), np.real(Y * turn)
    probes = np.cos(turned) * x + np.sin(turned) * y, -np.sin(turned) * x + np.cos(turned) * y
    noise = np.zeros((2, time.size)) if rng is None else 1e-6 * rng.standard_normal((2, time.size))
    tacho = np.where(revolutions % 1.0 < 0.5, 5.0, 0.0)
    channels = (
        Channel(
            "a",
            "displacement",
            "output",
            "disc 1.x" if turned == 0 else "45 deg",
            0.0 if turned == 0 else turned,
        ),
        Channel("b", "displacement", "output", "disc 1.y" if turned == 0 else "135 deg", np.pi / 2 + turned),
        Channel("tacho", "voltage", "reference", "tacho"),
    )
    if turned == 0:
        channels = (replace(channels[0], angle=None), replace(channels[1], angle=None), channels[2])
    return Recording(
        channels, np.column_stack([probes[0] + noise[0], probes[1] + noise[1], tacho]), RATE, "sweep"
    )


@pytest.mark.parametrize("turned", [0.0, np.pi / 4])
def test_a_sweep_gives_its_phasors_in_x_and_y(turned: float) -> None:
    plane = "disc 1" if turned == 0 else ""
    run = run_up_of(track_order(sweep(turned=turned), LINES), (), "sweep", 5.0, {plane: 1e-5 + 0j})
    assert run.planes == (plane,) and run.n_speed > 20 and np.all(np.diff(run.speed) > 0)
    # Pulses are known to a part of a sample, which is some degrees of a revolution.
    np.testing.assert_allclose(np.abs(run.response[:, 0, 0]), abs(X), rtol=0.01)
    np.testing.assert_allclose(np.abs(run.response[:, 0, 1]), abs(Y), rtol=0.01)
    relative = run.response[:, 0, 1] / run.response[:, 0, 0]
    np.testing.assert_allclose(np.angle(relative), np.angle(Y / X), atol=0.01)


def test_stated_errors_are_those_of_the_noise(rng: np.random.Generator) -> None:
    """4 s^2 / n samples is E|dX|^2; half of it falls on the amplitude, half across. The tacho is a sine,
    whose rise is known between samples.
    """
    plain, time = sweep(rng=rng), np.arange(60_000) / RATE
    turning = np.sin(2 * np.pi * (10 * time + 15 * time**2 / 30))
    recording = replace(plain, samples=np.column_stack([plain.samples[:, :2], turning]))
    run = run_up_of(track_order(recording, LINES), (), "sweep", 5.0, {"disc 1": 1e-5 + 0j})
    stretch = 20 * RATE / (run.speed / (2 * np.pi))
    np.testing.assert_allclose(run.amplitude_error[:, 0, 0], 1e-6 * np.sqrt(2 / stretch), rtol=0.15)
    np.testing.assert_allclose(run.phase_error, run.amplitude_error / np.abs(run.response))
    scatter = np.abs(run.response[:, 0, 0]) - abs(X)
    assert 0.5 < np.std(scatter / run.amplitude_error[:, 0, 0]) < 3.0


@pytest.mark.parametrize("late", [False, True])
def test_noise_at_the_order_counts_where_it_is_more_than_elsewhere(late: bool) -> None:
    """Noise of low frequencies, first order with a pole of 0.95, or pulses of a tacho that are known to a
    sample: the stated errors against those of eight records of the known phasors.
    """
    errors = []
    for draw in range(8):
        rng, plain = np.random.default_rng(draw), sweep()
        time = np.arange(60_000) / RATE
        revolutions = 10 * time + 15 * time**2 / 30
        white = rng.standard_normal((60_000, 2))
        noise = white if late else signal.lfilter([np.sqrt(1 - 0.95**2)], [1, -0.95], white, axis=0)
        tacho = np.where(revolutions % 1 < 0.5, 5.0, 0.0) if late else np.sin(2 * np.pi * revolutions)
        samples = np.column_stack([plain.samples[:, :2] + 3e-7 * noise, tacho])
        track = track_order(replace(plain, samples=samples), LINES)
        errors.append((track.amplitude - np.array([X, Y])) / np.sqrt(track.variance / 2))
    scatter = np.sqrt(np.mean(np.abs(np.array(errors)) ** 2) / 2)
    assert 0.85 < scatter < (1.6 if late else 1.15)


def test_pulses_known_to_a_sample_do_not_turn_the_readings() -> None:
    """Readings without noise by a tacho without edges in between: a sample is 7 deg of a turn at 40 Hz."""
    track = track_order(sweep(), LINES)
    turned = np.degrees(np.angle(track.amplitude / np.array([X, Y])))
    stated = np.degrees(np.sqrt(track.variance) / np.abs(track.amplitude))
    # All pulses err by half a sample towards early or late; what they have in common is no scatter.
    assert np.std(turned, axis=0) == pytest.approx(0.0, abs=0.1)
    assert np.all(np.abs(turned) < 3 * stated)


def test_a_steady_recording_is_no_run_up() -> None:
    time = np.arange(20_000) / RATE
    turn = np.exp(2j * np.pi * 25 * time)
    tacho = np.where((25 * time) % 1.0 < 0.5, 5.0, 0.0)
    steady = Recording(
        sweep(1.0).channels, np.column_stack([np.real(X * turn), np.real(Y * turn), tacho]), RATE, "steady"
    )
    track = track_order(steady, ShaftLines(speed=25.0))
    with pytest.raises(DataError, match="constant speed"):
        run_up_of(track, (), "steady", 5.0, {"disc 1": 1e-5 + 0j})
    with pytest.raises(DataError, match="no plane"):
        run_up_of(replace(track, planes=()), (), "steady", 5.0, {"disc 1": 1e-5 + 0j})
    accelerations = [replace(channel, quantity="acceleration") for channel in steady.channels]
    with pytest.raises(DataError, match="channel 'a' of recording 'steady' reads acceleration"):
        run_up_of(track, accelerations, "steady", 5.0, {"disc 1": 1e-5 + 0j})


def test_stretches_of_one_speed_are_one_point(rng: np.random.Generator) -> None:
    """A run in steps: the weighted mean by hand, its variance the inverse of the summed inverses."""
    track = track_order(sweep(rng=rng), LINES)
    n = track.time.size
    steps = np.repeat([30.0, 20.0], [n - 5, 5]) * (1 + 1e-5 * np.arange(n))
    found = run_up_of(replace(track, speed=steps), (), "steps", 5.0, {"disc 1": 1e-5 + 0j})
    weight = 2 / track.variance[-5:, 0]
    np.testing.assert_allclose(found.speed, 2 * np.pi * np.array([steps[-5:].mean(), steps[:-5].mean()]))
    assert found.response[0, 0, 0] == pytest.approx(np.sum(weight * track.amplitude[-5:, 0]) / weight.sum())
    assert found.amplitude_error[0, 0, 0] == pytest.approx(weight.sum() ** -0.5)


def run(
    speed: np.ndarray,
    response: np.ndarray,
    unbalance: dict[str, complex],
    error: float = 1e-7,
    phase: float = 0.01,
) -> RunUp:
    return RunUp(
        "run",
        5.0,
        speed,
        ("disc 1",),
        response,
        amplitude_error=np.full(response.shape, error),
        phase_error=np.full(response.shape, phase),
        unbalance=unbalance,
    )


SPEED = np.array([100.0, 110.0, 120.0])


def phasors(x: complex, y: complex) -> np.ndarray:
    return np.tile(np.array([x, y]), (3, 1, 1))


def test_the_difference_of_two_runs_is_the_response_to_what_was_added() -> None:
    with_weight = run(SPEED, phasors(3e-5 + 1e-5j, 2e-5j), {"disc 1": 5e-5 + 0j})
    residual = run(SPEED[1:], phasors(1e-5 + 0j, 0.5e-5j)[1:], {"disc 1": 1e-5j})
    net = difference(with_weight, residual)
    np.testing.assert_allclose(net.speed, SPEED[1:])
    np.testing.assert_allclose(net.response, phasors(2e-5 + 1e-5j, 1.5e-5j)[1:])
    assert net.unbalance == {"disc 1": 5e-5 - 1e-5j}


def test_the_errors_of_a_difference_are_those_of_many_draws(rng: np.random.Generator) -> None:
    """An independent calculation: both phasors drawn with their errors along and across, 40000 times."""
    first, second, errors = 3e-5 * np.exp(0.4j), 2e-5 * np.exp(1.5j), (4e-7, 0.02)
    one = run(SPEED, phasors(first, first), {"disc 1": 5e-5 + 0j}, *errors)
    other = run(SPEED, phasors(second, second), {"disc 1": 0j}, *errors)
    net = difference(one, other)
    draws = rng.standard_normal((4, 40_000))
    drawn = first * (1 + errors[0] / abs(first) * draws[0]) * np.exp(1j * errors[1] * draws[1])
    drawn = drawn - second * (1 + errors[0] / abs(second) * draws[2]) * np.exp(1j * errors[1] * draws[3])
    turned = drawn * np.exp(-1j * np.angle(first - second))
    assert net.amplitude_error[0, 0, 0] == pytest.approx(np.std(turned.real), rel=0.02)
    assert net.phase_error[0, 0, 0] * abs(first - second) == pytest.approx(np.std(turned.imag), rel=0.02)


def test_a_residual_is_read_between_its_speeds() -> None:
    grown = run(SPEED, phasors(1e-5, 2e-5) * np.array([1.0, 2.0, 3.0])[:, None, None], {"disc 1": 0j})
    found = interpolate_run(grown, np.array([90.0, 105.0, 115.0]))
    np.testing.assert_allclose(found.speed, [105.0, 115.0])
    np.testing.assert_allclose(found.response[:, 0, 0], [1.5e-5, 2.5e-5])
    with pytest.raises(DataError, match="does not reach"):
        interpolate_run(grown, np.array([10.0]))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"speed": SPEED + 50}, "share no speed"),
        ({"load": 7.0}, "loads of 5 and 7 N"),
        ({"unbalance": {"disc 1": 5e-5 + 0j}}, "same known unbalance"),
        ({"planes": ("disc 2",), "unbalance": {"disc 2": 0j}}, "other planes"),
        ({"unbalance": {}, "shaker": Shaker("disc 1", 1.0, 0.0)}, "shaker is not subtracted"),
        ({"response": phasors(3e-5, 1e-5)}, "do not differ"),
    ],
)
def test_runs_that_cannot_be_subtracted_are_refused(change: dict[str, object], message: str) -> None:
    one = run(SPEED, phasors(3e-5, 1e-5), {"disc 1": 5e-5 + 0j})
    other = run(SPEED, phasors(1e-5, 2e-5), {"disc 1": 0j})
    with pytest.raises(DataError, match=message):
        difference(one, replace(other, **change))


def test_a_cascade_has_its_peaks_on_the_shaft_line() -> None:
    """A sine keeps its amplitude under the window (a Hann window's coherent gain), but for what the sweep
    smears: half a line at most.
    """
    found = cascade_spectra(sweep(120.0), LINES, resolution=2.0)
    assert found.amplitude.shape == (found.speed.size, found.frequency.size, 2) and found.labels == ("a", "b")
    assert found.frequency[-1] <= 4 * found.speed.max()
    peaks = found.frequency[np.argmax(found.amplitude[:, :, 0], axis=1)]
    np.testing.assert_allclose(peaks, found.speed, atol=1.01)
    np.testing.assert_allclose(found.amplitude[:, :, 0].max(axis=1), abs(X), rtol=0.16)
    with pytest.raises(DataError, match=r"shorter than two blocks of 0\.5 s"):
        cascade_spectra(sweep(0.6), LINES, resolution=2.0)


def test_runs_less_one_baseline_share_its_noise() -> None:
    """A closed form: of n equal runs less one run, all of one noise, the mean has (1 + 1/n) of its variance
    and not 2/n, so that V becomes V + V (n - 1)/2 (V^-1 - P) V beside priors of information P.
    """
    n, source = 4, trained("inside")[1]
    error = np.full(source.response.shape, 3e-7)
    before = replace(
        source,
        response=np.roll(0.3j * source.response, 1, axis=0),
        unbalance={"disc 1": 0j},
        amplitude_error=error,
        phase_error=error / np.abs(np.roll(0.3 * source.response, 1, axis=0)),
    )
    both = source.response + before.response
    after = replace(source, response=both, amplitude_error=error, phase_error=error / np.abs(both))
    runs = [replace(difference(after, before), name=f"run {number}") for number in range(n)]
    alone = [replace(run, baseline=None) for run in runs]
    fit, plain = fit_jointly(RIG, runs, use_thresholds=False), fit_jointly(RIG, alone, use_thresholds=False)
    np.testing.assert_allclose(fit.values, plain.values, rtol=1e-12)
    v = plain.covariance
    by_data = np.eye(PRIOR.size) - v / PRIOR**2
    np.testing.assert_allclose(fit.covariance, v + (n - 1) / 2 * by_data @ v, rtol=1e-6, atol=1e-9 * v.max())
    one, of_itself = (fit_jointly(RIG, some[:1], use_thresholds=False) for some in (runs, alone))
    np.testing.assert_allclose(one.covariance, of_itself.covariance, rtol=1e-9)
    start = RIG.start_coefficients(source.load, source.speed)
    points, unit = fit_points(RIG, runs, bound=0.9)[0], scales(as_eight(*start))
    slopes = fit.groups[0].residual_and_slopes(points.coefficients)[1] * unit[:, None]
    v = np.linalg.inv(slopes.swapaxes(1, 2) @ slopes + np.eye(8) / 0.15**2)
    shared = v + (n - 1) / 2 * (v - v @ v / 0.15**2)
    expected = np.sqrt(np.diagonal(shared, axis1=1, axis2=2)) * unit
    np.testing.assert_allclose(points.std_error, expected, rtol=1e-6)


def test_a_baseline_read_between_its_speeds_is_shared_in_parts() -> None:
    """Two runs at speeds a quarter and a half between two readings of the run that both subtract: their
    errors have the covariance .75 x .5 + .25 x .5 of its variance, by hand.
    """
    residual = run(SPEED, phasors(2e-5, 2e-5), {"disc 1": 0j})
    parts = []
    for speed in (102.5, 105.0):
        moved = run(np.array([speed]), phasors(5e-5, 5e-5)[:1], {"disc 1": 5e-5 + 0j})
        net = weight_effect(residual, moved)
        excited = ExcitedRun(net, RIG.condense(net.speed, {}))
        slopes = np.zeros((1, excited.n_equation, 1))
        slopes[0, 0] = net.amplitude_error[0, 0, 0]
        parts.append((net, excited.by_baseline(slopes)[0]))
    assert shared_noise(parts, 1)[0, 0] == pytest.approx(2 * (0.75 * 0.5 + 0.25 * 0.5) * 1e-7**2)
