"""The shaft's motion from a given speed and from tacho pulses of known times."""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.errors import ConfigError, DataError
from labpipe.records.recording import Channel, Recording
from labpipe.spectra import shaft
from labpipe.spectra.settings import MaskSettings, ShaftLines
from labpipe.spectra.shaft import ShaftMotion, at_rest, shaft_motion, steady, tacho_pulses

RATE = 1000.0
TACHO = Channel("tacho", "voltage", "reference", "tacho")


def pulse_train(revolutions: np.ndarray, noise: np.ndarray | float = 0.0, offset: float = 2.0) -> Recording:
    """5 V while the shaft is in the first tenth of a revolution.

    Edges rise within two samples, so that they lie between samples.
    """
    share = revolutions % 1.0
    speed = np.gradient(revolutions)
    edge = np.clip(np.where(share > 0.5, share - 1, share) / speed / 2, -0.5, 0.5) + 0.5
    falling = np.clip((0.1 - share) / speed / 2, -0.5, 0.5) + 0.5
    samples = offset + 5 * np.where(share > 0.5, edge, np.minimum(edge, falling)) + noise
    return Recording((TACHO,), samples[:, None], RATE, "run")


def test_pulses_lie_where_the_revolutions_begin(rng: np.random.Generator) -> None:
    time = np.arange(4000) / RATE
    revolutions = 9.37 * time + 0.4
    pulses = tacho_pulses(pulse_train(revolutions), "tacho")
    expected = (np.arange(1, pulses.size + 1) - 0.4) / 9.37
    np.testing.assert_allclose(pulses, expected, atol=1e-9)
    noisy = tacho_pulses(pulse_train(revolutions, 0.2 * rng.normal(size=4000)), "tacho")
    assert noisy.size == pulses.size
    np.testing.assert_allclose(noisy, expected, atol=1e-3)


def test_pulses_over_block_borders_are_found_once() -> None:
    # 200,000 samples are read in several blocks.
    time = np.arange(200_000) / RATE
    pulses = tacho_pulses(pulse_train(20.01 * time + 0.5), "tacho")
    np.testing.assert_allclose(np.diff(pulses), 1 / 20.01, atol=1e-9)


@pytest.mark.parametrize("per_turn", [1, 2])
@pytest.mark.parametrize("smooth", [1, 9])
def test_noise_of_a_tacho_at_rest_is_no_shaft(per_turn: int, smooth: int, rng: np.random.Generator) -> None:
    """White, and as behind a filter; a shaft from rest under a constant torque turns, t^2 / 2 revolutions."""
    lines = ShaftLines(tacho="tacho", pulses=per_turn)
    noise = np.convolve(rng.normal(size=20_000), np.ones(smooth), "valid")
    still = Recording((TACHO,), noise[:, None], RATE, "still")
    assert at_rest(still, lines)
    with pytest.raises(DataError, match="no regular pulses"):
        shaft_motion(still, lines)
    time = 1 + np.arange(8000) / RATE
    assert not at_rest(pulse_train(per_turn * (time**2 / 2 + 0.3)), lines)


def test_a_run_up_is_followed() -> None:
    # phi = 5 t + t^2 revolutions: speed 5 + 2 t.
    time = np.arange(10_000) / RATE
    motion = shaft_motion(pulse_train(5 * time + time**2 + 0.25), ShaftLines(tacho="tacho"))
    middle = (motion.times[1:] + motion.times[:-1]) / 2
    np.testing.assert_allclose(motion.speeds, 5 + 2 * middle, rtol=1e-6)
    inside = (time > motion.times[0]) & (time < motion.times[-1])
    turned = motion.angle(time)[inside] / (2 * np.pi) + 0.75  # the first pulse is at 1.0 - 0.25 revolutions
    # Straight lines between pulses miss the parabola by at most dt^2 / 4 revolutions.
    assert (
        np.max(np.abs(turned - (5 * time + time**2)[inside])) < np.max(np.diff(motion.times)) ** 2 / 4 + 1e-9
    )


def test_the_speed_range_is_not_that_of_single_pulses(rng: np.random.Generator) -> None:
    times = np.arange(200) / 25.0 + 1e-3 * rng.uniform(-1, 1, 200)
    low, high = ShaftMotion(times, np.arange(200.0)).speed_range
    # 1 ms at either end of 10 revolutions of 40 ms: 0.5 % at most.
    assert 25 / 1.005 < low < 25.0 < high < 25 / 0.995
    # Fewer revolutions have one speed, their mean: four within 0.5 s.
    few = ShaftMotion(np.array([0.0, 0.2, 0.3, 0.4, 0.5]), np.arange(5.0))
    assert few.speed_range == pytest.approx((8.0, 8.0))


def test_several_pulses_per_revolution() -> None:
    time = np.arange(4000) / RATE
    motion = shaft_motion(pulse_train(12 * time + 0.3), ShaftLines(tacho="tacho", pulses=4))
    np.testing.assert_allclose(motion.speeds, 3.0, rtol=1e-6)


