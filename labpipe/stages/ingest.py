"""ingest: raw files -> calibrated recordings in SI units, chunk by chunk, with what was found in them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.artefacts.freshness import fresh_path
from labpipe.artefacts.header import Header, SourceRef, source_ref
from labpipe.artefacts.parquet import has_header
from labpipe.artefacts.recording_file import SUFFIX, RecordingWriter, StoredRecording, open_recording, recording_contents
from labpipe.artefacts.writing import OutputFolder
from labpipe.errors import DataError
from labpipe.formats.joined_table import JoinedTable
from labpipe.formats.table import Table, check_columns, open_table
from labpipe.quantities import UnitError, readings
from labpipe.records.rig import Rig, RigChannel
from labpipe.signals.screening import ChannelScreen, TimeAxisScreen

# Ends of the range of a channel that cannot clip.
FAR = (-1e300, 1e300)
# Rates are written down with this many digits at least.
SAME_RATE = 1e-4


def is_recording(path: Path) -> bool:
    """Whether the file is already a calibrated recording of labpipe's own."""
    return path.name.endswith(SUFFIX) or (path.suffix == ".parquet" and path.is_file() and has_header(path))


def ingest(
    source: Path, rig: Rig, output: OutputFolder, name: str, base: Path, joined: Sequence[Path] = (), by: str = ""
) -> StoredRecording:
    """The calibrated recording of a raw file, made unless the one on disk is fresh.

    *name* is the recording's file name in the output folder without its ending; *base* is the folder to which paths in the
    header are relative. *joined*: further files with channels of the same run, joined *by* time or sample. Raises DataError with file
    and line for what cannot be used.
    """
    if is_recording(source):
        return open_recording(source)
    table = _joined([source, *joined], rig, by) if joined else open_table(source)
    parameters = {**dataclasses.asdict(rig), **({"by": by} if by else {})}
    header = Header("recording", parameters, inputs=tuple(source_ref(path, base) for path in (source, *joined)))
    if (fresh := fresh_path(output, name + SUFFIX, header)) is not None:
        return open_recording(fresh)
    target = output.write_path(name + SUFFIX)
    recording = _write(table, rig, target, header, source.stem)
    for path, reference in zip((source, *joined), header.inputs, strict=True):
        if source_ref(path, base) != reference:
            raise DataError("changed while it was read", where=str(path), hint="run again when it is complete")
    return recording


def _joined(paths: Sequence[Path], rig: Rig, by: str) -> JoinedTable:
    """The files of one run as one table; DataError where they shall be joined on a time that one of them lacks."""
    tables = [open_table(path) for path in paths]
    untimed = [table for table in tables if rig.time not in table.columns]
    if by == "time" and untimed:
        what = f"has no time column '{rig.time}'" if rig.time else "cannot be joined on time: the rig file names no time column"
        raise DataError(what, where=str(untimed[0].path), hint="by: sample joins row by row")
    return JoinedTable(tables, rig.time if not untimed and by != "sample" else None)


def _write(table: Table, rig: Rig, target: Path, header: Header, name: str) -> StoredRecording:
    columns = [channel.column for channel in rig.channels]
    timed = [*([rig.time] if rig.time else []), *columns]
    check_columns(table, timed)
    if rig.time and table.units.get(rig.time) == "Hz":
        hint = "the file holds a spectrum; a recording is needed, or an FRF under `frfs:`"
        raise DataError(f"'{rig.time}' is a frequency, no time", where=str(table.path), hint=hint)
    for channel in rig.channels:
        _check_unit(table, channel)
    channels = rig.all_channels
    time = TimeAxisScreen(rig.time) if rig.time else None
    if time is None:
        stated_rate(table, rig)
    screen = ChannelScreen([channel.channel.name for channel in rig.channels], [_si_limits(channel) for channel in rig.channels])
    scale = np.array([channel.scale for channel in rig.channels])
    offset = np.array([channel.offset for channel in rig.channels])
    sums = rig.sums.T
    try:
        with RecordingWriter(target, channels) as writer:
            for chunk in table.chunks(timed):
                if time is not None:
                    time.add(chunk[:, 0] * rig.time_scale)
                block = _calibrated(chunk[:, len(timed) - len(columns) :], scale, offset)
                screen.add(block)
                writer.write(np.concatenate([block, block @ sums], axis=1) if rig.derived else block)
            sample_rate = time.sample_rate() if time is not None else stated_rate(table, rig)
            contents = recording_contents(channels, sample_rate, name, screen.levels())
            findings = (*(table.findings() if isinstance(table, JoinedTable) else ()), *screen.findings())
            writer.finish(dataclasses.replace(header, findings=findings, contents=contents))
    except DataError as error:
        error.where = error.where or str(table.path)
        raise
    return writer.recording()


