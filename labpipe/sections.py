"""Sections of a pipeline that ask for a result. SECTIONS by their key: how each is read, run, recorded, judged, listed and reported.

An entry names what does each step ("module:attribute"), so that the table loads nothing; other packages add sections under the
entry-point group labpipe.section.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from labpipe.registry import Registry

# "module:attribute" or the object itself, as plug-ins give it.
Reference = Any


@dataclass(frozen=True, kw_only=True)
class PipelineSection:
    """One section.

    words: what it does, for the docs. settings: the dataclass of the section, or of each of its entries where they are *named*.
    run: (settings, Work) -> its record. record: the type of the record, from which JSON is read back; entry: its key in
    identification.json. *standalone*: the section alone is work for a pipeline. *fits*: its record is a tuple of fits, held with those of
    all others.

    Optional: read: (node, key, name, Reading) -> settings, where more than the dataclass is needed; names: settings or record -> the names
    by which rules address it; outcome: (rule, record, compare) -> RuleOutcome; findings: record -> (origin, finding) pairs; parameters:
    record -> ListedParameters; report: (record, Identification) -> sections of the report; cover: record -> what the cover says of it;
    terminal: record -> lines.
    """

    words: str
    settings: Reference
    run: Reference
    named: bool = False
    standalone: bool = False
    fits: bool = False
    record: Reference = None
    entry: str = ""
    read: Reference = None
    names: Reference = None
    outcome: Reference = None
    findings: Reference = None
    parameters: Reference = None
    report: Reference = None
    cover: Reference = None
    terminal: Reference = None

    def load(self, step: str) -> Any:
        """What does a step; None where the section has none."""
        reference = getattr(self, step)
        if not isinstance(reference, str):
            return reference
        module, _, attribute = reference.partition(":")
        return getattr(import_module(module), attribute)

    def call(self, step: str, *arguments: Any, default: Any = ()) -> Any:
        """What a step gives; the default where the section has none."""
        function: Callable[..., Any] | None = self.load(step)
        return default if function is None else function(*arguments)


SECTIONS = Registry(
    "section",
    {name: f"labpipe.sections:{name.upper()}" for name in ("identify", "calibrate", "compare", "matrix", "study", "unbalance", "run_ups")},
)

IDENTIFY = PipelineSection(
    words="One entry per fit, under a name of your choice.",
    settings="labpipe.identify.settings:FitSettings",
    named=True,
    read="labpipe.config.fits:read_fit",
    run="labpipe.stages.fits:run_fits",
    fits=True,
)
CALIBRATE = PipelineSection(
    words="One entry per straight line to be fitted.",
    settings="labpipe.config.calibration:CalibrationSettings",
    named=True,
    standalone=True,
    run="labpipe.stages.calibrate:run_calibrations",
    fits=True,
)
COMPARE = PipelineSection(
    words="One entry per question to tests that differ in a condition, under a name of your choice.",
    settings="labpipe.campaign.settings:CompareSettings",
    named=True,
    read="labpipe.config.compare:read_comparison",
    run="labpipe.stages.compare:run_comparisons",
    record="labpipe.records.comparison:Comparisons",
    entry="comparisons",
    names="labpipe.records.comparison:names",
    outcome="labpipe.stages.judging_comparisons:comparison_outcome",
    findings="labpipe.records.comparison:findings",
    parameters="labpipe.campaign.listed:listed_amounts",
    report="labpipe.report.comparison:comparison_sections",
    terminal="labpipe.cli.terminal_sections:comparison_lines",
)
MATRIX = PipelineSection(
    words="One entry per matrix of tests: the coefficients of a fit over two conditions or more, under a name of your choice.",
    settings="labpipe.campaign.matrix_settings:MatrixSettings",
    named=True,
    read="labpipe.config.matrix:read_matrix",
    run="labpipe.stages.matrix:run_matrices",
    record="labpipe.records.condition_matrix:ConditionMatrices",
    entry="matrices",
    names="labpipe.records.comparison:names",
    outcome="labpipe.stages.matrix:matrix_outcome",
    findings="labpipe.records.condition_matrix:findings",
    parameters="labpipe.campaign.listed:listed_points",
    report="labpipe.report.condition_matrix:matrix_sections",
    terminal="labpipe.cli.terminal_sections:matrix_lines",
)
STUDY = PipelineSection(
    words="The fits repeated on a virtual rig.",
    settings="labpipe.study.settings:StudySettings",
    standalone=True,
    run="labpipe.stages.study:run_studies",
    record="labpipe.records.study:Studies",
    entry="studies",
    outcome="labpipe.stages.judging_study:study_outcome",
    parameters="labpipe.study.listed:listed_cases",
    report="labpipe.report.study:study_sections",
    terminal="labpipe.cli.terminal_sections:study_lines",
)
UNBALANCE = PipelineSection(
    words="The model's response to unbalance over speed.",
    settings="labpipe.rigs.unbalance_runs:UnbalanceSettings",
    standalone=True,
    run="labpipe.stages.unbalance:run_unbalance",
    record="labpipe.records.unbalance:UnbalanceRuns",
    entry="unbalance",
    outcome="labpipe.stages.judging_unbalance:unbalance_outcome",
    parameters="labpipe.rigs.listed:listed_peaks",
    report="labpipe.report.unbalance:unbalance_sections",
)
RUN_UPS = PipelineSection(
    words="Coefficients from unbalance run-ups.",
    settings="labpipe.run_ups.settings:RunUpSettings",
    standalone=True,
    run="labpipe.stages.run_ups:run_run_ups",
    record="labpipe.records.run_up_result:RunUpResult",
    entry="run_ups",
    outcome="labpipe.stages.judging_run_ups:run_up_outcome",
    findings="labpipe.records.run_up_result:findings",
    parameters="labpipe.run_ups.listed:listed_speeds_and_parameters",
    report="labpipe.report.run_up:run_up_sections",
    cover="labpipe.report.run_up:cover_facts",
    terminal="labpipe.cli.terminal_sections:run_up_lines",
)


def section(name: str) -> PipelineSection:
    """The section of that key; ConfigError with the nearest known key on a miss."""
    entry: PipelineSection = SECTIONS.load(name)
    return entry


def sections() -> Iterable[tuple[str, PipelineSection]]:
    """All sections with their keys, in the order in which they are run."""
    return ((name, section(name)) for name in SECTIONS.names())


def names_of(name: str, settings_or_record: Any) -> tuple[str, ...]:
    """The names by which rules address a section: its own key, unless it has names."""
    return tuple(section(name).call("names", settings_or_record, default=(name,)))
