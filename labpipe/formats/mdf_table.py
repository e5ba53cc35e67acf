"""MDF files of version 3 and 4 (.mf4, .mdf), read by asammdf: the channels of the longest group, with its times."""

from __future__ import annotations

import gc
import logging
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.errors import DataError
from labpipe.formats.names import unique
from labpipe.formats.table import load_extra

CHUNK_ROWS = 1 << 17
TIME = "time [s]"


class MdfTable:
    """The numeric channels of the longest group and their times as the column "time [s]". Satisfies Table."""

    def __init__(self, path: Path) -> None:
        self.path = path
        if path.stat().st_size == 0:
            raise DataError("the file is empty", where=str(path))
        self._library = load_extra("asammdf", "mdf", path)
        logging.getLogger("asammdf").setLevel(logging.CRITICAL)
        with self._open() as file:
            groups = [(int(group.channel_group.cycles_nr), number) for number, group in enumerate(file.groups)]
            self._length, self._group = max(groups, default=(0, -1))
            if self._length < 2:
                raise DataError("holds no group of samples", where=str(path))
            master = file.masters_db.get(self._group)
            channels = [
                (channel.name, number, signal.unit)
                for number, channel in enumerate(file.groups[self._group].channels)
                if number != master and _is_numeric(signal := file.get(group=self._group, index=number, record_count=2))
            ]
        names = unique([name for name, _, _ in channels])
        self._places = dict(zip(names, (number for _, number, _ in channels), strict=True))
        self.columns = (TIME, *names)
        self.units = {name: unit for name, (_, _, unit) in zip(names, channels, strict=True) if unit}
        self.sample_rate: float | None = None

    @contextmanager
    def _open(self) -> Iterator[Any]:
        """The file; DataError for a damaged one, for which the library has errors of many kinds, at opening and at reading."""
        file, reason = self._opened()
        if not reason:
            try:
                with file:
                    yield file
                    return
            except DataError:
                raise
            except Exception as error:
                reason = str(error)
        raise DataError(f"is not a readable MDF file ({(reason.splitlines() or ['damaged'])[0][:80]})", where=str(self.path))

    def _opened(self) -> tuple[Any, str]:
        """The file, or why it cannot be opened."""
        with _without_complaints():
            try:
                return self._library.MDF(self.path), ""
            except Exception as error:
                reason = str(error) or "damaged"
            # What the library has begun goes here, not later.
            gc.collect()
        return None, reason

    def chunks(self, columns: Sequence[str]) -> Iterator[FloatArray]:
        """Consecutive chunks (n, n_column) [unit of the file], scaled."""
        with self._open() as file:
            for start in range(0, self._length, CHUNK_ROWS):
                part = {"record_offset": start, "record_count": min(CHUNK_ROWS, self._length - start)}
                times = file.get_master(self._group, **part)
                signals = [
                    times if name == TIME else file.get(group=self._group, index=self._places[name], **part).samples for name in columns
                ]
                yield np.column_stack([np.asarray(signal, np.float64) for signal in signals])


@contextmanager
def _without_complaints() -> Iterator[None]:
    """Silence for a half-made object of the library, which fails once more when it goes."""
    hook = sys.unraisablehook
    sys.unraisablehook = lambda _: None
    try:
        yield
    finally:
        sys.unraisablehook = hook


def _is_numeric(signal: Any) -> bool:
    return signal.samples.dtype.kind in "iuf" and signal.samples.ndim == 1
