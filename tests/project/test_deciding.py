"""Rules with limits: how they are read, and how values, margins and several limits are decided on."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from labpipe.artefacts.identification_file import read_identification, write_identification
from labpipe.errors import ConfigError, ConfigErrors
from labpipe.project.judging import judge, judged_part, whole_outcome
from labpipe.project.marked_yaml import parse_marked
from labpipe.project.rules import Rule, read_rules
from labpipe.project.settings_reader import Faults
from labpipe.records.comparison import Comparison
from labpipe.records.finding import Parameter
from labpipe.records.identification import Identification, RuleDecision, RuleOutcome
from labpipe.records.uncertain import Budget, Uncertainty
from labpipe.report.build import build
from labpipe.report.cover import decision_blocks, percent
from tests.uncertainty.conftest import a_fit

# Stiffness in N/m with a standard error of 100.
FIT = a_fit("day 1", {"k": (134.4e3, 100.0), "c": (3.7, 0.02)}, correlation=0.5)


def rules(text: str) -> tuple[Rule, ...]:
    """The rules below `accept:`; ConfigErrors with all their faults."""
    faults = Faults()
    listed = read_rules("accept", parse_marked(text, "p.yaml"), faults, ("axial", "margins"), {})
    faults.raise_any()
    return listed


def outcome(text: str, fit: object = FIT, **records: object) -> RuleOutcome:
    (judged,) = judge(rules(text), [fit], records)  # type: ignore[list-item]
    return judged


@pytest.mark.parametrize(
    ("rule", "expected", "probability"),
    [
        ("limits: [134 kN/m, 135 kN/m], rule: guarded, risk: 5 %", "pass", 1 - 3.16712e-5),
        # w = 164.5 N/m: the lower limit is 100 N/m away.
        ("limits: [134.3 kN/m, 135 kN/m], rule: guarded", "conditional-pass", 0.8413447),
        ("limits: [134.5 kN/m, 135 kN/m], rule: guarded", "conditional-fail", 0.1586553),
        ("limits: [134.7 kN/m, 135 kN/m], rule: guarded", "fail", 0.0013499),
        ("limits: [134.3 kN/m, 135 kN/m], rule: guarded, risk: 20 %", "pass", 0.8413447),
        ("limits: [134.3 kN/m, null], rule: guarded, guard: 0.5", "pass", 0.8413447),
        ("limits: [134.3 kN/m, null], rule: guarded, guard: 0.52", "conditional-pass", 0.8413447),
        ("limits: [134.45 kN/m, null], rule: guarded, guard: -1", "pass", 0.3085375),
        ("min: 134.3 kN/m", "pass", 0.8413447),
        ("max: 134.3 kN/m, rule: simple", "fail", 0.1586553),
        ("max: 134.3 kN/m, rule: risk", "conditional-fail", 0.1586553),
        ("limits: [134.3 kN/m, 134.5 kN/m], rule: risk, risk: 35 %", "pass", 0.6826895),
        ("limits: [134.3 kN/m, 134.5 kN/m], rule: risk, risk: 30 %", "conditional-pass", 0.6826895),
    ],
)
def test_a_value_is_decided_on(rule: str, expected: str, probability: float) -> None:
    """Probabilities of the normal distribution, from its table."""
    judged = outcome(f"axial.k: {{{rule}}}")
    assert judged.decision is not None and judged.decision.outcome == expected
    assert judged.decision.probability == pytest.approx(probability, abs=5e-7)
    assert judged.passed is (expected == "pass") and expected in judged.found


def test_a_rule_may_hold_by_other_outcomes() -> None:
    text = "axial.k: {limits: [134.3 kN/m, 135 kN/m], rule: guarded, outcomes: [pass, conditional-pass]}"
    assert outcome(text).passed
    assert not outcome(text.replace("134.3", "134.5")).passed


def test_what_is_behind_the_interval_counts() -> None:
    """Noise 100, model error and repeats and given numbers together 300 N/m: half the probability is lost."""
    wide = replace(FIT.parameter("k"), std_error_inflated=300.0)
    fit = replace(FIT, parameters=(wide, FIT.parameter("c")))
    judged = outcome("axial.k: {min: 134.1 kN/m, rule: guarded}", fit)
    assert judged.decision is not None
    assert (judged.decision.outcome, judged.decision.uncertainty) == ("conditional-pass", 300.0)
    assert outcome("axial.k: {min: 134.1 kN/m, rule: guarded}").passed


def test_a_guard_band_is_a_part_of_the_expanded_uncertainty() -> None:
    """w = r U: of 7 degrees of freedom U = 2.3646 u by Student's t, not 1.96 u."""
    reach = float(stats.t.ppf(0.975, 7)) * 100.0
    k = replace(FIT.parameter("k"), ci95=(134.4e3 - reach, 134.4e3 + reach))
    fit = replace(FIT, parameters=(k, FIT.parameter("c")))
    for least, expected in (("134.2 kN/m", "conditional-pass"), ("134.16 kN/m", "pass")):
        judged = outcome(f"axial.k: {{min: {least}, rule: guarded, guard: 1}}", fit)
        assert judged.decision is not None and judged.decision.outcome == expected


