"""A run over so many tests that their results are kept as a dataset: nothing of a test stays in memory once its rows are written."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from labpipe import __version__
from labpipe.artefacts.code import code_digest
from labpipe.artefacts.dataset_file import parts, write_parts
from labpipe.artefacts.digest import DamagedError
from labpipe.artefacts.freshness import made_again
from labpipe.artefacts.header import SourceRef, source_ref
from labpipe.artefacts.identification_file import NAME, read_identification, write_identification
from labpipe.artefacts.parquet import read_header
from labpipe.artefacts.writing import OutputFolder
from labpipe.config.pipeline import Pipeline
from labpipe.config.rules import Rule
from labpipe.config.tests import Test
from labpipe.errors import ConfigError, DataError
from labpipe.identify.levels import LEVELS
from labpipe.pipeline.one_test import Done, Job
from labpipe.records.dataset_index import CountedFinding, DatasetIndex
from labpipe.records.dataset_row import DatasetRow, PartialOutcome, TestResult
from labpipe.records.identification import Failed, Identification, RuleOutcome
from labpipe.stages.identify import rig_entry, settings_entry
from labpipe.stages.judging import unfounded, whole_outcome
from labpipe.stages.result_of_test import failed_result

# From so many tests on, where nothing needs all of them at once.
DATASET_FROM = 100
# Tests whose rows make a part of the dataset.
PART_TESTS = 500
# Failed tests that are named in identification.json; the dataset has them all.
MOST_FAILED = 100


def keeps_dataset(pipeline: Pipeline, independent: Sequence[str]) -> bool:
    """Whether the results of a pipeline are kept as a dataset; ConfigError where it is asked for and cannot be.

    *independent*: the fits that need no other one.
    """
    if pipeline.results == "whole" or (pipeline.results == "auto" and len(pipeline.tests) < DATASET_FROM):
        return False
    hindrance = _hindrance(pipeline, independent)
    if hindrance and pipeline.results == "dataset":
        raise ConfigError(f"results: {hindrance}, which needs all tests at once", where=str(pipeline.path), hint="write results: whole")
    return not hindrance


def _hindrance(pipeline: Pipeline, independent: Sequence[str]) -> str:
    """What needs the results of all tests at once; empty where nothing does."""
    others = [name for name in pipeline.sections if name != "identify"]
    if others:
        return f"the section {others[0]} is there"
    dependent = [fit.name for fit in pipeline.fits if fit.name not in independent]
    if dependent:
        return f"the fit {dependent[0]} begins with another one"
    levels = [name for test in pipeline.tests for name in (*test.conditions, *test.recorded) if name in LEVELS]
    return f"the condition '{levels[0]}' asks whether the rig is linear" if levels else ""


class Gathered:
    """The outcomes of tests as they come: rows go to parts of the dataset, what concerns all tests is summed up.

    Tests are taken in their order, whatever the order in which they end: the same results give the same bytes.
    """

    def __init__(self, jobs: Sequence[Job], rules: Sequence[Rule], output: OutputFolder) -> None:
        self._jobs, self._rules, self._output = jobs, rules, output
        self._places = {job.test.name: place for place, job in enumerate(jobs)}
        self._early: dict[int, Done] = {}
        self._next = 0
        self._rows: list[DatasetRow] = []
        self.parts: list[str] = []
        self.failed: list[Failed] = []
        self._partial = [PartialOutcome()] * len(rules)
        self._forbidden: dict[str, RuleOutcome] = {}
        self._findings: dict[tuple[str, str], CountedFinding] = {}
        self._tests = self._not_accepted = self._n_row = 0
        self._fits: dict[str, int] = {}

    def add(self, done: Done) -> None:
        """Take the outcome of a test."""
        self._output.remarks.extend(done.remarks)
        self._early[self._places[done.test]] = done
        while self._next in self._early:
            self._take(self._early.pop(self._next), self._jobs[self._next].test)
            self._next += 1
            if self._next % PART_TESTS == 0 or self._next == len(self._jobs):
                self._write()

    def _take(self, done: Done, test: Test) -> None:
        if done.failed is not None:
            self.failed.append(done.failed)
            self._rows.extend(failed_result(test, done.failed.message).rows)
        elif done.result is not None:
            self._sum_up(done.result)
            self._rows.extend(done.result.rows)

    def _write(self) -> None:
        self.parts.extend(write_parts(self._rows, self._output))
        self._n_row += len(self._rows)
        self._rows.clear()

    def _sum_up(self, result: TestResult) -> None:
        self._tests += 1
        self._partial = [before.with_more(more) for before, more in zip(self._partial, result.partial, strict=True)]
        for outcome in result.forbidden:
            self._forbidden.setdefault(outcome.rule, outcome)
        self._not_accepted += bool(result.rows) and result.rows[0].accepted is False
        for name in dict.fromkeys((row.fit or "", row.term, row.low_hz) for row in result.rows):
            self._fits[name[0]] = self._fits.get(name[0], 0) + 1
        seen: set[tuple[str, str]] = set()
        for origin, finding in result.findings:
            key = finding.level, finding.code
            known = self._findings.get(key, CountedFinding(finding, origin, 0))
            self._findings[key] = dataclasses.replace(known, tests=known.tests + (key not in seen))
            seen.add(key)

    def index(self) -> DatasetIndex:
        """What is said of all tests together."""
        return DatasetIndex(
            tests=self._tests,
            failed=len(self.failed),
            not_accepted=self._not_accepted,
            rows=self._n_row,
            fits=self._fits,
            findings=tuple(sorted(self._findings.values(), key=lambda counted: (counted.finding.level, counted.finding.code))),
        )

    def outcomes(self) -> tuple[RuleOutcome, ...]:
        """The outcome of every rule over all tests; ConfigError for one that addresses nothing, where no test is missing."""
        outcomes: list[RuleOutcome] = []
        for rule, partial in zip(self._rules, self._partial, strict=True):
            try:
                outcomes.append(whole_outcome(rule, partial))
            except ConfigError:
                if not self.failed:
                    raise
                outcomes.append(unfounded(rule))
        return (*outcomes, *self._forbidden.values())


def identified(pipeline: Pipeline, gathered: Gathered, output: OutputFolder) -> Identification:
    """The result of all tests: identification.json, which sums the dataset up. Parts of an earlier run that are no longer of it go."""
    if not gathered.index().tests:
        first = gathered.failed[0].message
        raise DataError(f"{first} (and none of the other {len(gathered.failed) - 1} tests could be evaluated)")
    _remark_damaged(output, gathered.parts)
    settings = settings_entry(pipeline)
    del settings["tests"]
    identification = Identification(
        fits=(),
        title=pipeline.title,
        pipeline=pipeline.path.name,
        sources=tuple(dataclasses.asdict(source_ref(path, pipeline.folder)) for path in pipeline.side_files),
        inputs=tuple(dataclasses.asdict(_part_ref(output, name)) for name in gathered.parts),
        settings=settings,
        rig=rig_entry(pipeline),
        outcomes=gathered.outcomes(),
        version=__version__,
        code=code_digest(),
        failed=tuple(gathered.failed[:MOST_FAILED]),
        dataset=gathered.index(),
    )
    write_identification(output.write_path(NAME), identification)
    for name in (*gathered.parts, NAME):
        output.leave_same(name)
    return identification


def _part_ref(output: OutputFolder, name: str) -> SourceRef:
    return SourceRef(name, source_ref(output.read_path(name), output.target).sha256)


def _remark_damaged(output: OutputFolder, names: Sequence[str]) -> None:
    """Name what was found damaged in the folder, and have parts that are not of this result removed."""
    for part in parts(output.target):
        try:
            read_header(part.path, "")
        except DamagedError as error:
            output.remarks.append(made_again(error, part.path))
        name = part.path.relative_to(output.target).as_posix()
        if name not in names:
            output.outdate(name)
    _remark_result(output.target / NAME, output)


def _remark_result(path: Path, output: OutputFolder) -> None:
    if path.exists():
        try:
            read_identification(path)
        except DataError as error:
            output.remarks.append(made_again(error, path))
