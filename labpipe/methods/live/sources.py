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
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO, Protocol

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from labpipe.arrays import FloatArray
from labpipe.errors import DataError
from labpipe.raw_files import mdf_table, tdms_table
from labpipe.raw_files.other_tables import RATE_KEY, wav_chunks
from labpipe.raw_files.table import check_columns, check_names, open_table
from labpipe.raw_files.text_table import CsvTable, plain_suffix
from labpipe.records.finding import Finding
from labpipe.registry import Registry

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


SOURCES = Registry("sample source")


def open_source(path: Path, columns: Sequence[str]) -> SampleStream:
    """The stream of a growing file or folder; DataError for a kind that cannot be read while it grows."""
    if path.is_dir():
        return Folder(path, columns)
    suffix = plain_suffix(path)
    if suffix not in SOURCES or path.suffix.lower() != suffix:
        hint = f"known: {', '.join(SOURCES.names())}; or a folder into which whole files fall"
        raise DataError(f"files with the ending '{path.suffix}' cannot be read while they grow", path, hint)
    if not path.parent.is_dir():
        raise DataError("no such folder", path.parent)
    return SOURCES.load(suffix)(path, columns)


class _Growing:
    """A file that grows; *restarted*: the samples read last begin another recording."""

    restarted = False

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

    _table: CsvTable | None = None
    _place, _rest = 0, b""

    def read(self) -> FloatArray | None:
        """Samples (n, n_column) [unit of the file] as of `SampleStream`."""
        self.restarted = False
        size = self._size()
        if size < self._place:
            # The logger began the file anew.
            self._table, self._place, self._rest, self.restarted = None, 0, b"", True
        if self._table is None and not self._open(size):
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

    def _open(self, size: int) -> bool:
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


class GrowingTdms(_Growing):
    """A TDMS file that is opened anew each time, segment by segment while it is written."""

    _rows = staticmethod(tdms_table.growing_rows)
    _begins, _done, _seen = False, 0, 0

    def read(self) -> FloatArray | None:
        """Samples (n, n_column) [unit of the file] as of `SampleStream`."""
        size = self._size()
        if not size or size == self._seen:
            return self._none
        if size < self._seen:
            # The logger began the file anew.
            self._done, self._seen, self._begins = 0, 0, True
        rows, self.sample_rate = self._rows(self.path, self.columns, self._done, MOST_ROWS)
        self._done += rows.shape[0]
        self.restarted = self._begins and rows.shape[0] > 0
        self._begins &= not self.restarted
        if 0 < rows.shape[0] < MOST_ROWS:
            self._seen = size
        return rows


class GrowingMdf(GrowingTdms):
    """An MDF file of version 4.10 or later that is opened anew each time, sample by sample."""

    _rows = staticmethod(mdf_table.growing_rows)


# Samples of a WAV file by the code and bits that its head states; the code of heads with a longer one.
WAV_KINDS, EXTENSIBLE = {(1, 16): "<i2", (1, 32): "<i4", (3, 32): "<f4", (3, 64): "<f8"}, 0xFFFE


class GrowingWav(_Growing):
    """A WAV file whose data follow its head, whatever length that states; values relative to full scale."""

    _place, _kind, _n_track = 0, np.dtype("<i2"), 0

    def read(self) -> FloatArray | None:
        """Samples (n, n_column) [unit of the file] as of `SampleStream`."""
        if not self._place and not self._open():
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

    def _open(self) -> bool:
        if self._size() < 44:
            return False
        with self.path.open("rb") as stream:
            if stream.read(4) != b"RIFF":
                raise DataError("is no WAV file", self.path)
            stream.seek(0)
            places = {name: place for name, place, _ in wav_chunks(stream)}
            if not {b"fmt ", b"data"} <= places.keys():
                return False
            stream.seek(places[b"fmt "])
            head = stream.read(40)
        form, self._n_track, rate, _, _, bits = struct.unpack_from("<HHIIHH", head)
        kind = (struct.unpack_from("<H", head, 24)[0] if form == EXTENSIBLE else form, bits)
        if kind not in WAV_KINDS:
            raise DataError(f"{bits}-bit samples cannot be read while they grow", self.path)
        self._kind, self.sample_rate = np.dtype(WAV_KINDS[kind]), float(rate)
        check_names(self.path, self.columns, [str(n + 1) for n in range(self._n_track)])
        self._place = places[b"data"]
        return True


