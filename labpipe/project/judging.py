"""Holding a result against the pipeline's accept and expect rules."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from labpipe.errors import ConfigError
from labpipe.project import deciding
from labpipe.project.rules import ALSO, NOT, Rule
from labpipe.quantities import UnitError, parse_value, written_unit
from labpipe.records.comparison import Comparison, ConditionMatrices
from labpipe.records.dataset import PartialOutcome
from labpipe.records.finding import WARNING, Finding, Parameter, of_level
from labpipe.records.identification import Fit, RuleOutcome
from labpipe.records.sections import names_of, section
from labpipe.records.uncertain import parse_uncertain, split_uncertainty
from labpipe.registry import nearest

# (rule, value, unit, standard uncertainty) -> what is compared
CompareNumber = Callable[..., deciding.Compared]
_COMPARE = {"=": operator.eq, ">=": operator.ge, "<=": operator.le, ">": operator.gt, "<": operator.lt}


def compare_number(
    rule: Rule, value: float | None, unit: str, error: float | None = None, expanded: float | None = None
) -> deciding.Compared:
    """Whether a number [*unit*, SI] meets the rule, and the number in the rule's unit; one that could not be
    given meets none. *error*, *expanded*: its uncertainties [unit], by which rules with limits are decided;
    all others compare the value alone.
    """
    if rule.decision is not None:
        return deciding.decide(rule, value, error, unit, expanded)
    with rule.faults_of_units():
        text = "" if value is None else found_text(rule, value, unit)
        if rule.kind == "+-":
            wanted = parse_uncertain(rule.bound, unit)
            return value, value is not None and abs(value - wanted.value) <= wanted.std_error, text, None
        bound = parse_value(rule.bound, unit)
    return value, value is not None and bool(_COMPARE[rule.kind](value, bound)), text, None


def found_text(rule: Rule, value: float, unit: str) -> str:
    """The value [*unit*, SI] in the unit of the rule, for 0 in the usual one. UnitError for a wrong one."""
    return deciding.text_in(written_unit(split_uncertainty(rule.bound)[0]), value, None, unit)


def compare_covers(rule: Rule, ci95: tuple[float, float] | None, unit: str) -> deciding.Compared:
    """Whether a 95 % interval [*unit*, SI] covers the value of the rule."""
    with rule.faults_of_units():
        wanted = parse_value(rule.bound, unit)
        if ci95 is None:
            return "no interval", False, "no interval", None
        low, high = ci95
        ends = " to ".join(found_text(rule, end, unit) for end in (low, high))
    return f"{low:.6g} to {high:.6g}", low <= wanted <= high, ends, None


# Warnings with which nothing is accepted: the size of the error is not known.
FORBIDDING = ("feedback", "weak-injection")

_FIT_VALUES: dict[str, Callable[[Fit], float | None]] = {
    "gof": lambda fit: fit.gof.r2_adjusted if fit.noise_dof is None else None,
    "r2": lambda fit: fit.gof.r2 if fit.noise_dof is None else None,
    "chi2_reduced": lambda fit: fit.gof.chi2_reduced,
    "chi2_p": lambda fit: fit.gof.chi2_p,
    "condition_number": lambda fit: fit.condition_number,
    "lines": lambda fit: float(fit.lines),
}


def judge(
    rules: Iterable[Rule], fits: Sequence[Fit], records: Mapping[str, Any], incomplete: bool = False
) -> tuple[RuleOutcome, ...]:
    """The outcome of every rule on fits, and on the *records* of sections by their key. ConfigError at the
    rule's place when it addresses what the result does not have; in an *incomplete* result, where tests
    failed, it fails. A value whose bias cannot be known is not accepted, whatever the rules say.
    """
    rules = tuple(rules)
    outcomes: list[RuleOutcome] = []
    for rule in rules:
        try:
            of_all = judge_joint_rule(rule, fits, records) if rule.together else _judge_section(rule, records)
            outcomes.append(of_all or whole_outcome(rule, judged_part(rule, fits)))
        except ConfigError:
            if not incomplete:
                raise
            # It addresses what an incomplete result does not have.
            outcomes.append(rule.outcome(None, False))
    return (*outcomes, *forbidden(rules, fits))


def forbidden(rules: Iterable[Rule], fits: Sequence[Fit]) -> tuple[RuleOutcome, ...]:
    """A failed rule for every fit with a forbidding warning that no rule on its warnings expects."""
    on_warnings = [rule for rule in rules if rule.item == "warnings"]
    codes: dict[str, str] = {}
    for fit in fits:
        expected = {rule.bound.removeprefix(ALSO) for rule in on_warnings if _address(rule, [fit])}
        for finding in of_level(WARNING, fit.findings):
            if finding.code in FORBIDDING and finding.code not in expected:
                codes.setdefault(f"{fit.name}.warnings: not {finding.code}", finding.code)
    return tuple(
        RuleOutcome(
            "accept",
            text,
            code,
            False,
            shown=f"{code}, refused without any rule; `accept: {{warnings: {ALSO}{code}}}` accepts it",
        )
        for text, code in codes.items()
    )


def _judge_section(rule: Rule, records: Mapping[str, Any]) -> RuleOutcome | None:
    for name, record in records.items():
        outcome = section(name).outcome
        if outcome is not None and rule.fit in names_of(name, record):
            ruled: RuleOutcome = outcome(rule, record, compare_number)
            return ruled
    return None


def judge_joint_rule(rule: Rule, fits: Sequence[Fit], records: Mapping[str, Any]) -> RuleOutcome:
    """The outcome of a rule that several limits hold at once, over all fits and comparisons it addresses.
    ConfigError at its place where it addresses what the result does not have.
    """
    numbers: list[deciding.Limited] = []
    for member in rule.together:
        with replace(member, address=f"{rule.address}.{member.address}").faults_of_units():
            numbers.extend(_limit(member, fits, records))
    return deciding.decide_jointly(rule, numbers)


def _limit(rule: Rule, fits: Sequence[Fit], records: Mapping[str, Any]) -> list[deciding.Limited]:
    comparisons = [
        record
        for records_of in records.values()
        if isinstance(records_of, tuple)
        for record in records_of
        if isinstance(record, Comparison) and record.name == rule.fit
    ]
    if comparisons:
        amount = _amount(rule, comparisons[0], rule.item)
        return [deciding.limits_on_comparison(rule, comparisons[0], amount)]
    addressed = _having(rule, _address(rule, fits))
    if not addressed or rule.item in _FIT_VALUES:
        raise UnitError("no such fit or parameter in the result", "limits together need parameters of fits")
    return [deciding.limits_on_fit(rule, fit, fit.parameter(rule.item)) for fit in addressed]


def judged_part(rule: Rule, fits: Sequence[Fit]) -> PartialOutcome:
    """What a rule finds in fits: it must hold for each that it addresses (bands, terms, tests)."""
    if rule.together:
        try:
            return PartialOutcome(outcome=judge_joint_rule(rule, fits, {}), addressed=len(fits))
        except ConfigError as error:
            return PartialOutcome(addressed=len(fits), fault=(error.what, error.hint))
    addressed = _address(rule, fits)
    if not addressed or rule.item == "count":
        return PartialOutcome(addressed=len(addressed))
    whole = PartialOutcome()
    for test in dict.fromkeys(fit.test for fit in addressed):
        whole = whole.with_more(_judged_test(rule, [fit for fit in addressed if fit.test == test]))
    return whole


def _judged_test(rule: Rule, addressed: list[Fit]) -> PartialOutcome:
    if rule.item == "warnings":
        compared = [compare_warnings(rule, fit.findings) for fit in addressed]
    else:
        having = _having(rule, addressed)
        if not having:
            names = dict.fromkeys(parameter.name for fit in addressed for parameter in fit.parameters)
            name = _split(rule.item, addressed)[0]
            hint = nearest(name, [*names, *_FIT_VALUES, "warnings", "count"])
            return PartialOutcome(addressed=len(addressed), fault=(f"the fit has no '{name}'", hint))
        compared = [_compare_item(rule, fit) for fit in having]
    return PartialOutcome(outcome=rule.outcome_of_all(compared), addressed=len(addressed))


def whole_outcome(rule: Rule, partial: PartialOutcome) -> RuleOutcome:
    """The outcome of a rule on all fits; ConfigError at its place where it addresses none. A rule that cannot
    be judged in one of the tests is not kept.
    """
    if rule.item == "count" and partial.addressed:
        return rule.outcome(*compare_number(rule, float(partial.addressed), "1"))
    if partial.outcome is not None:
        if partial.fault is not None and partial.outcome.passed:
            return rule.outcome(None, False, f"not judged: in a test {partial.fault[0]}")
        return partial.outcome
    what, hint = partial.fault or ("no such fit in the result", "")
    raise rule.fault(what, hint)


def _address(rule: Rule, fits: Sequence[Fit]) -> list[Fit]:
    """The fits of the rule's name, or by what stands in brackets: test, diagonal term or centre of a band."""
    try:
        centre = parse_value(rule.which, "Hz")
    except UnitError:
        centre = math.nan
    return [
        fit
        for fit in fits
        if fit.name == rule.fit
        and (
            rule.which in ("", fit.test, fit.term)
            or abs(centre - fit.centre_hz) < 1e-6 * max(abs(fit.centre_hz), 1.0)
        )
    ]


