"""labpipe inspect FILE"""

from __future__ import annotations

from pathlib import Path

import click

from labpipe.artefacts.recording_file import StoredRecording, open_recording
from labpipe.cli import options
from labpipe.errors import DataError
from labpipe.formats.table import open_table
from labpipe.records.finding import Finding
from labpipe.signals.screening import ChannelScreen, TimeAxisScreen
from labpipe.stages.ingest import is_recording

BLOCK = 1 << 16
TIME_NAMES = ("t", "time", "zeit")


@click.command()
@click.argument("file", type=options.PATH)
def inspect(file: Path) -> None:
    """Show what is in a recording: channels, rate, length, gaps, clipping, levels."""
    if file.exists() and file.is_file() and is_recording(file):
        _inspect_recording(open_recording(file))
    else:
        _inspect_table(file)


def _inspect_recording(recording: StoredRecording) -> None:
    screen = ChannelScreen([channel.name for channel in recording.channels])
    for block in recording.blocks(BLOCK):
        screen.add(block)
    seconds = recording.n_sample / recording.sample_rate
    click.echo(f"calibrated recording {recording.name}: {recording.n_sample} samples, {recording.sample_rate:g} Hz, {seconds:g} s")
    labels = [f"{channel.name} [{channel.unit}] {channel.role} {channel.dof}" for channel in recording.channels]
    _echo_levels(labels, screen, recording.findings)


def _inspect_table(file: Path) -> None:
    """A raw file: a rate where one of its columns is a time."""
    table = open_table(file)
    names = list(dict.fromkeys(table.columns))
    times = [name for name in names if name.split("[")[0].split("(")[0].strip().lower() in TIME_NAMES]
    screen = ChannelScreen(names)
    time = TimeAxisScreen(times[0]) if times else None
    rate = "no time column; the rig file gives the rate"
    try:
        for chunk in table.chunks(names):
            screen.add(chunk)
            if time is not None:
                time.add(chunk[:, names.index(times[0])])
        if time is not None:
            rate = f"{time.sample_rate():g} samples per unit of '{times[0]}'"
    except DataError as error:
        error.where = error.where or str(file)
        raise
    click.echo(f"{file.name}: {screen.n_sample} rows, {len(names)} columns, {rate}")
    _echo_levels(names, screen, screen.findings())


def _echo_levels(labels: list[str], screen: ChannelScreen, findings: tuple[Finding, ...]) -> None:
    width = max(len(label) for label in labels)
    click.echo(f"  {'channel':<{width}}{'min':>13}{'max':>13}{'mean':>13}{'rms (ac)':>13}")
    for row in zip(labels, screen.minimum, screen.maximum, screen.mean, screen.rms, strict=True):
        click.echo(f"  {row[0]:<{width}}" + "".join(f"{float(value):>13.5g}" for value in row[1:]))
    for finding in findings:
        click.echo(f"  {finding.level} {finding.code}: {finding.message}")
    if not findings:
        click.echo("  no gaps, no clipping")
