"""labpipe identify -c PIPELINE -o DIR [FRF...]"""

from __future__ import annotations

from pathlib import Path

import click

from labpipe.artefacts.header import SourceRef, source_ref
from labpipe.artefacts.writing import OutputFolder, output_folder
from labpipe.cli import options
from labpipe.cli.terminal import echo_identification
from labpipe.config.pipeline import Pipeline, load_pipeline
from labpipe.errors import DataError
from labpipe.records.response import FrequencyResponse
from labpipe.stages.frf import DESCRIPTION, frf_file_name, load_ready, load_response, ready_refs
from labpipe.stages.identify import identify_stage


@click.command()
@click.argument("frfs", nargs=-1, metavar="[FRF...]", type=options.PATH)
@options.pipeline_file
@options.out_folder
@options.overrides
@options.quiet
@options.verbose
def identify(frfs: tuple[Path, ...], pipeline_path: Path, output: Path, overrides: tuple[str, ...], quiet: bool, verbose: bool) -> int:
    """Identify parameters from frequency responses: DIR/identification.json.

    Without FRF... the responses of `labpipe frf` in DIR are used, or those under frfs: in the pipeline.
    """
    pipeline = load_pipeline(pipeline_path, overrides)
    options.teller(quiet, verbose)(f"identify  {pipeline.title}")
    with output_folder(output) as folder:
        if frfs:
            responses, inputs = [load_response(path) for path in frfs], [source_ref(path, path.parent) for path in frfs]
        else:
            responses, inputs = _of_pipeline(pipeline, folder)
        files = [reference for reference in inputs if reference.path != DESCRIPTION]
        sources = [*files, *(source_ref(path, pipeline.folder) for path in pipeline.side_files)]
        identification = identify_stage(pipeline, responses, sources, folder, inputs=inputs)
    echo_identification(identification, quiet)
    return 0 if identification.accepted else 1


def _of_pipeline(pipeline: Pipeline, folder: OutputFolder) -> tuple[list[FrequencyResponse], list[SourceRef]]:
    """The responses of the pipeline's tests, in the folder or under frfs: with name and conditions of their test; what they depend on."""
    responses: list[FrequencyResponse] = []
    references: list[SourceRef] = []
    for test in pipeline.tests:
        for ready in test.frfs:
            responses.append(load_ready(ready, test.name, test.conditions))
            references.extend(ready_refs(ready))
        measured_path = folder.read_path(frf_file_name(test.name))
        if test.recordings and not measured_path.exists():
            raise DataError("no such file", where=str(measured_path), hint="run `labpipe frf` first, or `labpipe run` for all stages")
        if test.recordings:
            responses.append(load_response(measured_path))
            references.append(source_ref(measured_path, measured_path.parent))
    return responses, references