def _calibrated(chunk: FloatArray, scale: FloatArray, offset: FloatArray) -> FloatArray:
    """The columns (n, n_channel) [unit of the file] in SI units; those of a file that holds these already are not copied."""
    if np.all(scale == 1) and np.all(offset == 0):
        return chunk
    block: FloatArray = chunk * scale
    block += offset
    return block


def contradictions(table: Table, rig: Rig) -> list[DataError]:
    """Every point in which a file and a rig file do not agree: columns, units, rate."""
    columns = [channel.column for channel in rig.channels]
    checks: list[Callable[[], object]] = [partial(check_columns, table, [name]) for name in [*([rig.time] if rig.time else []), *columns]]
    checks.extend(partial(_check_unit, table, channel) for channel in rig.channels)
    if rig.time is None:
        checks.append(partial(stated_rate, table, rig))
    faults: list[DataError] = []
    for check in checks:
        try:
            check()
        except DataError as error:
            error.where = ""
            faults.append(error)
    return faults


def stated_rate(table: Table, rig: Rig) -> float:
    """The sampling rate [Hz] that the rig file or the file itself states; DataError when none does, or both do and differ."""
    file_rate = table.sample_rate
    if rig.sample_rate is None and file_rate is None:
        message = "states no sampling rate, and one of sample_rate and time is needed in the rig file"
        raise DataError(message, where=str(table.path), hint='write sample_rate: 20 kHz or time: "t [s]"')
    if rig.sample_rate is not None and file_rate is not None and abs(file_rate / rig.sample_rate - 1) > SAME_RATE:
        message = f"is sampled at {file_rate:g} Hz by the file itself, at {rig.sample_rate:g} Hz by the rig file"
        raise DataError(message, where=str(table.path), hint="leave sample_rate out of the rig file, or correct it")
    return float(rig.sample_rate or file_rate or 0.0)


def _check_unit(table: Table, channel: RigChannel) -> None:
    """DataError when the file states another unit for the column than the rig file does."""
    stated = table.units.get(channel.column)
    if stated is None:
        return
    try:
        theirs, ours = readings(stated), readings(channel.unit)
    except UnitError:
        return
    if not set(theirs) & set(ours):
        what = f"column '{channel.column}' is in {stated} by the file's own header, in {channel.unit} by the rig file"
        raise DataError(what, where=str(table.path), hint=f"correct the unit of channel '{channel.channel.name}'")


def _si_limits(channel: RigChannel) -> tuple[float, float] | None:
    """The recorded values at which the logger clips, in SI units of the channel, increasing; pulses have flat ends and none."""
    if channel.limits is None:
        return FAR if channel.channel.quantity == "tacho" else None
    low, high = sorted(limit * channel.scale + channel.offset for limit in channel.limits)
    return low, high


def unique_names(paths: Sequence[Path]) -> list[str]:
    """A name for each file from its stem, numbered where a stem comes again."""
    # In their order; of each stem how often it came. A fleet has a hundred thousand of them.
    names: dict[str, None] = {}
    numbers: dict[str, int] = {}
    for path in paths:
        stem = path.name.removesuffix(SUFFIX) if path.name.endswith(SUFFIX) else path.stem
        name, number = stem, numbers.get(stem, 1)
        while name in names:
            number += 1
            name = f"{stem}-{number}"
        numbers[stem] = number
        names[name] = None
    return list(names)


def ingest_all(sources: Iterable[Path], rig: Rig, output: OutputFolder, base: Path) -> list[StoredRecording]:
    """`ingest` for many files of one rig."""
    paths = list(sources)
    return [ingest(path, rig, output, name, base) for path, name in zip(paths, unique_names(paths), strict=True)]


def recording_refs(recording: StoredRecording, base: Path) -> tuple[SourceRef, ...]:
    """The references by which a result names the raw files behind a recording."""
    return recording.header.inputs or (source_ref(recording.path, base),)
