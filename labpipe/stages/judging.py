"""Holding a result against the pipeline's accept and expect rules."""

from __future__ import annotations

import operator
import re
from collections.abc import Callable, Iterable, Sequence

from labpipe.config.rules import STUDY, Rule
from labpipe.config.run_ups import RUN_UPS
from labpipe.config.unbalance import UNBALANCE
from labpipe.config.values import parse_uncertain
from labpipe.errors import ConfigError
from labpipe.quantities import UnitError, parse_value
from labpipe.records.comparison import Comparison
from labpipe.records.finding import WARNING, of_level
from labpipe.records.identification import Fit, RuleOutcome
from labpipe.records.run_up_result import RunUpResult
from labpipe.records.study import Study, StudyCase
from labpipe.records.unbalance import UnbalanceRuns
from labpipe.registry import nearest
from labpipe.stages.judging_comparisons import comparison_outcome
from labpipe.stages.judging_run_ups import run_up_outcome
from labpipe.stages.judging_unbalance import unbalance_outcome

_COMPARE = {">=": operator.ge, "<=": operator.le, ">": operator.gt, "<": operator.lt}
_STUDIED = re.compile(r"^(?P<fit>[^.\[\]]+)(?:\[(?P<noise>[^\]]*)\])?\.(?P<item>\w+)$")
_CASE_VALUES: dict[str, Callable[[StudyCase], float | None]] = {
    "mean_error": lambda case: case.mean_error,
    "median_error": lambda case: case.median_error,
    "failed": lambda case: float(case.failed),
    "success": lambda case: case.success[0],
    "rmse_over_bound": lambda case: case.rmse_over_bound,
    "coverage": lambda case: case.coverage,
}
_FIT_VALUES = {
    "gof": lambda fit: fit.gof.r2_adjusted,
    "r2": lambda fit: fit.gof.r2,
    "chi2_reduced": lambda fit: fit.gof.chi2_reduced,
    "chi2_p": lambda fit: fit.gof.chi2_p,
    "condition_number": lambda fit: fit.condition_number,
    "lines": lambda fit: float(fit.lines),
}


def judge(
    rules: Iterable[Rule],
    fits: Sequence[Fit],
    studies: Sequence[Study] = (),
    comparisons: Sequence[Comparison] = (),
    unbalance: UnbalanceRuns | None = None,
    run_ups: RunUpResult | None = None,
    incomplete: bool = False,
) -> tuple[RuleOutcome, ...]:
    """The outcome of every rule; ConfigError at the rule's place when it addresses what the result does not have.

    In an *incomplete* result, where tests failed, such a rule fails.
    """
    outcomes: list[RuleOutcome] = []
    for rule in rules:
        try:
            if unbalance is not None and rule.fit == UNBALANCE:
                outcomes.append(unbalance_outcome(rule, unbalance, _held))
            elif run_ups is not None and rule.fit == RUN_UPS:
                outcomes.append(run_up_outcome(rule, run_ups, _held))
            else:
                outcomes.append(_ruled(rule, fits, studies, comparisons))
        except ConfigError:
            if not incomplete:
                raise
            outcomes.append(RuleOutcome(rule.section, rule.text, None, False))
    return tuple(outcomes)


def _ruled(rule: Rule, fits: Sequence[Fit], studies: Sequence[Study], comparisons: Sequence[Comparison]) -> RuleOutcome:
    if rule.fit == STUDY:
        return _study_outcome(rule, studies)
    if any(comparison.name == rule.fit for comparison in comparisons):
        return comparison_outcome(rule, comparisons, _held)
    return _outcome(rule, _addressed(rule, fits))


def _study_outcome(rule: Rule, studies: Sequence[Study]) -> RuleOutcome:
    """A rule on "fit[noise].item", or "fit.item" for every noise level; threshold is the noise at which success ends."""
    match = _STUDIED.match(rule.item)
    if match is None:
        raise ConfigError(f"{rule.section}.{rule.address}: is no address", where=rule.place, hint="write study.fit[1 %].coverage")
    if match["item"] == "threshold":
        found = [t.noise for study in studies for t in study.thresholds if t.fit == match["fit"]]
    else:
        cases = [case for study in studies for case in study.cases if case.fit == match["fit"] and _is_noise(match["noise"], case.noise)]
        found = [_studied(rule, case, match["item"]) for case in cases]
    if not found:
        raise ConfigError(f"{rule.section}.{rule.address}: no such case in the study", where=rule.place)
    held = [_held(rule, value, "1") for value in found]
    value, passed = next((pair for pair in held if not pair[1]), held[0])
    return RuleOutcome(rule.section, rule.text, value, passed)


