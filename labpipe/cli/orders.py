"""labpipe orders RECORDING -o DIR"""

from __future__ import annotations

from pathlib import Path

import click

from labpipe.artefacts.writing import output_folder
from labpipe.cli import options
from labpipe.cli.output import echo
from labpipe.config.rig import load_rig
from labpipe.errors import ConfigError
from labpipe.quantities import QUANTITIES, UnitError, parse_value, to_display
from labpipe.records.setting_values import parse_phasor
from labpipe.spectra.settings import ShaftLines
from labpipe.stages.orders import Clearance, order_lines, track_run, write_tracked
from labpipe.stages.orders import save_run_up as table_of


@click.command()
@click.argument("recording", metavar="RECORDING", type=options.PATH)
@options.out_folder
@click.option("-r", "--rig", "rig_path", type=options.PATH, help="Rig file (YAML); a calibrated recording needs none.")
@click.option("--tacho", help="Channel with the tacho pulses.")
@click.option("--pulses", type=click.IntRange(min=1), default=1, show_default=True, help="Pulses per revolution.")
@click.option("--speed", help="Constant speed instead of a tacho, e.g. '50 Hz' or '3000 rpm'.")
@click.option("--order", type=float, default=1.0, show_default=True, help="Multiple of the speed.")
@click.option("--harmonics", type=click.IntRange(min=1), default=2, show_default=True, help="Multiples of the speed in the fit.")
@click.option("--revolutions", type=click.IntRange(min=2), default=20, show_default=True, help="Revolutions per segment.")
@click.option("--gap", help="Radial gap of the bearings, e.g. '0.45 mm', for comparison with the orbits.")
@click.option("--limit", default="20 %", show_default=True, help="Share of the gap beyond which an orbit is reported.")
@click.option("--save-run-up", type=options.PATH, help="Also write a run-up table (CSV) for `run_ups:` of a pipeline.")
@click.option("--load", help="Static load on the bearing, for that table, e.g. '3.66 N'.")
@click.option("--unbalance", multiple=True, metavar="PLANE=SIZE", help="Known unbalance, for that table: 'disc 1=50 g.mm at 0 deg'.")
@options.quiet
def orders(
    recording: Path,
    output: Path,
    rig_path: Path | None,
    tacho: str | None,
    pulses: int,
    speed: str | None,
    order: float,
    harmonics: int,
    revolutions: int,
    gap: str | None,
    limit: str,
    save_run_up: Path | None,
    load: str | None,
    unbalance: tuple[str, ...],
    quiet: bool,
) -> None:
    """Track an order of the shaft speed: amplitude and phase over the run, total motion, orbits, forward and backward.

    Responses with dofs such as front.x and front.y form a plane.

    \b
    labpipe orders run-up.parquet -r rig.yaml --tacho n --gap '0.45 mm' -o out/run-up
    """
    if order <= 0:
        raise ConfigError("--order must be positive")
    lines = ShaftLines(_value("--speed", speed, "Hz"), tacho, pulses, harmonics)
    conditions = None if save_run_up is None else _run_conditions(load, unbalance)
    rig = None if rig_path is None else load_rig(rig_path)
    with output_folder(output) as folder:
        run = track_run(recording, rig, lines, order, revolutions, folder, _clearance(gap, limit))
        names = write_tracked(run, folder)
        speeds = 0 if save_run_up is None or conditions is None else table_of(run, save_run_up, *conditions)
    if quiet:
        return
    between = f"{run.speeds.min():.4g}-{run.speeds.max():.4g} rpm"
    echo(f"{run.name}: order {order:g}, {run.speeds.size} segments of {revolutions} revolutions, {between}")
    quantity = QUANTITIES.get(run.quantity)
    unit = quantity.display_unit if quantity else "SI"
    for row in order_lines(run, unit, lambda value: to_display(value, unit) if quantity else value):
        echo(f"  {row}")
    echo(f"written to {output}: {', '.join(names)}" + (f"; {save_run_up}, {speeds} speeds" if speeds else ""))


def _run_conditions(load: str | None, unbalance: tuple[str, ...]) -> tuple[float, dict[str, complex]]:
    """Load and known unbalances of a run-up, which a recording does not hold; ConfigError for missing ones."""
    newtons = _value("--load", load, "N")
    if newtons is None or not unbalance:
        raise ConfigError("--save-run-up needs --load and --unbalance", hint="--load '3.66 N' --unbalance 'disc 1=50 g.mm at 0 deg'")
    unbalances = {}
    for text in unbalance:
        plane, _, size = text.partition("=")
        try:
            unbalances[plane.strip()] = parse_phasor(size.strip(), "kg.m")
        except UnitError as error:
            raise ConfigError(f"--unbalance {text}: {error.what}", hint=error.hint) from None
    return newtons, unbalances


def _clearance(gap: str | None, limit: str) -> Clearance | None:
    """The gap with its limit; ConfigError for values that are no length and no share."""
    share, length = _value("--limit", limit, "1"), _value("--gap", gap, "m")
    if length is None or share is None:
        return None
    if length <= 0 or share <= 0:
        raise ConfigError("--gap and --limit must be positive")
    return Clearance(length, share)


def _value(option: str, text: str | None, unit: str) -> float | None:
    if text is None:
        return None
    try:
        return parse_value(text, unit)
    except UnitError as error:
        raise ConfigError(f"{option}: {error.what}", hint=error.hint) from None
