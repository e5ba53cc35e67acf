"""Holding the response to unbalance against rules: "unbalance.CASE.forward_peak"."""

from __future__ import annotations

from labpipe.config.rules import Rule
from labpipe.errors import ConfigError
from labpipe.records.identification import RuleOutcome
from labpipe.records.unbalance import UnbalanceRuns
from labpipe.registry import nearest
from labpipe.stages.judging_numbers import CompareNumber


def unbalance_outcome(rule: Rule, runs: UnbalanceRuns, compare_number: CompareNumber) -> RuleOutcome:
    """The outcome of a rule on one case; ConfigError at its place when there is no such case or value."""
    name, _, item = rule.item.rpartition(".")
    cases = {case.name: case for case in runs.cases}
    if name not in cases:
        hint = nearest(name, list(cases))
        raise ConfigError(f"{rule.section}.{rule.address}: no such case of unbalance", where=rule.place, hint=hint)
    values = runs.values(cases[name])
    if item not in values:
        hint = nearest(item, list(values))
        raise ConfigError(f"{rule.section}.{rule.address}: a case of unbalance has no '{item}'", where=rule.place, hint=hint)
    return RuleOutcome(rule.section, rule.text, *compare_number(rule, *values[item]))
