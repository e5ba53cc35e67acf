"""Text tables with automatic detection of delimiter, decimal sign, header and units; read in blocks by pyarrow."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv as pc

from labpipe.arrays import FloatArray
from labpipe.arrow_arrays import numpy_array
from labpipe.errors import DataError, cut
from labpipe.formats.csv_layout import BLANKS, MISSING, fields_of, find_layout, is_number_or_missing
from labpipe.formats.packed import PACKED, damaged, open_unpacked
from labpipe.formats.squeezed import SqueezedBlanks
from labpipe.formats.time_stamps import StampClock

# Read ahead, a few times over: larger blocks are no faster and cost memory.
BLOCK_BYTES = 1 << 21


class CsvTable:
    """A text table of numbers. Satisfies Table; a faulty row is reported with its line number."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.layout = find_layout(path)
        self.columns = tuple(name for name in self.layout.names if name)
        self.units = self.layout.units
        self.sample_rate: float | None = None

    def chunks(self, columns: Sequence[str]) -> Iterator[FloatArray]:
        """Consecutive chunks (n, n_column) [unit of the file], a column beside the other.

        DataError names line and column of the first row that is not numbers.
        """
        fields = [str(self.layout.names.index(name)) for name in columns]
        clocks = {str(n): StampClock(self.layout.names[n]) for n in self.layout.stamps}
        try:
            with self._bytes() as source:
                for batch in self._open(source, fields):
                    if batch.num_rows:
                        yield np.array([self._numbers(batch.column(field), clocks.get(field)) for field in fields]).T
        except pa.ArrowInvalid as error:
            raise self._located(columns, str(error)) from None
        except UnicodeError as error:
            what = f"is not {self.layout.encoding.upper()} text as its first bytes say ({cut(str(error))})"
            raise DataError(what, where=str(self.path), hint="the file is damaged or cut off") from None
        except OSError as error:
            raise damaged(self.path, error) if self.path.suffix.lower() in PACKED else error from None

    def _open(self, source: Any, fields: list[str]) -> pc.CSVStreamingReader:
        layout = self.layout
        encoding = "utf8" if layout.encoding.startswith("utf-8") or layout.delimiter == BLANKS else layout.encoding
        n_field = len(layout.names)
        return pc.open_csv(
            source,
            pc.ReadOptions(
                block_size=BLOCK_BYTES,
                skip_rows=layout.first_line,
                column_names=[str(n) for n in range(n_field)],
                encoding=encoding,
            ),
            pc.ParseOptions(delimiter=layout.delimiter),
            pc.ConvertOptions(
                column_types={field: pa.string() if int(field) in layout.stamps else pa.float64() for field in fields},
                include_columns=fields,
                null_values=sorted(MISSING),
                decimal_point=layout.decimal,
            ),
        )

    @staticmethod
    def _numbers(column: pa.Array, clock: StampClock | None) -> FloatArray:
        """The numbers of a column, or the seconds of its times of day."""
        values: FloatArray = numpy_array(column) if clock is None else clock.seconds(column.to_pylist())
        return values

    @contextmanager
    def _bytes(self) -> Iterator[Any]:
        """The file, or its unpacked bytes, in which one blank stands between two fields."""
        if self.layout.delimiter == BLANKS:
            with SqueezedBlanks(open_unpacked(self.path), self.layout.encoding) as stream:
                yield stream
        elif self.path.suffix.lower() in PACKED:
            with open_unpacked(self.path) as stream:
                yield stream
        else:
            yield self.path

    def _located(self, columns: Sequence[str], reason: str) -> DataError:
        """The error with the first faulty line, found by reading the file again as text."""
        layout, indices = self.layout, [self.layout.names.index(name) for name in columns]
        with open_unpacked(self.path) as stream, io.TextIOWrapper(stream, encoding=layout.encoding, errors="replace") as lines:
            for number, line in enumerate(lines):
                if number < layout.first_line or not line.strip():
                    continue
                fields = fields_of(line.rstrip("\r\n"), layout.delimiter)
                where = f"{self.path}:{number + 1}"
                if len(fields) != len(layout.names):
                    return DataError(f"{len(fields)} fields, {len(layout.names)} are needed as in the rows before", where=where)
                for index, name in zip(indices, columns, strict=True):
                    if not is_number_or_missing(fields[index], layout.decimal):
                        return DataError(f"column '{name}': '{fields[index].strip()[:40]}' is not a number", where=where)
        return DataError(f"cannot be read: {reason.splitlines()[0]}", where=str(self.path))