@pytest.mark.parametrize(
    ("fit", "why"),
    [
        (
            replace(FIT, parameters=(replace(FIT.parameter("k"), std_error=None, ci95=None),)),
            "has no standard uncertainty",
        ),
        (replace(FIT, converged=False), "the fit did not converge"),
    ],
)
def test_what_cannot_be_judged_fails_with_its_reason(fit: object, why: str) -> None:
    for rule in ("{min: 1 N/m}", "{min: 1 N/m, rule: risk}"):
        judged = outcome(f"axial.k: {rule}", fit)
        assert not judged.passed and judged.decision is None and why in judged.found
    together = "all: {together: {axial.k: [1 N/m, null]}}"
    judged = outcome(together, fit)
    assert not judged.passed and "not judged" in judged.found


def test_the_risks_of_a_process() -> None:
    """Shares of a bivariate normal distribution, by scipy."""
    judged = outcome("axial.k: {limits: [134.3 kN/m, 134.7 kN/m], process: 134.5 kN/m +- 150 N/m}")
    assert judged.decision is not None and judged.decision.global_false_acceptance is not None
    joint = stats.multivariate_normal([0, 0], [[150.0**2] * 2, [150.0**2, 150.0**2 + 100.0**2]])
    both = joint.cdf([200, 200], lower_limit=[-200, -200])
    read = stats.norm(0, np.hypot(150.0, 100.0))
    taken = read.cdf(200) - read.cdf(-200)
    assert judged.decision.global_false_acceptance == pytest.approx(taken - both, abs=1e-5)


def test_limits_together_by_the_correlation_of_the_fit() -> None:
    judged = outcome(
        "stiff and damped: {together: {axial.k: [134.3 kN/m, null], axial.c: [null, 3.72 N.s/m]}, rule: risk}"
    )
    # c at most: the second coordinate with its sign turned.
    wanted = stats.multivariate_normal([0, 0], [[1, -0.5], [-0.5, 1]]).cdf([1.0, 1.0])
    assert judged.decision is not None and not judged.decision.least
    assert judged.decision.probability == pytest.approx(wanted, abs=2e-4)
    assert (judged.decision.together, judged.passed) == (2, False)


def test_limits_together_are_judged_in_each_test_of_a_dataset() -> None:
    text = "x: {{together: {{axial.k: [134.3 kN/m, null], axial.{}: [null, 3.72 N.s/m]}}, rule: risk}}"
    (rule,) = rules(text.format("c"))
    part = judged_part(rule, [FIT])
    assert part.addressed == 1 and whole_outcome(rule, part) == outcome(text.format("c"))
    (wrong,) = rules(text.format("kk"))
    lacking = judged_part(wrong, [FIT])
    assert lacking.outcome is None and lacking.fault is not None
    # A test in which it cannot be judged keeps the rule from holding in all.
    sure = judged_part(
        rule, [replace(FIT, parameters=tuple(replace(p, std_error=1e-3) for p in FIT.parameters))]
    )
    assert whole_outcome(rule, sure).passed
    mixed = whole_outcome(rule, sure.with_more(lacking))
    assert not mixed.passed and mixed.found.startswith("not judged: in a test ")
    with pytest.raises(ConfigError):
        whole_outcome(wrong, lacking)


def test_tests_with_one_sensor_hold_together_more_likely() -> None:
    """Two tests, noise of each 60 and the sensor of both 80 N/m: a correlation of 0.64."""
    budget = Budget(
        names=("k",),
        random=np.array([60.0]),
        random_dof=None,
        sources=(Uncertainty("sensitivity of f", 0.01, "1"),),
        changes=np.array([[80.0]]),
    )
    parameter = replace(FIT.parameter("k"), std_error=60.0, std_error_inflated=100.0, systematic=80.0)
    fits = [
        replace(FIT, parameters=(parameter,), budget=budget, correlation=np.eye(1), test=test)
        for test in ("day 1", "day 2")
    ]
    (judged,) = judge(rules("both: {together: {axial.k: [134.3 kN/m, null]}, rule: risk}"), fits, {})
    wanted = stats.multivariate_normal([0, 0], [[1, 0.64], [0.64, 1]]).cdf([1.0, 1.0])
    assert judged.decision is not None and judged.decision.probability == pytest.approx(wanted, abs=2e-4)