def test_a_given_speed_turns_evenly_beyond_its_ends() -> None:
    np.testing.assert_allclose(
        steady(2.0, 1.0).angle(np.array([-1.0, 0.0, 0.25, 3.0])), 2 * np.pi * np.array([-2.0, 0.0, 0.5, 6.0])
    )


def test_what_is_no_tacho_is_refused() -> None:
    still = Recording((TACHO,), np.zeros((100, 1)), RATE, "still")
    with pytest.raises(DataError, match="tacho 'tacho' of 'still' does not vary"):
        tacho_pulses(still, "tacho")
    with pytest.raises(DataError, match=r"no channel 'key'.*channels: tacho"):
        tacho_pulses(still, "key")
    with pytest.raises(DataError, match="shows 1 pulse"):
        shaft_motion(pulse_train(np.linspace(0.5, 1.4, 1000)), ShaftLines(tacho="tacho"))


@pytest.mark.parametrize(
    ("given", "fault"),
    [
        ({}, "one of 'speed' and 'tacho'"),
        ({"speed": 1.0, "tacho": "t"}, "one of"),
        ({"speed": 0.0}, "speed must be positive"),
    ],
)
def test_the_speed_is_given_in_one_way(given: dict[str, object], fault: str) -> None:
    with pytest.raises(ConfigError, match=fault):
        ShaftLines(**given)


def test_counts_and_widths_are_checked() -> None:
    with pytest.raises(ConfigError, match="harmonics must be positive"):
        ShaftLines(speed=50.0, harmonics=0)
    with pytest.raises(ConfigError, match="width must not be negative"):
        MaskSettings(speed=50.0, width=-1.0)


def run_up_instants(marks: np.ndarray, turns: int) -> np.ndarray:
    """When phi = 5 t + t^2 revolutions passes the *marks* of every turn."""
    places = (np.arange(turns)[:, None] + marks).ravel()
    return (np.sqrt(25 + 4 * places) - 5) / 2


MARKS = np.array([0.0, 0.13, 0.245, 0.38, 0.49, 0.62, 0.755, 0.87])


@pytest.mark.parametrize(
    ("marks", "missing", "extra"),
    [
        (MARKS[:1], [40], []),
        (MARKS[:1], [40, 41, 70], []),
        (MARKS[:1], [], [40.5, 77.02]),
        (MARKS[:1], [90], [20.03, 20.06, 60.4]),
        (MARKS, [], []),
        (MARKS, [301], []),
        (np.array([0.0, 0.3]), [], []),
        (MARKS, [*range(320, 328), 400], [12.31]),
    ],
)
def test_faults_of_a_tacho_are_told_by_the_pulses_beside_them(
    monkeypatch: pytest.MonkeyPatch, marks: np.ndarray, missing: list[int], extra: list[float]
) -> None:
    """phi = 5 t + t^2 in closed form, by pulses of which some are missing and others are too many."""
    instants = np.delete(run_up_instants(marks, 100), missing)
    instants = np.sort(
        np.append(instants, run_up_instants(np.zeros(1), 1) + (np.sqrt(25 + 4 * np.array(extra)) - 5) / 2)
    )
    monkeypatch.setattr(shaft, "tacho_pulses", lambda *_: instants)
    motion = shaft_motion(pulse_train(np.arange(9.0)), ShaftLines(tacho="tacho", pulses=marks.size))
    time = np.linspace(0.1, instants[-1], 2000)
    # Straight lines over two missing turns are dt^2 / 4 off, dt of three turns .22 s at most.
    late = motion.angle(time) / (2 * np.pi) - (5 * time + time**2)
    assert np.max(np.abs(late)) < 0.014
    message = "".join(finding.message for finding in motion.findings)
    told = f"{len(missing)} of {100 * marks.size} pulses are missing, {len(extra)} are too many"
    assert (told in message) if missing or extra else not message


def test_more_faults_than_neighbours_can_tell_are_refused(
    monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator
) -> None:
    instants = run_up_instants(np.zeros(1), 400)
    kept = np.delete(instants, 5 + np.flatnonzero(rng.random(390) < 0.2))
    monkeypatch.setattr(shaft, "tacho_pulses", lambda *_: kept)
    with pytest.raises(DataError, match=r"pulses are missing, . are too many, more than neighbours can tell"):
        shaft_motion(pulse_train(np.arange(9.0)), ShaftLines(tacho="tacho"))


@pytest.mark.parametrize("count", [np.sqrt, lambda n: 20 - np.sqrt(400 - n), lambda n: 1 - np.exp(-n / 40)])
def test_a_speed_that_only_rises_or_falls_has_no_fault(monkeypatch: pytest.MonkeyPatch, count) -> None:
    """From rest under a constant torque, to rest, and a run that becomes infinitely fast."""
    instants = count(np.arange(1.0, 200.0))
    monkeypatch.setattr(shaft, "tacho_pulses", lambda *_: instants)
    motion = shaft_motion(pulse_train(np.arange(9.0)), ShaftLines(tacho="tacho"))
    np.testing.assert_array_equal(motion.revolutions, np.arange(199.0))
    assert not motion.findings
