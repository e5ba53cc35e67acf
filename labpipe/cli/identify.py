"""labpipe identify -c PIPELINE -o DIR [FRF...]"""

from __future__ import annotations

from pathlib import Path

import click

from labpipe.artefacts.header import SourceRef, source_ref
from labpipe.artefacts.writing import OutputFolder
from labpipe.cli import options
from labpipe.cli.terminal import echo_identification
from labpipe.config.pipeline import Pipeline, load_pipeline
from labpipe.errors import DataError
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

    Without FRF... the responses of `labpipe frf` in DIR are used, or those under frfs: in the pipeline.
    """
    pipeline = load_pipeline(pipeline_path, overrides)
    options.teller(quiet, verbose)(f"identify  {pipeline.title}")
    with options.results_folder(output) as folder:
        if frfs:
            tests, inputs = [load_measured(path) for path in frfs], [source_ref(path, path.parent) for path in frfs]
        else:
            tests, inputs = _of_pipeline(pipeline, folder)
        files = [reference for reference in inputs if reference.path != DESCRIPTION]
        sources = [*files, *(source_ref(path, pipeline.folder) for path in pipeline.side_files)]
        identification = identify_stage(pipeline, tests, sources, folder, inputs=inputs)
    echo_identification(identification, quiet)
    return 0 if identification.accepted else 1


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
