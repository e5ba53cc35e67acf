"""study: the fits of a pipeline repeated on its virtual rig."""

from __future__ import annotations

from collections.abc import Callable

from labpipe.config.pipeline import Pipeline
from labpipe.errors import LabpipeError
from labpipe.records.study import Study
from labpipe.study.study import run_study


def study(pipeline: Pipeline, tell: Callable[[str], None], jobs: int) -> tuple[Study, ...]:
    """The pipeline's study, or none; *jobs* processes, 0 for one per processor."""
    if pipeline.study is None:
        return ()
    try:
        return (run_study(pipeline.study.rig, pipeline.study.settings, pipeline.fits, pipeline.frf, tell, jobs),)
    except LabpipeError as error:
        error.where = error.where or f"{pipeline.path}: study"
        raise
