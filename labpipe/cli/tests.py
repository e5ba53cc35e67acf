"""labpipe tests PIPELINE"""

from __future__ import annotations

from pathlib import Path

import click

from labpipe.cli import options
from labpipe.cli.output import echo
from labpipe.config.pipeline import load_pipeline


@click.command()
@click.argument("pipeline_path", metavar="PIPELINE", type=options.PATH)
@options.overrides
def tests(pipeline_path: Path, overrides: tuple[str, ...]) -> None:
    """Print the names of the tests of PIPELINE, one in each line, for schedulers that run them one by one with `labpipe run --only`."""
    for test in load_pipeline(pipeline_path, overrides).tests:
        echo(test.name)
