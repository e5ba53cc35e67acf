"""Holding a study against rules: "study.fit[noise].item", "study.fit.item" for every noise level, "study.fit.threshold"."""

from __future__ import annotations

import math
import re
from collections.abc import Callable

from labpipe.config.rules import Rule
from labpipe.errors import ConfigError
from labpipe.quantities import parse_value
from labpipe.records.identification import RuleOutcome
from labpipe.records.study import Studies, StudyCase
from labpipe.registry import nearest
from labpipe.stages.judging_numbers import CompareNumber

_STUDIED = re.compile(r"^(?P<fit>[^.\[\]]+)(?:\[(?P<noise>[^\]]*)\])?\.(?P<item>\w+)$")
_CASE_VALUES: dict[str, Callable[[StudyCase], float | None]] = {
    "mean_error": lambda case: case.mean_error,
    "median_error": lambda case: case.median_error,
    "failed": lambda case: float(case.failed),
    "success": lambda case: case.success[0],
    "rmse_over_bound": lambda case: case.rmse_over_bound,
    "coverage": lambda case: case.coverage,
}


def study_outcome(rule: Rule, studies: Studies, compare_number: CompareNumber) -> RuleOutcome:
    """A rule on "fit[noise].item", or "fit.item" for every noise level; threshold is the noise level of the success limit."""
    match = _STUDIED.match(rule.item)
    if match is None:
        raise ConfigError(f"{rule.section}.{rule.address}: is no address", where=rule.place, hint="write study.fit[1 %].coverage")
    if match["item"] == "threshold":
        values = [t.noise for study in studies for t in study.thresholds if t.fit == match["fit"]]
    else:
        cases = [case for study in studies for case in study.cases if case.fit == match["fit"] and _is_noise(match["noise"], case.noise)]
        values = [_studied(rule, case, match["item"]) for case in cases]
    if not values:
        raise ConfigError(f"{rule.section}.{rule.address}: no such case in the study", where=rule.place)
    outcomes = [compare_number(rule, value, "1") for value in values]
    return RuleOutcome(rule.section, rule.text, *next((outcome for outcome in outcomes if not outcome[1]), outcomes[0]))


def _studied(rule: Rule, case: StudyCase, item: str) -> float | None:
    if item not in _CASE_VALUES:
        hint = nearest(item, [*_CASE_VALUES, "threshold"])
        raise ConfigError(f"{rule.section}.{rule.address}: the study has no '{item}'", where=rule.place, hint=hint)
    return _CASE_VALUES[item](case)


def _is_noise(text: str | None, noise: float) -> bool:
    return text is None or math.isclose(parse_value(text, "1"), noise)
