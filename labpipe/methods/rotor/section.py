"""The section unbalance: the model's response to unbalance over speed, its rules and lists."""

from __future__ import annotations

from collections.abc import Iterator

from labpipe.errors import ConfigError
from labpipe.methods.rotor.report import unbalance_sections
from labpipe.methods.rotor.unbalance import UnbalanceRuns, UnbalanceSettings, unbalance_runs
from labpipe.project.judging import CompareNumber
from labpipe.project.rules import Rule
from labpipe.project.work import Work
from labpipe.records.finding import Parameter
from labpipe.records.identification import ListedParameter, RuleOutcome
from labpipe.registry import nearest
from labpipe.sections import PipelineSection


def listed_peaks(runs: UnbalanceRuns) -> Iterator[ListedParameter]:
    """Peaks [m] and their speeds [Hz] of every state of wear."""
    for case in runs.cases:
        for name, (value, unit) in runs.values(case).items():
            error = case.error(name)
            parameter = Parameter(name, value, unit, derived=True, std_error=error)
            yield ListedParameter(fit="unbalance", parameter=parameter, test=case.name, model="unbalance")


# The section unbalance: the model's response to unbalance over speed.


def run_unbalance(settings: UnbalanceSettings, work: Work) -> UnbalanceRuns:  # noqa: ARG001 (one signature for all sections)
    """The response of every state of wear at every speed."""
    return unbalance_runs(settings)


# Holding the response to unbalance against rules: "unbalance.CASE.forward_peak".


def unbalance_outcome(rule: Rule, runs: UnbalanceRuns, compare_number: CompareNumber) -> RuleOutcome:
    """The outcome of a rule on one case; ConfigError at its place when there is no such case or value."""
    name, _, item = rule.item.rpartition(".")
    cases = {case.name: case for case in runs.cases}
    if name not in cases:
        hint = nearest(name, list(cases))
        raise ConfigError(
            f"{rule.section}.{rule.address}: no such case of unbalance", where=rule.place, hint=hint
        )
    values = runs.values(cases[name])
    if item not in values:
        hint = nearest(item, list(values))
        raise ConfigError(
            f"{rule.section}.{rule.address}: a case of unbalance has no '{item}'", where=rule.place, hint=hint
        )
    return RuleOutcome(rule.section, rule.text, *compare_number(rule, *values[item]))


UNBALANCE = PipelineSection(
    words="The model's response to unbalance over speed.",
    settings=UnbalanceSettings,
    standalone=True,
    run=run_unbalance,
    record=UnbalanceRuns,
    entry="unbalance",
    outcome=unbalance_outcome,
    parameters=listed_peaks,
    report=unbalance_sections,
)
