"""The uncertainty budget of a test that is still planned: the pipeline that will evaluate it, run on rehearsed recordings."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import yaml

from labpipe.config.pipeline import Pipeline, load_pipeline
from labpipe.config.plan import PlanFile
from labpipe.identify.fitting import identify
from labpipe.planner.campaigns import Rig
from labpipe.planner.plan import planned_test
from labpipe.planner.rehearsal import rehearsed
from labpipe.planner.schemes import Multisines
from labpipe.planner.settings import PlanSettings
from labpipe.planner.uncertainty import Rehearse
from labpipe.records.budget import Budget
from labpipe.records.identification import Fit
from labpipe.spectra.all_channels import channel_spectra
from labpipe.spectra.measurement import measure
from labpipe.stages.plan_evaluation import PIPELINE, RIG, Evaluation, check_rig, pipeline_entries, rig_entries


def rig_path(file: PlanFile) -> Path | None:
    """The rig file that a plan names, if any."""
    settings: PlanSettings = file.settings
    return (file.path.parent / settings.rig).absolute() if settings.rig else None


def rehearsal(file: PlanFile) -> Rehearse | None:
    """What gives the budget of tests; None where nothing but noise is in doubt. ConfigError for a rig without the channels."""
    settings: PlanSettings = file.settings
    if settings.sensors is not None:
        check_rig(settings.sensors, settings, settings.shakers or settings.kind.axes)
    of_sensors = settings.sensors is not None and any(channel.channel.doubts for channel in settings.sensors.channels)
    if not of_sensors and not settings.doubts:
        return None

    def budget(rig: Rig, tests: Sequence[Multisines], periods: Sequence[int]) -> Budget | None:
        planned = tuple(planned_test(settings, rig, test, number) for test, number in zip(tests, periods, strict=True))
        with_masses = any(name[0] == "m" for name in rig.model.names)
        with tempfile.TemporaryDirectory() as folder:
            pipeline = _loaded(Evaluation(settings, file.title, planned, with_masses, rig_path(file)), Path(folder))
        return _of_coefficients(_fit(pipeline, rig, tests, periods), rig.model.names)

    return budget


def _loaded(evaluation: Evaluation, folder: Path) -> Pipeline:
    """The pipeline of an evaluation as it will be read, its recordings empty."""
    if evaluation.rig_path is None:
        (folder / RIG).write_text(yaml.safe_dump(rig_entries(evaluation)), encoding="utf-8")
    (folder / PIPELINE).write_text(yaml.safe_dump(pipeline_entries(evaluation, folder)), encoding="utf-8")
    (folder / "recordings").mkdir()
    for test in evaluation.tests:
        (folder / "recordings" / f"{test.name}.csv").touch()
    return load_pipeline(folder / PIPELINE)


def _fit(pipeline: Pipeline, rig: Rig, tests: Sequence[Multisines], periods: Sequence[int]) -> Fit:
    """The fit of the pipeline to the tests as they are expected."""
    (whole,), settings = pipeline.tests, pipeline.frf
    assert settings is not None
    highest = max(int(test.lines[-1]) for test in tests)
    recordings = [
        rehearsed(
            rig,
            test,
            [channel.channel for channel in source.rig.channels if channel.channel.role != "reference"],
            number / rig.spacing,
            settings.skip,
            highest,
        )
        for source, test, number in zip(whole.recordings, tests, periods, strict=True)
    ]
    make = channel_spectra if settings.result == "spectra" else measure
    (fit,) = identify(make(recordings, settings), pipeline.fits[0], judging=False)
    return fit


def _of_coefficients(fit: Fit, names: Sequence[str]) -> Budget | None:
    """The budget of the coefficients of those *names*; None where no source changes any."""
    if fit.budget is None:
        return None
    columns = [fit.budget.names.index(name) for name in names]
    whole = fit.budget
    return Budget(tuple(names), whole.random[columns], whole.random_dof, whole.sources, whole.changes[:, columns])
