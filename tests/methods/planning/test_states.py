"""States of a bearing: which to run how often, against all divisions of the runs, and information by hand."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from labpipe.errors import ConfigError
from labpipe.methods.planning.designs import CRITERIA
from labpipe.methods.planning.model import planned_model
from labpipe.methods.planning.runs import plan_runs
from labpipe.methods.planning.settings import NoiseSettings
from labpipe.methods.planning.states import (
    COEFFICIENTS,
    BearingState,
    CommonNumber,
    StatePlanSettings,
    StateTest,
    question_of,
    state_test,
)

FILM = {
    "k_xx": 45e6,
    "k_xy": 40e6,
    "k_yx": -79e6,
    "k_yy": 36e6,
    "c_xx": 318e3,
    "c_xy": -147e3,
    "c_yx": -147e3,
    "c_yy": 458e3,
}
# Made up: the film stiffens with load, clearance and viscosity do not change it alike in all states.
LOADS, POWERS = (2e3, 5e3, 9e3), (-2.0, -2.6, -3.4)
COMMON = [CommonNumber("clearance", 1e-4, "m"), CommonNumber("viscosity", 0.03, "Pa.s", 0.003)]


def settings(**entries: object) -> StatePlanSettings:
    chosen: dict[str, object] = {
        **{
            "loads": LOADS,
            "speeds": (50.0,),
            "mass": 60.0,
            "band": (20.0, 100.0),
            "period": 0.2,
            "sample_rate": 500.0,
        },
        **{"run": 1.0, "duration": 6 * 1.2, "force_limit": 1e3},
        **{"noise": NoiseSettings(force=3.0, displacement=1e-7, acceleration=0.1), **entries},
    }
    return StatePlanSettings("bearing-states", "bearing.yaml", **chosen)  # type: ignore[arg-type]


def states() -> list[BearingState]:
    found = []
    for number, (load, power) in enumerate(zip(LOADS, POWERS, strict=True)):
        values = np.array(list(FILM.values())) * (load / LOADS[0]) ** 0.7
        slopes = np.stack([power * values / 1e-4, values * np.linspace(0.5, 1.5, 8) ** number / 0.03], axis=1)
        model = planned_model("dynamic-stiffness", dict(zip(COEFFICIENTS, values, strict=True)), 60.0)
        found.append(BearingState(f"{load:g}N", load, 50.0, model, slopes))
    return found


@pytest.fixture(scope="module")
def tests() -> list[StateTest]:
    return [state_test(settings(), state) for state in states()]


@pytest.mark.parametrize("criterion", CRITERIA)
def test_no_other_division_of_the_runs_is_better(tests: list[StateTest], criterion: str) -> None:
    # All 28 divisions of six runs among three states, from J^T I J written out; viscosity is known to 10 %
    # before.
    own = settings(
        estimate=("clearance", "viscosity"),
        goal=(("clearance", (0.01,)), ("viscosity", (0.02,))),
        criterion=criterion,
    )
    plan = plan_runs(question_of(own, tests, COMMON), "states", own.model).plan
    assert sum(run.count for run in plan.runs) == 6
    values = {}
    for counts in product(range(7), repeat=3):
        if sum(counts) == 6:
            told = np.diag([0.0, 0.003**-2.0])
            for count, test in zip(counts, tests, strict=True):
                told = told + count * test.state.slopes.T @ test.information @ test.state.slopes
            inverse = np.linalg.inv(told) / np.outer([1e-6, 6e-4], [1e-6, 6e-4])
            values[counts] = {
                "D": np.linalg.det(inverse),
                "A": np.trace(inverse),
                "minimax": np.diagonal(inverse).max(),
            }[criterion]
    chosen = {run.name: run.count for run in plan.runs}
    assert values[tuple(chosen.get(test.state.name, 0) for test in tests)] == pytest.approx(
        min(values.values())
    )  # type: ignore[index]
    assert 0.8 < plan.efficiency <= 1


def test_coefficients_of_states_that_have_something_in_common(tests: list[StateTest]) -> None:
    # d k = J dp: the error of a coefficient in a state without a run is that of J V J^T.
    own = settings(estimate=("clearance", "viscosity"), goal=(("clearance", (0.01,)),))
    answered = plan_runs(question_of(own, tests, COMMON), "states", own.model)
    for test in tests:
        errors = np.sqrt(np.diagonal(test.state.slopes @ answered.covariance @ test.state.slopes.T))
        found = [
            number.error for number in answered.plan.numbers if number.name.endswith(f"[{test.state.name}]")
        ]
        np.testing.assert_allclose(found, errors, rtol=1e-6)


def test_states_by_themselves(tests: list[StateTest]) -> None:
    # One run in a state gives I^-1, n runs a n-th of the variance; the times level the largest errors as far
    # as whole runs can.
    own = settings(duration=24 * 1.2)
    plan = plan_runs(question_of(own, tests, []), "states", own.model).plan
    counts = {run.name: run.count for run in plan.runs}
    largest = {}
    for test in tests:
        one = np.sqrt(np.diagonal(np.linalg.inv(test.information)))
        found = [number.error for number in plan.numbers if number.name.endswith(f"[{test.state.name}]")]
        np.testing.assert_allclose(found, one / np.sqrt(counts[test.state.name]), rtol=1e-6)
        largest[test.state.name] = float(np.max((one / test.state.model.scales) ** 2))
    worst = max(largest[name] / counts[name] for name in counts)
    # No run can be taken from one state and given to that with the largest error without making another one
    # as large.
    assert all(
        largest[name] / (counts[name] - 1) >= worst * (1 - 1e-9) for name in counts if counts[name] > 1
    )


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ({"run": 0.4}, "2 periods in a run"),
        ({"goal": (("clearance", (0.01,)),)}, "no clearance is predicted"),
        ({"goal": (("k_xx", (0.0,)),)}, "one positive relative error"),
        ({"loads": (0.0,)}, "loads must be positive"),
        ({"loads": ()}, "loads: is empty"),
        ({"speeds": (25.0, 25.0)}, "speeds: one appears twice"),
        ({"estimate": ("clearance", "clearance")}, "estimate: one appears twice"),
        ({"band": (20.0, 300.0)}, "needs more than 600 Hz"),
    ],
)
def test_refusals(entries: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        settings(**entries)
