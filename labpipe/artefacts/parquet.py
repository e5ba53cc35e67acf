"""Parquet files with our header among their metadata, checksums in their pages and a digest of the whole."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from labpipe.artefacts.digest import BLANK, DIGEST_KEY, DamagedError, parquet_digest, stamp_parquet
from labpipe.artefacts.header import Header, header_from_json
from labpipe.artefacts.json_file import BAD_ENTRY
from labpipe.artefacts.writing import OutputFolder
from labpipe.errors import DataError, shorten

# numpy arrays <-> pyarrow arrays, by their buffers: pyarrow's own conversions import pandas, a third of the
# start of a command.


def arrow_array(values: Any) -> pa.Array:
    """The numbers of an array (n,) [any unit] as a pyarrow array that shares them, or texts and other cells
    as a copy.
    """
    numbers = np.ascontiguousarray(values) if isinstance(values, np.ndarray) else None
    if numbers is None or numbers.ndim != 1 or numbers.dtype.kind not in "iuf":
        return pa.array(values)
    return pa.Array.from_buffers(
        pa.from_numpy_dtype(numbers.dtype), numbers.size, [None, pa.py_buffer(numbers)]
    )


def numpy_array(column: pa.Array | pa.ChunkedArray) -> NDArray[Any]:
    """The values (n,) [unit of the column].

    Those of one chunk of numbers without a missing one are shared and read-only.
    """
    array = column.combine_chunks() if isinstance(column, pa.ChunkedArray) else column
    if array.null_count or not (pa.types.is_integer(array.type) or pa.types.is_floating(array.type)):
        return array.to_numpy(zero_copy_only=False)
    if not len(array):
        return np.empty(0, array.type.to_pandas_dtype())
    values = np.frombuffer(array.buffers()[1], array.type.to_pandas_dtype())
    return values[array.offset : array.offset + len(array)]


HEADER_KEY = b"labpipe"
# What damaged bytes make pyarrow raise; MemoryError where a damaged length asks for more than there is.
_FAULTS = (pa.ArrowException, OSError, MemoryError, ValueError, OverflowError, TypeError, KeyError)


@contextmanager
def _reword_errors(path: Path) -> Iterator[None]:
    try:
        yield
    except DataError:
        raise
    except FileNotFoundError:
        raise DataError("no such file", path) from None
    except IsADirectoryError:
        raise DataError("is a folder, a file is needed", path) from None
    except _FAULTS as error:
        if path.is_dir():
            raise DataError("is a folder", path) from None
        reason = (str(error).splitlines() or [type(error).__name__])[0].rstrip(".")
        raise DamagedError(f"is not a readable Parquet file ({reason})", path) from None


def open_parquet(path: Path) -> pq.ParquetFile:
    """A Parquet file opened for reading; DataError in plain words when it is none."""
    with _reword_errors(path):
        return pq.ParquetFile(path, pre_buffer=False, page_checksum_verification=True)


def batches(path: Path, columns: Sequence[str], n_row: int) -> Iterator[pa.RecordBatch]:
    """The columns in batches of at most *n_row* rows, one row group after the other: pyarrow would read the
    next ones ahead.
    """
    file = open_parquet(path)
    with _reword_errors(path):
        for group in range(file.num_row_groups):
            yield from file.iter_batches(batch_size=n_row, row_groups=[group], columns=list(columns))


@contextmanager
def check_layout(path: Path) -> Iterator[None]:
    """DamagedError where header or columns are not those of the artefact: only a file without a digest gets
    so far.
    """
    try:
        yield
    except BAD_ENTRY as error:
        if isinstance(error, DataError):
            raise
        raise DamagedError(
            f"is not as labpipe writes it ({type(error).__name__}: {shorten(str(error))})", path
        ) from None


def read_columns(path: Path, columns: Sequence[str] | None = None) -> pa.Table:
    """The columns of these names, or all; DataError in plain words for damaged pages."""
    with _reword_errors(path):
        return open_parquet(path).read(columns=None if columns is None else list(columns))


def metadata_of(header: Header) -> dict[bytes, bytes]:
    """The metadata of a file that `stamp_parquet` completes: the header, and the place of the digest."""
    return {HEADER_KEY: header.to_json().encode(), DIGEST_KEY: BLANK}


def write_columns(path: Path, columns: Mapping[str, Any], header: Header) -> None:
    """Write columns of equal length with the header and the digest."""
    table = pa.table({name: arrow_array(values) for name, values in columns.items()}).replace_schema_metadata(
        metadata_of(header)
    )
    pq.write_table(table, path, compression="zstd", write_page_checksum=True)
    stamp_parquet(path)


def has_header(path: Path) -> bool:
    """True for a Parquet file with a labpipe header."""
    return HEADER_KEY in (open_parquet(path).metadata.metadata or {})


def read_header(path: Path, kind: str = "") -> Header:
    """The header, of any kind for ""; DataError without one, DamagedError for content of another digest."""
    with _reword_errors(path):
        digest = parquet_digest(path)
    metadata = open_parquet(path).metadata.metadata or {}
    if HEADER_KEY not in metadata:
        hint = "another program may have saved it again and dropped the header; make it again with labpipe"
        raise DataError("has no labpipe header", path, hint)
    return header_from_json(metadata[HEADER_KEY], path, kind, digest)


def fresh_path(output: OutputFolder, name: str, header: Header) -> Path | None:
    """The path of an artefact that need not be made again; a damaged one is named in the remarks."""
    path = output.read_path(name)
    if not path.exists():
        return None
    try:
        existing = read_header(path, header.kind)
        if not existing.same_work(header):
            return None
        if not existing.digest:
            # This code writes a digest: it was lost.
            raise DamagedError("carries no digest")
    except DamagedError as error:
        output.remarks.append(remake_line(error, path))
        return None
    return path


def remake_line(fault: DataError, path: Path) -> str:
    """The line that says why an artefact is made again."""
    return f"{path}: {fault.what}; it is made again"
