"""Parquet tables of other programs, WAV files and Excel workbooks."""

from __future__ import annotations

import struct
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from datetime import datetime, time
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from scipy.io import wavfile

from labpipe.arrays import FloatArray
from labpipe.artefacts.parquet import batches, numpy_array, open_parquet
from labpipe.errors import DataError
from labpipe.raw_files.table import load_extra
from labpipe.raw_files.text_table import StampClock, bracketed_unit, check_filled, header_of, reading

CHUNK_ROWS = 1 << 17
# Integers of up to so many bits are exact as float64; of longer ones pyarrow refuses those that are not.
MOST_EXACT_BITS = 32


class ParquetTable:
    """A Parquet table of numbers. Satisfies Table."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._schema = open_parquet(path).schema_arrow
        self.columns = tuple(self._schema.names)
        self.units = {name: unit for name in self.columns if (unit := bracketed_unit(name))}
        self.sample_rate: float | None = None
        self.n_row = open_parquet(path).metadata.num_rows
        if self.n_row == 0:
            raise DataError("has no rows", path)

    def chunks(self, columns: Sequence[str]) -> Iterator[FloatArray]:
        """Consecutive chunks (n, n_column) [unit of the file], a column beside the other. DataError for a
        column without numbers.
        """
        for parts in self.column_chunks(columns):
            rows = np.empty((len(columns), parts[0].size))
            for row, part in zip(rows, parts, strict=True):
                row[:] = part
            yield rows.T

    def column_chunks(self, columns: Sequence[str]) -> Iterator[list[FloatArray]]:
        """The same, each column (n,) [unit of the file] in its own precision where float64 holds that
        exactly.
        """
        for name in columns:
            kind = self._schema.field(name).type
            if not (pa.types.is_floating(kind) or pa.types.is_integer(kind)):
                raise DataError(f"column '{name}' holds {kind}, numbers are required", self.path)
        for batch in batches(self.path, list(dict.fromkeys(columns)), CHUNK_ROWS):
            yield [_numbers(batch.column(name)) for name in columns]


def _numbers(column: pa.Array) -> FloatArray:
    exact = pa.types.is_floating(column.type) or column.type.bit_width <= MOST_EXACT_BITS
    values: FloatArray = numpy_array(column if exact and not column.null_count else column.cast(pa.float64()))
    return values


class WavTable:
    """The tracks "1", "2", ... of a WAV file as shares of full scale. Satisfies Table."""

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
    check_filled(path)
    _check_length(path)
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


def _check_length(path: Path) -> None:
    with path.open("rb") as stream:
        for name, place, length in wav_chunks(stream):
            if name == b"data" and place + length > path.stat().st_size:
                raise DataError("ends before its last sample", path, "the file is truncated")


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
        width = Counter(_width(row) for row in rows if _is_numeric(row)).most_common(1)[0][0]
        self._first = next(n for n, row in enumerate(rows) if _is_numeric(row) and _width(row) == width)
        above = ["\t".join(_text(cell) for cell in row[:width]) for row in rows[: self._first]]
        names, units = header_of(above, "\t", range(width - 1, width + 1))
        self._names, self._rows = names, [row[:width] for row in rows[self._first :]]
        self.columns = tuple(name for name in names if name)
        self.units = units
        self.sample_rate: float | None = None

    def _rows_of_numbers(self) -> tuple[str, list[Row]]:
        openpyxl = load_extra("openpyxl", "excel", self.path)
        check_filled(self.path)
        with reading(self.path, "Excel workbook"), warnings.catch_warnings():
            # Of styles and extensions that are no numbers.
            warnings.simplefilter("ignore")
            book = openpyxl.load_workbook(self.path, read_only=True, data_only=True)
            sheets = {sheet.title: list(sheet.iter_rows(values_only=True)) for sheet in book.worksheets}
            book.close()
        numeric = {title: rows for title, rows in sheets.items() if any(map(_is_numeric, rows))}
        if len(numeric) != 1:
            what = f"several sheets hold numbers: {', '.join(numeric)}"
            what = what if numeric else "no sheet holds a row of numbers"
            raise DataError(what, self.path, "a workbook with one table is needed")
        return next(iter(numeric.items()))

    def chunks(self, columns: Sequence[str]) -> Iterator[FloatArray]:
        """The rows (n, n_column) [unit of the file] at once; DataError names the cell that is no number."""
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


def _is_numeric(row: Row) -> bool:
    cells = [cell for cell in row if cell is not None]
    is_value = all(
        isinstance(cell, (int, float, datetime, time)) and not isinstance(cell, bool) for cell in cells
    )
    return is_value and any(isinstance(cell, (int, float)) for cell in cells)


def _width(row: Row) -> int:
    return max((number + 1 for number, cell in enumerate(row) if cell is not None), default=0)


def _text(cell: Any) -> str:
    return "" if cell is None else str(cell).replace("\t", " ").replace("\n", " ")
