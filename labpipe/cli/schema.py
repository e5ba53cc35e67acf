"""labpipe schema [rig|pipeline]"""

from __future__ import annotations

import json
from pathlib import Path

import click

from labpipe.artefacts.writing import output_file
from labpipe.cli import options
from labpipe.cli.output import echo
from labpipe.config.schema import pipeline_schema, rig_schema

SCHEMAS = {"pipeline": pipeline_schema, "rig": rig_schema}


@click.command()
@click.argument("kind", type=click.Choice(list(SCHEMAS)), default="pipeline")
@click.option("-o", "--output", type=options.PATH, metavar="FILE", help="File to write; default: standard output.")
def schema(kind: str, output: Path | None) -> None:
    """Print the JSON schema of a pipeline or rig file.

    Editors with support for YAML schemas complete and check a file that begins with the line
    `# yaml-language-server: $schema=pipeline.schema.json`.
    """
    text = json.dumps(SCHEMAS[kind](), indent=2) + "\n"
    if output is None:
        echo(text, nl=False)
        return
    with output_file(output) as target:
        target.write_text(text, encoding="utf-8")
