"""Channels of one run that lie in several files, or at several rates in one, as one table: joined row by
row or on their time columns, or resampled to one rate.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.errors import DataError
from labpipe.raw_files.table import RawTable, unique
from labpipe.records.finding import Finding, note
from labpipe.records.rig import time_scale

# Relative difference of rates that are the same.
SAME_RATE = 1e-4
# Share of a step by which the times of one row may differ between files.
BESIDE = 0.1
# Share of steps that differ where samples are lost; digits and other rates make more of them.
MOST_GAPS = 0.05


class JoinedTable:
    """The columns of several tables. Satisfies RawTable. A name that several files have is STEM/NAME for all
    but the first. With *time*, the name of their common time column, rows are those of equal times;
    without, row 1 stands beside row 1.
    """

    def __init__(self, tables: Sequence[RawTable], time: str | None) -> None:
        self.path = tables[0].path
        self._tables, self._time = tuple(tables), time
        self._place: dict[str, tuple[int, str]] = {}
        self.units: dict[str, str] = {}
        keys: list[str] = []
        for number, table in enumerate(tables):
            before = set(keys)
            for name in table.columns:
                keys.append(f"{table.path.stem}/{name}" if name in before else name)
                self._place[keys[-1]] = number, name
                if name in table.units:
                    self.units[keys[-1]] = table.units[name]
        self.columns = tuple(keys)
        rates = [(table.path.name, table.sample_rate) for table in tables if table.sample_rate is not None]
        for name, rate in rates[1:]:
            if abs(rate / rates[0][1] - 1) > SAME_RATE:
                what = f"{name} is sampled at {rate:g} Hz, {rates[0][0]} at {rates[0][1]:g} Hz"
                raise DataError(what, hint="one run has one rate")
        self.sample_rate = rates[0][1] if rates else None
        self._cut: list[tuple[Path, int, int]] = []

    def file_of(self, column: str) -> str:
        return self._tables[self._place[column][0]].path.name

    def chunks(self, columns: Sequence[str]) -> Iterator[FloatArray]:
        """Consecutive chunks (n, n_column) [unit of the file]; DataError for times that do not fit."""
        places = [self._place[column] for column in columns]
        members = sorted({number for number, _ in places})
        # The time of every file is read along, to be compared.
        times = [self._time] if self._time else []
        wanted = {
            n: list(dict.fromkeys([*times, *(name for number, name in places if number == n)]))
            for n in members
        }
        streams = [self._tables[n].chunks(wanted[n]) for n in members]
        skipped = [0] * len(members)
        if self._time:
            streams, skipped = self._align(streams, members)
        parts = _Parallel(streams, skipped)
        row = 0
        for blocks in parts:
            if self._time:
                self._check_times(blocks, members, row)
            row += blocks[0].shape[0]
            yield np.column_stack(
                [blocks[members.index(number)][:, wanted[number].index(name)] for number, name in places]
            )
        rests = parts.rests()
        self._cut = [
            (self._tables[n].path, skip, rest)
            for n, skip, rest in zip(members, skipped, rests, strict=True)
            if skip or rest
        ]
        if not row:
            raise DataError("the files have no time in common", self.path, "by: sample joins them row by row")

    def _align(
        self, streams: Sequence[Iterator[FloatArray]], members: Sequence[int]
    ) -> tuple[list[Iterator[FloatArray]], list[int]]:
        firsts = [next(stream) for stream in streams]
        if min(first.shape[0] for first in firsts) < 2:
            raise DataError("a file has fewer than two rows", self.path)
        starts = [float(first[0, 0]) for first in firsts]
        steps = [float(first[-1, 0] - first[0, 0]) / (first.shape[0] - 1) for first in firsts]
        for number, step in enumerate(steps):
            if not abs(step / steps[0] - 1) < max(
                1 / min(firsts[0].shape[0], firsts[number].shape[0]), SAME_RATE
            ):
                name, first = self._tables[members[number]].path.name, f"{self.path.name} ({steps[0]:g})"
                what = f"the time steps of {name} ({step:g}) differ from those of {first}"
                hint = "where that comes from times of few digits, by: sample joins row by row"
                gaps = np.abs(np.diff(firsts[number][:, 0]) / steps[0] - 1) > BESIDE
                if 0 < gaps.sum() < MOST_GAPS * gaps.size:
                    hint = f"samples are lost or stand twice after its row {int(np.argmax(gaps)) + 1}"
                raise DataError(what, hint=hint)
        for number, start in enumerate(starts):
            offset = (start - starts[0]) / steps[0]
            if (beside := abs(offset - round(offset))) > BESIDE:
                name = self._tables[members[number]].path.name
                what = f"the times of {name} lie {beside:.2f} steps beside those of {self.path.name}"
                raise DataError(what, self.path, "resample one of them; by: sample joins row by row")
        skipped = [round((max(starts) - start) / steps[0]) for start in starts]
        return [chain([first], stream) for first, stream in zip(firsts, streams, strict=True)], skipped

    def _check_times(self, blocks: Sequence[FloatArray], members: Sequence[int], row: int) -> None:
        first = blocks[0][:, 0]
        step = np.ptp(first) / max(first.size - 1, 1)
        for number, block in enumerate(blocks[1:], 1):
            beside = np.abs(block[:, 0] - first) > 0.5 * step
            if first.size > 1 and beside.any():
                n = int(np.argmax(beside))
                names = f"{self._tables[members[number]].path.name} and {self.path.name}"
                at = f"{block[n, 0]:g} and {first[n]:g} at common row {row + n + 1}"
                raise DataError(f"the times of {names} run apart: {at}", hint="a lost sample, or two clocks")

    def findings(self) -> tuple[Finding, ...]:
        return tuple(
            note(
                "cut",
                f"{path.name}: {before} samples at its start and {after} at its end are cut, where "
                "another file has none",
            )
            for path, before, after in self._cut
        )


# A channel at this share of its own sampling rate is brought to another rate within half a percent: a cubic
# spline through samples passes on 3 sinc^4(r) / (2 + cos 2 pi r) of it (Unser 1999, eq. 21).
TRUE_SHARE = 0.2


class ResampledTable:
    """Channels at several rates of one file at one *rate* [Hz], by cubic splines. Satisfies RawTable. Rows
    reach over what all of *tables* cover. `findings` says what was resampled, once it has been read.
    """

    def __init__(self, tables: Sequence[RawTable], rate: float) -> None:
        self.path = tables[0].path
        self.sample_rate: float | None = rate
        self._tables = tuple(tables)
        places = [
            (number, name)
            for number, table in enumerate(tables)
            for name in table.columns
            if name != _time_of(table)
        ]
        self.columns = unique([name for _, name in places])
        self._places = dict(zip(self.columns, places, strict=True))
        self.units = {
            key: tables[number].units[name]
            for key, (number, name) in self._places.items()
            if name in tables[number].units
        }
        self._rates: dict[int, float] = {}

    def chunks(self, columns: Sequence[str]) -> Iterator[FloatArray]:
        """One chunk (n, n_column) [unit of the file] at the common rate. DataError for a channel that is
        faster than that, for it would fold back.
        """
        from scipy.interpolate import CubicSpline

        assert self.sample_rate is not None
        chosen = [self._places[column] for column in columns]
        splines: dict[int, tuple[CubicSpline, list[str]]] = {}
        ends = []
        for number in sorted({number for number, _ in chosen}):
            table = self._tables[number]
            names = list(dict.fromkeys(name for n, name in chosen if n == number))
            times, rows = _times_and_rows(table, names)
            rate = (times.size - 1) / (times[-1] - times[0])
            if rate > self.sample_rate * (1 + SAME_RATE):
                what = f"'{names[0]}' is sampled at {rate:g} Hz, above resample: {self.sample_rate:g} Hz"
                raise DataError(what, self.path, f"resample: {rate:g} Hz keeps all of it")
            self._rates[number] = rate
            splines[number] = CubicSpline(times, rows, axis=0), names
            ends.append((times[0], times[-1]))
        first, last = max(start for start, _ in ends), min(stop for _, stop in ends)
        grid = first + np.arange(int((last - first) * self.sample_rate * (1 + 1e-12)) + 1) / self.sample_rate
        if last <= first or grid.size < 2:
            raise DataError("its groups have no time in common", self.path)
        # The last time may lie beyond the end by rounding.
        values = {n: spline(np.minimum(grid, last)) for n, (spline, _) in splines.items()}
        yield np.column_stack([values[n][:, splines[n][1].index(name)] for n, name in chosen])

    def findings(self) -> tuple[Finding, ...]:
        assert self.sample_rate is not None
        return tuple(
            note(
                "resampled",
                f"{', '.join(name for key, (n, name) in self._places.items() if n == number)}: recorded at "
                f"{rate:.6g} Hz, brought to {self.sample_rate:.6g} Hz by a cubic spline: within 0.5 % up to "
                f"{TRUE_SHARE * rate:.4g} Hz, and nothing above {rate / 2:.4g} Hz",
            )
            for number, rate in self._rates.items()
            if abs(rate / self.sample_rate - 1) > SAME_RATE
        )


def _time_of(table: RawTable) -> str:
    return "" if table.sample_rate is not None else table.columns[0]


def _times_and_rows(table: RawTable, names: Sequence[str]) -> tuple[FloatArray, FloatArray]:
    time = _time_of(table)
    rows = np.concatenate(list(table.chunks([time, *names] if time else names)))
    if rows.shape[0] < 2 or not np.isfinite(rows).all():
        raise DataError(f"'{names[0]}' lacks numbers, and is not resampled", table.path)
    if time:
        times, rows = rows[:, 0] * time_scale(time, table.units, table.path), rows[:, 1:]
        if np.any(np.diff(times) <= 0):
            raise DataError(f"the times of '{names[0]}' do not increase", table.path)
        return times, rows
    return getattr(table, "start", 0.0) + np.arange(rows.shape[0]) / float(table.sample_rate or 1.0), rows


class _Parallel:
    """Blocks of several streams with equally many rows, from row *skipped* of each on, until one ends."""

    def __init__(self, streams: Sequence[Iterator[FloatArray]], skipped: Sequence[int]) -> None:
        self._streams = list(streams)
        self._skip = list(skipped)
        self._buffers: list[FloatArray] = [np.empty((0, 0))] * len(streams)

    def __iter__(self) -> Iterator[list[FloatArray]]:
        while all(self._fill(number) for number in range(len(self._streams))):
            length = min(buffer.shape[0] for buffer in self._buffers)
            yield [buffer[:length] for buffer in self._buffers]
            self._buffers = [buffer[length:] for buffer in self._buffers]

    def _fill(self, number: int) -> bool:
        while not self._buffers[number].shape[0]:
            block = next(self._streams[number], None)
            if block is None:
                return False
            skip = min(self._skip[number], block.shape[0])
            self._skip[number] -= skip
            self._buffers[number] = block[skip:]
        return True

    def rests(self) -> list[int]:
        """Rows of each stream behind the last common one."""
        return [
            buffer.shape[0] + sum(block.shape[0] for block in stream)
            for buffer, stream in zip(self._buffers, self._streams, strict=True)
        ]
