"""labpipe ingest SOURCE... -r RIG -o DIR"""

from __future__ import annotations

from pathlib import Path

import click

from labpipe.cli import options
from labpipe.cli.output import echo
from labpipe.config.rig import load_rig
from labpipe.stages.ingest import ingest_all


@click.command()
@click.argument("sources", nargs=-1, required=True, metavar="SOURCE...", type=options.PATH)
@click.option("-r", "--rig", "rig_path", required=True, type=options.PATH, help="Rig file (YAML).")
@options.out_folder
@options.overrides
@options.quiet
@options.verbose
def ingest(sources: tuple[Path, ...], rig_path: Path, output: Path, overrides: tuple[str, ...], quiet: bool, verbose: bool) -> None:
    """Calibrate raw files to SI units: SOURCE... -> DIR/*.recording.parquet."""
    rig = load_rig(rig_path, overrides)
    options.teller(quiet, verbose)(f"ingest    {len(sources)} file(s)")
    with options.results_folder(output) as folder:
        recordings = ingest_all(sources, rig, folder, Path.cwd())
    for recording in recordings:
        if not quiet:
            seconds = recording.n_sample / recording.sample_rate
            echo(f"{recording.name}: {recording.n_sample} samples, {recording.sample_rate:g} Hz, {seconds:g} s")
        for finding in recording.findings:
            echo(f"  {finding.level} {finding.code}: {finding.message}")
