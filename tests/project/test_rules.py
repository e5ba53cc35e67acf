"""Rules of accept and expect: taken apart as written, faults at their place."""

from __future__ import annotations

import pytest
from hypothesis import given, strategies as st

from labpipe.errors import ConfigErrors
from labpipe.project.marked_yaml import parse_marked
from labpipe.project.rules import Rule, read_rules
from labpipe.project.settings_reader import Faults

FITS = ("direct", "sliding", "study")


def rules(text: str) -> tuple[Rule, ...]:
    """The rules below `accept:`; ConfigErrors with all their faults."""
    faults = Faults()
    found = read_rules("accept", parse_marked(text, "p.yaml"), faults, FITS, {})
    faults.raise_any()
    return found


@pytest.mark.parametrize(
    ("text", "fit", "which", "item", "kind", "bound"),
    [
        ("direct.gof: '>= 0.95'", "direct", "", "gof", ">=", "0.95"),
        ("direct.k: 45.2 kN/m +- 1 %", "direct", "", "k", "+-", "45.2 kN/m +- 1 %"),
        ("direct.k: 45.2 kN/m ± 1 %", "direct", "", "k", "+-", "45.2 kN/m ± 1 %"),
        ("direct.warnings: not collinear", "direct", "", "warnings", "=", "not collinear"),
        ("direct.k_xx.significant: true", "direct", "", "k_xx.significant", "=", "true"),
        ("'sliding[72.5 Hz].k_xx': '< 3 N/m'", "sliding", "72.5 Hz", "k_xx", "<", "3 N/m"),
        ("'sliding[427N-up].count': '> 3'", "sliding", "427N-up", "count", ">", "3"),
        ("'study.ls[4 %].coverage': '<= 90 %'", "study", "", "ls[4 %].coverage", "<=", "90 %"),
        ("direct.lines: 15", "direct", "", "lines", "=", "15"),
    ],
)
def test_a_rule_is_taken_apart(text: str, fit: str, which: str, item: str, kind: str, bound: str) -> None:
    (rule,) = rules(text)
    assert (rule.fit, rule.which, rule.item, rule.kind, rule.bound) == (fit, which, item, kind, bound)
    assert (rule.section, rule.place) == ("accept", "p.yaml:1:1")


@given(st.sampled_from([">=", "<=", ">", "<"]), st.floats(-1e6, 1e6), st.integers(0, 3), st.integers(0, 3))
def test_blanks_around_a_comparison_do_not_matter(sign: str, bound: float, before: int, after: int) -> None:
    (rule,) = rules(f"direct.k: '{' ' * before}{sign}{' ' * after}{bound!r} N/m '")
    assert (rule.kind, rule.bound, rule.text) == (sign, f"{bound!r} N/m", f"direct.k {sign} {bound!r} N/m")


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("direct.k: 45.2 kN/m +- 1 %", "direct.k 45.2 kN/m +- 1 %"),
        ("direct.gof: '>=0.9'", "direct.gof >= 0.9"),
        ("direct.warnings: none", "direct.warnings none"),
    ],
)
def test_a_rule_is_shown_as_people_write_it(text: str, shown: str) -> None:
    assert rules(text)[0].text == shown


def test_a_list_of_rules_are_rules_of_one_address() -> None:
    found = rules("direct.k: ['>= 1 N/m', '<= 2 N/m', 1.5 N/m +- 1 %]\ndirect.gof: '> 0.9'\n")
    assert [(rule.address, rule.kind) for rule in found] == [
        ("direct.k", ">="),
        ("direct.k", "<="),
        ("direct.k", "+-"),
        ("direct.gof", ">"),
    ]


def test_no_section_has_no_rules() -> None:
    assert read_rules("accept", None, Faults(), FITS, {}) == ()


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        (
            "direct: '> 1'",
            "p.yaml:1:1: accept.direct: is not an address; write fit.parameter, for example direct.k",
        ),
        ("'direct[72 Hz]': '> 1'", "accept.direct[72 Hz]: is not an address"),
        ("dirct.k: '> 1'", "accept.dirct.k: there is no fit 'dirct'; known: direct, sliding, study"),
        ("direct.k: ''", "accept.direct.k: a rule is missing"),
        ("direct.k:", "accept.direct.k: a rule is missing"),
        ("direct.k: {a: 1}", "accept.direct.k: a rule is missing"),
        ("direct.k: []", "accept.direct.k: a rule is missing"),
        ("direct.k: ['> 1', '']", "accept.direct.k: a rule is missing"),
        (
            "direct.warnings: not model-mismach",
            "unknown warning 'model-mismach'; did you mean 'model-mismatch'?",
        ),
        ("warnings: [also collinear, '>= 1']", "accept.warnings: 'warnings' is compared with a word"),
        ("direct.k.significant: maybe", "accept.direct.k.significant: 'maybe' is neither true nor false"),
        (
            "direct.k: 45 kN/m +- 1 % (k=2)",
            "accept.direct.k: 'k=2' is of an uncertainty, and a rule states a",
        ),
        ("direct.k: 45 kN/m +- 1 % (rectangular)", "'rectangular' is of an uncertainty"),
        ("- direct.k", "p.yaml:1:1: accept: a mapping of keys to values is needed"),
    ],
)
def test_a_rule_that_is_none_is_refused_at_its_place(text: str, fault: str) -> None:
    with pytest.raises(ConfigErrors) as caught:
        rules(text)
    assert any(fault in str(one) for one in caught.value.faults), str(caught.value)


def test_every_fault_of_a_section_is_named() -> None:
    with pytest.raises(ConfigErrors) as caught:
        rules("dirct.k: '> 1'\ndirect: '> 1'\ndirect.c: ''\ndirect.k: '> 1 N/m'\n")
    assert [fault.where for fault in caught.value.faults] == ["p.yaml:1:1", "p.yaml:2:1", "p.yaml:3:1"]
