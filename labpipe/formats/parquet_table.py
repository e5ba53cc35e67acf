"""Parquet tables of other programs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa

from labpipe.arrays import FloatArray
from labpipe.arrow_arrays import numpy_array
from labpipe.artefacts.parquet import batches, open_parquet
from labpipe.errors import DataError
from labpipe.formats.csv_layout import bracketed_unit

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
            raise DataError("has no rows", where=str(path))

    def chunks(self, columns: Sequence[str]) -> Iterator[FloatArray]:
        """Consecutive chunks (n, n_column) [unit of the file], a column beside the other; DataError for a column without numbers."""
        for parts in self.column_chunks(columns):
            rows = np.empty((len(columns), parts[0].size))
            for row, part in zip(rows, parts, strict=True):
                row[:] = part
            yield rows.T

    def column_chunks(self, columns: Sequence[str]) -> Iterator[list[FloatArray]]:
        """The same, each column (n,) [unit of the file] in its own precision where float64 holds that exactly."""
        for name in columns:
            kind = self._schema.field(name).type
            if not (pa.types.is_floating(kind) or pa.types.is_integer(kind)):
                raise DataError(f"column '{name}' holds {kind}, numbers are required", where=str(self.path))
        for batch in batches(self.path, list(dict.fromkeys(columns)), CHUNK_ROWS):
            yield [_numbers(batch.column(name)) for name in columns]


def _numbers(column: pa.Array) -> FloatArray:
    """The numbers of a column (n,) [unit of the file]; those of a kind that float64 does not hold exactly as float64, or refused."""
    exact = pa.types.is_floating(column.type) or column.type.bit_width <= MOST_EXACT_BITS
    values: FloatArray = numpy_array(column if exact and not column.null_count else column.cast(pa.float64()))
    return values
