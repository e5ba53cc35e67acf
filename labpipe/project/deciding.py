"""Deciding by limits: a number with its uncertainty, compared with those of a rule, and several together."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from labpipe.display import amount_text, with_error
from labpipe.project.rules import RISK, SIMPLE, Decision, Rule
from labpipe.quantities import UnitError, in_unit, parse_value, written_unit
from labpipe.records.comparison import Comparison
from labpipe.records.finding import NORMAL, Parameter
from labpipe.records.identification import Fit, RuleDecision, RuleOutcome, changes_of
from labpipe.records.uncertain import parse_uncertain
from labpipe.uncertainty import decisions

# (value [SI], whether it meets the rule, the value in the rule's unit, how limits were decided on)
Compared = tuple[float | str | None, bool, str, RuleDecision | None]


def stated_error(parameter: Parameter) -> float | None:
    """The combined standard uncertainty behind the interval that is stated [unit of the parameter], None
    without one. Where draws or a profile gave the interval alone, half of it over the normal quantile.
    """
    if parameter.full_error is not None or parameter.ci95 is None:
        return parameter.full_error
    return (parameter.ci95[1] - parameter.ci95[0]) / (2 * NORMAL)


def expanded_uncertainty(parameter: Parameter) -> float | None:
    """The expanded uncertainty [unit of the parameter], half the 95 % interval where noise alone is known."""
    if parameter.expanded is not None or parameter.ci95 is None:
        return parameter.expanded
    return (parameter.ci95[1] - parameter.ci95[0]) / 2


def decide(
    rule: Rule, value: float | None, error: float | None, unit: str, expanded: float | None = None
) -> Compared:
    """Whether a number [*unit*, SI] with its standard uncertainty meets a rule with limits. *expanded*: by
    default that of a normal distribution. ConfigError for limits of another dimension.
    """
    decision = rule.decision
    assert decision is not None
    with rule.faults_of_units():
        limits = limits_of(decision, unit)
        process = _process(decision, unit)
        written = written_unit(decision.low or decision.high)
        shown = "" if value is None else text_in(written, value, error, unit)
    if value is None or not math.isfinite(value):
        return None, False, "not judged: there is no value", None
    if error is None or not math.isfinite(error):
        return value, False, f"not judged: {shown} has no standard uncertainty", None
    probability = decisions.conformance(value, error, limits)
    reach = NORMAL * error if expanded is None else expanded
    outcome, acceptance = _outcome(decision, value, (error, reach), limits, probability)
    risks = None if process is None else decisions.global_risk(process, error, limits, acceptance)
    ends = (None, None) if acceptance is None else (_end(acceptance.low), _end(acceptance.high))
    record = RuleDecision(
        outcome=outcome,
        probability=probability,
        specific_risk=_specific(outcome, probability),
        uncertainty=error,
        unit=unit,
        low=_end(limits.low),
        high=_end(limits.high),
        accept_low=ends[0],
        accept_high=ends[1],
        global_false_acceptance=None if risks is None else risks.false_acceptance,
        global_false_rejection=None if risks is None else risks.false_rejection,
    )
    return value, outcome in decision.outcomes, f"{shown}: {outcome}, {within(probability)}", record


def limits_of(decision: Decision, unit: str) -> decisions.Limits:
    """The limits in SI; UnitError for another dimension, or where the lower one does not come first."""
    limits = decisions.Limits(
        parse_value(decision.low, unit) if decision.low else -math.inf,
        parse_value(decision.high, unit) if decision.high else math.inf,
    )
    if not limits.low < limits.high:
        raise UnitError(f"of the limits {decision.limits_text} the lower one comes first")
    return limits


def within(probability: float) -> str:
    """The probability in words, never rounded to certainty."""
    percent = 100 * probability
    text = f"{percent:.2f} %" if 0.01 <= percent <= 99.99 else ("> 99.99 %" if percent > 50 else "< 0.01 %")
    return f"within the limits with {text}"


def _process(decision: Decision, unit: str) -> tuple[float, float] | None:
    if not decision.process:
        return None
    process = parse_uncertain(decision.process, unit)
    if not process.std_error > 0:
        raise UnitError(f"the process '{decision.process}' has no spread")
    return process.value, process.std_error


def text_in(written: str, value: float, error: float | None, unit: str) -> str:
    """A value with its uncertainty [*unit*, SI] in a *written* unit, or the usual one where that is empty."""
    if not written:
        return amount_text(value, error, unit)
    size = None if error is None else in_unit(error, unit, written) - in_unit(0.0, unit, written)
    return with_error(in_unit(value, unit, written), size, written)


def _outcome(
    decision: Decision,
    value: float,
    errors: tuple[float, float],
    limits: decisions.Limits,
    probability: float,
) -> tuple[str, decisions.Limits | None]:
    """The outcome, and the values that pass, if any do. *errors*: standard and expanded uncertainty."""
    error, expanded = errors
    if decision.rule == RISK:
        acceptance = decisions.acceptance_by_risk(error, limits, decision.risk)
        return decisions.outcome_by_risk(probability, decision.risk), acceptance
    if decision.rule == SIMPLE:
        return (decisions.PASS if limits.hold(value) else decisions.FAIL), limits
    by_risk = decisions.guard_band(error, decision.risk)
    guard = by_risk if decision.guard is None else decision.guard * expanded
    if guard < 0:
        # A band outwards: what passes lies within it, and nothing is conditional.
        wide = limits.narrow(guard)
        return (decisions.PASS if wide.hold(value) else decisions.FAIL), wide
    narrow = limits.narrow(guard)
    return decisions.outcome_by_guard(value, guard, limits), narrow if narrow.low <= narrow.high else None


def _specific(outcome: str, probability: float) -> float:
    return 1.0 - probability if outcome in (decisions.PASS, decisions.CONDITIONAL_PASS) else probability


def _end(value: float) -> float | None:
    return value if math.isfinite(value) else None


@dataclass(frozen=True)
class Limited:
    """A number with its limits: *value* and standard uncertainty *error* [its unit], None where one is
    missing, with the reason in *why*; *changes* by every systematic source. owner: its fit or comparison.
    """

    owner: Fit | Comparison
    name: str
    limits: decisions.Limits
    value: float | None
    error: float | None
    changes: Mapping[str, float] = field(default_factory=dict)
    why: str = ""

    @property
    def random(self) -> float:
        """Standard uncertainty [unit] without what systematic sources add."""
        return math.sqrt(max((self.error or 0.0) ** 2 - sum(by**2 for by in self.changes.values()), 0.0))


def limits_on_fit(rule: Rule, fit: Fit, parameter: Parameter) -> Limited:
    """A parameter of a fit with its limits; UnitError for those of another dimension."""
    assert rule.decision is not None
    return Limited(
        owner=fit,
        name=parameter.name,
        limits=limits_of(rule.decision, parameter.unit),
        value=parameter.value if fit.converged else None,
        error=stated_error(parameter),
        changes=changes_of(fit, parameter),
        why="" if fit.converged else "the fit did not converge",
    )


def limits_on_comparison(rule: Rule, comparison: Comparison, amount: Parameter) -> Limited:
    """An amount of a comparison with its limits; UnitError for those of another dimension."""
    assert rule.decision is not None
    why = comparison.why_undecided(amount.name)
    limits = limits_of(rule.decision, amount.unit)
    value = None if why else amount.value
    return Limited(comparison, amount.name, limits, value, stated_error(amount), why=why)


def decide_jointly(rule: Rule, numbers: Sequence[Limited]) -> RuleOutcome:
    """The outcome of limits that hold at once, by the joint covariance of their values; where a correlation
    is not known, by the least probability that any leaves.
    """
    decision = rule.decision
    assert decision is not None
    for number in numbers:
        if number.value is None or number.error is None:
            why = number.why or f"{number.name} has no standard uncertainty"
            return rule.outcome(None, False, shown=f"not judged: {why}")
    values = np.array([number.value for number in numbers], dtype=float)
    errors = np.array([number.error for number in numbers], dtype=float)
    limits = [number.limits for number in numbers]
    covariance = np.diag(errors**2)
    is_known = True
    for first, second in itertools.combinations(range(len(numbers)), 2):
        common = _covariance(numbers[first], numbers[second])
        is_known = is_known and common is not None
        covariance[first, second] = covariance[second, first] = common or 0.0
    if is_known:
        probability = decisions.joint_conformance(values, covariance, limits)
    else:
        singles = [decisions.conformance(*single) for single in zip(values, errors, limits, strict=True)]
        probability = decisions.least_joint_conformance(singles)
    if decision.rule == RISK:
        outcome = decisions.outcome_by_risk(probability, decision.risk)
    else:
        hold = all(limit.hold(value) for limit, value in zip(limits, values, strict=True))
        outcome = decisions.PASS if hold else decisions.FAIL
    record = RuleDecision(
        outcome=outcome,
        probability=probability,
        specific_risk=_specific(outcome, probability),
        together=len(numbers),
        least=not is_known,
    )
    least = "" if is_known else "at least: some correlations are not known; "
    shown = f"{least}all {len(numbers)} {within(probability)}: {outcome}"
    return rule.outcome(probability, outcome in decision.outcomes, shown=shown, decision=record)


def _covariance(first: Limited, second: Limited) -> float | None:
    by_sources = sum(by * second.changes.get(source, 0.0) for source, by in first.changes.items())
    if isinstance(first.owner, Comparison) or isinstance(second.owner, Comparison):
        if first.owner is not second.owner or not isinstance(first.owner, Comparison):
            return None
        pairs = {frozenset(pair[:2]): pair[2] for pair in first.owner.correlations}
        correlation = pairs.get(frozenset((first.name, second.name)))
        return None if correlation is None else correlation * (first.error or 0.0) * (second.error or 0.0)
    if first.owner is second.owner:
        if first.name == second.name:
            return (first.error or 0.0) ** 2
        names = [parameter.name for parameter in first.owner.estimated]
        matrix = first.owner.correlation
        if {first.name, second.name} <= set(names) and matrix.shape == (len(names),) * 2:
            correlation = float(matrix[names.index(first.name), names.index(second.name)])
            return by_sources + correlation * first.random * second.random
        return None
    # Records of different tests have no noise in common; fits to one record do.
    return by_sources if first.owner.test != second.owner.test else None
