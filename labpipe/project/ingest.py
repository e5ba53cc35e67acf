"""ingest: raw files -> calibrated recordings in SI units, chunk by chunk, with what was found in them. A file
that is read as fast as that copy, and by single columns, is measured as it is read, without a copy.
"""

from __future__ import annotations

import json
import math
import os
import re
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.artefacts import recording_file
from labpipe.artefacts.digest import DigestAlong, file_sha256
from labpipe.artefacts.header import Header, SourceRef, source_ref
from labpipe.artefacts.parquet import fresh_path, has_header
from labpipe.artefacts.writing import OutputFolder, is_remote
from labpipe.errors import DataError, locate_errors
from labpipe.quantities import may_agree
from labpipe.raw_files.joined_table import JoinedTable, ResampledTable
from labpipe.raw_files.screening import JITTER, ChannelScreen, LostSamples, TimeAxisScreen
from labpipe.raw_files.table import QuickTable, RawTable, as_quick, check_columns, check_time, open_table
from labpipe.records.finding import Finding, note
from labpipe.records.rig import Rig, RigChannel, Span, time_scale

# Ends of the range of a channel that cannot clip.
FAR = (-1e300, 1e300)
TIME_NAMES = (
    "t", "time", "zeit", "x_value", "timestamp", "time stamp", "datetime", "date/time", "date time",
    "uhrzeit",
)  # fmt: skip
# Rates that differ by more are not those of one recording, whatever its clock.
ANOTHER_RATE = 0.01
# Rates are written down with this many digits at least.
SAME_RATE = 1e-4
# Share of a step by which a printed time may miss an end of a span.
NEAR = 1e-3
# Samples that are calibrated at once.
IN_CACHE = 1 << 12


def is_recording(path: Path) -> bool:
    """Whether the file is already a calibrated recording of labpipe's own."""
    return path.name.endswith(recording_file.SUFFIX) or (
        path.suffix == ".parquet" and path.is_file() and has_header(path)
    )


# What of a rig file makes a recording what it is.
MEASURES = ("sample_rate", "time", "resample", "channels", "derived")


def check_made_with(
    part: str, made: Mapping[str, Any], now: Mapping[str, Any], path: Path, again: str
) -> None:
    """DataError where a file was made with other entries of a *part* of the settings than it has *now*."""
    # Entries that an earlier version did not have are as they are now.
    entries = json.loads(json.dumps(now, default=vars))
    if other := [key for key, entry in entries.items() if key in made and not _agree(made[key], entry)]:
        what = f"was made with another `{part}:` than there is now ({', '.join(other)})"
        raise DataError(what, path, again)


def _agree(made: Any, now: Any) -> bool:
    if isinstance(made, dict) and isinstance(now, dict):
        return all(_agree(made[key], entry) for key, entry in now.items() if key in made)
    if isinstance(made, list) and isinstance(now, list) and len(made) == len(now):
        return all(map(_agree, made, now))
    return bool(made == now)


def check_rig(made: Mapping[str, Any], rig: Rig, path: Path, again: str) -> None:
    """DataError where a file was measured with another *rig*, of which *made* are the entries then."""
    check_made_with("rig", made, {name: getattr(rig, name) for name in MEASURES}, path, again)


@dataclass(frozen=True)
class SourceFile:
    """One recorded file and the rig that recorded it. *path* may be a URL of an object storage. *joined*:
    further files with channels of the same run, *by* time or sample, by default by time where all have it.
    *span*: the part of it that counts.
    """

    path: Path
    rig: Rig
    joined: tuple[Path, ...] = ()
    by: str = ""
    span: Span = Span()

    @property
    def paths(self) -> tuple[Path, ...]:
        return (self.path, *self.joined)

    def absolute(self) -> SourceFile:
        return self.at({path: path.absolute() for path in self.paths if not is_remote(path)})

    def at(self, places: Mapping[Path, Path]) -> SourceFile:
        """The same, of files that lie at other places."""
        return replace(
            self,
            path=places.get(self.path, self.path),
            joined=tuple(places.get(path, path) for path in self.joined),
        )


