"""labpipe init DIR"""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

import click

from labpipe.artefacts.writing import output_folder
from labpipe.cli import options
from labpipe.errors import ConfigError
from labpipe.simulate.settings import VirtualRig
from labpipe.stages.simulate import simulate_files

SCAFFOLD = ("rig.yaml", "pipeline.yaml")


@click.command()
@click.argument("folder", metavar="DIR", type=options.PATH)
def init(folder: Path) -> None:
    """Scaffold a project in DIR: rig.yaml, pipeline.yaml and a sample recording; it runs as it is."""
    taken = [name for name in SCAFFOLD if (folder / name).exists()]
    if taken:
        raise ConfigError(f"already holds {', '.join(taken)}", where=str(folder), hint="name a new folder")
    with output_folder(folder) as output:
        for name in SCAFFOLD:
            output.write_path(name).write_bytes(files("labpipe.cli").joinpath("scaffold", name).read_bytes())
        simulate_files(VirtualRig("virtual-magnetic-rig"), 1, ["pedestal"], output)
    click.echo(f"written to {folder}: {', '.join(SCAFFOLD)}, pedestal.csv, truth.json")
    click.echo(f"next: labpipe run {folder / 'pipeline.yaml'} -o {folder / 'out'}")
