"""The header of every artefact: kind, schema number, parameters, input checksums, findings, version; no clock."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Iterable
from dataclasses import KW_ONLY, dataclass, field
from pathlib import Path
from typing import Any

from labpipe import __version__
from labpipe.artefacts.code import code_digest
from labpipe.artefacts.digest import AGAIN, DamagedError, file_sha256
from labpipe.errors import DataError
from labpipe.places.address import shown
from labpipe.places.fetched import origin
from labpipe.records.finding import Finding

SCHEMA = 1


@dataclass(frozen=True)
class SourceRef:
    """A file that went into an artefact, by its path as people know it and its SHA-256."""

    path: str
    sha256: str


@dataclass(frozen=True)
class Header:
    """Header of an artefact; *contents* describes its columns (channels, ports, rate)."""

    kind: str
    parameters: dict[str, Any]
    _: KW_ONLY
    inputs: tuple[SourceRef, ...]
    findings: tuple[Finding, ...] = ()
    contents: dict[str, Any] = field(default_factory=dict)
    schema: int = SCHEMA
    labpipe: str = __version__
    code: str = field(default_factory=code_digest)
    # Of the file's content, verified when it was read; empty for a file without one, and before it is written.
    digest: str = field(default="", compare=False)

    def to_json(self) -> str:
        """The header as JSON entries."""
        return json.dumps({name: entry for name, entry in dataclasses.asdict(self).items() if name != "digest"}, allow_nan=False)

    def same_work(self, other: Header) -> bool:
        """Whether both were made from the same inputs with the same parameters by the same code."""
        mine, theirs = (json.dumps([h.kind, h.schema, h.labpipe, h.code, h.parameters, _asdicts(h.inputs)]) for h in (self, other))
        return mine == theirs


def _asdicts(records: Iterable[Any]) -> list[dict[str, Any]]:
    return [dataclasses.asdict(record) for record in records]


def header_from_json(text: str | bytes, path: Path, kind: str, digest: str = "") -> Header:
    """The header read from an artefact with its verified *digest*; DataError when it is another kind, a newer schema, or none at all."""
    try:
        entries = json.loads(text)
    except (ValueError, RecursionError):
        entries = None
    if not isinstance(entries, dict):
        raise DamagedError("has a header that cannot be read", where=str(path), hint=AGAIN)
    if kind and entries.get("kind") != kind:
        raise DataError(f"is a {entries.get('kind')} file, a {kind} file is needed", where=str(path))
    if entries.get("schema") != SCHEMA:
        hint = "make it again with this version"
        raise DataError(f"has schema {entries.get('schema')}, this version reads {SCHEMA}", where=str(path), hint=hint)
    try:
        entries["inputs"] = tuple(SourceRef(**entry) for entry in entries["inputs"])
        entries["findings"] = tuple(Finding(**entry) for entry in entries["findings"])
        return Header(**{"code": "", **entries, "digest": digest})
    except (KeyError, TypeError) as error:
        raise DamagedError(f"has a header that cannot be read ({error})", where=str(path), hint=AGAIN) from None


def source_ref(path: Path, folder: Path, sha256: str = "") -> SourceRef:
    """Checksum of a file, *sha256* where it is known; its path is kept relative to *folder* so that the same work gives the same bytes
    anywhere.

    Of a fetched recording it is the URL.
    """
    url = origin(path)
    named = Path(os.path.relpath(path, folder)).as_posix() if url is None else shown(url)
    return SourceRef(named, sha256 or file_sha256(path))
