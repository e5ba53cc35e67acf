"""identify: responses or decays -> identification.json, every rule of the pipeline compared with it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from labpipe import __version__
from labpipe.artefacts.digest import DamagedError
from labpipe.artefacts.header import SourceRef, code_digest
from labpipe.artefacts.identification_file import NAME, read_identification, write_identification
from labpipe.artefacts.json_file import entry_of
from labpipe.artefacts.parquet import remake_line
from labpipe.artefacts.writing import OutputFolder
from labpipe.errors import DataError
from labpipe.project.judging import judge
from labpipe.project.measured import MeasuredTest
from labpipe.project.pipeline_file import Pipeline
from labpipe.project.tests import Test
from labpipe.project.work import COMPARE_PREFIX, FIT_PREFIX, Work
from labpipe.records.identification import Failed, Fit, Identification
from labpipe.records.response import shown_part
from labpipe.records.sections import section

# What a result is fresh by.
BASIS = ("sources", "inputs", "settings", "rig", "version", "code")


@dataclass(frozen=True)
class MeasuredTests:
    """What came of all *tests*, and the files behind it: *digests* of each test, *sources* of all;
    *fits* made on the way, tests that *failed*. inputs: digests of what was measured, by which a change of a
    rig or recording reaches the result.
    """

    tests: tuple[MeasuredTest, ...] = ()
    sources: tuple[SourceRef, ...] = ()
    digests: Mapping[str, frozenset[str]] = field(default_factory=dict)
    fits: Mapping[str, Sequence[Fit]] = field(default_factory=dict)
    failed: tuple[Failed, ...] = ()
    inputs: tuple[SourceRef, ...] = ()


def identify_stage(
    pipeline: Pipeline,
    measured: MeasuredTests,
    output: OutputFolder,
    tell: Callable[[str], None] = lambda _: None,
    jobs: int = 0,
) -> Identification:
    """The identification of all tests and sections, made unless the one on disk is fresh. *jobs*: processes
    of the study, 0 for one per processor.
    """
    basis = Identification(
        fits=(),
        sources=tuple(map(entry_of, measured.sources)),
        settings=settings_entry(pipeline, measured.tests),
        rig=rig_entry(pipeline),
        version=__version__,
        failed=measured.failed,
        inputs=tuple(map(entry_of, measured.inputs)),
        code=code_digest(),
    )
    existing = _existing(output)
    if existing is not None and _same_work(existing, basis):
        return existing
    work = Work(
        pipeline,
        measured.tests,
        output,
        tell=tell,
        jobs=jobs,
        digests=measured.digests,
        test_fits=measured.fits,
        failed=list(measured.failed),
    )
    records: dict[str, Any] = {}
    for name, settings in work.pipeline.sections.items():
        entry = section(name)
        record = entry.run(settings, work)
        if entry.fits:
            work.fits.extend(record)
        else:
            records[name] = record
    identification = replace(
        basis,
        fits=tuple(work.fits),
        title=pipeline.title,
        pipeline=pipeline.path.name,
        responses=tuple(shown_part(response) for response in work.responses),
        spectra=tuple(work.spectra),
        outcomes=judge(pipeline.rules, work.fits, records, incomplete=bool(work.failed)),
        failed=tuple(work.failed),
        sections=records,
    )
    write_identification(output.write_path(NAME), identification)
    return identification


def _same_work(existing: Identification, basis: Identification) -> bool:
    of_sections = (COMPARE_PREFIX, FIT_PREFIX)
    failed_tests = tuple(fail for fail in existing.failed if not fail.name.startswith(of_sections))
    same = all(getattr(existing, name) == getattr(basis, name) for name in BASIS)
    return same and failed_tests == basis.failed


def _existing(output: OutputFolder) -> Identification | None:
    path = output.read_path(NAME)
    if not path.exists():
        return None
    try:
        existing = read_identification(path)
    except DataError as error:
        output.remarks.append(remake_line(error, path))
        return None
    if not existing.digest and existing.code == code_digest():
        output.remarks.append(remake_line(DamagedError("carries no digest"), path))
        return None
    return existing


def settings_entry(pipeline: Pipeline, tests: Sequence[MeasuredTest] = ()) -> dict[str, Any]:
    """All settings of a pipeline as JSON; conditions as the *tests* had them."""
    measured = {test.name: test.conditions for test in tests}
    entry: dict[str, Any] = {
        "frf": pipeline.frf,
        **pipeline.sections,
        "rules": [[rule.section, rule.text] for rule in pipeline.rules],
        "tests": [_test_entry(test, measured.get(test.name, {})) for test in pipeline.tests],
        "title": pipeline.title,
        "pipeline": pipeline.path.name,
    }
    return entry_of(entry)


def _test_entry(test: Test, conditions: Mapping[str, Any]) -> dict[str, Any]:
    entry: dict[str, Any] = {"frf": test.frf} if test.frf is not None else {}
    entry |= {"repeats": test.repeats} if test.repeats else {}
    return {"name": test.name, "conditions": {**test.conditions, **conditions}, **entry}


def rig_entry(pipeline: Pipeline) -> dict[str, Any]:
    """The rig as the report shows it."""
    rig = pipeline.first_rig
    return {} if rig is None else entry_of(rig)
