"""Measured critical speeds: against closed forms, against the virtual rig's truth with its noise, and their
standard errors.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from labpipe.errors import DataError
from labpipe.methods.run_ups.measured import measured_critical_speed
from labpipe.methods.run_ups.records import RunUp
from labpipe.methods.run_ups.virtual_rig import run_ups, true_coefficients
from labpipe.records.uncertain import Uncertain
from tests.methods.run_ups.run_up_cases import RIG, trained, virtual


def jeffcott(step: float, zeta: float = 0.1, natural: float = 150.0) -> RunUp:
    """A round rotor on one spring: W^2 / (w^2 - W^2 + 2 j zeta w W), circular, without noise."""
    speed = np.arange(60.0, 261.0, step)
    radius = 1e-5 * speed**2 / (natural**2 - speed**2 + 2j * zeta * natural * speed)
    response = np.stack([radius, -1j * radius], axis=-1)[:, None]
    amplitude, phase = 1e-4 * np.abs(response), np.full(response.shape, 1e-4)
    unbalance = {"disc": 1e-5 + 0j}
    return RunUp(
        "jeffcott",
        5.0,
        speed,
        ("disc",),
        response,
        amplitude_error=amplitude,
        phase_error=phase,
        unbalance=unbalance,
    )


@pytest.mark.parametrize("step", [5.0, 10.0])
@pytest.mark.parametrize("zeta", [0.05, 0.1, 0.2])
def test_the_peak_of_a_round_rotor(step: float, zeta: float) -> None:
    """w / sqrt(1 - 2 zeta^2), between the measured speeds, to two parts in a thousand."""
    found = measured_critical_speed(jeffcott(step, zeta))
    assert found.value == pytest.approx(150 / np.sqrt(1 - 2 * zeta**2), rel=2e-3)


def test_nine_speeds_know_the_error_of_the_curve_through_them() -> None:
    """Almost without noise: what two speeds fewer change, by the run that has seven of them."""
    whole = jeffcott(20.0, 0.05)

    def at(first: int, last: int) -> Uncertain:
        names = ("speed", "response", "amplitude_error", "phase_error")
        parts = {name: getattr(whole, name)[first:last] for name in names}
        return measured_critical_speed(dataclasses.replace(whole, **parts))

    # The largest displacement is that of the sixth speed of all.
    nine, seven = at(1, 10), at(2, 9)
    assert nine.std_error == pytest.approx(abs(nine.value - seven.value), rel=0.1) and nine.std_error > 0


@pytest.mark.long
@pytest.mark.parametrize(("kind", "most"), [("outside", 0.0015), ("inside", 0.0025), ("factors", 0.006)])
def test_the_rig_s_critical_speeds_are_read_off_with_their_errors(kind: str, most: float) -> None:
    """Four loads, four seeds, steps of 100 rpm; nine in ten within two standard errors, none beyond four."""
    truth = virtual(kind)
    exact = {load: RIG.critical_speed(true_coefficients(truth, load)) for load in truth.loads}
    found = [
        (run, measured_critical_speed(run))
        for seed in range(1, 5)
        for run in run_ups(truth, seed, ("load-1", "load-2", "load-3", "load-4"))
    ]
    relative = np.array([one.value / exact[run.load] - 1 for run, one in found])
    missed = np.array([(one.value - exact[run.load]) / one.std_error for run, one in found])
    assert np.max(np.abs(relative)) < most
    assert np.mean(np.abs(missed) < 2) > 0.85 and np.max(np.abs(missed)) < 4


def test_planes_have_peaks_of_their_own() -> None:
    run = trained("outside")[0]
    first, last = measured_critical_speed(run, "disc 1"), measured_critical_speed(run)
    assert last == measured_critical_speed(run, "disc 2")
    coefficients = true_coefficients(virtual("outside"), run.load)
    assert first.value == pytest.approx(RIG.critical_speed(coefficients, "disc 1"), rel=3e-3)


def test_the_same_run_gives_the_same_error() -> None:
    run = trained("outside")[1]
    assert measured_critical_speed(run) == measured_critical_speed(run)


def test_more_noise_is_less_certain() -> None:
    run = trained("outside")[1]
    louder = dataclasses.replace(
        run, amplitude_error=5 * run.amplitude_error, phase_error=5 * run.phase_error
    )
    assert measured_critical_speed(louder).std_error > 2 * measured_critical_speed(run).std_error


def test_a_run_without_a_peak_is_refused() -> None:
    run = jeffcott(10.0)
    low = run.speed < 120
    below = dataclasses.replace(
        run,
        **{name: getattr(run, name)[low] for name in ("speed", "response", "amplitude_error", "phase_error")},
    )
    with pytest.raises(DataError, match="no critical speed within its speeds"):
        measured_critical_speed(below)
