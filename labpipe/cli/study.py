"""labpipe study PIPELINE -o DIR"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import click

from labpipe.artefacts.writing import output_folder
from labpipe.cli import options
from labpipe.cli.output import echo
from labpipe.cli.terminal import echo_identification
from labpipe.config.pipeline import load_pipeline
from labpipe.errors import ConfigError
from labpipe.formats.study_csv import write_study_csv
from labpipe.stages.identify import identify_stage
from labpipe.stages.report import outdate_reports, write_reports

STUDY = "study"


@click.command()
@click.argument("pipeline_path", metavar="PIPELINE", type=options.PATH)
@options.out_folder
@click.option("-j", "--jobs", type=click.IntRange(min=0), default=0, help="Processes; default: one per processor.")
@options.overrides
@options.quiet
@options.verbose
def study(pipeline_path: Path, output: Path, jobs: int, overrides: tuple[str, ...], quiet: bool, verbose: bool) -> int:
    """Repeat the fits of PIPELINE on its virtual rig: bias, scatter against the Cramer-Rao bound, coverage, success.

    Writes identification.json, study.csv and the report. The same seed gives the same results on any number of processes.
    """
    pipeline = load_pipeline(pipeline_path, overrides)
    if STUDY not in pipeline.sections:
        raise ConfigError("study: is missing", where=str(pipeline_path), hint="name a virtual rig and noise levels")
    rules = tuple(rule for rule in pipeline.rules if rule.fit == STUDY)
    # The fits are repeated, not made.
    alone = replace(pipeline, tests=(), rules=rules, sections={"identify": pipeline.fits, STUDY: pipeline.sections[STUDY]})
    with output_folder(output) as folder:
        identification = identify_stage(alone, (), (), folder, options.teller(quiet, verbose), jobs)
        write_study_csv(folder.write_path("study.csv"), identification.sections[STUDY][0])
        outdate_reports(folder, pipeline.report.formats)
    write_reports(identification, output, pipeline.report.formats, options.teller(quiet, verbose))
    echo_identification(identification, quiet)
    if not quiet:
        echo(f"written: {output}/identification.json, study.csv" + "".join(f", report.{name}" for name in pipeline.report.formats))
    return 0 if identification.accepted else 1
