"""Fits at several levels of excitation: what changes with the level is named, once, where nothing else
changed.
"""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from labpipe.estimation.budget import with_sources
from labpipe.estimation.levels import with_level_findings, with_orders_named
from labpipe.records.finding import Finding, Parameter
from labpipe.records.identification import Fit, Goodness
from labpipe.records.uncertain import Uncertainty

K, C, ERROR_K, ERROR_C = 50e3, 20.0, 100.0, 0.5


def fit(test: str, k: float = K, c: float = C, correlation: float = 0.0, **other: object) -> Fit:
    parameters = (
        Parameter("k", k, "N/m", std_error=ERROR_K),
        Parameter("c", c, "N.s/m", std_error=ERROR_C),
        Parameter("f_n", 35.6, "Hz", std_error=0.1, derived=True),
    )
    plain = Fit(
        "direct",
        "sdof",
        "ml",
        band_hz=(20.0, 50.0),
        lines=100,
        equations=200,
        dof=198,
        gof=Goodness(0.99, 0.99),
        parameters=parameters,
        condition_number=3.0,
        correlation=np.array([[1.0, correlation], [correlation, 1.0]]),
        test=test,
    )
    return replace(plain, **other)


LEVELS = {"quiet": {"level": "5 N"}, "middle": {"level": "10 N"}, "loud": {"level": "0.02 kN"}}


def named(fits: list[Fit], conditions: dict[str, dict[str, str]] = LEVELS) -> list[str]:
    return [
        fit.test
        for fit in with_level_findings(fits, conditions)
        for finding in fit.findings
        if finding.code == "amplitude"
    ]


def test_three_per_cent_of_stiffness_is_named_at_the_highest_level() -> None:
    """1500 N/m against sqrt(2) 100 N/m: 3 % +- 0.28 %.

    The levels are compared as quantities, whatever their unit.
    """
    fits = with_level_findings([fit("loud", 1.03 * K), fit("quiet"), fit("middle", 1.01 * K)], LEVELS)
    assert [len(fit.findings) for fit in fits] == [1, 0, 0]
    message = fits[0].findings[0].message
    assert "between 5 N (test quiet) and 0.02 kN (this test)" in message
    assert re.search(r"stiffness by \+3\.00 \+- 0\.28 %", message)


def test_correlated_estimates_are_held_against_their_joint_uncertainty() -> None:
    """Both a standard error and a half up: along the long axis of a correlation of 0.99 that is chance,
    across it is not.

    z^2 of the change (1.5, +-1.5) sqrt(2) standard errors of the difference: 2 * 2.25 / (2 (1 +- 0.99)).
    """
    for sign, said in ((1, []), (-1, ["loud"])):
        changed = fit("loud", K + 1.5 * np.sqrt(2) * ERROR_K, C + sign * 1.5 * np.sqrt(2) * ERROR_C, 0.99)
        assert named([fit("quiet", correlation=0.99), changed]) == said


@pytest.mark.parametrize(
    ("conditions", "said"),
    [
        (
            {"quiet": {"level": "5 N", "preload": "1 N"}, "loud": {"level": "20 N", "preload": "1 N"}},
            ["loud"],
        ),
        ({"quiet": {"level": "5 N", "preload": "1 N"}, "loud": {"level": "20 N", "preload": "2 N"}}, []),
        ({"quiet": {"preload": "1 N"}, "loud": {"preload": "2 N"}}, []),
        ({"quiet": {"level": "20 N"}, "loud": {"level": "20 N"}}, []),
        ({"quiet": {"level": "low"}, "loud": {"level": "high"}}, []),
        ({"quiet": {"amplitude": "10 um"}, "loud": {"amplitude": "30 um"}}, ["loud"]),
        ({"quiet": {"level": "5 N"}, "loud": {"level": "30 um"}}, []),
        ({}, []),
    ],
)
def test_only_the_level_may_differ(conditions: dict[str, dict[str, str]], said: list[str]) -> None:
    assert named([fit("quiet"), fit("loud", 1.05 * K)], conditions) == said


