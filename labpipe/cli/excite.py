"""labpipe excite -o FILE ..."""

from __future__ import annotations

from collections.abc import Callable
from math import log2
from pathlib import Path
from typing import TypeVar

import click

from labpipe.cli import options
from labpipe.cli.output import echo
from labpipe.errors import ConfigError
from labpipe.formats.signal_file import write_signal
from labpipe.quantities import UnitError, parse_value
from labpipe.records.setting_values import Setting, to_band
from labpipe.signals.excitation import PHASES, design_multisine
from labpipe.signals.sweep import DIRECTIONS, LAWS, Sweep

Value = TypeVar("Value")


@click.command()
@click.option("-o", "--output", type=options.PATH, required=True, metavar="FILE", help="Signal file: .csv, .parquet or .wav.")
@click.option("--band", default="1-100 Hz", show_default=True, help="Excited band.")
@click.option("--spacing", default="0.5 Hz", show_default=True, help="Spacing of the lines; one period lasts 1 / spacing.")
@click.option("--rate", default="20 kHz", show_default=True, help="Sampling rate.")
@click.option("--periods", type=click.IntRange(min=1), default=6, show_default=True, help="Periods or sweeps written.")
@click.option("--level", default="1 V", show_default=True, help="Root mean square of the signal.")
@click.option("--phases", type=click.Choice(list(PHASES)), default="schroeder", show_default=True, help="Method for the phases.")
@click.option("--odd", is_flag=True, help="Odd lines only: even lines then show even distortion.")
@click.option(
    "--leave-out", type=click.IntRange(min=0), default=0, metavar="N", help="Leave out one line of every N: these show odd distortion."
)
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Seed of random phases and of the lines left out.")
@click.option("--sweep", type=click.Choice(LAWS), default=None, help="A swept sine over the band in place of a multisine.")
@click.option("--direction", type=click.Choice(DIRECTIONS), default="up", show_default=True, help="Of the sweeps.")
@click.option("--length", default="60 s", show_default=True, help="Length of one sweep.")
@click.option("--pause", default="5 s", show_default=True, help="Pause after each sweep, in which the rig comes to rest.")
@options.quiet
def excite(
    output: Path,
    band: str,
    spacing: str,
    rate: str,
    periods: int,
    level: str,
    phases: str,
    odd: bool,
    leave_out: int,
    seed: int,
    sweep: str | None,
    direction: str,
    length: str,
    pause: str,
    quiet: bool,
) -> None:
    """Design a test signal, a multisine or sweeps, and print the crest factor (peak over rms) or the rate."""
    limits = _option("--band", lambda: to_band(band, Setting("band", "", unit="Hz")))
    line_spacing = _option("--spacing", lambda: parse_value(spacing, "Hz"))
    sample_rate = _option("--rate", lambda: parse_value(rate, "Hz"))
    rms = _option("--level", lambda: parse_value(level, "V"))
    if sweep is not None:
        times = _option("--length", lambda: parse_value(length, "s")), _option("--pause", lambda: parse_value(pause, "s"))
        swept = Sweep(limits, times[0], rms, sweep, direction, times[1])
        write_signal(output, swept.samples(sample_rate, periods), sample_rate)
        if not quiet:
            echo(f"{periods} sweep(s) {direction}, {limits[0]:g}-{limits[1]:g} Hz, {sweep}, {_rate(swept)}; pauses of {times[1]:g} s")
        return
    signal = design_multisine(limits, line_spacing, rms, phases=phases, odd_only=odd, leave_out=leave_out, seed=seed)
    write_signal(output, signal.samples(sample_rate, periods), sample_rate)
    if quiet:
        return
    lines = f"{signal.lines.size} lines, {signal.lines[0] * line_spacing:g}-{signal.lines[-1] * line_spacing:g} Hz"
    echo(f"{lines}, period {1 / line_spacing:g} s, {phases} phases: crest factor {signal.crest_factor:.3f}")


def _rate(swept: Sweep) -> str:
    low, high = swept.band
    return (
        f"{(high - low) / swept.duration:.3g} Hz/s"
        if swept.law == "linear"
        else f"{60 * log2(high / low) / swept.duration:.3g} octaves/min"
    )


def _option(name: str, read: Callable[[], Value]) -> Value:
    """The value of an option; ConfigError that names the option."""
    try:
        return read()
    except UnitError as error:
        raise ConfigError(error.what, where=name, hint=error.hint) from None
