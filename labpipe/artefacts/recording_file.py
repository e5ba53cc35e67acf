"""``*.recording.parquet``: one calibrated recording, written and read block by block."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Any, TypeVar, cast

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from labpipe.arrays import FloatArray
from labpipe.artefacts import parquet
from labpipe.artefacts.digest import stamp_parquet
from labpipe.artefacts.header import Header, SourceRef, header_from_json, source_ref
from labpipe.artefacts.json_file import entry_of, record_of
from labpipe.errors import DataError
from labpipe.records.finding import Finding
from labpipe.records.recording import Channel, Recording

Block = TypeVar("Block")
_END = object()


def read_ahead(blocks: Iterable[Block]) -> Iterator[Block]:
    """The same blocks in the same order, one of them read ahead in a thread, with the errors of reading."""
    iterator = iter(blocks)
    with ThreadPoolExecutor(1, thread_name_prefix="read-ahead") as reader:
        coming = reader.submit(next, iterator, _END)
        while (block := coming.result()) is not _END:
            coming = reader.submit(next, iterator, _END)
            yield cast(Block, block)


SUFFIX = ".recording.parquet"
# A column is quantised, as a logger of up to 17 bits leaves it, where fewer than this share of its first
# LOOKED_AT numbers differ. A dictionary halves those; of others, byte planes under lz4 are smaller than it
# and written five times as fast.
DIFFERENT, LOOKED_AT = 0.95, 1 << 14


class RecordingWriter:
    """Writes the blocks of a recording as they come.

    The header, known at the end, goes to the file's foot.
    """

    def __init__(self, path: Path, channels: tuple[Channel, ...]) -> None:
        self._schema = pa.schema([(channel.name, pa.float64()) for channel in channels])
        self._path = path
        self._writer: pq.ParquetWriter | None = None
        self._header: Header | None = None
        self._digests = "", ""

    def __enter__(self) -> RecordingWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._header is not None:
            writer = self._open(np.empty((0, len(self._schema))))
            writer.add_key_value_metadata(parquet.metadata_of(self._header))
        if self._writer is not None:
            self._writer.close()
        if self._header is not None:
            self._digests = stamp_parquet(self._path)

    def _open(self, block: FloatArray) -> pq.ParquetWriter:
        """The writer, each column encoded as the first *block* (n, n_channel) [SI] lets expect."""
        if self._writer is None:
            first = block[:LOOKED_AT]
            coarse = [
                name
                for name, column in zip(self._schema.names, first.T, strict=True)
                if np.unique(column).size < DIFFERENT * column.size
            ]
            fine = [name for name in self._schema.names if name not in coarse]
            self._writer = pq.ParquetWriter(
                self._path,
                self._schema,
                compression={name: "zstd" if name in coarse else "lz4" for name in self._schema.names},
                use_dictionary=coarse,
                use_byte_stream_split=fine,
                write_page_checksum=True,
            )
        return self._writer

    def write(self, block: FloatArray) -> None:
        """Append a block (n, n_channel) [SI]."""
        arrays = [parquet.arrow_array(column) for column in np.ascontiguousarray(block.T)]
        self._open(block).write_table(pa.Table.from_arrays(arrays, schema=self._schema))

    def finish(self, header: Header) -> None:
        """Put the header; the digest follows when the file is closed."""
        self._header = header

    def recording(self) -> StoredRecording:
        """The recording of the closed file, without digesting it again."""
        assert self._header is not None
        digest, checksum = self._digests
        header = header_from_json(self._header.to_json(), self._path, "recording", digest)
        return replace(_recording_of(self._path, header), checksum=checksum)


def recording_contents(
    channels: tuple[Channel, ...],
    sample_rate: float,
    name: str,
    levels: Mapping[str, tuple[float, float]] | None = None,
) -> dict[str, object]:
    """The part of the header that describes the recording's columns; *levels*: mean and standard deviation of
    channels [SI].
    """
    # Of a channel that never is a number there is no level.
    finite = {name: pair for name, pair in (levels or {}).items() if math.isfinite(sum(pair))}
    return {"name": name, "sample_rate": sample_rate, "channels": channel_entries(channels), "levels": finite}


def channel_entries(channels: Sequence[Channel]) -> list[dict[str, Any]]:
    """Channels in a header, with the unit of their numbers."""
    return [{**entry_of(channel), "unit": channel.unit} for channel in channels]


@dataclass(frozen=True)
class StoredRecording:
    """A recording on disk. Satisfies SampleSource: its blocks are read on request."""

    path: Path
    channels: tuple[Channel, ...]
    sample_rate: float
    n_sample: int
    name: str
    findings: tuple[Finding, ...]
    header: Header
    # SHA-256 of the file, where it is known already.
    checksum: str = ""

    def source_ref(self) -> SourceRef:
        """The reference by which a response names the recording."""
        if self.checksum:
            return SourceRef(self.path.name, self.checksum)
        return source_ref(self.path, self.path.parent)

    @property
    def levels(self) -> dict[str, tuple[float, float]]:
        """Mean and standard deviation [SI] of the channels where they were noted."""
        return {
            name: (float(mean), float(scatter))
            for name, (mean, scatter) in self.header.contents.get("levels", {}).items()
        }

    @property
    def files(self) -> Mapping[str, str]:
        """The file of every channel where several were joined."""
        return self.header.contents.get("files", {})

    def blocks(self, n_sample: int) -> Iterator[FloatArray]:
        """Consecutive blocks of at most *n_sample* samples, (n, n_channel) [SI]."""
        return read_ahead(self._blocks_in_turn(n_sample))

    def _blocks_in_turn(self, n_sample: int) -> Iterator[FloatArray]:
        names = [channel.name for channel in self.channels]
        for batch in parquet.batches(self.path, names, n_sample):
            yield np.column_stack([parquet.numpy_array(batch.column(name)) for name in names])

    def in_memory(self) -> Recording:
        """The whole recording as an array record."""
        samples = np.concatenate(list(self.blocks(1 << 16)))
        return Recording(self.channels, samples, self.sample_rate, self.name, self.findings)


def open_recording(path: Path) -> StoredRecording:
    """A calibrated recording on disk; DataError when the file is not one."""
    return _recording_of(path, parquet.read_header(path, "recording"))


def _recording_of(path: Path, header: Header) -> StoredRecording:
    contents = header.contents
    channels: tuple[Channel, ...] = record_of(contents["channels"], tuple[Channel, ...])
    file = parquet.open_parquet(path)
    missing = {channel.name for channel in channels} - set(file.schema_arrow.names)
    if missing:
        raise DataError(f"lacks the column of channel {', '.join(sorted(missing))}", path)
    return StoredRecording(
        path,
        channels,
        contents["sample_rate"],
        file.metadata.num_rows,
        contents["name"],
        header.findings,
        header,
    )