class _Part:
    """The rows of a recording that lie within a *span*, chunk by chunk. *step* [s]: from row to row, or per
    unit of the first column where that is a *timed* one.
    """

    def __init__(self, span: Span, step: float, timed: bool) -> None:
        self._span, self._step, self._timed = span, step, timed
        self._n_row = self._n_kept = 0
        self._length = self._near = 0.0

    def rows(self, chunks: Iterable[FloatArray]) -> Iterator[FloatArray]:
        """Those of *chunks* (n, n_column) [any unit], with a time that is no number, to be refused later."""
        if self._span.is_whole:
            yield from chunks
            return
        first, spacing = 0.0, self._step
        start, end = self._span.start, self._end
        for chunk in chunks:
            times = chunk[:, 0] if self._timed else np.arange(self._n_row, self._n_row + len(chunk))
            times = times * self._step
            if self._timed and self._n_row == 0:
                first, spacing = times[0], float(np.median(np.diff(times))) if times.size > 1 else 0.0
            since, self._near = times - first, NEAR * spacing
            kept = chunk[~((since < start - self._near) | (since >= end - self._near))]
            self._n_row, self._n_kept = self._n_row + len(chunk), self._n_kept + len(kept)
            self._length = float(since[-1]) + spacing
            yield kept

    @property
    def _end(self) -> float:
        return math.inf if self._span.end is None else self._span.end

    def findings(self, path: Path) -> tuple[Finding, ...]:
        """What was left out. DataError for a span that reaches beyond the recording's end."""
        if self._span.is_whole:
            return ()
        start, length = self._span.start, self._length
        if not self._n_kept or length + self._near < self._end < math.inf:
            at = f"start: {start:g} s" if not self._n_kept else f"end: {self._end:g} s"
            hint = "times count from its first sample on"
            raise DataError(f"lasts {length:.6g} s, and `{at}` lies beyond", path, hint)
        until = min(self._end, length)
        what = f"{path.name}: of {length:.6g} s the part from {start:g} to {until:.6g} s counts"
        return (note("cut", what),)


def ingest(source: SourceFile, output: OutputFolder, name: str, base: Path) -> recording_file.StoredRecording:
    """The calibrated recording of a raw file, made unless the one on disk is fresh. *name*: its file name in
    the output folder without ending; *base*: the folder to which paths in the header are relative. DataError
    with file and line for what cannot be used.
    """
    rig, span = source.rig, source.span
    if is_recording(source.path) and not source.joined:
        recording = recording_file.open_recording(source.path)
        check_rig(
            recording.header.parameters, rig, source.path, "run `labpipe ingest` again, or name its rig"
        )
        return recording
    table = _join(source.paths, rig, source.by) if source.joined else _open(source.path, rig)
    stated = {"by": source.by, "span": {} if span.is_whole else asdict(span)}
    parameters = {**asdict(rig), **{key: entry for key, entry in stated.items() if entry}}
    inputs = tuple(source_ref(path, base) for path in source.paths)
    header = Header("recording", parameters, inputs=inputs)
    if (fresh := fresh_path(output, name + recording_file.SUFFIX, header)) is not None:
        return recording_file.open_recording(fresh)
    target = output.write_path(name + recording_file.SUFFIX)
    timed = check_table(table, rig)
    channels = rig.all_channels
    time = _clock(table, rig)
    if not rig.time:
        timed = [*_times_beside(table, rig), *timed]
    screen, calibration, seconds = channel_screen(rig), Calibration(rig), time_scale(rig.time, table.units)
    part = _Part(span, seconds if rig.time else 1 / stated_rate(table, rig), bool(rig.time))
    with locate_errors(table.path), recording_file.RecordingWriter(target, channels) as writer:
        for chunk in part.rows(table.chunks(timed)):
            if time is not None:
                time.add(chunk[:, 0] * seconds)
            block = calibration.to_si(chunk[:, len(timed) - len(rig.channels) :])
            screen.add(block)
            writer.write(calibration.with_sums(block))
        of_times = time.findings() if isinstance(time, LostSamples) else ()
        sample_rate = _rate(time, table, rig)
        contents = recording_file.recording_contents(channels, sample_rate, source.path.stem, screen.levels())
        of_table = table.findings() if isinstance(table, JoinedTable | ResampledTable) else ()
        if isinstance(table, JoinedTable):
            contents["files"] = {c.channel.name: table.file_of(c.column) for c in rig.channels}
        found = (*of_table, *part.findings(table.path), *screen.findings(), *of_times)
        writer.finish(replace(header, findings=found, contents=contents))
    recording = writer.recording()
    for path, reference in zip(source.paths, header.inputs, strict=True):
        if source_ref(path, base) != reference:
            raise write_conflict(path)
    return recording


