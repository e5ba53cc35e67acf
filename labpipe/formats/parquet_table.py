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


class ParquetTable:
    """A Parquet table of numbers. Satisfies Table."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._schema = open_parquet(path).schema_arrow
        self.columns = tuple(self._schema.names)
        self.units = {name: unit for name in self.columns if (unit := bracketed_unit(name))}
        self.sample_rate: float | None = None
        if open_parquet(path).metadata.num_rows == 0:
            raise DataError("has no rows", where=str(path))

    def chunks(self, columns: Sequence[str]) -> Iterator[FloatArray]:
        """Consecutive chunks (n, n_column) [unit of the file], a column beside the other; DataError for a column without numbers."""
        for name in columns:
            kind = self._schema.field(name).type
            if not (pa.types.is_floating(kind) or pa.types.is_integer(kind)):
                raise DataError(f"column '{name}' holds {kind}, numbers are required", where=str(self.path))
        for batch in batches(self.path, list(dict.fromkeys(columns)), CHUNK_ROWS):
            yield np.array([numpy_array(batch.column(name).cast(pa.float64())) for name in columns]).T
