"""labpipe run PIPELINE -o DIR"""

from __future__ import annotations

from pathlib import Path

import click

from labpipe import pipeline as flow
from labpipe.artefacts.writing import output_folder
from labpipe.cli import options
from labpipe.cli.terminal import echo_identification
from labpipe.config.pipeline import load_pipeline
from labpipe.stages.report import write_report


@click.command()
@click.argument("pipeline_path", metavar="PIPELINE", type=options.PATH)
@options.out_folder
@options.overrides
@options.quiet
@options.verbose
def run(pipeline_path: Path, output: Path, overrides: tuple[str, ...], quiet: bool, verbose: bool) -> int:
    """Run all stages of PIPELINE: recordings -> FRFs -> identification.json -> report.

    What is up to date is not computed again. Exit code 1 when an accept: or expect: rule fails.
    """
    tell = options.teller(quiet, verbose)
    pipeline = load_pipeline(pipeline_path, overrides)
    with output_folder(output) as folder:
        identification = flow.run(pipeline, folder, tell)
        for name in pipeline.report.formats:
            tell(f"report    report.{name}")
            write_report(identification, folder.write_path(f"report.{name}"))
    echo_identification(identification, quiet)
    if not quiet:
        click.echo(f"written: {output}/identification.json" + "".join(f", report.{name}" for name in pipeline.report.formats))
    return 0 if identification.accepted else 1