def write_conflict(path: Path) -> DataError:
    """The fault of a file that was written to meanwhile."""
    return DataError("changed while it was read", path, "run again when it is complete")


def _open(source: Path, rig: Rig) -> RawTable:
    table = open_table(source)
    if rig.resample is None:
        return table
    return ResampledTable([table, *getattr(table, "others", ())], rig.resample)


def _join(paths: Sequence[Path], rig: Rig, by: str) -> JoinedTable:
    calibrated = next(filter(is_recording, paths), None)
    if calibrated is not None:
        raise DataError("is calibrated already, and is not joined", calibrated, "join the raw files")
    tables = [open_table(path) for path in paths]
    if rig.resample is not None:
        what = "`resample` brings the channels of one file to a rate, and these files are joined"
        raise DataError(what, paths[0], "leave it out of the rig file")
    untimed = [table for table in tables if rig.time not in table.columns]
    if by == "time" and untimed:
        what = "cannot be joined on time: the rig file names no time column"
        what = f"has no time column '{rig.time}'" if rig.time else what
        raise DataError(what, untimed[0].path, "by: sample joins row by row")
    return JoinedTable(tables, rig.time if not untimed and by != "sample" else None)


def named_times(table: RawTable) -> list[str]:
    """The columns that are times by their names, and no frequencies by their unit."""
    names = (name for name in dict.fromkeys(table.columns) if table.units.get(name) != "Hz")
    return [name for name in names if re.split(r"[\[(]", name)[0].strip().lower() in TIME_NAMES]


def _times_beside(table: RawTable, rig: Rig) -> list[str]:
    """The columns of times beside a rate that the rig file states, the first of them."""
    names = named_times(table) if rig.sample_rate else []
    return [name for name in names if table.columns.count(name) == 1][:1]


_Clock = TimeAxisScreen | LostSamples | None


def _clock(table: RawTable, rig: Rig) -> _Clock:
    if rig.time:
        return TimeAxisScreen(rig.time)
    return next(map(LostSamples, _times_beside(table, rig)), None)


def _check_rate(table: RawTable, rig: Rig) -> None:
    """DataError for times at another rate by mean and median step, of which gaps or digits change one."""
    stated = rig.sample_rate or 0.0
    for name in _times_beside(table, rig):
        if name not in table.units:
            continue
        try:
            scale = time_scale(name, table.units)
        except DataError:
            continue
        times = next(iter(table.chunks([name])), np.zeros((1, 1)))[:, 0] * scale
        steps = np.diff(times) if times.size > 1 else np.zeros(1)
        both = np.array([steps.mean(), np.median(steps)])
        if np.all(both > 0) and np.all(np.abs(both * stated - 1) > ANOTHER_RATE):
            by_rig = f"at {stated:g} Hz by the rig file"
            what = f"is sampled at {1 / both[0]:g} Hz by its column '{name}', {by_rig}"
            raise DataError(what, table.path, f"time: '{name}' in place of sample_rate, or correct it")


def check_table(table: RawTable, rig: Rig) -> list[str]:
    """The columns of the rig's channels, the time first. DataError for a missing one or another unit."""
    check_columns(table, rig.columns)
    check_time(table, rig.time)
    _check_rate(table, rig)
    for channel in rig.channels:
        _check_unit(table, channel)
    return rig.columns


def channel_screen(rig: Rig) -> ChannelScreen:
    """The search for faults of a rig's measured channels."""
    channels = [channel.channel for channel in rig.channels]
    of_rotation = {channel.name for channel in channels if channel.quantity in ("tacho", "speed")}
    return ChannelScreen(
        [channel.name for channel in channels], [*map(_si_limits, rig.channels)], of_rotation
    )


