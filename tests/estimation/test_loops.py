"""What a closed loop explains of a fit."""

from __future__ import annotations

from dataclasses import replace

import pytest

from labpipe.estimation.diagnostics import held_findings, is_of_closed_loop, with_feedback
from labpipe.records.finding import Finding, Parameter, note
from tests.uncertainty.conftest import a_fit


def parameter(name: str, value: float, significant: bool = True) -> Parameter:
    return Parameter(name, value, "N/m", std_error=1.0, significant=significant)


@pytest.mark.parametrize(
    ("parameters", "named"),
    [
        ([parameter("k", -100.0)], "k"),
        ([parameter("k_xx", -100.0), parameter("k_yy", -80.0), parameter("k_xy", -50.0)], "k_xx, k_yy"),
        # Positive, not told from zero, across, or no stiffness: nothing that a loop must hold.
        ([parameter("k", 100.0)], ""),
        ([parameter("k", -1.0, significant=False)], ""),
        ([parameter("k_xy", -100.0), parameter("c", -100.0)], ""),
        ([], ""),
    ],
)
def test_direct_stiffness_below_zero_is_held_by_the_loop(parameters: list[Parameter], named: str) -> None:
    found = held_findings(parameters)
    assert [finding.message.partition(" is negative")[0] for finding in found] == ([named] if named else [])
    assert all((finding.code, finding.level) == ("closed-loop", "note") for finding in found)


def test_a_force_that_is_fed_back_takes_the_place_of_wrong_causes() -> None:
    fit = replace(
        a_fit("test", {"k": (1.0, 0.1)}),
        findings=(Finding("mass", "m"), Finding("band", "b"), Finding("unphysical", "u")),
    )
    assert [finding.code for finding in with_feedback(fit, [Finding("feedback", "f")]).findings] == [
        "feedback",
        "band",
    ]
    assert with_feedback(fit, [note("feedback", "f"), Finding("noise", "n")]) is fit
    assert is_of_closed_loop([Finding("noise", "n"), note("closed-loop", "c")]) and not is_of_closed_loop(
        [Finding("noise", "n")]
    )
