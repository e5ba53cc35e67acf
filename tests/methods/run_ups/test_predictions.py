"""What a method says of one run: intervals where it has them, words where it has nothing, curves that end at
the threshold.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from labpipe.errors import FitError
from labpipe.methods.run_ups.methods import PEAK_STEP, AtLoad, predict, with_unbalance_of
from labpipe.methods.run_ups.records import Shaker
from labpipe.methods.run_ups.rotor_file import load_run_up_rotor
from labpipe.methods.run_ups.run_up_csv import read_run_up_csv
from labpipe.records.uncertain import Uncertain

ROOT = Path(__file__).parents[3]
RIG = load_run_up_rotor(ROOT / "configs/rotors/falah.yaml")
RUN = read_run_up_csv(ROOT / "sample_data/falah/load-1.csv")
RPM = np.pi / 30


def at_load(**more: object) -> AtLoad:
    eight = np.ones((RUN.n_speed, 8))
    return AtLoad(RIG.start(RUN.load), eight, **more)  # type: ignore[arg-type]


def test_a_method_with_intervals_keeps_them() -> None:
    found = at_load(
        critical=lambda _: Uncertain(150.0, 0.5), threshold=lambda: Uncertain(280.0, 2.0), notes=("beyond",)
    )
    told = predict(RIG, RUN, found, "")
    assert told.critical_speed is not None and told.critical_speed.ci95 == pytest.approx(
        (150 - 0.979982, 150 + 0.979982)
    )
    assert told.threshold is not None and told.threshold.std_error == 2.0 and told.notes == ("beyond",)
    assert told.speed[-1] == pytest.approx(280.0) and told.speed[0] == pytest.approx(RUN.speed[0])


def test_curves_are_closer_about_the_peak() -> None:
    told = predict(RIG, RUN, at_load(critical=lambda _: Uncertain(150.0, 0.5)), "")
    speed = np.array(told.speed)
    assert np.all(np.diff(speed) > 0)
    about = np.abs(speed - 150) < 10 * RPM * 8
    assert np.all(np.diff(speed[about]) <= PEAK_STEP * 1.001) and np.diff(speed).max() > 4 * PEAK_STEP


def test_another_plane_has_a_critical_speed_of_its_own() -> None:
    """With its interval where the method has one, else computed."""
    at_plane = {"disc 1": Uncertain(150.0, 0.5), "": Uncertain(160.0, 0.6)}
    told = predict(RIG, RUN, at_load(critical=at_plane.__getitem__), "disc 1").critical_speed
    assert told is not None and (told.value, told.std_error) == (150.0, 0.5)
    told = predict(RIG, RUN, at_load(), "disc 1").critical_speed
    assert told is not None and told.std_error is None
    assert told.value == pytest.approx(RIG.critical_speed(RIG.start(RUN.load), "disc 1"))


def test_what_fails_or_does_not_exist_is_said() -> None:
    def fails(_plane: str = "") -> Uncertain:
        raise FitError("the response has no peak")

    told = predict(RIG, RUN, at_load(critical=fails, threshold=lambda: None), "")
    assert told.critical_speed is None and told.threshold is None
    assert told.notes == ("no critical speed: the response has no peak", "no threshold below 6000 rpm")
    nothing = predict(RIG, RUN, "not at this load", "")
    assert nothing.notes == ("not at this load",) and nothing.motions == ()


def test_a_shaker_run_has_a_curve_but_no_critical_speed() -> None:
    shaken = replace(RUN, unbalance={}, shaker=Shaker("disc 1", 2.0, 0.0, 0.95))
    told = predict(RIG, shaken, at_load(), "")
    assert told.critical_speed is None and told.notes == () and told.threshold is not None
    # Twice the force, twice the motion: the curve is that of the shaker, not of an unbalance.
    harder = predict(RIG, replace(shaken, shaker=Shaker("disc 1", 4.0, 0.0, 0.95)), at_load(), "")
    np.testing.assert_allclose(
        harder.motions[0].real, 2 * np.array(told.motions[0].real), rtol=1e-6, atol=1e-12
    )
    assert len(told.motions) == 4


def test_the_rotor_takes_the_runs_unbalance() -> None:
    assert with_unbalance_of(RIG, RUN) is RIG
    other = replace(RUN, unbalance={"disc 2": 1e-5 * np.exp(1j)})
    own = with_unbalance_of(RIG, other)
    assert own.known_unbalance == {"disc 2": pytest.approx(1e-5 * np.exp(1j))}
    np.testing.assert_allclose(
        own.response(RUN.speed, RIG.start(RUN.load)).reshape(RUN.n_speed, -1),
        RIG.condense(RUN.speed, other.unbalance).response(*RIG.start_coefficients(RUN.load, RUN.speed)),
    )
