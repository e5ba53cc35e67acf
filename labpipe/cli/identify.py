"""labpipe identify -c PIPELINE -o DIR [FRF...]"""

from __future__ import annotations

from pathlib import Path

import click

from labpipe.artefacts.header import SourceRef, source_ref
from labpipe.artefacts.writing import OutputFolder
from labpipe.cli import options
from labpipe.cli.many import echo_failed
from labpipe.cli.progress import Progress, silent
from labpipe.cli.terminal import echo_identification
from labpipe.config.pipeline import Pipeline, load_pipeline
from labpipe.errors import DataError
from labpipe.pipeline.run import Manner, identify_many
from labpipe.records.identification import Identification
from labpipe.stages.frf import DESCRIPTION, ready_refs
from labpipe.stages.identify import identify_stage
from labpipe.stages.measured import MeasuredTest, load_measured, load_ready_measured, measured_file_name


@click.command()
@click.argument("frfs", nargs=-1, metavar="[FRF...]", type=options.PATH)
@options.pipeline_file
@options.out_folder
@options.overrides
@options.quiet
@options.verbose
def identify(frfs: tuple[Path, ...], pipeline_path: Path, output: Path, overrides: tuple[str, ...], quiet: bool, verbose: bool) -> int:
    """Identify parameters from frequency responses, or from free decays: DIR/identification.json.

    Without FRF... the responses of `labpipe frf` in DIR are used, or those under frfs: in the pipeline. Of very many tests the results are
    kept as a dataset, as `labpipe run` does.
    """
    pipeline = load_pipeline(pipeline_path, overrides)
    options.teller(quiet, verbose)(f"identify  {pipeline.title}")
    with options.results_folder(output) as folder:
        many = None if frfs else identify_many(pipeline, folder, Manner(progress=silent if quiet else Progress(verbose)))
        identification = many if many is not None else _identified(pipeline, frfs, folder)
    echo_identification(identification, quiet)
    echo_failed(identification.failed)
    return 2 if identification.failed else 0 if identification.accepted else 1


def _identified(pipeline: Pipeline, frfs: tuple[Path, ...], folder: OutputFolder) -> Identification:
    """The result of all tests at once."""
    if frfs:
        tests, inputs = [load_measured(path) for path in frfs], [source_ref(path, path.parent) for path in frfs]
    else:
        tests, inputs = _of_pipeline(pipeline, folder)
    files = [reference for reference in inputs if reference.path != DESCRIPTION]
    sources = [*files, *(source_ref(path, pipeline.folder) for path in pipeline.side_files)]
    return identify_stage(pipeline, tests, sources, folder, inputs=inputs)


def _of_pipeline(pipeline: Pipeline, folder: OutputFolder) -> tuple[list[MeasuredTest], list[SourceRef]]:
    """What the folder holds of the pipeline's tests, or frfs: names, with name and conditions of the test; what they depend on."""
    tests: list[MeasuredTest] = []
    references: list[SourceRef] = []
    for test in pipeline.tests:
        for ready in test.frfs:
            tests.append(load_ready_measured(ready, test.name, test.conditions))
            references.extend(ready_refs(ready))
        measured_path = folder.read_path(measured_file_name(test.name, test.frf or pipeline.frf))
        if test.recordings and not measured_path.exists():
            raise DataError("no such file", where=str(measured_path), hint="run `labpipe frf` first, or `labpipe run` for all stages")
        if test.recordings:
            tests.append(load_measured(measured_path))
            references.append(source_ref(measured_path, measured_path.parent))
    return tests, references
