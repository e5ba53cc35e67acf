"""labpipe check PIPELINE..."""

from __future__ import annotations

import tempfile
from pathlib import Path

import click

from labpipe.artefacts.writing import output_folder
from labpipe.cli import options
from labpipe.config.pipeline import load_pipeline
from labpipe.errors import DataError
from labpipe.pipeline.run import Manner, run
from labpipe.records.identification import RuleOutcome


@click.command()
@click.argument("pipelines", nargs=-1, required=True, metavar="PIPELINE...", type=options.PATH)
@options.overrides
@options.quiet
@options.verbose
def check(pipelines: tuple[Path, ...], overrides: tuple[str, ...], quiet: bool, verbose: bool) -> int:
    """Run each PIPELINE from scratch and compare with its expect: and accept: rules; exit code 1 when one fails."""
    tell = options.teller(quiet, verbose)
    failed = 0
    for path in pipelines:
        pipeline = load_pipeline(path, overrides)
        with tempfile.TemporaryDirectory() as scratch, output_folder(Path(scratch) / "out") as folder:
            identification = run(pipeline, folder, Manner(tell))
        for one in identification.failed:
            raise DataError(one.message)
        outcomes = identification.outcomes
        wrong = [outcome for outcome in outcomes if not outcome.passed]
        failed += len(wrong)
        if not quiet:
            click.echo(f"{path}: {len(outcomes) - len(wrong)} of {len(outcomes)} rules hold")
        for outcome in wrong:
            click.echo(_failure(path, outcome))
    return 1 if failed else 0


def _failure(path: Path, outcome: RuleOutcome) -> str:
    return f"{path}: {outcome.section}: {outcome.rule} fails, found {outcome.value}"
