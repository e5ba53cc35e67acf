"""labpipe verify FOLDER"""

from __future__ import annotations

import tempfile
from pathlib import Path

import click

from labpipe.artefacts.mirrored import everything, results_read
from labpipe.artefacts.writing import output_folder
from labpipe.cli import options
from labpipe.cli.many import manner
from labpipe.cli.output import echo
from labpipe.config.pipeline import Pipeline, load_pipeline
from labpipe.errors import ConfigError
from labpipe.pipeline.run import run
from labpipe.places.address import shown
from labpipe.stages.verification import Verified, differences, verified


@click.command()
@click.argument("folder", type=options.PLACE)
@click.option(
    "-c",
    "--config",
    "pipeline_path",
    type=options.PATH,
    metavar="PIPELINE",
    help="The pipeline that made the results: its raw files are compared as well.",
)
@click.option("--again", is_flag=True, help="Run the pipeline again, aside, and compare every artefact byte for byte.")
@options.jobs
@options.overrides
@options.quiet
@options.verbose
def verify(folder: Path, pipeline_path: Path | None, again: bool, jobs: int, overrides: tuple[str, ...], quiet: bool, verbose: bool) -> int:
    """Verify the artefacts below FOLDER: each against the digest of its content, and the files that it was made from.

    FOLDER may be s3://bucket/prefix. Exit code 0 when all holds, 1 when something does not, 2 when nothing could be verified. Results of
    earlier versions carry no digest, which is said and is no fault.

    \b
    labpipe verify out/
    labpipe verify out/ -c pipeline.yaml --again
    """
    if again and pipeline_path is None:
        raise ConfigError("--again: needs the pipeline", hint="name it with -c PIPELINE")
    with results_read(folder, everything) as here:
        artefacts = list(verified(here, None if pipeline_path is None else pipeline_path.parent))
        for artefact in artefacts:
            _echo(artefact, shown(folder / artefact.path.relative_to(here)), verbose)
        faults = sum(bool(artefact.faults) for artefact in artefacts)
        if again and pipeline_path is not None:
            others = _done_again(here, load_pipeline(pipeline_path, overrides), jobs)
            for line in others:
                echo(f"FAILED {line}".replace(str(here), shown(folder)))
            faults += len(others)
    if not quiet:
        undigested = sum("carries no digest" in artefact.remarks for artefact in artefacts)
        inputs = sum(artefact.inputs for artefact in artefacts)
        missing = sum(len(artefact.remarks) for artefact in artefacts) - undigested
        echo(
            f"{len(artefacts)} artefacts: {faults} do not hold; {undigested} without a digest; "
            f"of the files that they name {inputs} are the same, {missing} are not there"
        )
    return 1 if faults else 0


def _done_again(folder: Path, pipeline: Pipeline, jobs: int) -> list[str]:
    """What differs when the pipeline is run again, aside."""
    with tempfile.TemporaryDirectory() as scratch:
        with output_folder(Path(scratch) / "out") as output:
            run(pipeline, output, manner(True, False, jobs, None))
        return differences(folder, Path(scratch) / "out")


def _echo(artefact: Verified, name: str, verbose: bool) -> None:
    for fault in artefact.faults:
        echo(f"FAILED {name}: {fault}")
    for remark in artefact.remarks if verbose else [remark for remark in artefact.remarks if remark == "carries no digest"]:
        echo(f"note   {name}: {remark}")
