"""A bearing at several loads and speeds: what a run in every state tells, of every state's coefficients or of what they have in common.

Of numbers p that all states have in common, a clearance or a viscosity, the run in a state s tells J_s^T I_s J_s, where I_s is what it
tells of the coefficients there and J_s = d(coefficients)/dp.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.planner.campaigns import Rig
from labpipe.planner.model import UNITS, PlannedModel
from labpipe.planner.plan import bench, planned_lines, planned_test, weighting_factor
from labpipe.planner.run_plan import Condition, Quantity, RunQuestion
from labpipe.planner.schemes import Multisines
from labpipe.planner.search import BOTH_LIMITS, flat
from labpipe.planner.state_settings import COEFFICIENTS, StatePlanSettings
from labpipe.records.plan import PlannedTest


@dataclass(frozen=True)
class Common:
    """A number of the bearing that all states have in common: value [unit], standard error known before, None for nothing."""

    name: str
    value: float
    unit: str
    std_error: float | None = None


@dataclass(frozen=True)
class BearingState:
    """The bearing under a *load* [N] at a *speed* [Hz], with its expected coefficients in *model*.

    slopes (8, n_common) [units of the coefficients per unit of each number]: their derivatives by what all states have in common.
    """

    name: str
    load: float
    speed: float
    model: PlannedModel
    slopes: FloatArray


@dataclass(frozen=True)
class StateTest:
    """The test of a state: the rig, its multisine, and the information (8, 8) [1/units] of the coefficients by one run."""

    state: BearingState
    rig: Rig
    multisine: Multisines
    planned: PlannedTest
    information: FloatArray


def state_tests(settings: StatePlanSettings, states: Sequence[BearingState]) -> list[StateTest]:
    """The flat multisine of every state, as large as its limits allow; ConfigError where no line is left."""
    return [_test(settings, state) for state in states]


def _test(settings: StatePlanSettings, state: BearingState) -> StateTest:
    state_settings = settings.at(state.speed)
    rig = bench(state_settings, state.model)
    campaign = flat(rig, planned_lines(state_settings), settings.scheme, BOTH_LIMITS)
    factor = weighting_factor(settings.periods, of_spectra=True)
    information = campaign.rate * settings.periods * settings.period / factor**2 / np.outer(state.model.scales, state.model.scales)
    return StateTest(state, rig, campaign.tests[0], planned_test(state_settings, rig, campaign.tests[0], settings.periods), information)


def question_of(settings: StatePlanSettings, tests: Sequence[StateTest], common: Sequence[Common]) -> RunQuestion:
    """What is asked of the runs: parameters are the numbers in common, or where there are none the coefficients of every state.

    Equation (plan-states).
    """
    if common:
        slopes = [test.state.slopes for test in tests]
        parameters = tuple(number.name for number in common)
        units = np.array([abs(number.value) for number in common])
        prior = np.diag([0.0 if number.std_error is None else number.std_error**-2.0 for number in common])
    else:
        n = len(COEFFICIENTS)
        slopes = [np.eye(n * len(tests))[n * number : n * (number + 1)] for number in range(len(tests))]
        parameters = tuple(f"{name}[{test.state.name}]" for test in tests for name in COEFFICIENTS)
        units = np.concatenate([test.state.model.scales for test in tests])
        prior = np.zeros((len(parameters),) * 2)
    conditions = tuple(_condition(settings, test, slope) for test, slope in zip(tests, slopes, strict=True))
    quantities = tuple(_quantities(settings, tests, slopes, common))
    return RunQuestion(parameters, units, prior, conditions, quantities, settings.duration, settings.criterion)


def _condition(settings: StatePlanSettings, test: StateTest, slopes: FloatArray) -> Condition:
    words = (
        ("load", f"{test.state.load:.4g} N"),
        ("speed", f"{60 * test.state.speed:.5g} rpm"),
        ("force", f"{max(test.planned.peak_force):.4g} N peak"),
        ("displacement", f"{1e6 * max(test.planned.peak_displacement):.3g} um peak"),
    )
    return Condition(test.state.name, settings.seconds, words, slopes.T @ test.information @ slopes)


def _quantities(
    settings: StatePlanSettings, tests: Sequence[StateTest], slopes: Sequence[FloatArray], common: Sequence[Common]
) -> Iterator[Quantity]:
    """The numbers in common, and every coefficient of every state."""
    goals = {name: values[0] for name, values in settings.goal}
    for number, quantity in enumerate(common):
        size = abs(quantity.value)
        goal = goals[quantity.name] * size if quantity.name in goals else None
        yield Quantity(quantity.name, quantity.unit, quantity.value, np.eye(len(common))[number], goal, size)
    for test, rows in zip(tests, slopes, strict=True):
        model = test.state.model
        for name, value, scale, row in zip(COEFFICIENTS, model.expected, model.scales, rows, strict=True):
            goal = goals[name] * float(scale) if name in goals else None
            yield Quantity(f"{name}[{test.state.name}]", UNITS[name[0]], float(value), row, goal, float(scale))
