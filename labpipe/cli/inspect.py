"""labpipe inspect FILE [-o CARD]"""

from __future__ import annotations

from pathlib import Path

import click

from labpipe.cli import options
from labpipe.cli.output import echo
from labpipe.config.rig import load_rig
from labpipe.records.channel_spectra import ChannelSpectra
from labpipe.records.overview import Overview
from labpipe.records.response import FORMS, FrequencyResponse, Port
from labpipe.stages.inspect import inspect as content_of
from labpipe.stages.inspect import write_card
from labpipe.stages.report import format_of


@click.command()
@click.argument("file", type=options.PATH)
@click.option("-r", "--rig", "rig_path", type=options.PATH, help="Rig file to compare names, units and rate with.")
@click.option("-o", "--output", type=options.PATH, metavar="CARD", help="Also write a card with small plots (.html, .pdf, .md).")
def inspect(file: Path, rig_path: Path | None, output: Path | None) -> None:
    """Show the content of a recording, an FRF or spectra: channels, units, rate, length, gaps, clipping, levels.

    \b
    labpipe inspect run.tdms -r rig.yaml -o card.html
    """
    if output is not None:
        format_of(output)
    content = content_of(file, None if rig_path is None else load_rig(rig_path))
    if output is not None:
        write_card(content, file.name, output)
    if isinstance(content, FrequencyResponse):
        _echo_response(content, file.name)
    elif isinstance(content, ChannelSpectra):
        _echo_spectra(content, file.name)
    else:
        _echo_recording(content)
    if output is not None:
        echo(f"written: {output}", err=True)


def _echo_response(response: FrequencyResponse, file: str) -> None:
    frequency = response.frequency
    lines = f"{frequency.size} lines, {frequency[0]:g} to {frequency[-1]:g} Hz"
    echo(f"{file}: {response.form} [{FORMS[response.form]}], {lines}")
    for title, ports in (("responses", response.outputs), ("bases" if response.form == "transmissibility" else "forces", response.inputs)):
        echo(f"  {title:<9} " + ", ".join(_port(port) for port in ports))
    qualities = [name for name in ("covariance", "coherence") if getattr(response, name) is not None]
    echo(f"  with {' and '.join(qualities)}" if qualities else "  without covariance or coherence")


def _echo_spectra(spectra: ChannelSpectra, file: str) -> None:
    frequency = spectra.frequency
    lines = f"{frequency.size} lines, {frequency[0]:g} to {frequency[-1]:g} Hz"
    echo(f"{file}: spectra of all channels, {lines}, runs {', '.join(spectra.runs)}")
    width = max(len(channel.name) for channel in spectra.channels)
    echo(f"  {'channel':<{max(width, 7)}}  {'rms of a line':>14}{'noise':>12}  unit")
    for number, channel in enumerate(spectra.channels):
        size = (abs(spectra.vectors[:, :, number]) ** 2).mean() ** 0.5 / 2**0.5
        noise = (spectra.covariance[:, :, number, number].real.mean() / 2) ** 0.5
        echo(f"  {channel.name:<{max(width, 7)}}  {size:>14.4g}{noise:>12.3g}  {channel.unit}, {channel.role} {channel.dof}")
    for finding in spectra.findings:
        echo(f"  {finding.level} {finding.code}: {finding.message}")


def _port(port: Port) -> str:
    return port.label if port.dof == port.label else f"{port.label} ({port.dof})"


def _echo_recording(overview: Overview) -> None:
    if overview.kind == "raw file":
        echo(f"{overview.file}: {overview.n_sample} rows, {len(overview.channels)} columns, {overview.rate}")
        labels = [channel.label for channel in overview.channels]
    else:
        echo(f"{overview.kind} {overview.file}: {overview.n_sample} samples, {overview.rate}")
        labels = [f"{channel.name} [{channel.unit}] {channel.about}" for channel in overview.channels]
    width = max(len(label) for label in labels)
    echo(f"  {'channel':<{width}}{'min':>13}{'max':>13}{'mean':>13}{'rms (ac)':>13}")
    for label, channel in zip(labels, overview.channels, strict=True):
        levels = (channel.minimum, channel.maximum, channel.mean, channel.rms)
        echo(f"  {label:<{width}}" + "".join(f"{level:>13.5g}" for level in levels))
    for finding in overview.findings:
        echo(f"  {finding.level} {finding.code}: {finding.message}")
    if not overview.findings:
        echo("  no gaps, no clipping")
    for contradiction in overview.contradictions or ():
        echo(f"  warning rig: {contradiction}")