def compare_warnings(rule: Rule, findings: Iterable[Finding]) -> deciding.Compared:
    """ "collinear" must be there, "not collinear" must not, "also collinear" may; "none": no warning."""
    codes = list(dict.fromkeys(finding.code for finding in of_level(WARNING, findings)))
    code = rule.bound
    if code == "none":
        passed = not codes
    elif code.startswith(ALSO):
        passed = True
    elif code.startswith(NOT):
        passed = code.removeprefix(NOT).strip() not in codes
    else:
        passed = code in codes
    text = ", ".join(codes) or "none"
    return text, passed, text, None


def _having(rule: Rule, fits: list[Fit]) -> list[Fit]:
    # Of a calibration, only the first line has the linear range.
    if rule.item in _FIT_VALUES:
        return fits
    name, _ = _split(rule.item, fits)
    return [fit for fit in fits if name in [parameter.name for parameter in fit.parameters]]


def _split(item: str, fits: Sequence[Fit]) -> tuple[str, str]:
    """(parameter, attribute) of "k_xx.significant"; the names of dofs may hold points themselves."""
    if any(parameter.name == item for fit in fits for parameter in fit.parameters):
        return item, ""
    name, _, attribute = item.rpartition(".")
    return (name, attribute) if name else (item, "")


def _compare_item(rule: Rule, fit: Fit) -> deciding.Compared:
    if not fit.converged:
        return None, False, "not judged: the fit did not converge", None
    if rule.item in _FIT_VALUES:
        return compare_number(rule, _FIT_VALUES[rule.item](fit), "1")
    name, attribute = _split(rule.item, [fit])
    return _compare_attribute(rule, fit.parameter(name), attribute)


