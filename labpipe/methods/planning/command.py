"""labpipe plan PLAN -o DIR"""

from __future__ import annotations

from pathlib import Path

import click

from labpipe.cli import options
from labpipe.cli.output import echo


@click.command()
@click.argument("plan_path", metavar="PLAN", type=options.PATH)
@options.out_folder
@options.overrides
@options.quiet
@options.verbose
def plan(plan_path: Path, output: Path, overrides: tuple[str, ...], quiet: bool, verbose: bool) -> None:
    """Plan the test of a PLAN file: signals for the shakers, predicted errors (plan.json, report.html), and
    the pipeline for the test.
    """
    from labpipe.artefacts.writing import output_folder
    from labpipe.methods.planning.plan_file import load_plan, plan_files

    file = load_plan(plan_path, overrides)
    options.teller(quiet, verbose)(f"plan      {file.title}")
    with output_folder(output) as folder:
        sentences, names = plan_files(file, folder)
    if quiet:
        return
    for line in sentences:
        echo(line)
    echo(f"written to {output}: {', '.join(names)}")
