"""labpipe identify -c PIPELINE -o DIR [FRF...]"""

from __future__ import annotations

from pathlib import Path

import click

from labpipe.artefacts.header import source_ref
from labpipe.artefacts.writing import OutputFolder, output_folder
from labpipe.cli import options
from labpipe.cli.terminal import echo_identification
from labpipe.config.pipeline import Pipeline, load_pipeline
from labpipe.errors import DataError
from labpipe.stages.identify import identify_stage
from labpipe.stages.measured import MeasuredTest, load_measured, measured_file_name


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
    with output_folder(output) as folder:
        tests = [load_measured(path) for path in frfs] or _pipeline_tests(pipeline, folder)
        inputs = [source_ref(path, path.parent) for path in frfs or _pipeline_paths(pipeline, folder)]
        sources = [*inputs, *(source_ref(path, pipeline.folder) for path in pipeline.side_files)]
        identification = identify_stage(pipeline, tests, sources, folder, inputs=inputs)
    echo_identification(identification, quiet)
    return 0 if identification.accepted else 1


def _pipeline_tests(pipeline: Pipeline, folder: OutputFolder) -> list[MeasuredTest]:
    """The responses or decays of the pipeline's tests; those under frfs: with the name and the conditions of their test."""
    ready = {path: test for test in pipeline.tests for path in test.frfs}
    return [
        load_measured(path, ready[path].name or path.stem, ready[path].conditions) if path in ready else load_measured(path)
        for path in _pipeline_paths(pipeline, folder)
    ]


def _pipeline_paths(pipeline: Pipeline, folder: OutputFolder) -> list[Path]:
    """The response files of the pipeline's tests: in the folder, or those under frfs:."""
    paths: list[Path] = []
    for test in pipeline.tests:
        paths.extend(test.frfs)
        measured_path = folder.read_path(measured_file_name(test.name, pipeline.frf))
        if test.recordings and not measured_path.exists():
            raise DataError("no such file", where=str(measured_path), hint="run `labpipe frf` first, or `labpipe run` for all stages")
        if test.recordings:
            paths.append(measured_path)
    return paths
