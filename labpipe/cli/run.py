"""labpipe run PIPELINE -o DIR"""

from __future__ import annotations

from pathlib import Path

import click

from labpipe.artefacts.mirrored import results_made
from labpipe.cli import options
from labpipe.cli.many import check_shared, echo_failed, manner
from labpipe.cli.output import echo
from labpipe.cli.terminal import echo_identification
from labpipe.config.pipeline import load_pipeline
from labpipe.pipeline.run import run as run_pipeline
from labpipe.pipeline.run import run_only
from labpipe.places.address import shown
from labpipe.stages.measured import files_of_test
from labpipe.stages.report import outdate_reports, write_reports


@click.command()
@click.argument("pipeline_path", metavar="PIPELINE", type=options.PATH)
@options.out_place
@options.jobs
@options.cluster
@click.option("--only", default="", metavar="TEST", help="Work on this test alone, up to its fits; a run without --only then finishes.")
@options.overrides
@options.quiet
@options.verbose
def run(
    pipeline_path: Path, output: Path, jobs: int, cluster: str | None, only: str, overrides: tuple[str, ...], quiet: bool, verbose: bool
) -> int:
    """Run all stages of PIPELINE: recordings -> FRFs -> identification.json -> report.

    identification.json is written before the report is drawn. Results and reports that are up to date are not made again. When a test
    fails, the others are finished and the failed one is named at the end (exit code 2); an interrupted run continues where it stopped.
    Exit code 1 when an accept: or expect: rule fails.
    """
    how = manner(quiet, verbose, jobs, cluster)
    check_shared(output, cluster)
    pipeline = load_pipeline(pipeline_path, overrides)
    if only:
        with results_made(output, lambda name: name in files_of_test(only)) as here:
            done = run_only(pipeline, here, only)
        echo_failed([done.failed] if done.failed else [])
        return 2 if done.failed else 0
    with results_made(output) as here:
        with options.results_folder(here) as folder:
            identification = run_pipeline(pipeline, folder, how)
            outdate_reports(folder, pipeline.report.formats)
        write_reports(identification, here, pipeline.report.formats, how.tell)
    echo_identification(identification, quiet)
    if not quiet:
        echo(f"written: {shown(output)}/identification.json" + "".join(f", report.{name}" for name in pipeline.report.formats))
    echo_failed(identification.failed)
    return 2 if identification.failed else 0 if identification.accepted else 1
