"""Parquet tables of other programs, WAV files and Excel workbooks."""

from __future__ import annotations

import re
import struct
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from datetime import datetime, time
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray
from scipy.io import wavfile

from labpipe.arrays import FloatArray
from labpipe.artefacts.parquet import batches, numpy_array, open_parquet
from labpipe.errors import DataError
from labpipe.raw_files.table import load_extra
from labpipe.raw_files.text_table import StampClock, bracketed_unit, header_of, reading

CHUNK_ROWS = 1 << 17
# Integers of up to so many bits are exact as float64; of longer ones pyarrow refuses those that are not.
MOST_EXACT_BITS = 32


_TICKS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}


# Of the metadata of a Parquet table that states its rate [Hz].
RATE_KEY = b"sample_rate"


class ParquetTable:
    """The columns of a Parquet table that hold numbers, states (0 or 1), or times, in seconds since the
    midnight before the first. Satisfies RawTable.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        file = open_parquet(path)
        self._kinds = {field.name: field.type for field in file.schema_arrow}
        held = [(name, _is_number(self._kinds[name])) for name in file.schema_arrow.names]
        self.columns = tuple(name for name, is_number in held if is_number)
        self.texts = tuple(name for name, is_number in held if not is_number)
        self.units = {name: unit for name in self.columns if (unit := bracketed_unit(name))}
        self.units |= {name: "s" for name in self.columns if pa.types.is_temporal(self._kinds[name])}
        rate = (file.schema_arrow.metadata or {}).get(RATE_KEY)
        self.sample_rate: float | None = None if rate is None else float(rate)
        self.n_row = file.metadata.num_rows
        if self.n_row == 0 or not self.columns:
            raise DataError("has no rows" if self.columns else "has no column of numbers", path)

    def chunks(self, columns: Sequence[str]) -> Iterator[FloatArray]:
        """Consecutive chunks (n, n_column) [unit of the file], a column beside the other."""
        for parts in self.column_chunks(columns):
            rows = np.empty((len(columns), parts[0].size))
            for row, part in zip(rows, parts, strict=True):
                row[:] = part
            yield rows.T

    def column_chunks(self, columns: Sequence[str]) -> Iterator[list[FloatArray]]:
        """The same, each column (n,) [unit of the file] in its own precision where float64 holds that
        exactly.
        """
        midnights: dict[str, int] = {}
        for batch in batches(self.path, list(dict.fromkeys(columns)), CHUNK_ROWS):
            yield [
                _seconds(batch.column(name), name, midnights)
                if pa.types.is_temporal(self._kinds[name])
                else _numbers(batch.column(name))
                for name in columns
            ]


def _is_number(kind: pa.DataType) -> bool:
    types = pa.types
    is_time = types.is_timestamp(kind) or types.is_duration(kind) or types.is_time(kind)
    plain = types.is_floating(kind) or types.is_integer(kind) or types.is_decimal(kind)
    return plain or types.is_boolean(kind) or is_time


def _numbers(column: pa.Array) -> FloatArray:
    kind = column.type
    exact = pa.types.is_floating(kind) or (pa.types.is_integer(kind) and kind.bit_width <= MOST_EXACT_BITS)
    values: FloatArray = numpy_array(column if exact and not column.null_count else column.cast(pa.float64()))
    return values


def _seconds(column: pa.Array, name: str, midnights: dict[str, int]) -> FloatArray:
    """Times [s] of the day of the first one, which is put down in *midnights* under the *name*."""
    tick = _TICKS[column.type.unit]
    counts = column.cast(pa.int32() if column.type.bit_width == 32 else pa.int64()).cast(pa.int64())
    first = next((count.as_py() for count in counts if count.is_valid), 0)
    day = round(86400 / tick)
    midnight = midnights.setdefault(name, first // day * day if pa.types.is_timestamp(column.type) else 0)
    # Of whole numbers: their difference is exact.
    seconds: FloatArray = tick * numpy_array(pc.subtract(counts, midnight).cast(pa.float64()))
    return seconds


class WavTable:
    """The tracks "1", "2", ... of a WAV file as shares of full scale. Satisfies RawTable."""

    def __init__(self, path: Path) -> None:
        self.path = path
        rate, self._samples = _read(path)
        if self._samples.shape[0] < 1:
            raise DataError("holds no samples", path)
        self.columns = tuple(str(n + 1) for n in range(self._samples.shape[1]))
        self.units = dict.fromkeys(self.columns, "1")
        self.sample_rate: float | None = float(rate)

    def chunks(self, columns: Sequence[str]) -> Iterator[FloatArray]:
        """Consecutive chunks (n, n_column) [1], relative to full scale."""
        indices = [self.columns.index(name) for name in columns]
        for start in range(0, self._samples.shape[0], CHUNK_ROWS):
            yield _share(self._samples[start : start + CHUNK_ROWS, indices])


def _read(path: Path) -> tuple[int, NDArray[np.generic]]:
    """(rate [Hz], samples (n, n_track)), mapped from the file where its format (not 24 bit) permits it."""
    with path.open("rb") as stream:
        for name, place, length in wav_chunks(stream):
            if name == b"data" and place + length > path.stat().st_size:
                raise DataError("ends before its last sample", path, "the file is truncated")
    with reading(path, "WAV file"), warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            rate, samples = wavfile.read(str(path), mmap=True)
        except ValueError:
            rate, samples = wavfile.read(str(path))
    if any("EOF" in str(warning.message) for warning in caught):
        raise DataError("ends before its last sample", path, "the file is truncated")
    if rate <= 0:
        raise DataError("has no sampling rate", path)
    return rate, samples.reshape(samples.shape[0], -1)


def wav_chunks(stream: BinaryIO) -> Iterator[tuple[bytes, int, int]]:
    """Name, place and stated length [bytes] of the content of every chunk of a WAV file so far."""
    order = {b"RIFF": "<", b"RIFX": ">"}.get(stream.read(4))
    place = 12
    while order is not None:
        stream.seek(place)
        head = stream.read(8)
        if len(head) < 8:
            return
        name, length = struct.unpack(f"{order}4sI", head)
        yield name, place + 8, length
        place += 8 + length + length % 2


def _share(samples: NDArray[np.generic]) -> FloatArray:
    """Samples by full scale: integers by 2^(bits - 1), bytes around 128. Scipy gives 24 bit as the upper part
    of 32.
    """
    if samples.dtype.kind == "f":
        return samples.astype(np.float64)
    half = 2.0 ** (8 * samples.dtype.itemsize - 1)
    return (samples.astype(np.float64) - (half if samples.dtype.kind == "u" else 0.0)) / half


Row = tuple[Any, ...]


class XlsxTable:
    """The columns of the only sheet with numbers; formulas count with the values that Excel stored. Satisfies
    Table.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._sheet, rows = self._rows_of_numbers()
        width, numeric = _places_of_numbers(rows)
        self._first = next(
            n for n, row in enumerate(rows) if _width(row) == width and _is_numeric([row[p] for p in numeric])
        )
        above = [
            "\t".join(re.sub(r"[\t\n]", " ", str("" if c is None else c)) for c in row[:width])
            for row in rows[: self._first]
        ]
        names, units = header_of(above, "\t", range(width - 1, width + 1))
        self._names, self._rows = names, [row[:width] for row in rows[self._first :]]
        self.columns = tuple(names[place] for place in numeric if names[place])
        self.texts = tuple(name for place, name in enumerate(names) if name and place not in numeric)
        self.units = units
        self.sample_rate: float | None = None

    def _rows_of_numbers(self) -> tuple[str, list[Row]]:
        openpyxl = load_extra("openpyxl", "excel", self.path)
        with reading(self.path, "Excel workbook"), warnings.catch_warnings():
            # Of styles and extensions that are not numbers.
            warnings.simplefilter("ignore")
            book = openpyxl.load_workbook(self.path, read_only=True, data_only=True)
            sheets = {sheet.title: list(sheet.iter_rows(values_only=True)) for sheet in book.worksheets}
            book.close()
        numeric = {title: rows for title, rows in sheets.items() if any(map(_is_numeric, rows))}
        numeric = numeric or {title: rows for title, rows in sheets.items() if _places_of_numbers(rows)[1]}
        if len(numeric) != 1:
            what = f"several sheets hold numbers: {', '.join(numeric)}"
            what = what if numeric else "no sheet holds a row of numbers"
            raise DataError(what, self.path, "a workbook with one table is needed")
        return next(iter(numeric.items()))

    def chunks(self, columns: Sequence[str]) -> Iterator[FloatArray]:
        """The rows (n, n_column) [unit of the file] at once; DataError names a cell without a number."""
        rows = [
            (number, row)
            for number, row in enumerate(self._rows, self._first + 1)
            if any(cell is not None for cell in row)
        ]
        yield np.column_stack([self._column(self._names.index(name), rows) for name in columns])

    def _column(self, place: int, rows: Sequence[tuple[int, Row]]) -> FloatArray:
        clock = StampClock(self._names[place])
        values = np.empty(len(rows))
        for number, (row_number, row) in enumerate(rows):
            cell = row[place] if place < len(row) else None
            if isinstance(cell, (datetime, time)):
                values[number] = clock.seconds([str(cell)])[0]
            elif cell is None or (isinstance(cell, (int, float)) and not isinstance(cell, bool)):
                values[number] = np.nan if cell is None else cell
            else:
                what = f"column '{self._names[place]}': '{str(cell)[:40]}' is not a number"
                raise DataError(what, f"{self.path}: sheet {self._sheet}, row {row_number}")
        return values


