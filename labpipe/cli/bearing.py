"""labpipe bearing BEARING [--json FILE] [--sweep KEY=START:STOP:STEP] [-o DIR]"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import click

from labpipe.artefacts.writing import output_file, output_folder
from labpipe.cli import options
from labpipe.cli.bearing_table import echo_bearing, echo_sweep
from labpipe.cli.output import echo
from labpipe.config.bearing import BearingFile, open_bearing
from labpipe.stages.bearing import bearing_entry, bearing_json, evaluated, swept, write_bearing, write_sweep
from labpipe.stages.sweep import parse_sweep


@click.command()
@click.argument("bearing_path", metavar="BEARING", type=options.PATH)
@click.option("--json", "json_path", type=options.PATH, metavar="FILE", help="Write the coefficients as JSON; - for standard output.")
@click.option("--sweep", "sweep_text", metavar="KEY=START:STOP:STEP", help="Vary one entry over a range of values, e.g. loads.z=0:2000:50.")
@click.option("-o", "--output", type=options.PATH, metavar="DIR", help="Folder for table and figures.")
@options.overrides
@options.quiet
@options.verbose
def bearing(
    bearing_path: Path,
    json_path: Path | None,
    sweep_text: str | None,
    output: Path | None,
    overrides: tuple[str, ...],
    quiet: bool,
    verbose: bool,
) -> None:
    """Stiffness and damping of a BEARING model at its load and speed.

    \b
    labpipe bearing configs/bearings/nsk-6208.yaml --set loads.z='700 N'
    labpipe bearing configs/bearings/nsk-6208.yaml --sweep loads.z=0:2000:50 -o out/6208
    """
    if sweep_text is not None:
        if output is None or json_path is not None:
            raise click.UsageError("--sweep needs -o DIR for its table, and has no --json", click.get_current_context())
        _sweep(open_bearing(bearing_path, overrides), sweep_text, output, quiet, options.teller(quiet, verbose))
        return
    file = open_bearing(bearing_path, overrides)
    name = file.settings().name or bearing_path.stem
    whole = evaluated(file)
    text = bearing_json(bearing_entry(file, name, whole))
    if str(json_path) == "-":
        echo(text, nl=False)
        return
    if json_path is not None:
        with output_file(json_path) as target:
            target.write_text(text, encoding="utf-8")
    if output is not None:
        with output_folder(output) as folder:
            names = write_bearing(file, name, whole, folder)
    if not quiet:
        echo_bearing(name, file.kind_name, whole)
        if output is not None:
            echo(f"written to {output}: {', '.join(names)}")


def _sweep(file: BearingFile, sweep_text: str, output: Path, quiet: bool, tell: Callable[[str], None]) -> None:
    sweep = parse_sweep(sweep_text, file.kind.settings)
    tell(f"bearing   {file.path}, {sweep.label}: {sweep.values.size} values")
    points = swept(file, sweep)
    name = file.settings().name or file.path.stem
    with output_folder(output) as folder:
        names = write_sweep(name, sweep, points, folder)
    if not quiet:
        echo_sweep(name, sweep, [point.coefficients for point in points])
        echo(f"written to {output}: {', '.join(names)}")