class GrowingHdf5(_Growing):
    """Datasets of an HDF5 file that another process appends to (single writer, multiple readers)."""

    _file: Any = None
    _done = 0

    def read(self) -> FloatArray | None:
        """Samples (n, n_column) [unit of the file] as of `SampleStream`."""
        import h5py

        if self._file is None:
            if not self._size():
                return self._none
            try:
                self._file = h5py.File(self.path, "r", libver="latest", swmr=True)
            except OSError:
                return self._none
        names = [name for name, entry in self._file.items() if hasattr(entry, "shape")]
        check_names(self.path, self.columns, names)
        datasets = [self._file[name] for name in self.columns]
        for dataset in datasets:
            dataset.refresh()
        last = min(min(dataset.shape[0] for dataset in datasets), self._done + MOST_ROWS)
        rows = np.array([dataset[self._done : last] for dataset in datasets], float).T
        self._done = max(last, self._done)
        return rows


class Folder:
    """Whole recordings of a folder, or a single one, each once it no longer changes."""

    def __init__(self, path: Path, columns: Sequence[str], settle: float = 1.0) -> None:
        self.path, self.columns, self._settle, self.restarted = path, list(columns), settle, False
        self.sample_rate: float | None = None
        self._chunks: Iterator[FloatArray] = iter(())
        self.files: list[Path] = []

    def read(self) -> FloatArray | None:
        """Samples (n, n_column) [unit of the file] as of `SampleStream`."""
        self.restarted = False
        if (chunk := next(self._chunks, None)) is not None:
            return chunk
        for path in sorted(self.path.iterdir()) if self.path.is_dir() else [self.path]:
            is_whole = path.is_file() and is_old(path, self._settle) and path.stat().st_size
            if not is_whole or path in self.files or path.name.startswith("."):
                continue
            try:
                table = open_table(path)
            except DataError:
                if path != self.path:
                    raise
                # Without its foot a Parquet file is not whole yet.
                break
            check_columns(table, self.columns)
            self.sample_rate = table.sample_rate or self.sample_rate
            self._chunks, self.restarted = table.chunks(self.columns), bool(self.files)
            self.files.append(path)
            break
        return next(self._chunks, np.empty((0, len(self.columns))))


def is_old(path: Path, seconds: float) -> bool:
    """Whether a file has not changed for so long that nobody writes to it."""
    try:
        return time.time() - path.stat().st_mtime > seconds
    except FileNotFoundError:
        return False


class FrameStore:
    """Frames of *size* bytes on disk as they come, behind a *head*; *full*: why there is no more room."""

    def __init__(self, path: Path, size: int, head: bytes = b"") -> None:
        self.path, self.full, self._size, self._n_byte = path, "", size, -len(head)
        # Without a buffer nothing waits to be written when the disk is full, or the process is killed.
        self._file = path.open("wb", buffering=0)
        self.add(head)

    def add(self, content: bytes) -> None:
        try:
            while content and not self.full:
                written = self._file.write(content)
                self._n_byte, content = self._n_byte + written, content[written:]
        except OSError as error:
            self.full = (error.strerror or str(error)).lower()

    @property
    def n_frame(self) -> int:
        """Whole frames that are on disk."""
        return max(self._n_byte, 0) // self._size

    def findings(self, rate: float) -> list[Finding]:
        """What is said of a full disk, of frames at the *rate* [Hz]."""
        message = f"{self.full}: samples from {self.n_frame / rate:.1f} s on are not kept, {self.n_frame} are"
        return [Finding("disk-full", message)] if self.full else []

    def close(self) -> None:
        self._file.close()


