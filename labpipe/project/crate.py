"""ro-crate-metadata.json: what an archive holds, as linked data by RO-Crate 1.1
(https://w3id.org/ro/crate/1.1). What it asks for and labpipe does not know, a licence or a person, is said to
be not stated.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import quote, unquote

from labpipe import __version__
from labpipe.artefacts.header import code_digest, commit
from labpipe.errors import DataError, shorten
from labpipe.records.identification import Identification


@dataclass(frozen=True)
class Member:
    """A file of an archive: its *name* there, what it is in words, where it lies now, and its SHA-256. kept:
    it is in the archive itself. day: on which it was last changed, where the result depends on that.
    """

    name: str
    role: str
    path: Path
    sha256: str = ""
    size: int | None = None
    kept: bool = True
    day: str = ""


@dataclass(frozen=True)
class Contents:
    """What the result was made *of*, with the pipeline's name, the *results*, and files of no result."""

    identification: Identification
    pipeline: str
    of: tuple[Member, ...]
    results: tuple[Member, ...]
    left_out: tuple[Path, ...] = ()

    @property
    def members(self) -> tuple[Member, ...]:
        return tuple(sorted((*self.of, *self.results), key=lambda member: member.name))


# The one folder of an archive.
EXPERIMENT = "experiment"
NAME = "ro-crate-metadata.json"
VERSION = "https://w3id.org/ro/crate/1.1"
# Of the context of version 1.1 the term is not part; that of 1.2 defines it so.
CONTEXT = [f"{VERSION}/context", {"sha256": "http://schema.org/sha256"}]
FAMILY = "https://w3id.org/ro/crate/"
NO_LICENCE = "Not stated. Whoever made this archive decides what may be done with it."
UNKNOWN = "application/octet-stream"
FORMATS = {
    ".csv": "text/csv", ".txt": "text/plain", ".dat": "text/plain", ".asc": "text/plain",
    ".lvm": "text/plain", ".md": "text/markdown",
    ".html": "text/html", ".pdf": "application/pdf", ".json": "application/json", ".yaml": "application/yaml",
    ".yml": "application/yaml", ".xml": "application/xml",
    ".parquet": "application/vnd.apache.parquet", ".h5": "application/x-hdf5", ".hdf5": "application/x-hdf5",
    ".wav": "audio/vnd.wave",
    ".mat": "application/x-matlab-data", ".gz": "application/gzip", ".zst": "application/zstd",
    ".xlsx": "application/vnd.openxmlformats-officedocument.spreadsheetml.sheet",
}  # fmt: skip

Entity = dict[str, Any]


@dataclass(frozen=True)
class Listed:
    """A file as the metadata list it; *day*: on which it was last changed, empty where it does not matter."""

    name: str
    size: int
    sha256: str
    day: str = ""


@dataclass(frozen=True)
class Crate:
    """What verification reads: files, the pipeline's name, and the number of files known by digest only."""

    files: tuple[Listed, ...]
    pipeline: str
    left_out: int


def metadata(contents: Contents, date: str) -> bytes:
    """The metadata of an archive; the same bytes for the same contents and *date* (ISO 8601)."""
    graph = [*_heads(contents, date), *(_entity(member) for member in contents.members), *_run(contents)]
    return (json.dumps({"@context": CONTEXT, "@graph": graph}, indent=1, ensure_ascii=False) + "\n").encode()


def _heads(contents: Contents, date: str) -> Iterator[Entity]:
    title = contents.identification.title
    files = [{"@id": _id(member)} for member in contents.members if member.kept]
    yield {"@id": NAME, "@type": "CreativeWork", "conformsTo": {"@id": VERSION}, "about": {"@id": "./"}}
    yield {
        "@id": "./",
        "@type": "Dataset",
        "name": title,
        "description": f"{title}: procedure, rig and recordings of a test, the result that labpipe made of "
        "them, and its report.",
        "datePublished": date,
        "license": NO_LICENCE,
        "conformsTo": {"@id": VERSION},
        "mainEntity": {"@id": quote(contents.pipeline)},
        "mentions": {"@id": "#run"},
        "hasPart": [{"@id": f"{EXPERIMENT}/"}, *files],
    }
    yield {"@id": f"{EXPERIMENT}/", "@type": "Dataset", "name": title, "hasPart": files}


