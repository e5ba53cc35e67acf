"""Where samples come from while a test runs: growing files, folders, raw frames on standard input, virtual
rigs in real time.

A source gives samples in the file's units, in the order of the rig's columns, as they come. Other packages
add sources by the ending of their files under the entry-point group labpipe.sample_source.
"""

from __future__ import annotations

import io
import json
import select
import struct
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO, Protocol

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.errors import ConfigError, DataError
from labpipe.raw_files.table import check_columns, open_table
from labpipe.raw_files.text_table import CsvTable, plain_suffix
from labpipe.registry import Registry, nearest

# Samples that are handed on at once.
MOST_ROWS = 1 << 16
# What a file must hold before its layout is looked at [bytes].
LEAST_TEXT = 64


class SampleStream(Protocol):
    """Samples as they come. *sample_rate* [Hz] where the source states it."""

    sample_rate: float | None

    def read(self) -> FloatArray | None:
        """The next samples (n, n_column) [unit of the file]; n is 0 where none came yet, None at the end."""
        ...

    @property
    def restarted(self) -> bool:
        """Whether the samples read last begin another recording."""
        ...


Open = Callable[[Path, Sequence[str]], SampleStream]

SOURCES = Registry("sample source")


def open_source(path: Path, columns: Sequence[str]) -> SampleStream:
    """The stream of a growing file or folder; DataError for a kind that cannot be read while it grows."""
    if path.is_dir():
        return Folder(path, columns)
    suffix = plain_suffix(path)
    if suffix not in SOURCES or path.suffix.lower() != suffix:
        raise DataError(
            f"files with the ending '{path.suffix}' cannot be read while they grow",
            where=str(path),
            hint=f"known: {', '.join(SOURCES.names())}; or a folder into which whole files fall",
        )
    if not path.parent.is_dir():
        raise DataError("no such folder", where=str(path.parent))
    return SOURCES.load(suffix)(path, columns)


class _Source:
    """What all sources here share; *restarted*: the samples read last begin another recording."""

    restarted = False

    def read(self) -> FloatArray | None:
        """The next samples (n, n_column) [unit of the file]; n is 0 where none came yet, None at the end."""
        return self._next()

    def _next(self) -> FloatArray | None:
        raise NotImplementedError


class _Growing(_Source):
    def __init__(self, path: Path, columns: Sequence[str]) -> None:
        self.path, self.columns = path, list(columns)
        self.sample_rate: float | None = None
        self._none = np.empty((0, len(self.columns)))

    def _size(self) -> int:
        try:
            return self.path.stat().st_size
        except FileNotFoundError:
            return 0


class GrowingText(_Growing):
    """A text table that grows line by line; a line without its end waits for it."""

    def __init__(self, path: Path, columns: Sequence[str]) -> None:
        super().__init__(path, columns)
        self._table: CsvTable | None = None
        self._place = 0
        self._rest = b""

    def _next(self) -> FloatArray | None:
        self.restarted = False
        size = self._size()
        if size < self._place:
            # The logger began the file anew.
            self._table, self._place, self._rest, self.restarted = None, 0, b"", True
        if self._table is None and not self._opened(size):
            return self._none
        assert self._table is not None
        with self.path.open("rb") as stream:
            stream.seek(self._place)
            text = stream.read(MOST_ROWS * 16 * (1 + len(self.columns)))
        self._place += len(text)
        whole, end, rest = (self._rest + text).rpartition(b"\n")
        self._rest = rest if end else self._rest + text
        if not end or not whole.strip():
            return self._none
        return self._table.rows_of(whole + end, self.columns)

    def _opened(self, size: int) -> bool:
        if size < LEAST_TEXT:
            return False
        with self.path.open("rb") as stream:
            head = stream.read(1 << 18)
        if head.count(b"\n") < 3:
            return False
        try:
            table = CsvTable(self.path)
        except DataError:
            if head.count(b"\n") > 500:
                raise
            return False
        check_columns(table, self.columns)
        lines = head.split(b"\n")[: table.layout.first_line]
        self._place, self._table = sum(len(line) + 1 for line in lines), table
        return True


