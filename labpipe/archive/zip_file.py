"""The ZIP around an RO-Crate: the same bytes for the same content, and reading that trusts no name and no size.

Files are stored as they are, in the order of their names, at the first moment that ZIP knows: compression would make the bytes depend on
the library that compresses. A recording that is compressed itself (.csv.gz) stays so.
"""

from __future__ import annotations

import hashlib
import stat
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import IO

from labpipe.archive.contents import Contents
from labpipe.archive.crate import NAME, Listed, metadata
from labpipe.artefacts.digest import DamagedError
from labpipe.artefacts.writing import output_file
from labpipe.errors import ConfigError, DataError, cut

ZIP, ELN = ".zip", ".eln"
EPOCH = (1980, 1, 1, 0, 0, 0)
CHUNK = 1 << 20
LONGEST_METADATA = 1 << 28
ENCRYPTED = 0x1
# What reading a damaged member raises.
DAMAGE = (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, OSError, ValueError)


def is_archive(path: Path) -> bool:
    """Whether a path is that of an archive by its ending, and no folder."""
    return path.suffix.lower() in (ZIP, ELN) and not path.is_dir()


def check_output(path: Path) -> None:
    """ConfigError for the name of an archive that has another ending, or that is there already."""
    if path.suffix.lower() not in (ZIP, ELN):
        raise ConfigError(f"no archive has the ending '{path.suffix}'", where=str(path), hint=f"known: {ZIP}, {ELN}")
    if path.exists():
        raise ConfigError("is there already", where=str(path), hint="name another file, or remove this one; an archive is never replaced")


def write_archive(contents: Contents, path: Path, date: str) -> None:
    """Write the archive; DataError where a file changes meanwhile. An .eln has one folder of its own name around all."""
    check_output(path)
    around = f"{path.stem}/" if path.suffix.lower() == ELN else ""
    with output_file(path) as target, zipfile.ZipFile(target, "x") as archive:
        for member in (member for member in contents.members if member.kept):
            digest = hashlib.sha256()
            with member.path.open("rb") as source, _opened(archive, around + member.name, member.size or 0) as goal:
                while chunk := source.read(CHUNK):
                    digest.update(chunk)
                    goal.write(chunk)
            if digest.hexdigest() != member.sha256:
                raise DataError("changes while it is archived", where=str(member.path), hint="try again when it is finished")
        content = metadata(contents, date)
        with _opened(archive, around + NAME, len(content)) as goal:
            goal.write(content)


@contextmanager
def _opened(archive: zipfile.ZipFile, name: str, size: int) -> Iterator[IO[bytes]]:
    info = zipfile.ZipInfo(name, EPOCH)
    info.create_system, info.external_attr, info.file_size = 3, (stat.S_IFREG | 0o644) << 16, size
    with archive.open(info, "w") as stream:
        yield stream


@dataclass(frozen=True)
class Opened:
    """An archive whose names are safe: its *members* by their names in the crate, and the metadata."""

    path: Path
    archive: zipfile.ZipFile
    members: dict[str, zipfile.ZipInfo]
    metadata: bytes

    def unpack(self, listed: Listed, folder: Path) -> str:
        """Write a listed file below a folder; what does not hold, empty where all does."""
        info = self.members.get(listed.name)
        if info is None:
            return "is missing"
        if info.file_size != listed.size:
            return f"has {info.file_size} bytes in place of {listed.size}"
        target = folder / listed.name
        target.parent.mkdir(parents=True, exist_ok=True)
        digest = hashlib.sha256()
        try:
            with target.open("wb") as goal:
                for chunk in self._chunks(info):
                    digest.update(chunk)
                    goal.write(chunk)
        except DamagedError as error:
            return error.what
        return "" if digest.hexdigest() == listed.sha256 else "is not the file that the archive lists: its SHA-256 is another"

    def _chunks(self, info: zipfile.ZipInfo) -> Iterator[bytes]:
        """The content of a member; DamagedError where it cannot be read. What goes wrong where it is written is no fault of the archive."""
        try:
            with self.archive.open(info) as stream:
                while chunk := stream.read(CHUNK):
                    yield chunk
        except DAMAGE as error:
            raise DamagedError(f"is damaged ({cut(str(error))})", where=str(self.path)) from None


@contextmanager
def opened(path: Path) -> Iterator[Opened]:
    """An archive to be read; DataError for what is no ZIP, for names that lead out of it, and without metadata."""
    if not path.is_file():
        what = "is no regular file" if path.exists() else "no such file"
        raise DataError(what, where=str(path), hint="name a file that `labpipe archive` wrote")
    try:
        archive = zipfile.ZipFile(path)
    except DAMAGE as error:
        raise DataError(f"is no ZIP file, or a damaged one ({cut(str(error))})", where=str(path), hint="have it sent again") from None
    with archive:
        members: dict[str, zipfile.ZipInfo] = {}
        for info in archive.infolist():
            _check_safe(info, members, path)
            if not info.is_dir():
                members[info.filename] = info
        for name in members:
            if above := next((str(folder) for folder in PurePosixPath(name).parents if str(folder) in members), ""):
                raise DataError("is a file and a folder", where=f"{path}: {cut(above)!r}", hint="labpipe writes no such archive")
        around = _around(members, path)
        members = {name.removeprefix(around): info for name, info in members.items()}
        yield Opened(path, archive, members, _metadata(archive, members.pop(NAME), path))


def _check_safe(info: zipfile.ZipInfo, members: dict[str, zipfile.ZipInfo], path: Path) -> None:
    """DataError for an entry that must not be unpacked."""
    name = info.orig_filename
    parts = name.removesuffix("/").split("/")
    if "\0" in name or "\\" in name or ":" in parts[0] or any(part in ("", ".", "..") for part in parts):
        what = "has a name that leads out of the archive, or is none"
    elif stat.S_IFMT(info.external_attr >> 16) not in (0, stat.S_IFREG, stat.S_IFDIR):
        what = "is no regular file"
    elif info.flag_bits & ENCRYPTED:
        what = "is encrypted"
    elif info.filename in members:
        what = "is there twice"
    else:
        return
    raise DataError(what, where=f"{path}: {cut(name)!r}", hint="labpipe writes no such archive")


def _around(members: dict[str, zipfile.ZipInfo], path: Path) -> str:
    """The folder around all of an .eln, as a prefix; empty for a crate at the top. DataError without metadata."""
    if NAME in members:
        return ""
    tops = {PurePosixPath(name).parts[0] for name in members}
    if len(tops) == 1 and f"{(top := tops.pop())}/{NAME}" in members:
        return f"{top}/"
    raise DataError(f"holds no {NAME}", where=str(path), hint="name a file that `labpipe archive` wrote")


def _metadata(archive: zipfile.ZipFile, info: zipfile.ZipInfo, path: Path) -> bytes:
    if info.file_size > LONGEST_METADATA:
        raise DataError(f"has more than {LONGEST_METADATA >> 20} MB", where=f"{path}: {NAME}")
    try:
        return archive.read(info)
    except DAMAGE as error:
        raise DataError(f"is damaged ({cut(str(error))})", where=f"{path}: {NAME}", hint="have it sent again") from None