class Calibration:
    """What makes the recorded columns of a rig's channels SI units, and adds its sums."""

    def __init__(self, rig: Rig) -> None:
        self._scale = np.array([channel.scale for channel in rig.channels])
        self._offset = np.array([channel.offset for channel in rig.channels])
        self._sums = rig.sums.T if rig.derived else None
        self._changes = (self._scale != 1) | (self._offset != 0)

    def to_si(self, chunk: FloatArray) -> FloatArray:
        """Recorded columns (n, n_measured) [unit of the file] in SI units, not copied where they are."""
        if not self._changes.any():
            return chunk
        block: FloatArray = chunk * self._scale
        block += self._offset
        return block

    def channel_to_si(self, number: int, recorded: FloatArray) -> FloatArray:
        """The numbers (n,) [unit of the file] of one measured channel in SI units."""
        values: FloatArray = np.asarray(recorded, np.float64)
        return values * self._scale[number] + self._offset[number] if self._changes[number] else values

    def rows_to_si(self, columns: Sequence[FloatArray]) -> FloatArray:
        """Recorded columns (n,) [unit of the file] as (n, n_measured) [SI], sample by sample."""
        block = np.empty((columns[0].size, len(columns)))
        for start in range(0, block.shape[0], IN_CACHE):
            piece = slice(start, start + IN_CACHE)
            for number, column in enumerate(columns):
                # Single precision becomes double where it is put.
                changes, recorded = self._changes[number], column[piece]
                block[piece, number] = self.channel_to_si(number, recorded) if changes else recorded
        return block

    def with_sums(self, block: FloatArray) -> FloatArray:
        """The measured channels (n, n_measured) [SI] and beside them the sums, (n, n_channel) [SI]."""
        return block if self._sums is None else np.concatenate([block, block @ self._sums], axis=1)


def contradictions(table: RawTable, rig: Rig) -> list[DataError]:
    """Every point in which a file and a rig file do not agree: columns, units, rate."""
    checks: list[Callable[[], object]] = [partial(check_columns, table, [name]) for name in rig.columns]
    checks.extend(partial(_check_unit, table, channel) for channel in rig.channels)
    checks += [partial(check_time, table, rig.time), partial(_check_rate, table, rig)]
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


def stated_rate(table: RawTable, rig: Rig) -> float:
    """The rate [Hz] that the rig file or the file states. DataError for none, or two that differ."""
    file_rate = table.sample_rate
    if rig.sample_rate is None and file_rate is None:
        message = "states no sampling rate, and one of sample_rate and time is needed in the rig file"
        raise DataError(message, table.path, 'write sample_rate: 20 kHz or time: "t [s]"')
    if rig.sample_rate and file_rate is not None and abs(file_rate / rig.sample_rate - 1) > SAME_RATE:
        by_rig = f"at {rig.sample_rate:g} Hz by the rig file"
        message = f"is sampled at {file_rate:g} Hz by the file itself, {by_rig}"
        raise DataError(message, table.path, "leave sample_rate out of the rig file, or correct it")
    return float(rig.sample_rate or file_rate or 0.0)


def _rate(clock: _Clock, table: RawTable, rig: Rig) -> float:
    """The rate [Hz] by the times that the rig names, or as stated."""
    if not isinstance(clock, TimeAxisScreen):
        return stated_rate(table, rig)
    rate, stated = clock.sample_rate(), table.sample_rate
    if stated is not None and abs(stated / rate - 1) > JITTER:
        what = f"is sampled at {stated:g} Hz by the file itself, at {rate:g} Hz by its times"
        raise DataError(what, table.path, "leave time out of the rig file, or correct the file")
    return rate


def _check_unit(table: RawTable, channel: RigChannel) -> None:
    stated = table.units.get(channel.column)
    if stated is not None and not may_agree(stated, channel.unit):
        by_rig = f"in {channel.unit} by the rig file"
        what = f"column '{channel.column}' is in {stated} by the file's own header, {by_rig}"
        raise DataError(what, table.path, f"correct the unit of channel '{channel.channel.name}'")


def _si_limits(channel: RigChannel) -> tuple[float, float] | None:
    """Where the logger clips [SI of the channel], increasing. Pulses have flat ends and no limits."""
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
        stem = path.name.removesuffix(recording_file.SUFFIX)
        stem = path.stem if stem == path.name else stem
        name, number = stem, numbers.get(stem, 1)
        while name in names:
            number += 1
            name = f"{stem}-{number}"
        numbers[stem] = number
        names[name] = None
    return list(names)


def ingest_all(
    sources: Iterable[Path], rig: Rig, output: OutputFolder, base: Path
) -> list[recording_file.StoredRecording]:
    """`ingest` for many files of one rig."""
    paths = list(sources)
    named = zip(paths, unique_names(paths), strict=True)
    return [ingest(SourceFile(path, rig), output, name, base) for path, name in named]


def recording_refs(recording: recording_file.StoredRecording, base: Path) -> tuple[SourceRef, ...]:
    """The references by which a result names the raw files behind a recording."""
    return recording.header.inputs or (source_ref(recording.path, base),)


YOUNG = 2_000_000_000


