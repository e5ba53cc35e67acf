"""A pipeline from a script, as `labpipe run` does it."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from labpipe.artefacts.mirrored import results_made
from labpipe.artefacts.writing import output_folder
from labpipe.config.pipeline import load_pipeline
from labpipe.pipeline.executors import in_processes, serially
from labpipe.pipeline.one_test import silent
from labpipe.pipeline.run import Manner
from labpipe.pipeline.run import run as run_pipeline
from labpipe.places.address import path_of
from labpipe.records.identification import Identification
from labpipe.stages.report import outdate_reports, write_reports


def run(pipeline: str | Path, output: str | Path | None = None, overrides: Iterable[str] = (), jobs: int = 1) -> Identification:
    """The result of a pipeline file; with an *output* folder also its files and reports, where fresh results are reused.

    The output may be of an object storage, s3://bucket/prefix.
    *overrides*: as --set takes them, "identify.support.band=60-70 Hz". *jobs*: processes for several tests; a script that asks for more
    than one needs the usual ``if __name__ == "__main__"``. LabpipeError as on the command line; rules that fail are in the result.
    Without a folder the result is whole, however many tests it has; in a folder that of very many is a dataset, read with pandas.
    """
    settings = load_pipeline(Path(pipeline), overrides)
    if output is None:
        settings = replace(settings, results="whole")
    manner = Manner(execute=serially if jobs == 1 else in_processes(jobs), processes=jobs)
    if output is None:
        with tempfile.TemporaryDirectory(prefix="labpipe-") as scratch, output_folder(Path(scratch)) as folder:
            return run_pipeline(settings, folder, manner)
    with results_made(path_of(str(output))) as here:
        with output_folder(here) as folder:
            identification = run_pipeline(settings, folder, manner)
            outdate_reports(folder, settings.report.formats)
        write_reports(identification, here, settings.report.formats, silent)
    return identification
