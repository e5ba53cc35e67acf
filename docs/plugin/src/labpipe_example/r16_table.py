"""Files of a small logger: one line of JSON, then 16-bit numbers, channel after channel within each
sample.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from labpipe.errors import DataError

CHUNK_ROWS = 1 << 16


class R16Table:
    """Columns by name, units and rate as the file states them, read in chunks.

    Satisfies labpipe.raw_files.table.RawTable.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with path.open("rb") as stream:
            head = self._head(stream.readline())
            self._start = stream.tell()
        self.columns = tuple(channel["name"] for channel in head["channels"])
        self.units = {channel["name"]: channel["unit"] for channel in head["channels"]}
        self.sample_rate: float | None = float(head["rate_hz"])
        self._scale = np.array([channel["scale"] for channel in head["channels"]])
        if (path.stat().st_size - self._start) % (2 * len(self.columns)):
            raise DataError("ends within a sample", where=str(path), hint="the file is cut off")

    def _head(self, line: bytes) -> dict[str, Any]:
        try:
            head: dict[str, Any] = json.loads(line)
        except ValueError:
            raise DataError("does not begin with a line of JSON", where=str(self.path)) from None
        return head

    def chunks(self, columns: Sequence[str]) -> Iterator[NDArray[np.float64]]:
        """Consecutive chunks (n, len(columns)) of the named columns, in the units stated."""
        wanted = [self.columns.index(name) for name in columns]
        with self.path.open("rb") as stream:
            stream.seek(self._start)
            while (raw := np.frombuffer(stream.read(2 * CHUNK_ROWS * len(self.columns)), "<i2")).size:
                yield raw.reshape(-1, len(self.columns))[:, wanted] * self._scale[wanted]
