"""labpipe simulate RIG -o DIR [--seed N]"""

from __future__ import annotations

from pathlib import Path

import click

from labpipe.artefacts.writing import output_folder
from labpipe.cli import options
from labpipe.cli.output import echo
from labpipe.config.virtual_rig import load_virtual_rig
from labpipe.stages.simulate import simulate_files


@click.command()
@click.argument("rig_path", metavar="RIG", type=options.PATH)
@options.out_folder
@click.option("--seed", type=click.IntRange(min=0), default=1, show_default=True, help="Seed of the noise; the same seed, the same bytes.")
@click.option("--run", "runs", multiple=True, metavar="NAME", help="Simulate this run only (repeatable); default: all.")
@options.overrides
@options.quiet
@options.verbose
def simulate(
    rig_path: Path, output: Path, seed: int, runs: tuple[str, ...], overrides: tuple[str, ...], quiet: bool, verbose: bool
) -> None:
    """Simulate recordings of a virtual RIG with known truth (truth.json)."""
    rig = load_virtual_rig(rig_path, overrides)
    options.teller(quiet, verbose)(f"simulate  {rig.name}, seed {seed}")
    with output_folder(output) as folder:
        names = simulate_files(rig, seed, runs or None, folder)
    if not quiet:
        echo(f"written to {output}: {', '.join(names)}")
