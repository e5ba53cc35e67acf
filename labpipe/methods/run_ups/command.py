"""labpipe orders RECORDING -o DIR"""

from __future__ import annotations

from typing import Any

import click

from labpipe.cli import options


@click.command()
@click.argument("recording", metavar="RECORDING", type=options.PATH)
@options.out_folder
@click.option(
    "-r", "--rig", "rig_path", type=options.PATH, help="Rig file (YAML); a calibrated recording needs none."
)
@click.option("--tacho", help="Channel with the tacho pulses; default: the rig's, where it has one.")
@click.option(
    "--pulses", type=click.IntRange(min=1), default=1, show_default=True, help="Pulses per revolution."
)
@click.option("--speed", help="Constant speed instead of a tacho, e.g. '50 Hz' or '3000 rpm'.")
@click.option("--order", type=float, default=1.0, show_default=True, help="Multiple of the speed.")
@click.option(
    "--harmonics",
    type=click.IntRange(min=1),
    default=2,
    show_default=True,
    help="Multiples of the speed in the fit.",
)
@click.option(
    "--revolutions",
    type=click.IntRange(min=2),
    default=20,
    show_default=True,
    help="Revolutions per segment.",
)
@click.option("--gap", help="Radial gap of the bearings, e.g. '0.45 mm', for comparison with the orbits.")
@click.option("--limit", help="Share of the gap beyond which an orbit is reported; default: 20 %.")
@click.option(
    "--save-run-up", type=options.PATH, help="Also write a run-up table (CSV) for `run_ups:` of a pipeline."
)
@click.option("--load", help="Static load on the bearing, for that table, e.g. '3.66 N'.")
@click.option(
    "--unbalance",
    multiple=True,
    metavar="PLANE=SIZE",
    help="Known unbalance, for that table: 'disc 1=50 g.mm at 0 deg'.",
)
@click.option("--slow-roll", metavar="BAND", help="Speeds of the slow roll to subtract: '300-600 rpm'.")
@click.option(
    "--speed-range",
    metavar="BAND",
    help="Operating speeds from which critical ones must be apart (API 617, 684): '5000-6200 rpm'. Exit code "
    "1 where a margin is broken or undecided.",
)
@click.option(
    "--baseline",
    type=options.PATH,
    metavar="RECORDING",
    help="The run before --unbalance was added, subtracted for the sensitivity to it.",
)
@click.option(
    "--centreline",
    is_flag=True,
    help="How far the shaft's mean position moves, of probes with their gap voltage.",
)
@options.quiet
def orders(**settings: Any) -> int:
    """Track an order of the shaft speed: amplitude and phase over the run, total motion, orbits, forward and
    backward. A run-up is judged where operating speeds, slow roll or a baseline are named.

    Responses with dofs such as front.x and front.y form a plane.

    \b
    labpipe orders run-up.parquet -r rig.yaml --tacho n --gap '0.45 mm' -o out/run-up
    """
    from labpipe.methods.run_ups.orders import track_and_write

    if settings["speed"] is not None:
        options.refuse_given(("pulses",), "a tacho, which takes the place of --speed")
    return track_and_write(**settings)
