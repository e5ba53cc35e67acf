"""identify: frequency responses -> identification.json, every rule of the pipeline held against it."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

from labpipe import __version__
from labpipe.artefacts.header import SourceRef
from labpipe.artefacts.identification_file import NAME, read_identification, write_identification
from labpipe.artefacts.writing import OutputFolder
from labpipe.config.pipeline import Pipeline
from labpipe.config.run_ups import run_ups_entry
from labpipe.config.tests import Test
from labpipe.errors import ConfigError, DataError, LabpipeError
from labpipe.identify.fitting import identify
from labpipe.identify.settings import FitSettings
from labpipe.records.identification import Failed, Fit, Identification
from labpipe.records.response import FrequencyResponse
from labpipe.registry import nearest
from labpipe.rigs.unbalance_runs import unbalance_runs
from labpipe.stages.calibrate import calibrate
from labpipe.stages.compare import COMPARE_PREFIX, compare_tests
from labpipe.stages.judging import judge
from labpipe.stages.run_ups import identify_run_ups
from labpipe.stages.study import study
from labpipe.wear.prior import with_prior


def identify_stage(
    pipeline: Pipeline,
    responses: Sequence[FrequencyResponse],
    sources: Sequence[SourceRef],
    output: OutputFolder,
    tell: Callable[[str], None] = lambda _: None,
    jobs: int = 0,
    made: Mapping[str, Sequence[Fit]] = MappingProxyType({}),
    failed: Sequence[Failed] = (),
) -> Identification:
    """The identification of all tests, calibrations and the study of a pipeline, made unless the one on disk is fresh.

    *jobs*: processes of the study, 0 for one per processor. *made*: fits that were made test by test, by their name in the
    pipeline. *failed*: the tests that are missing; a comparison that cannot do without them is missing as well.
    """
    listed = tuple(dataclasses.asdict(source) for source in sources)
    settings = settings_entry(pipeline)
    existing = _existing(output)
    if existing is not None and _same_work(existing, listed, settings, failed):
        return existing
    fits = [*_fits(pipeline, responses, made), *calibrate(pipeline.calibrations)]
    comparisons, missing = compare_tests(pipeline, fits, responses, go_on=bool(failed))
    failed = (*failed, *missing)
    studies = study(pipeline, tell, jobs)
    unbalance = None if pipeline.unbalance is None else unbalance_runs(pipeline.unbalance)
    run_ups = None if pipeline.run_ups is None else identify_run_ups(pipeline.run_ups, output, pipeline.folder, tell)
    identification = Identification(
        fits=tuple(fits),
        title=pipeline.title,
        pipeline=pipeline.path.name,
        sources=listed,
        settings=settings,
        rig=_rig_entry(pipeline),
        responses=tuple(responses),
        outcomes=judge(pipeline.rules, fits, studies, comparisons, unbalance, run_ups, incomplete=bool(failed)),
        studies=studies,
        comparisons=comparisons,
        unbalance=unbalance,
        run_ups=run_ups,
        version=__version__,
        failed=tuple(failed),
    )
    write_identification(output.write_path(NAME), identification)
    return identification


def _same_work(existing: Identification, sources: tuple[dict[str, str], ...], settings: dict[str, Any], failed: Sequence[Failed]) -> bool:
    tests_failed = tuple(one for one in existing.failed if not one.name.startswith(COMPARE_PREFIX))
    return (existing.sources, existing.settings, existing.version, tests_failed) == (sources, settings, __version__, tuple(failed))


def _existing(output: OutputFolder) -> Identification | None:
    """The result on disk, or None when there is none that this version reads."""
    path = output.read_path(NAME)
    if not path.exists():
        return None
    try:
        return read_identification(path)
    except DataError:
        return None


def _fits(pipeline: Pipeline, responses: Sequence[FrequencyResponse], made: Mapping[str, Sequence[Fit]]) -> list[Fit]:
    fits: list[Fit] = []
    for settings in pipeline.fits:
        if settings.name in made:
            fits.extend(made[settings.name])
        else:
            check_tested(settings, [response.name for response in responses])
            fits.extend(fits_of(responses, with_prior(settings, fits), pipeline.path))
    return fits


def fits_of(responses: Sequence[FrequencyResponse], settings: FitSettings, pipeline_path: Path) -> list[Fit]:
    """The fits of the responses whose test the settings name, or of all; LabpipeError names fit and test."""
    fits: list[Fit] = []
    for response in responses:
        if settings.test and response.name not in settings.test:
            continue
        try:
            found = identify(response, settings)
        except LabpipeError as error:
            test = f", test {response.name}" if response.name else ""
            error.where = error.where or f"{pipeline_path}: identify.{settings.name}{test}"
            raise
        fits.extend(dataclasses.replace(fit, test=response.name) for fit in found)
    return fits


def check_tested(settings: FitSettings, known: Sequence[str]) -> None:
    """ConfigError when a fit names a test that is not *known*."""
    for name in settings.test:
        if name not in known:
            raise ConfigError(f"identify.{settings.name}.test: no test '{name}'", hint=nearest(name, known))


def settings_entry(pipeline: Pipeline) -> dict[str, Any]:
    """All settings of a pipeline as JSON holds them, so that another lab can repeat the work."""
    entry: dict[str, Any] = {
        "frf": None if pipeline.frf is None else dataclasses.asdict(pipeline.frf),
        "identify": [dataclasses.asdict(fit) for fit in pipeline.fits],
        "calibrate": [{**dataclasses.asdict(c), "path": c.table} for c in pipeline.calibrations],
        "compare": [dataclasses.asdict(settings) for settings in pipeline.comparisons],
        "rules": [[rule.section, rule.text] for rule in pipeline.rules],
        "tests": [_test_entry(test) for test in pipeline.tests],
        "title": pipeline.title,
        "pipeline": pipeline.path.name,
    }
    if pipeline.study is not None:
        entry["study"] = {**dataclasses.asdict(pipeline.study.settings), "virtual_rig": dataclasses.asdict(pipeline.study.rig)}
    if pipeline.unbalance is not None:
        entry["unbalance"] = dataclasses.asdict(pipeline.unbalance)
    if pipeline.run_ups is not None:
        entry["run_ups"] = run_ups_entry(pipeline.run_ups)
    return json.loads(json.dumps(entry))  # type: ignore[no-any-return]


def _test_entry(test: Test) -> dict[str, Any]:
    """Name and conditions of a test, and the digests of the rigs that recorded it: other calibrations make another result."""
    rigs = (json.dumps(dataclasses.asdict(source.rig)) for source in test.recordings)
    return {"name": test.name, "conditions": test.conditions, "rigs": [hashlib.sha256(rig.encode()).hexdigest() for rig in rigs]}


def _rig_entry(pipeline: Pipeline) -> dict[str, Any]:
    """The rig as the report shows it."""
    rig = pipeline.rig or next((source.rig for test in pipeline.tests for source in test.recordings), None)
    return {} if rig is None else json.loads(json.dumps(dataclasses.asdict(rig)))
