"""labpipe export ARTEFACT --to FORMAT -o FILE"""

from __future__ import annotations

from pathlib import Path

import click

from labpipe.artefacts.writing import output_file
from labpipe.cli import options
from labpipe.formats.exports import WRITERS


@click.command()
@click.argument("artefact", type=options.PATH)
@click.option("--to", "target_format", type=click.Choice(WRITERS.names()), required=True, help="Format of the file.")
@click.option("-o", "--output", type=options.PATH, required=True, metavar="FILE", help="File to write.")
def export(artefact: Path, target_format: str, output: Path) -> None:
    """Write a recording, free decays, a frequency response, or the parameters or mode shapes of an identification for other programs.

    Of an identification csv and parquet hold the parameters, shapes (a table) and uff (records 15, 82 and 55) the mode shapes.
    """
    table = WRITERS.load(target_format)
    with output_file(output) as target:
        table(artefact, target)
