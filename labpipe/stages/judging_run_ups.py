"""Holding run-ups against rules: "run_ups.joint[held-out].critical_speed", ".threshold.covers", "run_ups.points.rank", "run_ups.warnings".

Speeds are given in rpm or Hz. Without a run in brackets a rule must hold for every run that has such a value.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from labpipe.config.rules import Rule
from labpipe.errors import ConfigError
from labpipe.records.finding import WARNING, of_level
from labpipe.records.identification import RuleOutcome
from labpipe.records.run_up_result import Amount, MeasuredRun, MetamodelResult, RunPrediction, RunUpMethod, RunUpResult
from labpipe.registry import nearest
from labpipe.stages.judging_numbers import Compared, CompareNumber, compare_covers

MEASURED = "measured"
SPEEDS = ("critical_speed", "threshold")
ATTRIBUTES = ("std_error", "covers", "difference")
METHOD_VALUES: dict[str, Callable[[RunUpMethod], float | None]] = {
    "rank": lambda method: None if method.rank is None else float(method.rank),
    "condition_number": lambda method: method.condition,
    "chi2_reduced": lambda method: method.chi2_per_datum,
    "chi2_p": lambda method: method.chi2_p,
    "share_at_bound": lambda method: method.share_at_bound,
}
_ADDRESS = re.compile(r"^(?P<method>[^.\[\]]+)(?:\[(?P<run>[^\]]*)\])?\.(?P<item>\w+)(?:\.(?P<attribute>\w+))?$")
HZ = 1 / (2 * np.pi)


@dataclass(frozen=True)
class _Address:
    """Parts of a rule's address: method, run, item, attribute."""

    method: str
    run: str
    item: str
    attribute: str


def run_up_outcome(rule: Rule, result: RunUpResult, compare_number: CompareNumber) -> RuleOutcome:
    """The outcome of a rule; ConfigError at its place for what the result does not have."""
    if rule.item == "warnings":
        return _warnings(rule, result)
    match = _ADDRESS.match(rule.item)
    if match is None:
        raise _fault(rule, "is no address", "write run_ups.joint[held-out].critical_speed")
    address = _Address(match["method"], match["run"] or "", match["item"], match["attribute"] or "")
    if address.run and address.run not in [run.name for run in result.runs]:
        raise _fault(rule, f"there is no run '{address.run}'", nearest(address.run, [run.name for run in result.runs]))
    if address.item in SPEEDS:
        return _speed(rule, address, result, compare_number)
    return _of_method(rule, address, result, compare_number)


def _fault(rule: Rule, what: str, hint: str) -> ConfigError:
    return ConfigError(f"{rule.section}.{rule.address}: {what}", where=rule.place, hint=hint)


def _warnings(rule: Rule, result: RunUpResult) -> RuleOutcome:
    """A code that must be there, "not CODE" that must not, "none" for none at all."""
    codes = list(dict.fromkeys(finding.code for finding in of_level(WARNING, result.findings)))
    wanted = rule.bound.removeprefix("not ").strip()
    passed = not codes if wanted == "none" else (wanted in codes) != rule.bound.startswith("not ")
    return RuleOutcome(rule.section, rule.text, ", ".join(codes) or "none", passed)


def _predictors(result: RunUpResult) -> dict[str, RunUpMethod | MetamodelResult]:
    methods: list[RunUpMethod | MetamodelResult] = [*result.methods, *result.metamodels]
    return {method.name: method for method in methods}


def _of_method(rule: Rule, address: _Address, result: RunUpResult, compare_number: CompareNumber) -> RuleOutcome:
    """Rank, condition, chi-square, share at bounds, verdict of a method; the largest left-out error of a metamodel."""
    predictors = _predictors(result)
    if address.method not in predictors:
        raise _fault(rule, f"there is no method '{address.method}'", nearest(address.method, [*predictors, MEASURED]))
    predictor = predictors[address.method]
    if isinstance(predictor, MetamodelResult):
        if address.item != "left_out":
            raise _fault(rule, f"a metamodel has no '{address.item}'", nearest(address.item, [*SPEEDS, "left_out"]))
        worst = max((_rms(validation.errors) for validation in predictor.left_out), default=None)
        return RuleOutcome(rule.section, rule.text, *compare_number(rule, worst, "1"))
    if address.item == "verdict":
        return RuleOutcome(rule.section, rule.text, predictor.verdict, predictor.verdict == rule.bound)
    if address.item not in METHOD_VALUES:
        hint = nearest(address.item, [*SPEEDS, *METHOD_VALUES, "verdict"])
        raise _fault(rule, f"a method has no '{address.item}'", hint)
    return RuleOutcome(rule.section, rule.text, *compare_number(rule, METHOD_VALUES[address.item](predictor), "1"))


def _rms(errors: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(errors))))


def _speed(rule: Rule, address: _Address, result: RunUpResult, compare_number: CompareNumber) -> RuleOutcome:
    """A critical or threshold speed of one run, or of every run that has it; the value shown is the first that fails, or the first."""
    if address.attribute and address.attribute not in ATTRIBUTES:
        raise _fault(rule, f"a speed has no '{address.attribute}'", nearest(address.attribute, ATTRIBUTES))
    runs = [run for run in result.runs if address.run in ("", run.name)]
    candidates = [(run, _amount(rule, address, result, run)) for run in runs]
    selected = [(run, amount) for run, amount in candidates if amount is not None] or candidates[:1]
    outcomes = [_attribute(rule, address, run, amount, compare_number) for run, amount in selected]
    return RuleOutcome(rule.section, rule.text, *next((outcome for outcome in outcomes if not outcome[1]), outcomes[0]))


def _amount(rule: Rule, address: _Address, result: RunUpResult, run: MeasuredRun) -> Amount | None:
    if address.method == MEASURED:
        return getattr(run, address.item)
    predictors = _predictors(result)
    if address.method not in predictors:
        raise _fault(rule, f"there is no method '{address.method}'", nearest(address.method, [*predictors, MEASURED]))
    prediction: RunPrediction | None = predictors[address.method].prediction(run.name)
    return None if prediction is None else getattr(prediction, address.item)


def _attribute(rule: Rule, address: _Address, run: MeasuredRun, amount: Amount | None, compare_number: CompareNumber) -> Compared:
    if address.attribute == "covers":
        interval = None if amount is None else amount.ci95
        return compare_covers(rule, None if interval is None else (HZ * interval[0], HZ * interval[1]), "Hz")
    if address.attribute == "difference":
        measured: Amount | None = getattr(run, address.item)
        return compare_number(rule, None if amount is None or measured is None else abs(amount.value / measured.value - 1), "1")
    if amount is None:
        return compare_number(rule, None, "Hz")
    value = amount.std_error if address.attribute == "std_error" else amount.value
    return compare_number(rule, None if value is None else HZ * value, "Hz")