def raw_recording(source: Path, rig: Rig, base: Path) -> RawRecording | None:
    """The recording of a raw file that can be measured as it is read; None for one that needs `ingest`.
    Raises DataError as that does. *base* is the folder to which the path in its reference is relative.
    """
    if is_recording(source) or rig.resample is not None:
        return None
    quick = as_quick(open_table(source))
    return None if quick is None else RawRecording(quick, rig, base)


class RawRecording:
    """The channels of a raw file [SI], a SampleSource. Findings and digest are of the first reading."""

    def __init__(self, table: QuickTable, rig: Rig, base: Path) -> None:
        self.path, self.rig, self.n_sample, self.name = table.path, rig, table.n_row, table.path.stem
        self._state, self._began = _state_of(self.path), time.time_ns()
        self._columns = check_table(table, rig)[1 if rig.time else 0 :]
        self.channels = rig.all_channels
        self._table, self._base, self._calibration = table, base, Calibration(rig)
        self._findings: tuple[Finding, ...] | None = None
        self._sha256 = ""

    @cached_property
    def sample_rate(self) -> float:
        """Rate [Hz] as the rig file or the raw file states it, or by the time column, read first."""
        clock = _clock(self._table, self.rig)
        return _rate(self._read_times(clock) if self.rig.time else clock, self._table, self.rig)

    def _read_times(self, clock: _Clock) -> _Clock:
        if clock is not None:
            scale = time_scale(self.rig.time, self._table.units)
            for (times,) in self._table.column_chunks([clock.column]):
                clock.add(np.asarray(times, np.float64) * scale)
        return clock

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What was found in the samples; the file is read where it has not been."""
        if self._findings is None:
            for _ in self._screen_chunks():
                pass
        assert self._findings is not None
        return self._findings

    def blocks(self, n_sample: int) -> Iterator[FloatArray]:
        """Consecutive blocks of at most *n_sample* samples, (n, n_channel) [SI]."""
        return recording_file.read_ahead(self._blocks_in_turn(n_sample))

    def _blocks_in_turn(self, n_sample: int) -> Iterator[FloatArray]:
        for columns in self._screen_chunks() if self._findings is None else self._record():
            block = self._calibration.with_sums(self._calibration.rows_to_si(columns))
            for start in range(0, block.shape[0], n_sample):
                yield block[start : start + n_sample]

    def _record(self) -> Iterator[list[FloatArray]]:
        return self._table.column_chunks(self._columns)

    def _screen_chunks(self) -> Iterator[list[FloatArray]]:
        """The same, looked at for faults and digested on the way; what comes of it holds after the last."""
        screen = channel_screen(self.rig)
        with DigestAlong(self.path) as digest:
            for columns in self._record():
                self._screen(screen, columns)
                if not self._sha256:
                    digest.advance(screen.n_sample / self.n_sample)
                yield columns
            clock = None if self.rig.time else self._read_times(_clock(self._table, self.rig))
            of_times = clock.findings() if isinstance(clock, LostSamples) else ()
            self._findings = (*screen.findings(), *of_times)
            self._sha256 = self._sha256 or digest.hexdigest()

    def _screen(self, screen: ChannelScreen, columns: Sequence[FloatArray]) -> None:
        """Look at the extremes of columns (n,) [unit of the file], and into them where these say so."""
        calibrated = self._calibration.channel_to_si
        extremes = ((column.min(), column.max()) for column in columns)
        ends = np.array([[calibrated(n, end) for end in pair] for n, pair in enumerate(extremes)])
        low, high = ends.min(axis=1), ends.max(axis=1)
        if not screen.add_between(low, high, columns[0].size, lambda n: calibrated(n, columns[n])):
            screen.add(self._calibration.rows_to_si(columns))

    def source_ref(self) -> SourceRef:
        self._sha256 = self._sha256 or file_sha256(self.path)
        return source_ref(self.path, self._base, self._sha256)

    def check_unchanged(self) -> None:
        """DataError where the file is no longer the one that was opened."""
        changed = _state_of(self.path) != self._state
        if not changed and self._began - self._state[0] < YOUNG:
            changed = file_sha256(self.path) != self._sha256
        if changed:
            raise write_conflict(self.path)


def _state_of(path: Path) -> tuple[int, int, int]:
    """What changes with a file's content: time of change [ns], size [byte], number."""
    status = os.stat(path)
    return status.st_mtime_ns, status.st_size, status.st_ino
