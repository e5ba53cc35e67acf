"""labpipe inspect FILE"""

from __future__ import annotations

from pathlib import Path

import click

from labpipe.artefacts.recording_file import StoredRecording, open_recording
from labpipe.cli import options
from labpipe.config.rig import load_rig
from labpipe.errors import DataError
from labpipe.formats.table import open_table
from labpipe.records.finding import Finding
from labpipe.records.response import FORMS, FrequencyResponse, Port
from labpipe.records.rig import Rig
from labpipe.signals.screening import ChannelScreen, TimeAxisScreen
from labpipe.stages.frf import is_response, load_response
from labpipe.stages.ingest import contradictions, is_recording

BLOCK = 1 << 16
TIME_NAMES = ("t", "time", "zeit")


@click.command()
@click.argument("file", type=options.PATH)
@click.option("-r", "--rig", "rig_path", type=options.PATH, help="Rig file against which names, units and rate are held.")
def inspect(file: Path, rig_path: Path | None) -> None:
    """Show what is in a recording or an FRF: channels, units, rate, length, gaps, clipping, levels."""
    rig = None if rig_path is None else load_rig(rig_path)
    if is_response(file):
        _inspect_response(load_response(file), file)
    elif file.is_file() and is_recording(file):
        _inspect_recording(open_recording(file))
    else:
        _inspect_table(file, rig)


def _inspect_response(response: FrequencyResponse, file: Path) -> None:
    frequency = response.frequency
    lines = f"{frequency.size} lines, {frequency[0]:g} to {frequency[-1]:g} Hz"
    click.echo(f"{file.name}: {response.form} [{FORMS[response.form]}], {lines}")
    for title, ports in (("responses", response.outputs), ("forces", response.inputs)):
        click.echo(f"  {title:<9} " + ", ".join(_port(port) for port in ports))
    known = [name for name in ("covariance", "coherence") if getattr(response, name) is not None]
    click.echo(f"  with {' and '.join(known)}" if known else "  without covariance or coherence")


def _port(port: Port) -> str:
    return port.label if port.dof == port.label else f"{port.label} ({port.dof})"


def _inspect_recording(recording: StoredRecording) -> None:
    screen = ChannelScreen([channel.name for channel in recording.channels])
    for block in recording.blocks(BLOCK):
        screen.add(block)
    seconds = recording.n_sample / recording.sample_rate
    click.echo(f"calibrated recording {recording.name}: {recording.n_sample} samples, {recording.sample_rate:g} Hz, {seconds:g} s")
    labels = [f"{channel.name} [{channel.unit}] {channel.role} {channel.dof}" for channel in recording.channels]
    _echo_levels(labels, screen, recording.findings)


def _inspect_table(file: Path, rig: Rig | None) -> None:
    """A raw file: the rate it states itself, or that of a column which is a time."""
    table = open_table(file)
    names = list(dict.fromkeys(table.columns))
    times = [name for name in names if name.split("[")[0].split("(")[0].strip().lower() in TIME_NAMES]
    screen = ChannelScreen(names)
    time = TimeAxisScreen(times[0]) if times else None
    rate = "no time column; the rig file gives the rate" if table.sample_rate is None else f"{table.sample_rate:g} Hz"
    try:
        for chunk in table.chunks(names):
            screen.add(chunk)
            if time is not None:
                time.add(chunk[:, names.index(times[0])])
        if time is not None and table.sample_rate is None:
            rate = f"{time.sample_rate():g} samples per unit of '{times[0]}'"
    except DataError as error:
        error.where = error.where or str(file)
        raise
    click.echo(f"{file.name}: {screen.n_sample} rows, {len(names)} columns, {rate}")
    labels = [f"{name} [{table.units[name]}]" if name in table.units and table.units[name] not in name else name for name in names]
    _echo_levels(labels, screen, screen.findings())
    for contradiction in contradictions(table, rig) if rig is not None else ():
        click.echo(f"  warning rig: {contradiction}")


def _echo_levels(labels: list[str], screen: ChannelScreen, findings: tuple[Finding, ...]) -> None:
    width = max(len(label) for label in labels)
    click.echo(f"  {'channel':<{width}}{'min':>13}{'max':>13}{'mean':>13}{'rms (ac)':>13}")
    for row in zip(labels, screen.minimum, screen.maximum, screen.mean, screen.rms, strict=True):
        click.echo(f"  {row[0]:<{width}}" + "".join(f"{float(value):>13.5g}" for value in row[1:]))
    for finding in findings:
        click.echo(f"  {finding.level} {finding.code}: {finding.message}")
    if not findings:
        click.echo("  no gaps, no clipping")
