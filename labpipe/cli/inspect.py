"""labpipe inspect FILE [-o CARD]"""

from __future__ import annotations

from pathlib import Path

import click

from labpipe.cli import options
from labpipe.config.rig import load_rig
from labpipe.records.overview import Overview
from labpipe.records.response import FORMS, FrequencyResponse, Port
from labpipe.stages.inspect import inspect as look_into
from labpipe.stages.inspect import write_card
from labpipe.stages.report import format_of


@click.command()
@click.argument("file", type=options.PATH)
@click.option("-r", "--rig", "rig_path", type=options.PATH, help="Rig file against which names, units and rate are held.")
@click.option("-o", "--output", type=options.PATH, metavar="CARD", help="Also a card with small plots; its ending: .html, .pdf, .md.")
def inspect(file: Path, rig_path: Path | None, output: Path | None) -> None:
    """Show what is in a recording or an FRF: channels, units, rate, length, gaps, clipping, levels.

    \b
    labpipe inspect run.tdms -r rig.yaml -o card.html
    """
    if output is not None:
        format_of(output)
    seen = look_into(file, None if rig_path is None else load_rig(rig_path))
    if output is not None:
        write_card(seen, file.name, output)
    if isinstance(seen, FrequencyResponse):
        _echo_response(seen, file.name)
    else:
        _echo_recording(seen)
    if output is not None:
        click.echo(f"written: {output}", err=True)


def _echo_response(response: FrequencyResponse, file: str) -> None:
    frequency = response.frequency
    lines = f"{frequency.size} lines, {frequency[0]:g} to {frequency[-1]:g} Hz"
    click.echo(f"{file}: {response.form} [{FORMS[response.form]}], {lines}")
    for title, ports in (("responses", response.outputs), ("forces", response.inputs)):
        click.echo(f"  {title:<9} " + ", ".join(_port(port) for port in ports))
    known = [name for name in ("covariance", "coherence") if getattr(response, name) is not None]
    click.echo(f"  with {' and '.join(known)}" if known else "  without covariance or coherence")


def _port(port: Port) -> str:
    return port.label if port.dof == port.label else f"{port.label} ({port.dof})"


def _echo_recording(seen: Overview) -> None:
    if seen.kind == "raw file":
        click.echo(f"{seen.file}: {seen.n_sample} rows, {len(seen.channels)} columns, {seen.rate}")
        labels = [channel.label for channel in seen.channels]
    else:
        click.echo(f"{seen.kind} {seen.file}: {seen.n_sample} samples, {seen.rate}")
        labels = [f"{channel.name} [{channel.unit}] {channel.about}" for channel in seen.channels]
    width = max(len(label) for label in labels)
    click.echo(f"  {'channel':<{width}}{'min':>13}{'max':>13}{'mean':>13}{'rms (ac)':>13}")
    for label, one in zip(labels, seen.channels, strict=True):
        click.echo(f"  {label:<{width}}" + "".join(f"{value:>13.5g}" for value in (one.minimum, one.maximum, one.mean, one.rms)))
    for finding in seen.findings:
        click.echo(f"  {finding.level} {finding.code}: {finding.message}")
    if not seen.findings:
        click.echo("  no gaps, no clipping")
    for contradiction in seen.contradictions or ():
        click.echo(f"  warning rig: {contradiction}")