def test_of_an_unknown_correlation_the_least_probability_counts() -> None:
    derived = Parameter("f_n", 65.7, "Hz", std_error=0.1, derived=True)
    fit = replace(FIT, parameters=(*FIT.parameters, derived))
    judged = outcome("x: {together: {axial.k: [134.3 kN/m, null], axial.f_n: [65.6 Hz, null]}}", fit)
    assert judged.decision is not None and judged.decision.least
    assert judged.decision.probability == pytest.approx(1 - 2 * 0.1586553, abs=1e-6)
    assert judged.passed and "at least" in judged.found


def test_margins_and_ratios_of_comparisons() -> None:
    amounts = (Parameter("gain_margin", 2.2, "1", std_error=0.1), Parameter("pole_1", -3.0, "rad/s"))
    comparison = Comparison(
        name="margins",
        kind="certificate",
        subject="",
        unit="1",
        points=(),
        amounts=amounts,
        verdict="accepted",
        statement="",
        undecided=(("pole_*", "its draws do not agree"),),
    )
    judged = outcome("margins.gain_margin: {min: 2, rule: guarded}", compare=(comparison,))
    assert judged.passed and judged.decision is not None
    assert judged.decision.probability == pytest.approx(0.9772499, abs=1e-6)
    undecided = outcome("margins.pole_1: {max: -2 rad/s}", compare=(comparison,))
    assert not undecided.passed and "its draws do not agree" in undecided.found
    together = outcome(
        "m: {together: {margins.gain_margin: [2, null], margins.pole_1: [null, -2 rad/s]}}",
        compare=(comparison,),
    )
    assert not together.passed and "its draws do not agree" in together.found


@pytest.mark.parametrize(
    ("correlations", "probability", "least"),
    [((("b", "a", 0.5),), 1 / 3, False), ((("a", "b", -0.5),), 1 / 6, False), ((), 0.0, True)],
)
def test_numbers_of_a_comparison_hold_together_by_their_correlation(
    correlations: tuple[tuple[str, str, float], ...], probability: float, least: bool
) -> None:
    """Both above their own values: 1/4 + asin(r) / (2 pi); at worst they exclude each other."""
    amounts = Parameter("a", 2.0, "1", std_error=0.1), Parameter("b", 5.0, "1", std_error=0.3)
    comparison = Comparison(
        name="margins",
        kind="certificate",
        subject="",
        unit="1",
        points=(),
        amounts=amounts,
        verdict="accepted",
        statement="",
        correlations=correlations,
    )
    judged = outcome(
        "x: {together: {margins.a: [2, null], margins.b: [5, null]}, rule: risk}", compare=(comparison,)
    )
    assert judged.decision is not None and judged.decision.least is least
    assert judged.decision.probability == pytest.approx(probability, abs=2e-4)


def test_decisions_are_in_json_and_come_back(tmp_path: Path) -> None:
    judged = judge(
        rules("axial.k: {limits: [134.3 kN/m, 135 kN/m], rule: guarded}\naxial.c: '>= 3 N.s/m'"), [FIT], {}
    )
    path = tmp_path / "identification.json"
    write_identification(path, Identification((FIT,), outcomes=judged))
    entries = json.loads(path.read_text())["accept"]
    assert (entries[0]["outcome"], entries[0]["passed"]) == ("conditional-pass", False)
    assert entries[0]["probability"] == pytest.approx(0.8413447, abs=1e-6)
    assert set(entries[1]) == {"rule", "value", "passed"}
    assert read_identification(path).outcomes == judged


def test_the_report_states_risk_and_simple_acceptance() -> None:
    judged = judge(
        rules("axial.k: {limits: [134.3 kN/m, 135 kN/m], rule: guarded}\naxial.c: '>= 3 N.s/m'"), [FIT], {}
    )
    text = str(decision_blocks(judged))
    assert "conditional-pass" in text and "84 %" in text and "16 %" in text
    assert "134.464 kN/m to 134.836 kN/m" in text
    assert "simple acceptance" in str(build(Identification((FIT,), outcomes=judged)))
    assert decision_blocks(()) == ()