class Frames:
    """Raw frames: one JSON line that says rate, channels and type, then interleaved samples.

    `{"sample_rate": 1000, "channels": ["f", "y"], "dtype": "<f8"}`; DataError for a head that says less. What
    is read is first written to a file of the folder *keep*. The files that are there already, of processes
    that were killed, come before what is read; *n_earlier* are their samples.
    """

    def __init__(self, stream: BinaryIO, columns: Sequence[str], keep: Path | None = None) -> None:
        self.columns, self._rest, self.restarted, self._begins = list(columns), b"", False, False
        self._head = stream.readline(1 << 16)
        try:
            stated = json.loads(self._head)
            self.channels = [str(name) for name in stated["channels"]]
            self.sample_rate: float | None = float(stated["sample_rate"])
            self._kind = np.dtype(stated.get("dtype", "<f8"))
        except (ValueError, KeyError, TypeError):
            hint = 'begin with {"sample_rate": 1000, "channels": ["f", "y"], "dtype": "<f8"}'
            raise DataError("standard input begins with no header", hint=hint) from None
        if self._kind.kind not in "iuf" or not self.sample_rate > 0:
            raise DataError(f"samples of the type {self._kind} at {self.sample_rate:g} Hz cannot be read")
        if len(set(self.channels)) < len(self.channels):
            raise DataError("the header names a channel twice", "standard input", "give each its own name")
        check_names(Path("standard input"), self.columns, self.channels)
        self._picked = [self.channels.index(name) for name in self.columns]
        self._frame = self._kind.itemsize * len(self.channels)
        # A process that was killed before it read a frame leaves at most the head.
        every = [] if keep is None else sorted(keep.glob("*.frames"))
        self.files = [path for path in every if path.stat().st_size >= len(self._head) + self._frame]
        self.n_earlier = sum((path.stat().st_size - len(self._head)) // self._frame for path in self.files)
        self._streams = [*(self._reopen(path) for path in self.files), stream]
        self.kept: FrameStore | None = None
        if keep is not None:
            keep.mkdir(parents=True, exist_ok=True)
            self.files.append(keep / f"{int(self.files[-1].stem) + 1 if self.files else 1:04}.frames")
            self.kept = FrameStore(self.files[-1], self._frame, self._head)

    def _reopen(self, path: Path) -> BinaryIO:
        stream = path.open("rb")
        if stream.readline(1 << 16) != self._head:
            hint = "name another folder, or remove these frames"
            raise DataError("holds frames of another test", path.parent, hint)
        return stream

    def read(self) -> FloatArray | None:
        """Samples (n, n_column) [unit of the file] as of `SampleStream`."""
        stream, self.restarted = self._streams[0], False
        if len(self._streams) > 1:
            text = stream.read(1 << 20)
            if not text:
                # What was cut off by the kill is not a frame; what follows is another recording.
                stream.close()
                self._streams, self._rest, self._begins = self._streams[1:], b"", True
                return self.read()
        else:
            if not select.select([stream], [], [], 0.2)[0]:
                return np.empty((0, len(self.columns)))
            # What has come, without waiting for more.
            text = stream.read1(1 << 20) if isinstance(stream, io.BufferedReader) else stream.read()
            if not text:
                return None
            if self.kept is not None:
                self.kept.add(text)
        rows = self._rows(text)
        self.restarted = self._begins and rows.shape[0] > 0
        self._begins &= not self.restarted
        return rows

    def _rows(self, text: bytes) -> FloatArray:
        whole = self._rest + text
        end = len(whole) // self._frame * self._frame
        self._rest = whole[end:]
        frames = np.frombuffer(whole[:end], self._kind).reshape(-1, len(self.channels))
        return frames[:, self._picked].astype(float)

    def recordings(self, write_path: Callable[[str], Path]) -> list[Path]:
        """What is on disk as Parquet files, one for each process, where *write_path* of their names says."""
        fields, paths = [(name, pa.float64()) for name in self.columns], []
        schema = pa.schema(fields, {RATE_KEY: str(self.sample_rate)})
        # Where all had been read before the kill, nothing comes behind it.
        files = self.files[:-1] if self.kept and not self.kept.n_frame and self.n_earlier else self.files
        for number, path in enumerate(files, 1):
            paths.append(write_path(f"recording{f'-{number}' if len(files) > 1 else ''}.parquet"))
            self._rest = b""
            with self._reopen(path) as stream, pq.ParquetWriter(paths[-1], schema) as writer:
                while text := stream.read(1 << 22):
                    writer.write_table(pa.table(list(self._rows(text).T), schema=schema))
        return paths

    def close(self) -> None:
        if self.kept is not None:
            self.kept.close()


class Played:
    """A recording in memory as if it were made now, *speed* [1] times as fast."""

    def __init__(self, samples: FloatArray, sample_rate: float, speed: float) -> None:
        self._samples, self.sample_rate, self._speed = samples, sample_rate, speed
        self._done, self._began, self.restarted = 0, time.monotonic(), False

    def read(self) -> FloatArray | None:
        """Samples (n, n_column) [unit of the file] as of `SampleStream`."""
        if self._done >= self._samples.shape[0]:
            return None
        due = int((time.monotonic() - self._began) * self._speed * self.sample_rate)
        block = self._samples[self._done : min(due, self._done + MOST_ROWS)]
        self._done += block.shape[0]
        return block
