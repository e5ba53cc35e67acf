"""labpipe report DIR|identification.json -o FILE"""

from __future__ import annotations

from pathlib import Path

import click

from labpipe.artefacts.identification_file import NAME, read_identification
from labpipe.cli import options
from labpipe.stages.report import write_report


@click.command()
@click.argument("result", metavar="DIR|identification.json", type=options.PATH)
@click.option(
    "-o",
    "--output",
    required=True,
    type=options.PATH,
    metavar="FILE",
    help="Report file; its ending (.html, .pdf, .md) chooses the format.",
)
@options.quiet
@options.verbose
def report(result: Path, output: Path, quiet: bool, verbose: bool) -> None:
    """Write the report of a result: verdict, parameters, figures, warnings, provenance."""
    identification = read_identification(result / NAME if result.is_dir() else result)
    options.teller(quiet, verbose)(f"report    {identification.title}")
    write_report(identification, output)
    if not quiet:
        click.echo(f"written: {output}", err=True)
