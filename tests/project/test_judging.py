"""Warnings of a fit compared with rules: one that must be there, one that must not, none at all."""

from __future__ import annotations

from dataclasses import replace

import pytest

from labpipe.errors import ConfigError
from labpipe.project.judging import judge
from labpipe.project.marked_yaml import parse_marked
from labpipe.project.rules import Rule, read_rules
from labpipe.project.settings_reader import Faults
from labpipe.records.finding import Finding, note
from labpipe.records.identification import Fit
from tests.uncertainty.conftest import a_fit


def with_warnings(*codes: str) -> Fit:
    """A fit with these warnings, and a remark, which is none."""
    findings = (*(Finding(code, "said") for code in codes), note("remark", "said"))
    return replace(a_fit("test", {"k": (1.0, 0.1)}), findings=findings)


@pytest.mark.parametrize(
    ("codes", "bound", "passed"),
    [
        ((), "none", True),
        (("mass",), "none", False),
        (("mass", "band"), "mass", True),
        (("mass",), "band", False),
        ((), "mass", False),
        (("mass",), "not mass", False),
        (("mass",), "not band", True),
        ((), "not mass", True),
        ((), "remark", False),
    ],
)
def test_warnings_that_must_be_there_or_must_not(codes: tuple[str, ...], bound: str, passed: bool) -> None:
    rule = Rule(
        section="accept",
        address="axial.warnings",
        fit="axial",
        which="",
        item="warnings",
        kind="=",
        bound=bound,
        place="p.yaml:1:1",
    )
    (outcome,) = judge([rule], [with_warnings(*codes)], {})
    assert outcome.passed is passed and outcome.found == (", ".join(codes) or "none")


def test_a_bias_that_nobody_knows_is_not_accepted_unless_it_is_expected() -> None:
    """As of a force that is fed back: whatever the rules on the values say."""
    biased = with_warnings("feedback")
    (outcome,) = judge([], [biased, biased], {})
    assert not outcome.passed and outcome.rule == "axial.warnings: not feedback"
    expected = Rule(
        section="expect",
        address="axial.warnings",
        fit="axial",
        which="",
        item="warnings",
        kind="=",
        bound="feedback",
        place="p.yaml:1:1",
    )
    (outcome,) = judge([expected], [biased], {})
    assert outcome.passed
    taken = replace(expected, section="accept", bound="also feedback")
    for of in (biased, with_warnings("leakage"), with_warnings()):
        assert all(outcome.passed for outcome in judge([taken], [of], {}))
    # What is taken of one test is taken of no other.
    rules, other = [replace(taken, which="test")], replace(biased, test="other")
    assert [outcome.passed for outcome in judge(rules, [biased, other], {})] == [True, False]


def test_one_rule_says_which_warnings_of_every_fit_refuse_a_result() -> None:
    faults = Faults()
    node = parse_marked("warnings: [not leakage, also feedback]", "p.yaml")
    rules = read_rules("accept", node, faults, ("axial", "radial"), {})
    assert len(faults) == 0
    assert [(rule.fit, rule.bound) for rule in rules] == [
        (fit, bound) for fit in ("axial", "radial") for bound in ("not leakage", "also feedback")
    ]


@pytest.mark.parametrize(("rule", "passed"), [("k.covers: 1.15 N/m", True), ("k.covers: 1.25 N/m", False)])
def test_the_interval_of_a_fit_is_held_against_a_value(rule: str, passed: bool) -> None:
    """k = 1 N/m with a standard error of 0.1 N/m: 95 % from 0.8 to 1.2 N/m, within 2 %."""
    (found,) = read_rules("accept", parse_marked(f"axial.{rule}", "p.yaml"), Faults(), ("axial",), {})
    (outcome,) = judge([found], [a_fit("test", {"k": (1.0, 0.1)})], {})
    assert outcome.passed is passed


def test_an_unknown_attribute_is_not_taken_for_the_value() -> None:
    node = parse_marked("axial.k.exapnded: <= 2 N/m", "p.yaml")
    found = read_rules("accept", node, Faults(), ("axial",), {})
    with pytest.raises(ConfigError, match=r"'k' has no 'exapnded'; did you mean 'expanded'\?"):
        judge(found, [a_fit("test", {"k": (1.0, 0.1)})], {})