def _id(member: Member) -> str:
    return quote(member.name) if member.kept else f"#left-out/{quote(member.name)}"


def _entity(member: Member) -> Entity:
    path = PurePosixPath(member.name)
    entity = {
        "@id": _id(member),
        "@type": "File" if member.kept else "CreativeWork",
        "name": path.name if member.kept else member.name,
        "description": member.role
        if member.kept
        else f"{member.role}; not in the archive, known by its digest",
        "encodingFormat": FORMATS.get(path.suffix.lower(), UNKNOWN),
        "sha256": member.sha256,
    }
    sized = {} if member.size is None else {"contentSize": str(member.size)}
    return entity | sized | ({"dateModified": member.day} if member.day else {})


def _run(contents: Contents) -> Iterator[Entity]:
    commit_hash = commit()
    yield {
        "@id": "#run",
        "@type": "CreateAction",
        "name": f"labpipe run {PurePosixPath(contents.pipeline).name}",
        "instrument": {"@id": "#labpipe"},
        "object": [{"@id": _id(member)} for member in contents.of],
        "result": [{"@id": _id(member)} for member in contents.results],
    }
    yield {
        "@id": "#labpipe",
        "@type": "SoftwareApplication",
        "name": "labpipe",
        "version": __version__ + (f" (commit {commit_hash})" if commit_hash else ""),
        "softwareVersion": __version__,
        "identifier": [{"@id": "#code"}, *([{"@id": "#commit"}] if commit_hash else [])],
    }
    yield {"@id": "#code", "@type": "PropertyValue", "name": "SHA-256 of the source", "value": code_digest()}
    if commit_hash:
        yield {"@id": "#commit", "@type": "PropertyValue", "name": "commit", "value": commit_hash}


def read_metadata(content: bytes, where: str) -> Crate:
    """What the metadata say; DataError where they are not an RO-Crate, or not one of labpipe's."""
    try:
        graph = json.loads(content.decode("utf-8"))["@graph"]
        entities: Mapping[str, Entity] = {entity["@id"]: entity for entity in graph}
        descriptor: Entity = {}
        for entity in entities.values():
            kind = entity.get("conformsTo")
            kind = kind.get("@id") if isinstance(kind, dict) else kind
            if not descriptor and str(kind).startswith(FAMILY) and "about" in entity:
                descriptor = entity
        main = entities[descriptor["about"]["@id"]]
        files = tuple(_listing(entity, where) for entity in entities.values() if entity["@type"] == "File")
        left_out = sum(name.startswith("#left-out/") for name in entities)
        pipeline = unquote(main["mainEntity"]["@id"])
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        reason = shorten(f"{type(error).__name__}: {error}")
        raise DataError(f"is not an RO-Crate of labpipe ({reason})", where, VERSION) from None
    if pipeline not in {file.name for file in files}:
        raise DataError(
            f"names the pipeline '{shorten(pipeline)}', which is not a file of the archive", where
        )
    return Crate(files, pipeline, left_out)


def _listing(entity: Entity, where: str) -> Listed:
    name, day = unquote(entity["@id"]), entity.get("dateModified", "")
    size, sha256 = entity["contentSize"], entity["sha256"]
    texts = all(isinstance(entry, str) for entry in (size, sha256, day))
    if not (texts and size.isascii() and size.isdigit()):
        raise DataError(f"lists '{shorten(name)}' without its size and digest", where)
    return Listed(name, int(size), sha256, day)
