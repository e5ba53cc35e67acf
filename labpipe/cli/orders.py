"""labpipe orders RECORDING -o DIR"""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np

from labpipe.artefacts.writing import output_folder
from labpipe.cli import options
from labpipe.config.rig import load_rig
from labpipe.errors import ConfigError
from labpipe.quantities import UnitError, parse_value
from labpipe.spectra.settings import ShaftLines
from labpipe.stages.orders import track_run, write_tracked


@click.command()
@click.argument("recording", metavar="RECORDING", type=options.PATH)
@options.out_folder
@click.option("-r", "--rig", "rig_path", type=options.PATH, help="Rig file (YAML); a calibrated recording needs none.")
@click.option("--tacho", help="Channel with the tacho's pulses.")
@click.option("--pulses", type=click.IntRange(min=1), default=1, show_default=True, help="Pulses per revolution.")
@click.option("--speed", help="Constant speed instead of a tacho, e.g. '50 Hz' or '3000 rpm'.")
@click.option("--order", type=float, default=1.0, show_default=True, help="Multiple of the speed.")
@click.option("--harmonics", type=click.IntRange(min=1), default=2, show_default=True, help="Multiples fitted along.")
@click.option("--revolutions", type=click.IntRange(min=2), default=20, show_default=True, help="Revolutions of one stretch.")
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
    quiet: bool,
) -> None:
    """Track an order of the shaft speed: amplitude and phase over the run, orbits, forward and backward."""
    if order <= 0:
        raise ConfigError("--order must be positive")
    lines = ShaftLines(_speed(speed), tacho, pulses, harmonics)
    rig = None if rig_path is None else load_rig(rig_path)
    with output_folder(output) as folder:
        run = track_run(recording, rig, lines, order, revolutions, folder)
        names = write_tracked(run, folder)
    if quiet:
        return
    speeds = 60 * run.track.speed
    between = f"{speeds.min():.4g}-{speeds.max():.4g} rpm"
    click.echo(f"{run.name}: order {order:g}, {speeds.size} stretches of {revolutions} revolutions, {between}")
    for track in (run.track, run.circles):
        for number, port in enumerate(track.ports if track is not None else ()):
            size = np.abs(track.amplitude[:, number]) if track is not None else np.empty(0)
            peak = int(np.argmax(size))
            click.echo(f"  {port.label:<6} largest {size[peak]:.4g} (SI, 0-to-peak) at {speeds[peak]:.4g} rpm")
    click.echo(f"written to {output}: {', '.join(names)}")


def _speed(text: str | None) -> float | None:
    if text is None:
        return None
    try:
        return parse_value(text, "Hz")
    except UnitError as error:
        raise ConfigError(f"--speed: {error.what}", hint=error.hint) from None
