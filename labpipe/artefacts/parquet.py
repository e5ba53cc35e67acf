"""Parquet files with our header among their metadata."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from labpipe.artefacts.header import Header, header_from_json
from labpipe.errors import DataError

HEADER_KEY = b"labpipe"


def open_parquet(path: Path) -> pq.ParquetFile:
    """A Parquet file opened for reading; DataError in plain words when it is none."""
    try:
        return pq.ParquetFile(path, pre_buffer=False)
    except FileNotFoundError:
        raise DataError("no such file", where=str(path)) from None
    except IsADirectoryError:
        raise DataError("is a folder, a file is needed", where=str(path)) from None
    except (pa.ArrowInvalid, OSError) as error:
        reason = "is a folder" if path.is_dir() else f"is not a readable Parquet file ({str(error).splitlines()[0].rstrip('.')})"
        raise DataError(reason, where=str(path)) from None


def batches(path: Path, columns: Sequence[str], n_row: int) -> Iterator[pa.RecordBatch]:
    """The columns in batches of at most *n_row* rows, one row group after the other: pyarrow would read the next ones ahead."""
    file = open_parquet(path)
    for group in range(file.num_row_groups):
        yield from file.iter_batches(batch_size=n_row, row_groups=[group], columns=list(columns))


def has_header(path: Path) -> bool:
    """True for a Parquet file with a labpipe header."""
    return HEADER_KEY in (open_parquet(path).metadata.metadata or {})


def read_header(path: Path, kind: str) -> Header:
    """The labpipe header of a Parquet file; DataError without one."""
    metadata = open_parquet(path).metadata.metadata or {}
    if HEADER_KEY not in metadata:
        hint = "another program may have saved it again and dropped the header; make it again with labpipe"
        raise DataError("has no labpipe header", where=str(path), hint=hint)
    return header_from_json(metadata[HEADER_KEY], path, kind)
