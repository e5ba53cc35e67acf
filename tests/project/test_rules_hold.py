"""Rules of a pipeline against its result, through files: what holds, what fails, what is refused, and what is
shown.

Two receptances without noise: 1 kg on 100 and on 400 kN/m, 20 N s/m, 20-120 Hz every 1 Hz; so every fit has
the truth to eight digits.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from labpipe.artefacts.identification_file import read_identification
from labpipe.artefacts.writing import output_folder
from labpipe.errors import ConfigError, LabpipeError
from labpipe.project.pipeline_file import load_pipeline
from labpipe.project.run import Manner, run
from labpipe.raw_files.frf_csv import write_frf_csv
from labpipe.records.identification import RuleOutcome
from labpipe.records.response import FrequencyResponse, Port, diagonal_covariance

LINES = np.arange(20.0, 121.0)
SOFT, STIFF, DAMPING = 1e5, 4e5, 20.0
PLAN = {
    "title": "Rules",
    "tests": [
        {"name": name, "frfs": f"{name}.csv", "conditions": {"preload": f"{n} N"}}
        for n, name in ((100, "soft"), (200, "stiff"))
    ],
    "identify": {
        "direct": {"model": "sdof", "mass": "1 kg"},
        "one": {"model": "sdof", "mass": "1 kg", "test": "soft"},
        "curve": {
            "model": "sdof",
            "mass": "1 kg",
            "test": "stiff",
            "sliding": {"width": "20 Hz", "step": "20 Hz"},
        },
        "narrow": {"model": "sdof", "mass": "1 kg", "test": "soft", "band": "40-42 Hz"},
    },
}


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The two responses."""
    folder = tmp_path_factory.mktemp("rules")
    w = 2 * np.pi * LINES
    for name, k in (("soft", SOFT), ("stiff", STIFF)):
        h = (1 / (k - w**2 + 1j * DAMPING * w))[:, None, None]
        ports = (Port("x", "x", "x"),), (Port("f", "f", "x"),)
        write_frf_csv(
            folder / f"{name}.csv",
            FrequencyResponse(LINES, h, *ports, covariance=diagonal_covariance(np.full(h.shape, 1e-18))),
        )
    return folder


def judged(lab: Path, **rules: object) -> tuple[RuleOutcome, ...]:
    """The outcomes of rules, `accept={address: text}` or `expect=...`, as the result has them."""
    (lab / "p.yaml").write_text(yaml.safe_dump({**PLAN, **rules}, sort_keys=False))
    with output_folder(lab / "out") as output:
        return run(load_pipeline(lab / "p.yaml"), output, Manner()).outcomes


HELD = [
    ("one.k", "100 kN/m +- 0.1 %"),
    ("one.k", "1e5 N/m +- 10 N/m"),
    ("one.k", ">= 99.9 kN/m"),
    ("one.k", "< 100.1 N/mm"),
    ("one.c", "20 N.s/m +- 0.1 %"),
    # sqrt(k / m) / (2 pi) = 50.3292 Hz, c / (2 sqrt(k m)) = 0.0316228.
    ("one.f_n", "50.3292 Hz +- 0.01 Hz"),
    ("one.f_n", "3019.75 rpm +- 1 rpm"),
    ("one.zeta", "3.16228 % +- 0.01 %"),
    ("one.gof", ">= 0.9999"),
    ("one.r2", "> 99.99 %"),
    ("one.lines", "101"),
    ("one.lines", ">= 101"),
    ("one.count", "1"),
    ("direct.count", "2"),
    ("curve.count", "5"),
    ("direct[soft].k", "100 kN/m +- 0.1 %"),
    ("direct[stiff].k", "400 kN/m +- 0.1 %"),
    ("direct.c", "20 N.s/m +- 0.1 %"),
    ("direct.k", ">= 99 kN/m"),
    ("curve.k", "400 kN/m +- 1 %"),
    ("curve[90 Hz].k", "400 kN/m +- 1 %"),
    ("curve[5400 rpm].k", "400 kN/m +- 1 %"),
    ("one.k.significant", "true"),
    ("one.k.std_error", "> 0 N/m"),
    ("one.k.std_error", "< 1 kN/m"),
    ("narrow.warnings", "few-lines"),
    ("one.warnings", "not few-lines"),
    ("one.warnings", "not collinear"),
    ("one.chi2_reduced", "< 1e-6"),
    ("one.chi2_p", "> 0.999"),
    ("one.condition_number", ">= 1"),
    ("one.k.expanded", "> 0 N/m"),
    ("one.k.expanded", "< 1 kN/m"),
    ("one.k.expanded", "< 1 %"),
]
FAILED = [
    ("one.k", "101 kN/m +- 0.1 %"),
    ("one.k", ">= 100.1 kN/m"),
    ("one.k", "< 99.9 kN/m"),
    ("one.k", "100.1 kN/m +- 0 %"),
    ("one.gof", "> 1"),
    ("one.lines", "100"),
    ("direct.k", "100 kN/m +- 0.1 %"),
    ("direct.k", "<= 100.1 kN/m"),
    ("direct.count", "1"),
    ("curve.count", ">= 6"),
    ("one.k.significant", "false"),
    ("one.warnings", "clipped"),
    ("narrow.warnings", "none"),
    ("narrow.warnings", "not few-lines"),
    ("one.chi2_p", "< 0.5"),
    ("one.condition_number", "< 1"),
    ("one.k.expanded", "> 1 kN/m"),
    ("one.k.expanded", "> 1 %"),
    ("one.k.std_error", "> 1 kN/m"),
]


