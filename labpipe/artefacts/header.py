"""The header of every artefact, and the code behind it: its commit and its digest."""

from __future__ import annotations

import functools
import hashlib
import json
import os
from dataclasses import KW_ONLY, asdict, dataclass, field
from importlib.metadata import PackageNotFoundError, distribution, entry_points
from pathlib import Path
from typing import Any

import labpipe
from labpipe import __version__
from labpipe.artefacts.digest import AGAIN, DamagedError, file_sha256
from labpipe.artefacts.json_file import BAD_ENTRY, json_value, record_of
from labpipe.artefacts.places import origin
from labpipe.artefacts.writing import show
from labpipe.errors import DataError
from labpipe.records.finding import Finding

# The code behind a result, as a digest: results of another build count as stale, whatever its version
# number says.

PLUG_IN_GROUPS = "labpipe."


@functools.cache
def code_digest() -> str:
    """SHA-256 over labpipe's source, and name and version of every package that adds to its tables."""
    digest = hashlib.sha256()
    root = Path(labpipe.__file__).parent
    for path in sorted((*root.rglob("*.py"), *root.rglob("entry_points.txt"))):
        digest.update(path.relative_to(root).as_posix().encode())
        digest.update(path.read_bytes())
    for name in sorted(_plug_ins()):
        digest.update(name.encode())
    return digest.hexdigest()


def _plug_ins() -> set[str]:
    every = entry_points()
    groups = (group for group in every.groups if group.startswith(PLUG_IN_GROUPS))
    added = (entry for group in groups for entry in every.select(group=group))
    # Whatever is asked of a package's metadata reads them anew.
    name_of = functools.cache(lambda package: package.name)
    # What labpipe itself adds is source. Its metadata may lie there twice, as an old folder beside the
    # checkout does.
    others = (entry for entry in added if entry.dist is None or name_of(entry.dist) != "labpipe")
    return {
        f"{entry.value} {entry.dist.name} {entry.dist.version}" if entry.dist else entry.value
        for entry in others
    }


# The commit that this code is of, where that is known: of a checkout, or of what was installed from a
# repository.

# Letters of a commit that people write.
SHORT = 10


def commit(package: Path = Path(__file__).parent) -> str:
    """The first SHORT letters of the commit of the code in *package*, empty where nothing names it."""
    return (checkout_commit(package.parent / ".git") or _installed_commit())[:SHORT]


def version_text() -> str:
    """The version, and the commit where it is known."""
    known = commit()
    return f"{__version__} (commit {known})" if known else __version__


def checkout_commit(git: Path) -> str:
    """The commit that a checkout's folder *git* is at, read without git; empty where there is none."""
    try:
        head = (git / "HEAD").read_text("ascii").strip()
        if not head.startswith("ref: "):
            return head
        reference = head.removeprefix("ref: ")
        if (git / reference).is_file():
            return (git / reference).read_text("ascii").strip()
        packed = (git / "packed-refs").read_text("ascii").splitlines()
    except (OSError, UnicodeDecodeError):
        return ""
    return next((line.split()[0] for line in packed if line.endswith(f" {reference}")), "")


def _installed_commit() -> str:
    try:
        noted = distribution("labpipe").read_text("direct_url.json")
        return str(json.loads(noted or "{}").get("vcs_info", {}).get("commit_id", ""))
    except (PackageNotFoundError, ValueError, AttributeError):
        return ""


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
    # Of the file's content, verified when it was read; empty for a file without one, and before it is
    # written.
    digest: str = field(default="", compare=False)

    def to_json(self) -> str:
        """The header as JSON entries."""
        return json.dumps(
            {name: entry for name, entry in asdict(self).items() if name != "digest"}, allow_nan=False
        )

    def same_work(self, other: Header) -> bool:
        """Whether both were made from the same inputs with the same parameters by the same code."""
        mine, theirs = (
            json.dumps([h.kind, h.schema, h.labpipe, h.code, h.parameters, h.inputs], default=vars)
            for h in (self, other)
        )
        return mine == theirs


def header_from_json(text: str | bytes, path: Path, kind: str, digest: str = "") -> Header:
    """The header read from an artefact with its verified *digest*.

    DataError when it is another kind, a newer schema, or none at all.
    """
    try:
        entries = json_value(text if isinstance(text, str) else text.decode())
    except (ValueError, RecursionError):
        entries = None
    if not isinstance(entries, dict):
        raise DamagedError("has a header that cannot be read", path, AGAIN)
    if kind and entries.get("kind") != kind:
        raise DataError(f"is a {entries.get('kind')} file, a {kind} file is needed", path)
    if entries.get("schema") != SCHEMA:
        hint = "make it again with this version"
        raise DataError(f"has schema {entries.get('schema')}, this version reads {SCHEMA}", path, hint)
    try:
        header: Header = record_of({"code": "", **entries, "digest": digest}, Header)
    except BAD_ENTRY as error:
        raise DamagedError(f"has a header that cannot be read ({error})", path, AGAIN) from None
    return header


def source_ref(path: Path, folder: Path, sha256: str = "") -> SourceRef:
    """Checksum of a file, *sha256* where it is known; its path is kept relative to *folder* so that the same
    work gives the same bytes anywhere.

    Of a fetched recording it is the URL.
    """
    url = origin(path)
    named = Path(os.path.relpath(path, folder)).as_posix() if url is None else show(url)
    return SourceRef(named, sha256 or file_sha256(path))
