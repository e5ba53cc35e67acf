"""identify: frequency responses -> identification.json, every rule of the pipeline held against it."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Sequence
from typing import Any

from labpipe import __version__
from labpipe.artefacts.header import SourceRef
from labpipe.artefacts.identification_file import NAME, read_identification, write_identification
from labpipe.artefacts.writing import OutputFolder
from labpipe.config.pipeline import Pipeline
from labpipe.errors import ConfigError, DataError, LabpipeError
from labpipe.identify.fitting import identify
from labpipe.identify.settings import FitSettings
from labpipe.identify.unbalance import unbalance_runs
from labpipe.identify.worn_prior import with_prior
from labpipe.records.identification import Fit, Identification
from labpipe.records.response import FrequencyResponse
from labpipe.registry import nearest
from labpipe.stages.calibrate import calibrate
from labpipe.stages.compare import compare_tests
from labpipe.stages.judging import judge
from labpipe.stages.study import study


def identify_stage(
    pipeline: Pipeline,
    responses: Sequence[FrequencyResponse],
    sources: Sequence[SourceRef],
    output: OutputFolder,
    tell: Callable[[str], None] = lambda _: None,
    jobs: int = 0,
) -> Identification:
    """The identification of all tests, calibrations and the study of a pipeline, made unless the one on disk is fresh.

    *jobs*: processes of the study, 0 for one per processor.
    """
    listed = tuple(dataclasses.asdict(source) for source in sources)
    settings = settings_entry(pipeline)
    existing = _existing(output)
    if existing is not None and (existing.sources, existing.settings, existing.version) == (listed, settings, __version__):
        return existing
    fits = [*_fits(pipeline, responses), *calibrate(pipeline.calibrations)]
    comparisons = compare_tests(pipeline, fits, responses)
    studies = study(pipeline, tell, jobs)
    unbalance = None if pipeline.unbalance is None else unbalance_runs(pipeline.unbalance)
    identification = Identification(
        fits=tuple(fits),
        title=pipeline.title,
        pipeline=pipeline.path.name,
        sources=listed,
        settings=settings,
        rig=_rig_entry(pipeline),
        responses=tuple(responses),
        outcomes=judge(pipeline.rules, fits, studies, comparisons, unbalance),
        studies=studies,
        comparisons=comparisons,
        unbalance=unbalance,
        version=__version__,
    )
    write_identification(output.write_path(NAME), identification)
    return identification


def _existing(output: OutputFolder) -> Identification | None:
    """The result on disk, or None when there is none that this version reads."""
    path = output.read_path(NAME)
    if not path.exists():
        return None
    try:
        return read_identification(path)
    except DataError:
        return None


def _fits(pipeline: Pipeline, responses: Sequence[FrequencyResponse]) -> list[Fit]:
    fits: list[Fit] = []
    for settings in pipeline.fits:
        for response in _tested(settings, responses):
            try:
                found = identify(response, with_prior(settings, fits))
            except LabpipeError as error:
                test = f", test {response.name}" if response.name else ""
                error.where = error.where or f"{pipeline.path}: identify.{settings.name}{test}"
                raise
            fits.extend(dataclasses.replace(fit, test=response.name) for fit in found)
    return fits


def _tested(settings: FitSettings, responses: Sequence[FrequencyResponse]) -> list[FrequencyResponse]:
    """The responses of the tests that a fit names; all where it names none."""
    known = [response.name for response in responses]
    for name in settings.test:
        if name not in known:
            raise ConfigError(f"identify.{settings.name}.test: no test '{name}'", hint=nearest(name, known))
    return [response for response in responses if not settings.test or response.name in settings.test]


def settings_entry(pipeline: Pipeline) -> dict[str, Any]:
    """All settings of a pipeline as JSON holds them, so that another lab can repeat the work."""
    entry: dict[str, Any] = {
        "frf": None if pipeline.frf is None else dataclasses.asdict(pipeline.frf),
        "identify": [dataclasses.asdict(fit) for fit in pipeline.fits],
        "calibrate": [{**dataclasses.asdict(c), "path": c.table} for c in pipeline.calibrations],
        "compare": [dataclasses.asdict(settings) for settings in pipeline.comparisons],
        "rules": [[rule.section, rule.text] for rule in pipeline.rules],
        "tests": [{"name": test.name, "conditions": test.conditions} for test in pipeline.tests],
        "title": pipeline.title,
        "pipeline": pipeline.path.name,
    }
    if pipeline.study is not None:
        entry["study"] = {**dataclasses.asdict(pipeline.study.settings), "virtual_rig": dataclasses.asdict(pipeline.study.rig)}
    if pipeline.unbalance is not None:
        entry["unbalance"] = dataclasses.asdict(pipeline.unbalance)
    return json.loads(json.dumps(entry))  # type: ignore[no-any-return]


def _rig_entry(pipeline: Pipeline) -> dict[str, Any]:
    """The rig as the report shows it."""
    rig = pipeline.rig or next((source.rig for test in pipeline.tests for source in test.recordings), None)
    return {} if rig is None else json.loads(json.dumps(dataclasses.asdict(rig)))