def _studied(rule: Rule, case: StudyCase, item: str) -> float | None:
    if item not in _CASE_VALUES:
        hint = nearest(item, [*_CASE_VALUES, "threshold"])
        raise ConfigError(f"{rule.section}.{rule.address}: the study has no '{item}'", where=rule.place, hint=hint)
    return _CASE_VALUES[item](case)


def _is_noise(text: str | None, noise: float) -> bool:
    return text is None or abs(parse_value(text, "1") - noise) < 1e-6 * noise


def _addressed(rule: Rule, fits: Sequence[Fit]) -> list[Fit]:
    """All fits of the rule's name, or those that stand in brackets: a test's name, a diagonal term or the centre of a band."""
    found = [fit for fit in fits if fit.name == rule.fit]
    if rule.which:
        found = [fit for fit in found if rule.which in (fit.test, fit.term) or _is_centre(rule.which, fit.centre_hz)]
    if not found:
        raise ConfigError(f"{rule.section}.{rule.address}: no such fit in the result", where=rule.place)
    return found


def _is_centre(text: str, centre: float) -> bool:
    try:
        return abs(parse_value(text, "Hz") - centre) < 1e-6 * max(abs(centre), 1.0)
    except UnitError:
        return False


def _outcome(rule: Rule, fits: list[Fit]) -> RuleOutcome:
    """A rule on several fits (bands, tests) must hold for each; the value shown is the first that fails, or the first."""
    if rule.item == "count":
        held = [_held(rule, float(len(fits)), "1")]
    elif rule.item == "warnings":
        held = [_warnings_held(rule, fit) for fit in fits]
    else:
        held = [_item_held(rule, fit) for fit in _having(rule, fits)]
    value, passed = next((pair for pair in held if not pair[1]), held[0])
    return RuleOutcome(rule.section, rule.text, value, passed)


def _warnings_held(rule: Rule, fit: Fit) -> tuple[str, bool]:
    """ "collinear" must be among the warnings, "not collinear" must not; "none" means no warning at all."""
    codes = [finding.code for finding in of_level(WARNING, fit.findings)]
    word = rule.bound
    if word == "none":
        passed = not codes
    elif word.startswith("not "):
        passed = word.removeprefix("not ").strip() not in codes
    else:
        passed = word in codes
    return ", ".join(codes) or "none", passed


def _having(rule: Rule, fits: list[Fit]) -> list[Fit]:
    """The fits that have what the rule names; a calibration's linear range stands with its first line only."""
    name, _ = _split(rule.item, fits)
    if rule.item in _FIT_VALUES:
        return fits
    found = [fit for fit in fits if name in [parameter.name for parameter in fit.parameters]]
    if not found:
        names = dict.fromkeys(parameter.name for fit in fits for parameter in fit.parameters)
        hint = nearest(name, [*names, *_FIT_VALUES, "warnings", "count"])
        raise ConfigError(f"{rule.section}.{rule.address}: the fit has no '{name}'", where=rule.place, hint=hint)
    return found


def _split(item: str, fits: Sequence[Fit]) -> tuple[str, str]:
    """(parameter, attribute) of "k_xx.significant"; the names of dofs may hold points themselves."""
    if any(parameter.name == item for fit in fits for parameter in fit.parameters):
        return item, ""
    name, _, attribute = item.rpartition(".")
    return (name, attribute) if name else (item, "")


def _item_held(rule: Rule, fit: Fit) -> tuple[float | str | None, bool]:
    if rule.item in _FIT_VALUES:
        return _held(rule, _FIT_VALUES[rule.item](fit), "1")
    name, attribute = _split(rule.item, [fit])
    parameter = fit.parameter(name)
    if attribute == "significant":
        word = str(bool(parameter.significant)).lower()
        return word, word == rule.bound
    if attribute == "std_error":
        return _held(rule, parameter.std_error, parameter.unit)
    return _held(rule, parameter.value, parameter.unit)


def _held(rule: Rule, value: float | None, unit: str) -> tuple[float | None, bool]:
    """Whether a number meets the rule; a number that could not be given meets none."""
    try:
        if rule.kind == "+-":
            wanted = parse_uncertain(rule.bound, unit)
            return value, value is not None and abs(value - wanted.value) <= wanted.std_error
        bound = parse_value(rule.bound, unit)
        if rule.kind == "=":
            return value, value is not None and value == bound
    except UnitError as error:
        raise ConfigError(f"{rule.section}.{rule.address}: {error.what}", where=rule.place, hint=error.hint) from None
    return value, value is not None and bool(_COMPARE[rule.kind](value, bound))