class GrowingTable(_Growing):
    """A file that is opened anew each time: TDMS while it is written, Parquet once it is whole."""

    def __init__(self, path: Path, columns: Sequence[str]) -> None:
        super().__init__(path, columns)
        self._done = self._seen = 0

    def _next(self) -> FloatArray | None:
        size = self._size()
        if not size or size == self._seen:
            return self._none
        rows, self.sample_rate = self._rows_from(self._done)
        if not rows.shape[0]:
            return rows
        self._done += rows.shape[0]
        if rows.shape[0] < MOST_ROWS:
            self._seen = size
        return rows

    def _rows_from(self, first: int) -> tuple[FloatArray, float | None]:
        if self.path.suffix.lower() == ".tdms":
            from labpipe.raw_files.tdms_table import growing_rows

            return growing_rows(self.path, self.columns, first, MOST_ROWS)
        try:
            table = open_table(self.path)
        except DataError:
            # Without its foot a Parquet file is not whole yet.
            return self._none, self.sample_rate
        check_columns(table, self.columns)
        rows = np.concatenate([self._none, *table.chunks(self.columns)])
        return rows[first : first + MOST_ROWS], table.sample_rate


class GrowingWav(_Growing):
    """A WAV file whose data follow its head, whatever length that states; values relative to full scale."""

    def __init__(self, path: Path, columns: Sequence[str]) -> None:
        super().__init__(path, columns)
        self._place, self._kind, self._n_track = 0, np.dtype("<i2"), 0

    def _next(self) -> FloatArray | None:
        if not self._place and not self._opened():
            return self._none
        frame = self._kind.itemsize * self._n_track
        n = min((self._size() - self._place) // frame, MOST_ROWS)
        if n <= 0:
            return self._none
        with self.path.open("rb") as stream:
            stream.seek(self._place)
            raw = np.frombuffer(stream.read(n * frame), self._kind).reshape(-1, self._n_track)
        self._place += raw.shape[0] * frame
        chosen = raw[:, [int(name) - 1 for name in self.columns]].astype(float)
        return chosen / (1.0 if self._kind.kind == "f" else 2.0 ** (8 * self._kind.itemsize - 1))

    def _opened(self) -> bool:
        if self._size() < 44:
            return False
        with self.path.open("rb") as stream:
            head = stream.read(4096)
        if head[:4] != b"RIFF" or head[8:12] != b"WAVE":
            raise DataError("is no WAV file", where=str(self.path))
        at, kinds = 12, {(1, 16): "<i2", (1, 32): "<i4", (3, 32): "<f4", (3, 64): "<f8"}
        while at + 8 <= len(head):
            name, length = head[at : at + 4], struct.unpack_from("<I", head, at + 4)[0]
            if name == b"fmt ":
                form, self._n_track, rate, _, _, bits = struct.unpack_from("<HHIIHH", head, at + 8)
                if form == 0xFFFE:
                    form = struct.unpack_from("<H", head, at + 32)[0]
                if (form, bits) not in kinds:
                    raise DataError(
                        f"{bits}-bit samples cannot be read while they grow", where=str(self.path)
                    )
                self._kind, self.sample_rate = np.dtype(kinds[form, bits]), float(rate)
            elif name == b"data":
                known = [str(n + 1) for n in range(self._n_track)]
                for column in self.columns:
                    if column not in known:
                        raise DataError(
                            f"no column '{column}'", where=str(self.path), hint=nearest(column, known)
                        )
                self._place = at + 8
                return True
            at += 8 + length + length % 2
        return False


class GrowingHdf5(_Growing):
    """Datasets of an HDF5 file that another process appends to (single writer, multiple readers)."""

    def __init__(self, path: Path, columns: Sequence[str]) -> None:
        super().__init__(path, columns)
        self._file: Any = None
        self._done = 0

    def _next(self) -> FloatArray | None:
        import h5py

        if self._file is None:
            if not self._size():
                return self._none
            try:
                self._file = h5py.File(self.path, "r", libver="latest", swmr=True)
            except OSError:
                return self._none
        datasets = []
        for name in self.columns:
            if name not in self._file:
                known = [key for key, value in self._file.items() if hasattr(value, "shape")]
                raise DataError(f"no column '{name}'", where=str(self.path), hint=nearest(name, known))
            datasets.append(self._file[name])
            datasets[-1].refresh()
        last = min(min(dataset.shape[0] for dataset in datasets), self._done + MOST_ROWS)
        rows = np.array([dataset[self._done : last] for dataset in datasets], float).T
        self._done = max(last, self._done)
        return rows


class Folder(_Source):
    """A folder into which whole recordings fall, each read once it no longer changes."""

    def __init__(self, path: Path, columns: Sequence[str], settle: float = 1.0) -> None:
        self.path, self.columns, self._settle = path, list(columns), settle
        self.sample_rate: float | None = None
        self.restarted = False
        self._read: set[Path] = set()
        self._chunks: Iterator[FloatArray] = iter(())
        self.files: list[Path] = []

    def _next(self) -> FloatArray | None:
        self.restarted = False
        chunk = next(self._chunks, None)
        if chunk is not None:
            return chunk
        for path in sorted(self.path.iterdir()):
            if path in self._read or path.name.startswith(".") or not path.is_file():
                continue
            if time.time() - path.stat().st_mtime < self._settle or not path.stat().st_size:
                continue
            self._read.add(path)
            table = open_table(path)
            check_columns(table, self.columns)
            self.sample_rate = table.sample_rate or self.sample_rate
            self._chunks, self.restarted = table.chunks(self.columns), bool(self.files)
            self.files.append(path)
            return next(self._chunks, np.empty((0, len(self.columns))))
        return np.empty((0, len(self.columns)))


class Frames(_Source):
    """Raw frames: one JSON line that says rate, channels and type, then interleaved samples.

    `{"sample_rate": 1000, "channels": ["f", "y"], "dtype": "<f8"}`; DataError for a head that says less.
    """

    def __init__(self, stream: BinaryIO, columns: Sequence[str]) -> None:
        self._stream, self.columns = stream, list(columns)
        head = stream.readline(1 << 16)
        try:
            stated = json.loads(head)
            self.channels = [str(name) for name in stated["channels"]]
            self.sample_rate: float | None = float(stated["sample_rate"])
            self._kind = np.dtype(stated.get("dtype", "<f8"))
        except (ValueError, KeyError, TypeError):
            hint = 'begin with {"sample_rate": 1000, "channels": ["f", "y"], "dtype": "<f8"}'
            raise DataError("standard input begins with no header", hint=hint) from None
        if self._kind.kind not in "iuf" or not self.sample_rate > 0:
            raise DataError(f"samples of the type {self._kind} at {self.sample_rate:g} Hz cannot be read")
        self._rest = b""
        self._picked = [self._place(name) for name in self.columns]

    def _place(self, column: str) -> int:
        if column not in self.channels:
            raise DataError(f"no channel '{column}' in the frames", hint=nearest(column, self.channels))
        return self.channels.index(column)

    def _next(self) -> FloatArray | None:
        if not select.select([self._stream], [], [], 0.2)[0]:
            return np.empty((0, len(self.columns)))
        # What has come, without waiting for more.
        text = (
            self._stream.read1(1 << 20)
            if isinstance(self._stream, io.BufferedReader)
            else self._stream.read()
        )
        if not text:
            return None
        whole = self._rest + text
        frame = self._kind.itemsize * len(self.channels)
        end = len(whole) // frame * frame
        self._rest = whole[end:]
        return (
            np.frombuffer(whole[:end], self._kind)
            .reshape(-1, len(self.channels))[:, self._picked]
            .astype(float)
        )


class Played(_Source):
    """A recording in memory as if it were made now, *speed* [1] times as fast."""

    def __init__(self, samples: FloatArray, sample_rate: float, speed: float) -> None:
        self._samples, self.sample_rate, self._speed = samples, sample_rate, speed
        self._done, self._began = 0, time.monotonic()

    def _next(self) -> FloatArray | None:
        if self._done >= self._samples.shape[0]:
            return None
        due = int((time.monotonic() - self._began) * self._speed * self.sample_rate)
        block = self._samples[self._done : min(due, self._done + MOST_ROWS)]
        self._done += block.shape[0]
        return block


def standard_input(columns: Sequence[str]) -> Frames:
    """The frames on standard input; ConfigError on a terminal."""
    if sys.stdin.isatty():
        raise ConfigError("standard input is a terminal", hint="pipe frames into the command, or name a file")
    return Frames(sys.stdin.buffer, columns)


def is_old(path: Path, seconds: float) -> bool:
    """Whether a file has not changed for so long that nobody writes to it."""
    try:
        return time.time() - path.stat().st_mtime > seconds
    except FileNotFoundError:
        return False
