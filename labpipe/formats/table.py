"""A table on disk: named columns of numbers, read chunk by chunk. READERS by suffix."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol, cast

from labpipe.arrays import FloatArray
from labpipe.errors import DataError
from labpipe.formats.guard import GuardedTable, guarded
from labpipe.formats.packed import plain_suffix
from labpipe.registry import Registry, nearest

TEXT_SUFFIXES = (".csv", ".txt", ".tsv", ".dat", ".asc")
READERS = Registry(
    "reader",
    {
        **dict.fromkeys(TEXT_SUFFIXES, "labpipe.formats.csv_table:CsvTable"),
        ".parquet": "labpipe.formats.parquet_table:ParquetTable",
        **dict.fromkeys((".uff", ".unv", ".uf"), "labpipe.formats.uff_read:UffTable"),
        ".mat": "labpipe.formats.mat_file:mat_table",
        **dict.fromkeys((".h5", ".hdf5", ".hdf"), "labpipe.formats.hdf5_table:hdf5_table"),
        ".tdms": "labpipe.formats.tdms_table:TdmsTable",
        ".wav": "labpipe.formats.wav_table:WavTable",
        ".lvm": "labpipe.formats.lvm_table:LvmTable",
        **dict.fromkeys((".npy", ".npz"), "labpipe.formats.numpy_table:numpy_table"),
        **dict.fromkeys((".xlsx", ".xlsm"), "labpipe.formats.xlsx_table:XlsxTable"),
        **dict.fromkeys((".mf4", ".mdf"), "labpipe.formats.mdf_table:mdf_table"),
    },
)


class Table(Protocol):
    """Columns by name; *units* and *sample_rate* [Hz] where the file states them; missing numbers are NaN."""

    path: Path
    columns: tuple[str, ...]
    units: dict[str, str]
    sample_rate: float | None

    def chunks(self, columns: Sequence[str]) -> Iterator[FloatArray]:
        """Consecutive chunks (n, n_column) [unit of the file] of the named columns."""
        ...


def open_table(path: Path) -> Table:
    """The table of a file by its suffix; DataError for a missing file, a folder, or an unknown kind."""
    if path.is_dir():
        raise DataError("is a folder, not a file", where=str(path))
    if not path.exists():
        raise DataError("no such file", where=str(path))
    suffix = plain_suffix(path)
    if suffix not in READERS.names():
        raise DataError(f"files with the ending '{suffix}' cannot be read", where=str(path), hint=f"known: {', '.join(READERS.names())}")
    if not path.is_file():
        raise DataError("is no regular file", where=str(path))
    table: Table = GuardedTable(guarded(READERS.load(suffix), path))
    return table


class QuickTable(Table, Protocol):
    """A table whose file states its *n_row* rows and is read as fast as labpipe's own recordings, column by column."""

    n_row: int

    def column_chunks(self, columns: Sequence[str]) -> Iterator[list[FloatArray]]:
        """Consecutive chunks of the named columns, each (n,) [unit of the file], in single precision or integers where the file is."""
        ...


def as_quick(table: Table) -> QuickTable | None:
    """The table where it is a quick one; None for any other."""
    return cast(QuickTable, table) if getattr(table, "n_row", None) is not None else None


def load_extra(module: str, extra: str, path: Path) -> Any:
    """A library that only some files need; DataError names the extra by which it is installed."""
    try:
        return import_module(module)
    except ImportError:
        raise DataError(f"needs the package {module}", where=str(path), hint=f"pip install 'labpipe[{extra}]'") from None


def check_columns(table: Table, required: Sequence[str]) -> None:
    """DataError for a required column that is missing (with the nearest name) or not unique."""
    for name in required:
        count = table.columns.count(name)
        if count == 0:
            raise DataError(f"no column '{name}'", where=str(table.path), hint=nearest(name, table.columns))
        if count > 1:
            raise DataError(f"the column '{name}' appears {count} times", where=str(table.path), hint="rename one of them")