@pytest.fixture(scope="module")
def outcomes(lab: Path) -> dict[str, RuleOutcome]:
    """All of these rules, judged in one run, by the rule as people read it."""
    rules: dict[str, list[str]] = {}
    for address, text in (*HELD, *FAILED):
        rules.setdefault(address, []).append(text)
    return {outcome.rule: outcome for outcome in judged(lab, accept=rules)}


@pytest.mark.parametrize(("address", "text"), HELD)
def test_a_rule_that_holds(outcomes: dict[str, RuleOutcome], address: str, text: str) -> None:
    assert outcomes[f"{address} {text}"].passed, outcomes[f"{address} {text}"]


@pytest.mark.parametrize(("address", "text"), FAILED)
def test_a_rule_that_fails(outcomes: dict[str, RuleOutcome], address: str, text: str) -> None:
    assert not outcomes[f"{address} {text}"].passed, outcomes[f"{address} {text}"]


REFUSED = [
    ("one.kk", "> 0 N/m", "the fit has no 'kk'; did you mean 'k'?"),
    ("one.k", "> 0 m", "'m' has the wrong dimension, N/m is needed"),
    ("one.k", "> 0.5", "'0.5' has no unit"),
    ("one.k", "big", "'big' is not a value with a unit"),
    ("one.k", "3 N/m +- 1 m", "'m' has the wrong dimension"),
    ("one.gof", "> 3 N", "'N' has the wrong dimension, 1 is needed"),
    ("one[stiff].k", "> 0 N/m", "no such fit in the result"),
    ("curve[91 Hz].k", "> 0 N/m", "no such fit in the result"),
    ("direct[sofd].k", "> 0 N/m", "no such fit in the result"),
]


@pytest.mark.parametrize(("address", "text", "said"), REFUSED)
def test_a_rule_on_what_there_is_not(lab: Path, address: str, text: str, said: str) -> None:
    with pytest.raises(ConfigError) as caught:
        judged(lab, accept={address: text})
    assert said in str(caught.value) and f"accept.{address}" in str(caught.value)
    assert caught.value.where.startswith(f"{lab / 'p.yaml'}:")


def test_the_expanded_uncertainty_is_half_the_interval_and_relative_in_per_cent(lab: Path) -> None:
    absolute, relative = judged(lab, accept={"one.k.expanded": ["> 0 N/m", "> 0 %"]})
    (fit,) = (fit for fit in read_identification(lab / "out/identification.json").fits if fit.name == "one")
    low, high = fit.parameter("k").ci95
    assert (
        absolute.value == (high - low) / 2 and relative.value == (high - low) / 2 / fit.parameter("k").value
    )


def test_the_value_shown_is_the_first_that_fails(lab: Path) -> None:
    """Of two tests the second fails the rule, so its value is shown; of two that hold the first."""
    (outcome,) = judged(lab, accept={"direct.k": "<= 100.1 kN/m"})
    assert outcome.value == pytest.approx(STIFF, rel=1e-3)
    (outcome,) = judged(lab, accept={"direct.k": ">= 1 kN/m"})
    assert outcome.value == pytest.approx(SOFT, rel=1e-3)


# The truth of LINES in the unit of each rule: sqrt(1e5) / (2 pi) = 50.32921 Hz = 316.2278 rad/s, 20 / (2
# sqrt(1e5)) = 0.03162278.
SHOWN = [
    ("one.k", ">= 99.9 kN/m", 100.0, "kN/m"),
    ("one.k", "< 100.1 N/mm", 100.0, "N/mm"),
    ("one.k", "1e5 N/m +- 10 N/m", 1e5, "N/m"),
    ("one.k", "> 0", 100.0, "kN/m"),
    ("one.f_n", "3019.75 rpm +- 1 rpm", 3019.752, "rpm"),
    ("one.f_n", ">= 300 rad/s", 316.2278, "rad/s"),
    ("one.zeta", "3.16228 % +- 0.01 %", 3.162278, "%"),
    ("one.zeta", "<= 0.05", 0.03162278, ""),
    ("one.gof", ">= 99 %", 100.0, "%"),
    ("one.lines", "101", 101.0, ""),
    ("curve[90 Hz].k", "400 kN/m +- 1 %", 400.0, "kN/m"),
]


