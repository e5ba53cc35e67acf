"""Run-ups compared with rules: which run of several decides, and in which unit the speed is shown."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from labpipe.errors import ConfigError
from labpipe.methods.run_ups.records import (
    HELD_OUT,
    TRAINED,
    MeasuredRun,
    RunUpMethod,
    RunUpResult,
    UncertainAmount,
)
from labpipe.methods.run_ups.section import run_up_outcome
from labpipe.project.judging import compare_number
from labpipe.project.rules import Rule


def run(name: str, role: str, critical: float | None) -> MeasuredRun:
    """A run with a critical speed [Hz] known to 0.1 Hz."""
    speed = None if critical is None else UncertainAmount(2 * math.pi * critical, 2 * math.pi * 0.1)
    return MeasuredRun(name, 10.0, role, excitation="unbalance", speed=(), motions=(), critical_speed=speed)


RUNS = (
    run("none", TRAINED, None),
    run("first", TRAINED, 30.0),
    run("second", HELD_OUT, 20.0),
    run("third", TRAINED, 31.0),
)
RESULT = RunUpResult("rotor", "disc", "journal", runs=RUNS, methods=())


def rule(item: str, kind: str, bound: str) -> Rule:
    return Rule(
        section="accept",
        address=f"run_ups.{item}",
        fit="run_ups",
        which="",
        item=item,
        kind=kind,
        bound=bound,
        place="p.yaml:1:1",
    )


@pytest.mark.parametrize(
    ("item", "kind", "bound", "shown", "passed"),
    [
        ("measured.critical_speed", ">=", "25 Hz", "20 Hz", False),
        ("measured.critical_speed", ">=", "900 rpm", "1800 rpm", True),
        ("measured[third].critical_speed", ">=", "25 Hz", "31 Hz", True),
        ("measured.critical_speed.std_error", "<=", "0.2 Hz", "0.1 Hz", True),
        ("measured[second].critical_speed.covers", "=", "20.1 Hz", "19.804 Hz to 20.196 Hz", True),
        ("measured[second].critical_speed.covers", "=", "20.3 Hz", "19.804 Hz to 20.196 Hz", False),
    ],
)
def test_a_rule_without_a_run_shows_the_first_that_fails(
    item: str, kind: str, bound: str, shown: str, passed: bool
) -> None:
    outcome = run_up_outcome(rule(item, kind, bound), RESULT, compare_number)
    assert (outcome.shown, outcome.passed) == (shown, passed)


def test_a_run_without_a_value_meets_no_rule() -> None:
    assert not run_up_outcome(
        rule("measured[none].critical_speed", ">=", "1 Hz"), RESULT, compare_number
    ).passed


def test_a_run_that_is_not_there() -> None:
    with pytest.raises(ConfigError, match="there is no run 'fist'"):
        run_up_outcome(rule("measured[fist].critical_speed", ">=", "1 Hz"), RESULT, compare_number)


@pytest.mark.parametrize("item", ["joint[first].rank", "joint.rank.std_error"])
def test_a_number_of_all_runs_has_no_run_and_no_attribute(item: str) -> None:
    method = RunUpMethod("joint", "(c)", "not rejected", predictions=(), rank=8)
    with pytest.raises(ConfigError, match="'rank' is that of all runs, by itself"):
        run_up_outcome(rule(item, ">=", "8"), replace(RESULT, methods=(method,)), compare_number)