def test_other_bands_and_terms_are_not_compared() -> None:
    assert named([fit("quiet"), fit("loud", 1.05 * K, band_hz=(20.0, 60.0))]) == []
    assert named([fit("quiet", term="x"), fit("loud", 1.05 * K, term="y")]) == []


def test_a_level_that_is_no_number_hides_no_other() -> None:
    """Of 20 N, "full" and 5 N the two numbers are compared, in whatever order the tests stand."""
    conditions = {"quiet": {"level": "5 N"}, "most": {"level": "full"}, "loud": {"level": "20 N"}}
    tests = [fit("loud", 1.05 * K), fit("most", 1.1 * K), fit("quiet")]
    assert [named([tests[n] for n in order], conditions) for order in ((0, 1, 2), (1, 0, 2), (2, 1, 0))] == [
        ["loud"]
    ] * 3


def test_without_standard_errors_there_is_nothing_to_compare() -> None:
    unknown = fit("loud", 1.05 * K, parameters=(Parameter("k", 1.05 * K, "N/m"), Parameter("c", C, "N.s/m")))
    assert named([fit("quiet"), unknown]) == []


def test_enlarged_standard_errors_count() -> None:
    """A change of 5 standard errors that are themselves enlarged threefold."""
    (k, c, f_n) = fit("loud", K + 5 * ERROR_K).parameters
    assert named([fit("quiet"), fit("loud", parameters=(k, c, f_n))]) == ["loud"]
    enlarged = tuple(replace(p, std_error_inflated=3 * (p.std_error or 0.0)) for p in (k, c, f_n))
    assert named([fit("quiet"), fit("loud", parameters=enlarged)]) == []


def test_what_both_levels_share_hides_no_change() -> None:
    """A gain +- 1 % makes k +- 500 N/m in both tests alike: a change of 1000 N/m is 7 of its own errors."""
    cell = Uncertainty("cell", 0.01, "1")
    tests = [
        with_sources(fit(name, k), [(cell, np.array([-0.01 * k, -0.01 * C, 0.0]))])
        for name, k in (("quiet", K), ("loud", K + 10 * ERROR_K))
    ]
    assert tests[0].parameter("k").full_error == pytest.approx(np.hypot(ERROR_K, 500.0))
    assert named(tests) == ["loud"]


def test_noise_alone_is_a_false_alarm_in_one_run_of_a_hundred_at_most() -> None:
    """600 pairs of correlated normal estimates: 1 % and three binomial deviations."""
    rng = np.random.default_rng(1)
    covariance = np.array([[1.0, 0.7], [0.7, 1.0]]) * np.outer([ERROR_K, ERROR_C], [ERROR_K, ERROR_C])
    draws = rng.multivariate_normal([K, C], covariance, size=(600, 2))
    alarms = [bool(named([fit("quiet", *low, 0.7), fit("loud", *high, 0.7)])) for low, high in draws]
    assert np.mean(alarms) < 0.01 + 3 * np.sqrt(0.01 / 600)


@pytest.mark.parametrize(
    ("line", "speed", "said"),
    [
        (100.0, "6000 rpm", ". 100 Hz is 1x of the shaft at 6000 rpm"),
        (100.2, "50 Hz", ". 100.2 Hz is 2x of the shaft at 3000 rpm"),
        (100.0, "4000 rpm", ""),
        (100.0, "slow", ""),
    ],
)
def test_a_line_alone_is_an_order_of_the_shaft_as_well(line: float, speed: str, said: str) -> None:
    """At 6000 rpm 1x is 100 Hz, which a grid of 50 Hz has as well: nothing tells which of them acts."""
    message = "a multiple of the mains' 50 Hz"
    off = fit("run", findings=(Finding("model-mismatch", message, line_hz=line), Finding("drift", "another")))
    (named_fit,) = with_orders_named([off], {"run": {"speed": speed}})
    assert [found.message for found in named_fit.findings] == [message + said, "another"]