def _compare_attribute(rule: Rule, parameter: Parameter, attribute: str) -> deciding.Compared:
    if attribute == "significant":
        text = str(bool(parameter.significant)).lower()
        return text, text == rule.bound, text, None
    if attribute == "std_error":
        return compare_number(rule, parameter.full_error, parameter.unit)
    if attribute == "expanded":
        # The expanded uncertainty against a rule, relative to the value where that is in per cent
        half = deciding.expanded_uncertainty(parameter)
        if parameter.ci95 is None or half is None:
            return None, False, "", None
        if rule.bound.endswith("%"):
            return compare_number(rule, half / abs(parameter.value) if parameter.value else None, "1")
        return compare_number(rule, half, parameter.unit)
    if attribute == "covers":
        return compare_covers(rule, parameter.ci95, parameter.unit)
    if attribute:
        what = f"'{parameter.name}' has no '{attribute}'"
        raise rule.fault(what, nearest(attribute, ("std_error", "expanded", "covers", "significant")))
    errors = deciding.stated_error(parameter), deciding.expanded_uncertainty(parameter)
    return compare_number(rule, parameter.value, parameter.unit, *errors)


def comparison_outcome(
    rule: Rule, comparisons: Sequence[Comparison], compare_number: CompareNumber
) -> RuleOutcome:
    """The outcome of a rule on a comparison; *compare_number*: of rule, value, unit. What could not be judged
    keeps no rule. ConfigError for an unknown item.
    """
    comparison = next(candidate for candidate in comparisons if candidate.name == rule.fit)
    if rule.item == "verdict":
        why = comparison.why_undecided("verdict")
        shown = f"{comparison.verdict}: {why}" if why else ""
        return rule.outcome(comparison.verdict, comparison.verdict == rule.bound, shown)
    if rule.item == "count":
        return rule.outcome(*compare_number(rule, float(len(comparison.points)), "1"))
    name, _, attribute = rule.item.partition(".")
    why = comparison.why_undecided(name)
    if why:
        return rule.outcome(None, False, f"not judged: {why}")
    return rule.outcome(*_compare_attribute(rule, _amount(rule, comparison, name), attribute))


def _amount(rule: Rule, comparison: Comparison, name: str) -> Parameter:
    try:
        return comparison.amount(name)
    except KeyError:
        hint = nearest(name, [*(amount.name for amount in comparison.amounts), "verdict", "count"])
        raise rule.fault(f"the comparison has no '{name}'", hint) from None


def matrix_outcome(rule: Rule, matrices: ConditionMatrices, _compare_number: CompareNumber) -> RuleOutcome:
    """The outcome of a rule on an amount of a matrix; ConfigError for an unknown one."""
    matrix = next(candidate for candidate in matrices if candidate.name == rule.fit)
    try:
        amount = matrix.amount(rule.item)
    except KeyError:
        hint = nearest(rule.item, [amount.name for amount in matrix.amounts])
        raise rule.fault(f"the matrix has no '{rule.item}'", hint) from None
    return rule.outcome(*_compare_attribute(rule, amount, ""))
