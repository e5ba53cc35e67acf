"""Studies compared with rules: which noise levels a rule is for, and which of them is shown."""

from __future__ import annotations

import pytest

from labpipe.errors import ConfigError
from labpipe.project.judging import compare_number
from labpipe.project.rules import Rule
from labpipe.project.study import study_outcome
from labpipe.records.comparison import Study, StudyCase, StudyThreshold


def case(fit: str, noise: float, coverage: float) -> StudyCase:
    errors = {"mean_error": 0.1, "median_error": 0.1, "error_variance": 0.01, "rmse_over_bound": 1.0}
    return StudyCase(
        fit=fit,
        estimator="ml",
        noise=noise,
        lines=10,
        repeats=100,
        failed=0,
        success=(1.0,),
        coverage=coverage,
        parameters=(),
        **errors,
    )


CASES = (
    case("other", 0.01, 0.1),
    case("direct", 0.01, 0.95),
    case("direct", 0.07, 0.8),
    case("direct", 0.0700001, 0.7),
)
STUDIES = (Study("rig", 1, (0.1,), 0.9, CASES, (StudyThreshold("direct", 0.1, 0.05, 100),)),)


def rule(item: str, bound: str) -> Rule:
    return Rule(
        section="accept",
        address=f"study.{item}",
        fit="study",
        which="",
        item=item,
        kind=">=",
        bound=bound,
        place="p.yaml:1:1",
    )


@pytest.mark.parametrize(
    ("item", "bound", "value", "passed"),
    [
        ("direct.coverage", "0.9", 0.8, False),
        ("direct.coverage", "0.5", 0.95, True),
        # 7 % is 0.07 to the last digits of a product; 7.00001 % is another level.
        ("direct[7 %].coverage", "0.75", 0.8, True),
        ("direct[7.00001 %].coverage", "0.75", 0.7, False),
        ("direct.threshold", "4 %", 0.05, True),
    ],
)
def test_a_rule_is_for_one_noise_level_or_for_all(item: str, bound: str, value: float, passed: bool) -> None:
    outcome = study_outcome(rule(item, bound), STUDIES, compare_number)
    assert (outcome.value, outcome.passed) == (pytest.approx(value), passed)


@pytest.mark.parametrize(
    "item", ["direct[2 %].coverage", "direct[2 Hz].coverage", "unknown.coverage", "direct.colour"]
)
def test_what_the_study_does_not_have(item: str) -> None:
    with pytest.raises(ConfigError, match="study"):
        study_outcome(rule(item, "0.5"), STUDIES, compare_number)