@pytest.mark.parametrize(("address", "text", "number", "unit"), SHOWN)
def test_the_value_is_shown_in_the_unit_of_the_rule(
    shown: dict[str, RuleOutcome], address: str, text: str, number: float, unit: str
) -> None:
    outcome = shown[f"{address} {text}"]
    value, _, shown_unit = outcome.found.partition(" ")
    assert (float(value), shown_unit) == (pytest.approx(number, rel=2e-5), unit)


@pytest.fixture(scope="module")
def shown(lab: Path) -> dict[str, RuleOutcome]:
    """The rules of SHOWN, judged in one run and read back from its file."""
    rules: dict[str, list[str]] = {}
    for address, text, _, _ in SHOWN:
        rules.setdefault(address, []).append(text)
    judged(lab, expect=rules)
    return {
        outcome.rule: outcome for outcome in read_identification(lab / "out/identification.json").outcomes
    }


def test_readers_of_earlier_results_find_no_further_key_in_a_rule(lab: Path) -> None:
    """A reader before the values in the rules' units takes rule, value, passed.

    A result without them shows the SI value.
    """
    judged(lab, expect={"one.k": "> 1 kN/m", "one.warnings": "not clipped"})
    path = lab / "out/identification.json"
    whole = json.loads(path.read_text("utf-8"))
    assert all(set(entry) == {"rule", "value", "passed"} for entry in whole["expect"])
    del whole["found"], whole["digest"]
    path.write_text(json.dumps(whole), "utf-8")
    number, codes = read_identification(path).outcomes
    assert number.found == "100000" and codes.found == codes.value


def test_codes_of_warnings_are_shown(lab: Path) -> None:
    (outcome,) = judged(lab, accept={"narrow.warnings": "none"})
    assert isinstance(outcome.value, str) and "few-lines" in outcome.value.split(", ")


def test_every_rule_of_a_list_is_judged_by_itself(lab: Path) -> None:
    outcomes = judged(lab, accept={"one.k": [">= 99 kN/m", "<= 99.5 kN/m", "100 kN/m +- 1 %"]})
    assert [outcome.passed for outcome in outcomes] == [True, False, True]


def test_accept_comes_before_expect_and_both_count(lab: Path) -> None:
    outcomes = judged(lab, expect={"one.k": "> 0 N/m"}, accept={"one.k": "< 0 N/m"})
    assert [(outcome.section, outcome.passed) for outcome in outcomes] == [
        ("accept", False),
        ("expect", True),
    ]


def test_outcomes_stand_in_the_result_s_file(lab: Path) -> None:
    judged(lab, accept={"one.lines": "101", "one.warnings": "not clipped"}, expect={"one.k": "> 1 MN/m"})
    whole = json.loads((lab / "out/identification.json").read_text("utf-8"))
    assert whole["accept"][0] == {"rule": "one.lines 101", "value": 101.0, "passed": True}
    assert whole["accept"][1]["rule"] == "one.warnings not clipped" and whole["accept"][1]["passed"] is True
    assert whole["expect"][0]["passed"] is False


@pytest.mark.parametrize("text", [">= 99 kN/m", "100 kN/m +- 1 %"])
def test_units_of_a_rule_do_not_matter(lab: Path, text: str) -> None:
    same = text.replace("99 kN/m", "99 N/mm").replace("100 kN/m", "100 N/mm")
    first, second = (judged(lab, accept={"one.k": one})[0] for one in (text, same))
    assert (first.value, first.passed) == (second.value, second.passed)


def test_a_rule_on_a_test_that_failed_does_not_hold(lab: Path) -> None:
    """In a result that is not whole, what a rule names may be missing: it fails, it is not a fault of the
    rule.
    """
    (lab / "broken.csv").write_text("frequency_hz,x/f:re,x/f:im\n1,2,3\n")
    tests = [*PLAN["tests"], {"name": "broken", "frfs": "broken.csv"}]
    (outcome,) = judged(lab, tests=tests, accept={"direct[broken].k": "> 0 N/m"})
    assert (outcome.value, outcome.passed) == (None, False)


def test_a_fault_of_a_fit_names_fit_and_test(lab: Path) -> None:
    fits = {"odd": {"model": "sdof", "mass": "1 kg", "band": "300-400 Hz"}}
    with pytest.raises(LabpipeError) as caught:
        judged(lab, identify=fits)
    assert "identify.odd, test soft" in str(caught.value) and "no frequency line lies in the band" in str(
        caught.value
    )
