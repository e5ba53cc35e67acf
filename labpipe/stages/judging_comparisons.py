"""Holding comparisons against rules: "name.amount", "name.amount.covers", "name.amount.std_error", "name.verdict"."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from labpipe.config.rules import Rule
from labpipe.errors import ConfigError
from labpipe.quantities import UnitError, parse_value
from labpipe.records.comparison import Comparison
from labpipe.records.identification import Parameter, RuleOutcome
from labpipe.registry import nearest

# (rule, value, unit) -> (value shown, passed)
CompareNumber = Callable[[Rule, float | None, str], tuple[float | None, bool]]


def comparison_outcome(rule: Rule, comparisons: Sequence[Comparison], compare_number: CompareNumber) -> RuleOutcome:
    """The outcome of a rule on a comparison; *compare_number*: of rule, value, unit. ConfigError for an unknown item."""
    comparison = next(candidate for candidate in comparisons if candidate.name == rule.fit)
    if rule.item == "verdict":
        return RuleOutcome(rule.section, rule.text, comparison.verdict, comparison.verdict == rule.bound)
    if rule.item == "count":
        return RuleOutcome(rule.section, rule.text, *compare_number(rule, float(len(comparison.points)), "1"))
    name, _, attribute = rule.item.partition(".")
    amount = _amount(rule, comparison, name)
    if attribute == "covers":
        return _covers(rule, amount)
    value = amount.std_error if attribute == "std_error" else amount.value
    return RuleOutcome(rule.section, rule.text, *compare_number(rule, value, amount.unit))


def _amount(rule: Rule, comparison: Comparison, name: str) -> Parameter:
    try:
        return comparison.amount(name)
    except KeyError:
        hint = nearest(name, [*(amount.name for amount in comparison.amounts), "verdict", "count"])
        raise ConfigError(f"{rule.section}.{rule.address}: the comparison has no '{name}'", where=rule.place, hint=hint) from None


def _covers(rule: Rule, amount: Parameter) -> RuleOutcome:
    """True if the 95 % interval covers the value of the rule, with the interval as text."""
    try:
        wanted = parse_value(rule.bound, amount.unit)
    except UnitError as error:
        raise ConfigError(f"{rule.section}.{rule.address}: {error.what}", where=rule.place, hint=error.hint) from None
    if amount.ci95 is None:
        return RuleOutcome(rule.section, rule.text, "no interval", False)
    low, high = amount.ci95
    return RuleOutcome(rule.section, rule.text, f"{low:.6g} to {high:.6g}", low <= wanted <= high)
