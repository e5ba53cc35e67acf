"""MDF files of version 3 and 4 (.mf4, .mdf), read by asammdf: the channels of the longest group, with its
times; other groups on request.
"""

from __future__ import annotations

import gc
import io
import logging
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stdout, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.errors import DataError
from labpipe.raw_files.table import check_in_child, check_names, load_extra, unique
from labpipe.raw_files.text_table import not_readable

CHUNK_ROWS = 1 << 17
TIME = "time [s]"
# No packing of a block makes more bytes of one.
MOST_SQUEEZED = 1 << 16


def mdf_table(path: Path) -> MdfTable:
    """The table of a file that a child process has looked at: places beyond a sample make the
    library crash.
    """
    load_extra("asammdf", "mdf", path)
    check_in_child(path, "MDF", touch)
    return MdfTable(path)


def touch(path: Path) -> None:
    """Open a file and read the first and the last two samples of every channel of every group."""
    longest = MdfTable(path)
    for table in (longest, *longest.others):
        # The first two were read when the table was made.
        table.rows(table.columns, table._length - 2, 2)


def growing_rows(
    path: Path, columns: Sequence[str], first: int, most: int
) -> tuple[FloatArray, float | None]:
    """At most *most* rows (n, n_column) [unit of the file] from row *first* on of a file that is being
    written, as far as they are whole; it states no rate. DataError for a column that is not there.
    """
    table: MdfTable | None = None
    rows: FloatArray = np.empty((0, len(columns)))
    # Between two writes it may not be readable.
    with suppress(DataError):
        table = MdfTable(path) if first else mdf_table(path)
        if set(columns) <= set(table.columns):
            rows = table.rows(columns, first, most)
    if table is not None:
        check_names(path, columns, table.columns)
    return rows, None


class MdfTable:
    """The numeric channels of the longest group, or of *group*, and their times as the column "time [s]".
    Satisfies RawTable. `others` are the tables of the other groups.
    """

    def __init__(self, path: Path, group: int | None = None) -> None:
        self.path = path
        self._library = load_extra("asammdf", "mdf", path)
        logging.getLogger("asammdf").setLevel(logging.CRITICAL)
        with _quiet(), self._open() as file:
            groups = [
                (int(group.channel_group.cycles_nr), number) for number, group in enumerate(file.groups)
            ]
            if group is not None:
                groups = [groups[group]]
            self._length, self._group = max(groups, default=(0, -1))
            if self._length < 2:
                raise DataError("holds no group of samples", path)
            self._check_amount(file.groups[self._group])
            self._others = [n for length, n in groups if n != self._group and length > 1]
            self.unused = {
                channel.name: length
                for length, n in groups
                if n in self._others
                for place, channel in enumerate(file.groups[n].channels)
                if place != file.masters_db.get(n)
            }
            master = file.masters_db.get(self._group)
            channels = [
                (channel.name, number, signal.unit)
                for number, channel in enumerate(file.groups[self._group].channels)
                if number != master
                and (signal := file.get(group=self._group, index=number, record_count=2)).samples.ndim == 1
                and signal.samples.dtype.kind in "iuf"
            ]
        names = unique([name for name, _, _ in channels])
        self._places = dict(zip(names, (number for _, number, _ in channels), strict=True))
        self.columns = (TIME, *names)
        self.units = {name: unit for name, (_, _, unit) in zip(names, channels, strict=True) if unit}
        self.sample_rate: float | None = None

    @property
    def others(self) -> tuple[MdfTable, ...]:
        """The tables of the other groups that hold numeric channels."""
        tables = (MdfTable(self.path, number) for number in self._others)
        return tuple(table for table in tables if len(table.columns) > 1)

    def _check_amount(self, group: Any) -> None:
        """DataError where the file says more samples than its blocks hold: the library would make room for
        all.
        """
        # Marks of invalid samples stand behind each sample, except in files that keep every column by itself.
        marks = int(getattr(group.channel_group, "invalidation_bytes_nr", 0))
        marks = 0 if getattr(group, "uses_ld", False) else marks
        size, record = self.path.stat().st_size, int(group.channel_group.samples_byte_nr) + marks
        room = sum(
            min(info.original_size, MOST_SQUEEZED * min(info.compressed_size, size))
            for info in group.data_blocks
        )
        if self._length * record > room:
            what = (
                f"is not a readable MDF file ({self._length} samples of {record} bytes are stated, "
                f"{room} bytes are there)"
            )
            raise DataError(what, self.path, "the file is cut off or damaged")

    @contextmanager
    def _open(self) -> Iterator[Any]:
        # The library finishes a copy of a file that is being written, and forgets it where that fails.
        with TemporaryDirectory(prefix="labpipe-mdf-") as folder:
            file, reason = self._open_file(folder)
            if not reason:
                try:
                    with file:
                        yield file
                        return
                except DataError:
                    raise
                except Exception as error:
                    reason = str(error)
        raise not_readable(self.path, "MDF file", reason)

    def _open_file(self, folder: str) -> tuple[Any, str]:
        with _quiet(), _disable_collector():
            try:
                return self._library.MDF(self.path, temporary_folder=folder), ""
            except Exception as error:
                reason = str(error) or "damaged"
            # What the library has begun goes here, not later.
            gc.collect(0)
        return None, reason

    def chunks(self, columns: Sequence[str]) -> Iterator[FloatArray]:
        """Consecutive chunks (n, n_column) [unit of the file], scaled."""
        with self._open() as file:
            for start in range(0, self._length, CHUNK_ROWS):
                with _quiet():
                    chunk = self._chunk(file, columns, start, min(CHUNK_ROWS, self._length - start))
                yield chunk

    def rows(self, columns: Sequence[str], first: int, most: int) -> FloatArray:
        """At most *most* rows (n, n_column) [unit of the file] from row *first* on."""
        count = min(most, self._length - first)
        if count <= 0:
            return np.empty((0, len(columns)))
        with self._open() as file, _quiet():
            return self._chunk(file, columns, first, count)

    def _chunk(self, file: Any, columns: Sequence[str], start: int, count: int) -> FloatArray:
        part = {"record_offset": start, "record_count": count}
        times = file.get_master(self._group, **part)
        columns_read = [
            times if name == TIME else self._valid(file, self._places[name], part) for name in columns
        ]
        if len(times) != count:
            what = f"ends within its {self._length} samples"
            raise DataError(what, self.path, "the file is cut off or damaged")
        return np.column_stack(columns_read)

    def _valid(self, file: Any, index: int, part: dict[str, int]) -> FloatArray:
        """Samples (n,) [unit of the file], NaN where the file marks them as invalid."""
        signal = file.get(group=self._group, index=index, ignore_invalidation_bits=True, **part)
        invalid = False if signal.invalidation_bits is None else np.asarray(signal.invalidation_bits, bool)
        return np.where(invalid, np.nan, np.asarray(signal.samples, np.float64))


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence of the library, which prints what it holds of a damaged file and fails once more when that
    goes.
    """
    hook = sys.unraisablehook
    sys.unraisablehook = lambda _: None
    try:
        with redirect_stdout(io.StringIO()):
            yield
    finally:
        sys.unraisablehook = hook


@contextmanager
def _disable_collector() -> Iterator[None]:
    """What is made within stays in the youngest generation, where a search for garbage finds it at once."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()
