"""A run over so many tests that their results are kept as a dataset: nothing of a test stays in memory once
its rows are written.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from typing import Any

from labpipe import __version__
from labpipe.artefacts.dataset_file import parts, write_parts
from labpipe.artefacts.digest import DamagedError
from labpipe.artefacts.header import SourceRef, code_digest, source_ref
from labpipe.artefacts.identification_file import NAME, read_identification, write_identification
from labpipe.artefacts.parquet import read_header, remake_line
from labpipe.artefacts.writing import OutputFolder
from labpipe.errors import ConfigError, DataError
from labpipe.estimation.levels import LEVELS
from labpipe.project.identify import rig_entry, settings_entry
from labpipe.project.judging import whole_outcome
from labpipe.project.one_test import Done, Job, failed_result
from labpipe.project.pipeline_file import Pipeline
from labpipe.project.rules import Rule
from labpipe.project.tests import Test
from labpipe.records.dataset import DatasetSummary, PartialOutcome, TestResult, summary_of
from labpipe.records.identification import Identification, RuleOutcome

# From so many tests on people are told of the dataset.
MANY_TESTS = 100
# Tests whose rows make a part of the dataset.
PART_TESTS = 500


def keeps_dataset(pipeline: Pipeline, independent: Sequence[str]) -> bool:
    """Whether the results of a pipeline are kept as a dataset; ConfigError where it is asked for and cannot
    be. *independent*: the fits that need no other one.
    """
    if pipeline.results == "whole":
        return False
    what = hindrance(pipeline, independent)
    if what:
        what = f"results: {what}, which needs all tests at once"
        raise ConfigError(what, pipeline.path, "write results: whole")
    return True


def advice(pipeline: Pipeline, independent: Sequence[str]) -> str:
    """That a dataset would hold so many tests in less memory; empty where there are few, or it cannot."""
    if pipeline.results == "dataset" or len(pipeline.tests) < MANY_TESTS or hindrance(pipeline, independent):
        return ""
    return (
        f"{len(pipeline.tests)} tests stand whole in {NAME}; `results: dataset` keeps them as rows of "
        "tables, in a fraction of the memory"
    )


def hindrance(pipeline: Pipeline, independent: Sequence[str]) -> str:
    """What needs the results of all tests at once; empty where nothing does."""
    others = [name for name in pipeline.sections if name != "identify"]
    if others:
        return f"the section {others[0]} is there"
    dependent = [fit.name for fit in pipeline.fits if fit.name not in independent]
    if dependent:
        return f"the fit {dependent[0]} begins with another one"
    conditions = (name for test in pipeline.tests for name in (*test.conditions, *test.recorded))
    level = next((name for name in conditions if name in LEVELS), "")
    return f"the condition '{level}' asks whether the rig is linear" if level else ""


class Gathered:
    """The outcomes of tests, taken in their order, whatever that in which they end: rows go to parts of the
    dataset, what concerns all tests is summed up.
    """

    def __init__(self, jobs: Sequence[Job], output: OutputFolder) -> None:
        self._jobs, self._output = jobs, output
        self._places = {job.test.name: place for place, job in enumerate(jobs)}
        self._early: dict[int, Done] = {}
        self._next = 0
        self._waiting: list[TestResult] = []
        self.parts: list[str] = []
        self.summary = DatasetSummary()

    def add(self, done: Done) -> None:
        self._output.remarks.extend(done.remarks)
        self._early[self._places[done.test]] = done
        while self._next in self._early:
            result = outcome_of(self._early.pop(self._next), self._jobs[self._next].test)
            self.summary = self.summary.with_more(summary_of(result))
            self._waiting.append(result)
            self._next += 1
            if self._next % PART_TESTS == 0 or self._next == len(self._jobs):
                self.parts.extend(write_parts(self._waiting, self._output))
                self._waiting.clear()


def outcome_of(done: Done, test: Test) -> TestResult:
    """The result of a test that ended, or why it has none."""
    if done.failed is not None:
        return failed_result(test, done.failed.message)
    assert done.result is not None
    return done.result


def identify(pipeline: Pipeline, gathered: Gathered, output: OutputFolder) -> Identification:
    """The result of all tests, which sums the dataset up; other parts in the folder go."""
    failed = gathered.summary.failed
    if failed and not gathered.summary.index.tests:
        n_test = gathered.summary.index.failed
        raise DataError(f"{failed[0].message} (none of {n_test} tests could be evaluated)")
    _remark_damaged(output, gathered.parts)
    parts_made = {name: source_ref(output.read_path(name), output.target) for name in gathered.parts}
    inputs = tuple(asdict(SourceRef(name, part.sha256)) for name, part in parts_made.items())
    identification = replace(summarise_tests(pipeline, gathered.summary), inputs=inputs)
    write_identification(output.write_path(NAME), identification)
    for name in (*gathered.parts, NAME):
        output.leave_same(name)
    return identification


def summarise_tests(pipeline: Pipeline, summary: DatasetSummary) -> Identification:
    """The result of many tests but its parts. ConfigError for a rule on nothing where no test failed."""
    return Identification(
        fits=(),
        title=pipeline.title,
        pipeline=pipeline.path.name,
        sources=tuple(asdict(source_ref(path, pipeline.folder)) for path in pipeline.side_files),
        settings=settings_of_many(pipeline),
        rig=rig_entry(pipeline),
        outcomes=(*_outcomes(pipeline.rules, summary), *summary.forbidden),
        version=__version__,
        code=code_digest(),
        failed=summary.failed,
        dataset=summary.index,
    )


def settings_of_many(pipeline: Pipeline) -> dict[str, Any]:
    """The settings of a pipeline as JSON holds them, without the tests: these stand in the dataset."""
    return {name: entry for name, entry in settings_entry(pipeline).items() if name != "tests"}


def _outcomes(rules: Sequence[Rule], summary: DatasetSummary) -> Iterator[RuleOutcome]:
    for rule, partial in zip(rules, summary.partial or (PartialOutcome(),) * len(rules), strict=True):
        try:
            yield whole_outcome(rule, partial)
        except ConfigError:
            if not summary.failed:
                raise
            yield rule.outcome(None, False)


def _remark_damaged(output: OutputFolder, names: Sequence[str]) -> None:
    for part in parts(output.target):
        try:
            read_header(part.path)
        except DamagedError as error:
            output.remarks.append(remake_line(error, part.path))
        name = part.path.relative_to(output.target).as_posix()
        if name not in names:
            output.outdate(name)
    path = output.target / NAME
    if path.exists():
        try:
            read_identification(path)
        except DataError as error:
            output.remarks.append(remake_line(error, path))