def _places_of_numbers(rows: Sequence[Row]) -> tuple[int, Sequence[int]]:
    """How wide most rows of numbers are, and the places of numbers in them: all, or those beside texts that
    most rows have; none of a sheet without a table.
    """
    filled = [row[:width] for row in rows if (width := _width(row))]
    widths = Counter(len(row) for row in filled if _is_numeric(row)).most_common(1)
    kinds = Counter(tuple(map(_is_value, row)) for row in filled).most_common(1)
    if widths and (2 * widths[0][1] >= len(filled) or not any(kinds[0][0])):
        return widths[0][0], range(widths[0][0])
    if not kinds or kinds[0][1] < max(2, len(filled) / 2):
        return (widths[0][0], range(widths[0][0])) if widths else (0, ())
    (kind, _) = kinds[0]
    return len(kind), [place for place, is_value in enumerate(kind) if is_value]


def _is_value(cell: Any) -> bool:
    return isinstance(cell, (int, float, datetime, time)) and not isinstance(cell, bool)


def _is_numeric(row: Sequence[Any]) -> bool:
    cells = [cell for cell in row if cell is not None]
    return all(map(_is_value, cells)) and any(isinstance(cell, (int, float)) for cell in cells)


def _width(row: Row) -> int:
    return max((number + 1 for number, cell in enumerate(row) if cell is not None), default=0)
