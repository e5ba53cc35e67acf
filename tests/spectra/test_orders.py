"""Order tracking of orbits with known amplitude, phase and sense of turning."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labpipe.errors import DataError
from labpipe.records.recording import Channel, Recording
from labpipe.spectra.orders import OrderTrack, plane_track, track_order
from labpipe.spectra.settings import ShaftLines

RATE = 2000.0
X, Y = (
    Channel("x", "displacement", "output", "x", 0.0),
    Channel("y", "displacement", "output", "y", np.pi / 2),
)
TACHO = Channel("tacho", "voltage", "reference", "tacho")


def circles_of(track: OrderTrack) -> OrderTrack:
    return plane_track(track, track.planes[0])


def run(
    revolutions: np.ndarray, x: np.ndarray, y: np.ndarray, channels: tuple[Channel, ...] = (X, Y)
) -> Recording:
    pulses = np.where(revolutions % 1.0 < 0.5, 5.0, 0.0)
    return Recording((*channels, TACHO), np.column_stack([x, y, pulses]), RATE, "run")


def circle(revolutions: np.ndarray, forward: complex, backward: complex) -> tuple[np.ndarray, np.ndarray]:
    """[x, y] = A [f, b] turned with the shaft."""
    turn = np.exp(2j * np.pi * revolutions)
    return np.real((forward + backward) * turn), np.real((-1j * forward + 1j * backward) * turn)


def test_an_orbit_at_a_given_speed() -> None:
    revolutions = 43.7 * np.arange(20_000) / RATE
    forward, backward = 3e-5 * np.exp(0.4j), 1e-5 * np.exp(-1.1j)
    track = track_order(run(revolutions, *circle(revolutions, forward, backward)), ShaftLines(speed=43.7))
    assert track.time.size == 21
    np.testing.assert_allclose(track.speed, 43.7, rtol=1e-9)
    np.testing.assert_allclose(track.amplitude[:, 0], forward + backward, rtol=1e-9)
    circles = circles_of(track)
    np.testing.assert_allclose(circles.amplitude, np.tile([forward, backward], (21, 1)), rtol=1e-8)
    # The orbit's half axes by its extreme radii.
    radius = np.hypot(*circle(np.linspace(0, 1, 100_000), forward, backward))
    assert radius.max() == pytest.approx(abs(forward) + abs(backward), rel=1e-6)
    assert radius.min() == pytest.approx(abs(forward) - abs(backward), rel=1e-6)


def test_a_rotor_whirling_forward_has_no_backward_part() -> None:
    revolutions = 30.0 * np.arange(10_000) / RATE
    circles = circles_of(
        track_order(run(revolutions, *circle(revolutions, 1.0, 0.0)), ShaftLines(speed=30.0))
    )
    assert np.max(np.abs(circles.amplitude[:, 1])) < 1e-12
    backward = circles_of(
        track_order(run(revolutions, *circle(revolutions, 0.0, 1.0)), ShaftLines(speed=30.0))
    )
    assert np.max(np.abs(backward.amplitude[:, 0])) < 1e-12


def test_sensors_at_45_degrees_see_the_same_circles() -> None:
    revolutions = 30.0 * np.arange(10_000) / RATE
    x, y = circle(revolutions, 2.0, 0.5j)
    turned = (
        Channel("a", "displacement", "output", "45 deg", np.pi / 4),
        Channel("b", "displacement", "output", "135 deg", 3 * np.pi / 4),
    )
    recording = run(revolutions, (x + y) / np.sqrt(2), (y - x) / np.sqrt(2), turned)
    circles = circles_of(track_order(recording, ShaftLines(speed=30.0)))
    np.testing.assert_allclose(circles.amplitude[3], [2.0, 0.5j], atol=1e-9)


def test_a_run_up_is_tracked_by_the_tacho(rng: np.random.Generator) -> None:
    # 20 to 60 Hz in 60 s; amplitude and phase of a resonance at 40 Hz passed slowly.
    time = np.arange(int(60 * RATE)) / RATE
    revolutions = 20 * time + time**2 / 3 + 0.5
    speed = 20 + 2 * time / 3

    def resonance(f: np.ndarray) -> np.ndarray:
        return f**2 / (40.0**2 - f**2 + 2j * 0.1 * 40.0 * f)

    x = np.real(resonance(speed) * np.exp(2j * np.pi * revolutions)) + 0.01 * rng.normal(size=time.size)
    track = track_order(run(revolutions, x, x), ShaftLines(tacho="tacho", harmonics=3), revolutions=10)
    # The first pulse comes half a revolution after the start: angles agree modulo whole turns. A stretch of
    # 10 revolutions spans 0.2 Hz, and a pulse is known to one sample, 1/33 of a revolution at 60 Hz.
    expected = resonance(track.speed)
    np.testing.assert_allclose(np.abs(track.amplitude[:, 0]), np.abs(expected), rtol=0.02)
    assert np.max(np.abs(np.angle(track.amplitude[:, 0] / expected))) < 2 * np.pi / 33
    assert track.speed[0] < 21 and track.speed[-1] > 58


def test_the_variance_is_that_of_repeats(rng: np.random.Generator) -> None:
    revolutions = 40.0 * np.arange(200_000) / RATE
    x, y = circle(revolutions, 1.0, 0.3)
    track = track_order(
        run(revolutions, x + 0.1 * rng.normal(size=x.size), y), ShaftLines(speed=40.0), revolutions=10
    )
    assert np.mean(track.variance[:, 0]) == pytest.approx(4 * 0.01 / 500, rel=0.02)
    assert np.mean(track.variance[:, 0]) / np.var(track.amplitude[:, 0]) == pytest.approx(1.0, abs=0.12)
    circles = circles_of(track)
    np.testing.assert_allclose(
        np.mean(circles.variance, axis=0) / np.var(circles.amplitude, axis=0), 1.0, atol=0.12
    )


def test_a_change_within_segments_is_no_noise(rng: np.random.Generator) -> None:
    # The phasor grows linearly, by a tenth in a segment: its errors are those of the noise, 4 s^2 / n.
    time = np.arange(60_000) / RATE
    growing = (1 + 0.4j) * time
    x = np.real(growing * np.exp(80j * np.pi * time)) + 0.01 * rng.normal(size=time.size)
    track = track_order(run(40 * time, x, x), ShaftLines(speed=40.0), revolutions=10)
    z = (track.amplitude[:, 0] - (1 + 0.4j) * track.time) / np.sqrt(track.variance[:, 0])
    assert np.mean(track.variance[:, 0]) == pytest.approx(4e-4 / 500, rel=0.02)
    assert np.mean(np.abs(z) ** 2) == pytest.approx(1.0, abs=0.25)


def test_block_borders_do_not_matter() -> None:
    # 70,000 samples are read in two blocks; every stretch is whole and none is lost.
    revolutions = 17.0 * np.arange(70_000) / RATE
    track = track_order(
        run(revolutions, *circle(revolutions, 1.0, 0.0)), ShaftLines(speed=17.0), revolutions=7
    )
    assert track.time.size == int(17.0 * 35 / 7) or track.time.size == int(17.0 * 35 / 7) - 1
    np.testing.assert_allclose(np.diff(track.time), 7 / 17.0, atol=1 / RATE)
    np.testing.assert_allclose(track.amplitude[:, 0], 1.0, rtol=1e-9)


def test_what_cannot_be_tracked_is_refused() -> None:
    revolutions = 10.0 * np.arange(2000) / RATE
    recording = run(revolutions, *circle(revolutions, 1.0, 0.0))
    with pytest.raises(DataError, match="shorter than 20 revolutions"):
        track_order(recording, ShaftLines(speed=10.0))
    alone = Recording((X, Channel("z", "displacement", "output", "z"), TACHO), recording.samples, RATE, "run")
    assert track_order(alone, ShaftLines(speed=10.0), revolutions=2).planes == ()


def test_harmonics_beyond_half_the_rate_take_nothing_from_an_order() -> None:
    """Ten samples a turn: 8x is 2x there, and the two would share its amplitude of one."""
    recording = run(0.1 * np.arange(2000), np.cos(0.4 * np.pi * np.arange(2000)), np.zeros(2000))
    track = track_order(recording, ShaftLines(speed=RATE / 10, harmonics=8), order=2.0)
    np.testing.assert_allclose(track.amplitude[:, 0], 1.0, rtol=1e-9)


def test_delays_and_responses_of_the_channels_are_taken_out() -> None:
    """A circle of one unit seen 2 ms late in x, 1.5 times too large in y, by a tacho that is 1 ms late."""
    revolutions = 30.0 * np.arange(10_000) / RATE
    x, y = (np.roll(part, late) for part, late in zip(circle(revolutions, 1.0, 0.0), (4, 0), strict=True))
    late_x, large_y = replace(X, delay=2e-3), replace(Y, response=((0.0, 1.5, 0.0), (100.0, 1.5, 0.0)))
    recording = run(revolutions - 0.03, x, 1.5 * y, (late_x, large_y))
    lines = ShaftLines(tacho="tacho")
    found = track_order(replace(recording, channels=(late_x, large_y, replace(TACHO, delay=1e-3))), lines)
    # The tacho tells where the shaft was to half a sample.
    np.testing.assert_allclose(found.amplitude, np.tile([1.0, -1.0j], (found.time.size, 1)), atol=0.06)
    with pytest.raises(DataError, match="leaves the table of channel 'y'"):
        track_order(recording, ShaftLines(speed=30.0), order=5.0)


def test_a_recording_without_responses_is_refused() -> None:
    recording = Recording((TACHO,), np.arange(2000.0)[:, None] % 7, RATE, "run")
    with pytest.raises(DataError, match="no response"):
        track_order(recording, ShaftLines(speed=10.0), revolutions=2)


def test_a_track_that_bends_within_its_segments_is_that_of_their_middles() -> None:
    """Through a peak of zeta = .02 at .2 Hz/s a segment of twenty turns is .13 Hz wide, a tenth of the peak:
    its mean is off by X'' T^2 / 24, 13 standard errors at .1 % noise of the peak. Beside the exact X at the
    speed of the middle errors are those stated, within ten per cent about the peak.
    """

    def exact(speed: np.ndarray) -> np.ndarray:
        return speed**2 / (30.0**2 - speed**2 + 2j * 0.02 * 30.0 * speed)

    time = np.arange(0, 60, 1 / RATE)
    speed, revolutions = 24 + 0.2 * time, 24 * time + 0.1 * time**2
    x = np.real(exact(speed) * np.exp(2j * np.pi * revolutions))
    pulses = np.tanh(3 * np.sin(2 * np.pi * revolutions))
    off = []
    for seed in range(6):
        noisy = x + 0.025 * np.random.default_rng(seed).normal(size=x.size)
        track = track_order(
            Recording((X, TACHO), np.column_stack([noisy, pulses]), RATE, "run"), ShaftLines(tacho="tacho")
        )
        errors = (track.amplitude[:, 0] - exact(track.speed)) / np.sqrt(track.variance[:, 0])
        off.append(errors[np.abs(track.speed - 30) < 3])
    assert np.sqrt(np.mean(np.abs(np.concatenate(off)) ** 2)) == pytest.approx(1.0, abs=0.3)


@pytest.mark.parametrize("rate", [1.0, 1.5])
def test_a_peak_within_a_few_segments_is_as_right_as_stated(rate: float) -> None:
    """X = 1 / (1 + j u), closed form, whose half-power width takes four and three segments of twenty
    turns. The tacho is a smooth wave.
    """
    time = np.arange(0, 40 / rate, 1 / RATE)
    revolutions = 20 * time + rate * time**2 / 2
    off, stated = [], []
    for seed in range(4):
        noise = 1e-4 * np.random.default_rng(seed).normal(size=time.size)
        x = np.real(np.exp(2j * np.pi * revolutions) / (1 + 1j * (rate * time - 20))) + noise
        samples = np.column_stack([x, np.sin(2 * np.pi * revolutions)])
        track = track_order(Recording((X, TACHO), samples, RATE, "run"), ShaftLines(tacho="tacho"))
        errors = track.amplitude[:, 0] - 1 / (1 + 1j * (rate * track.time - 20))
        off.append(errors / np.sqrt(track.variance[:, 0]))
        stated.append(np.sqrt(track.variance[:, 0]))
    assert np.sqrt(np.mean(np.abs(np.concatenate(off)) ** 2)) == pytest.approx(1.0, abs=0.3)
    assert np.median(stated[0]) < 2 * 2e-4 / np.sqrt(RATE * 20 / 40)
