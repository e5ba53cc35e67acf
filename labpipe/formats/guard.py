"""The boundary to files of other programs: whatever damaged bytes make a library raise is a fault of the file."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.errors import DataError, LabpipeError, cut

Read = TypeVar("Read")


@contextmanager
def readable(path: Path) -> Iterator[None]:
    """DataError for every exception of a library inside the block; faults of the machine keep their own words."""
    try:
        # Numbers beyond all measure are refused by the screening, with channel and sample.
        with np.errstate(all="ignore"):
            yield
    except LabpipeError:
        raise
    except OSError as error:
        if error.errno is not None:
            raise
        raise _unreadable(path, error) from None
    except Exception as error:
        raise _unreadable(path, error) from None


def _unreadable(path: Path, error: Exception) -> DataError:
    said = (str(error).splitlines() or [""])[0].rstrip(".")
    return DataError(f"cannot be read ({cut(': '.join(filter(None, (type(error).__name__, said))))})", where=str(path), hint=DAMAGED)


DAMAGED = "the file is damaged, or not what its ending says"


def guarded(read: Callable[..., Read], path: Path, *arguments: Any) -> Read:
    """What *read* makes of a file."""
    with readable(path):
        return read(path, *arguments)


class GuardedTable:
    """A table whose chunks are read within the boundary. Satisfies Table."""

    def __init__(self, table: Any) -> None:
        self._table = table

    def __getattr__(self, name: str) -> Any:
        return getattr(self._table, name)

    def chunks(self, columns: Sequence[str]) -> Iterator[FloatArray]:
        """The chunks (n, n_column) [unit of the file] of the table."""
        return self._guarded(self._table.chunks(columns))

    def column_chunks(self, columns: Sequence[str]) -> Iterator[list[FloatArray]]:
        """Column by column (n,) [unit of the file], of a table that has them so."""
        return self._guarded(self._table.column_chunks(columns))

    def _guarded(self, chunks: Iterator[Read]) -> Iterator[Read]:
        while True:
            with readable(self._table.path):
                chunk = next(chunks, None)
            if chunk is None:
                return
            yield chunk
