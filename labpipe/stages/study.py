"""The section study: the fits of a pipeline repeated on its virtual rig."""

from __future__ import annotations

from labpipe.errors import LabpipeError
from labpipe.records.study import Studies
from labpipe.stages.work import Work
from labpipe.study.settings import StudySettings
from labpipe.study.study import run_study


def run_studies(settings: StudySettings, work: Work) -> Studies:
    """The study of all fits of the pipeline; LabpipeError names the section."""
    pipeline = work.pipeline
    assert settings.virtual_rig is not None
    try:
        return (run_study(settings.virtual_rig, settings, pipeline.fits, pipeline.frf, work.tell, work.jobs),)
    except LabpipeError as error:
        error.where = error.where or f"{pipeline.path}: study"
        raise