def test_a_row_says_what_passes_and_both_shares_of_a_process() -> None:
    """Ends that are open, both ends closed to everything, and several limits, which have no one end."""
    plain = RuleDecision(outcome="pass", probability=0.9, specific_risk=0.1, uncertainty=20.0, unit="N/m")
    decisions = (
        replace(plain, accept_low=1e3),
        replace(plain, accept_high=2e3, global_false_acceptance=0.001, global_false_rejection=0.02),
        plain,
        replace(plain, together=2, uncertainty=None, least=True),
    )
    outcomes = [RuleOutcome("accept", "r", 1.0, True, decision=decision) for decision in decisions]
    (table,) = decision_blocks(outcomes)
    assert [row[4] for row in table.rows] == [">= 1 kN/m", "<= 2 kN/m", "nothing", ""]
    assert [row[2:4] for row in table.rows] == [("90 %", "20 N/m")] * 3 + [(">= 90 %", "")]
    assert [row[6] for row in table.rows] == ["", "0.10 % / 2.0 %", "", ""]
    assert "accepted falsely / rejected falsely" in table.caption


@pytest.mark.parametrize(
    ("probability", "text"), [(0.99943, "99.943 %"), (0.158, "16 %"), (1.0, "100 %"), (1e-9, "< 0.01 %")]
)
def test_probabilities_keep_their_distance_from_certainty(probability: float, text: str) -> None:
    assert percent(probability) == text


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("axial.k: {limits: [1 N/m]}", "accept.axial.k.limits: two limits are needed"),
        ("axial.k: {limits: [null, null]}", "accept.axial.k: has no limit"),
        ("axial.k: {limits: [2 N/m, 1 N/m]}", "accept.axial.k.limits: the lower limit comes first"),
        ("axial.k: {limits: [1 N/m, 2 umm]}", "unknown unit 'umm'"),
        ("axial.k: {limits: [1 N/m, 2 N/m], min: 1 N/m}", "limits are given twice"),
        ("axial.k: {min: 1 N/m, rule: guardd}", "unknown rule 'guardd'; did you mean 'guarded'?"),
        ("axial.k: {min: 1 N/m, rule: guarded, risk: 60 %}", "risk: must lie between 0 and 0.5"),
        ("axial.k: {min: 1 N/m, risk: 5 %}", "simple acceptance has none"),
        ("axial.k: {min: 1 N/m, rule: risk, guard: 1}", "only 'guarded' has one"),
        ("axial.k: {min: 1 N/m, rule: guarded, risk: 1 %, guard: 1}", "takes the place of the risk"),
        ("axial.k: {min: 1 N/m, process: 3 N/m}", "has no spread"),
        ("axial.k: {min: 1 N/m, process: {a: 1}}", "has no spread"),
        ("axial.k: {min: 1 N/m, outcomes: passed}", "unknown outcome 'passed'"),
        ("axial.k: {min: 1 N/m, riks: 1 %}", "accept.axial.k.riks: unknown key; did you mean 'risk'?"),
        ("axial.warnings: {min: 1}", "is a word, and limits need a number"),
        ("axle.k: {min: 1 N/m}", "there is no fit 'axle'"),
        ("a: {together: {axle.k: [1 N/m, null]}}", "accept.a.together.axle.k: there is no fit 'axle'"),
        ("a: {together: {axial.k: [1 N/m, null]}, rule: guarded}", "guard bands hold for one limit"),
        ("a: {together: {axial.k: [1 N/m, null]}, process: 1 +- 2}", "belongs to one number"),
        ("a: {together: {}}", "two addresses with their limits are needed"),
    ],
)
def test_what_cannot_be_read_is_refused_at_its_place(text: str, fault: str) -> None:
    with pytest.raises(ConfigErrors) as caught:
        rules(text)
    assert any(fault in str(one) for one in caught.value.faults), str(caught.value)


@pytest.mark.parametrize(
    "text",
    [
        "axial.k: {min: 1 Hz}",
        "axial.k: {min: 1 N/m, process: 1 Hz +- 1 Hz}",
        "axial.k: {min: 1 N/m, process: 1 N/m +- 0 N/m}",
        "a: {together: {axial.k: [1 Hz, null]}}",
        "a: {together: {axial.kk: [1 N/m, null]}}",
    ],
)
def test_limits_of_another_dimension_are_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="accept"):
        outcome(text)
