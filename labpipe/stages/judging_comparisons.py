"""Holding comparisons against rules: "name.amount", "name.amount.covers", ".std_error", ".expanded", "name.verdict"."""

from __future__ import annotations

from collections.abc import Sequence

from labpipe.config.rules import Rule
from labpipe.errors import ConfigError
from labpipe.records.comparison import Comparison
from labpipe.records.identification import Parameter, RuleOutcome
from labpipe.registry import nearest
from labpipe.stages.judging_numbers import CompareNumber, compare_covers, compare_expanded


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
        return RuleOutcome(rule.section, rule.text, *compare_covers(rule, amount.ci95, amount.unit))
    if attribute == "expanded":
        return RuleOutcome(rule.section, rule.text, *compare_expanded(rule, amount))
    value = amount.full_error if attribute == "std_error" else amount.value
    return RuleOutcome(rule.section, rule.text, *compare_number(rule, value, amount.unit))


def _amount(rule: Rule, comparison: Comparison, name: str) -> Parameter:
    try:
        return comparison.amount(name)
    except KeyError:
        hint = nearest(name, [*(amount.name for amount in comparison.amounts), "verdict", "count"])
        raise ConfigError(f"{rule.section}.{rule.address}: the comparison has no '{name}'", where=rule.place, hint=hint) from None
