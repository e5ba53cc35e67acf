"""labpipe excite -o FILE ..."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import click

from labpipe.cli import options
from labpipe.errors import ConfigError
from labpipe.formats.signal_file import write_signal
from labpipe.quantities import UnitError, parse_value
from labpipe.records.setting_values import Setting, to_band
from labpipe.signals.excitation import PHASES, design_multisine

Value = TypeVar("Value")


@click.command()
@click.option("-o", "--output", type=options.PATH, required=True, metavar="FILE", help="Signal file: .csv, .parquet or .wav.")
@click.option("--band", default="1-100 Hz", show_default=True, help="Excited band.")
@click.option("--spacing", default="0.5 Hz", show_default=True, help="Spacing of the lines; one period lasts 1 / spacing.")
@click.option("--rate", default="20 kHz", show_default=True, help="Sampling rate.")
@click.option("--periods", type=click.IntRange(min=1), default=6, show_default=True, help="Periods written.")
@click.option("--level", default="1 V", show_default=True, help="Root mean square of the signal.")
@click.option("--phases", type=click.Choice(list(PHASES)), default="schroeder", show_default=True, help="Method for the phases.")
@click.option("--odd", is_flag=True, help="Odd lines only: even lines then show even distortion.")
@click.option(
    "--leave-out", type=click.IntRange(min=0), default=0, metavar="N", help="Leave out one line of every N: these show odd distortion."
)
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Seed of random phases and of the lines left out.")
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
    quiet: bool,
) -> None:
    """Design a periodic test signal and print its crest factor (peak over rms)."""
    limits = _option("--band", lambda: to_band(band, Setting("band", "", unit="Hz")))
    line_spacing = _option("--spacing", lambda: parse_value(spacing, "Hz"))
    sample_rate = _option("--rate", lambda: parse_value(rate, "Hz"))
    rms = _option("--level", lambda: parse_value(level, "V"))
    signal = design_multisine(limits, line_spacing, rms, phases=phases, odd_only=odd, leave_out=leave_out, seed=seed)
    write_signal(output, signal.samples(sample_rate, periods), sample_rate)
    if quiet:
        return
    lines = f"{signal.lines.size} lines, {signal.lines[0] * line_spacing:g}-{signal.lines[-1] * line_spacing:g} Hz"
    click.echo(f"{lines}, period {1 / line_spacing:g} s, {phases} phases: crest factor {signal.crest_factor:.3f}")


def _option(name: str, read: Callable[[], Value]) -> Value:
    """The value of an option; ConfigError that names the option."""
    try:
        return read()
    except UnitError as error:
        raise ConfigError(error.what, where=name, hint=error.hint) from None
