"""One file that holds a result with all it was made from: an RO-Crate in a ZIP; reading it trusts no name and
no size. Files are stored as they are, in the order of their names, at the first moment that ZIP knows, so
that the same content gives the same bytes: compression would depend on its library.
"""

from __future__ import annotations

import datetime
import glob
import hashlib
import os
import stat
import zipfile
import zlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path, PurePosixPath
from typing import IO

from labpipe import __version__
from labpipe.artefacts.digest import DamagedError
from labpipe.artefacts.header import code_digest, source_ref
from labpipe.artefacts.identification_file import NAME as IDENTIFICATION, read_identification
from labpipe.artefacts.parquet import read_header
from labpipe.artefacts.recording_file import SUFFIX as RECORDING
from labpipe.artefacts.writing import is_remote, output_file, path_of, show
from labpipe.errors import ConfigError, DataError, shorten
from labpipe.project.crate import EXPERIMENT, NAME, Contents, Listed, Member, metadata, read_metadata
from labpipe.project.identify import rig_entry, settings_entry
from labpipe.project.marked_yaml import Marked, load_marked
from labpipe.project.measured import files_of_test
from labpipe.project.one_test import change_day, files_of
from labpipe.project.pipeline_file import Pipeline
from labpipe.project.report import COMMENTS, drawn_from, is_drawn
from labpipe.project.verification import artefacts_below, verify_artefacts
from labpipe.records.identification import Identification

# The two folders in that of an archive.
PROJECT, RESULTS = f"{EXPERIMENT}/project", f"{EXPERIMENT}/results"
YAML = (".yaml", ".yml")
# The result as a certificate, made for the archive.
CERTIFICATE = "result.dcc.xml"


def contents(folder: Path, pipeline: Pipeline, scratch: Path, *, digests_only: bool) -> Contents:
    """What an archive of a folder's results holds; *digests_only*: of recordings the digests alone.
    *scratch*: a folder for the result as a certificate. DataError for results that do not hold or are not of
    the pipeline; ConfigError for files that an archive cannot hold.
    """
    identification = read_identification(folder / IDENTIFICATION)
    _check_same(identification, pipeline, folder)
    for artefact in verify_artefacts(folder, pipeline.folder):
        if artefact.faults:
            raise DataError(artefact.faults[0], artefact.path, "run `labpipe run` again")
    names = _names_of_result(folder, identification, pipeline)
    reports = [f"report.{name}" for name in COMMENTS if (folder / f"report.{name}").is_file()]
    for name in reports:
        if not is_drawn(folder / name, drawn_from(folder / IDENTIFICATION)):
            hint = f"remove it or draw it again by `labpipe report {folder}`"
            raise DataError("was not drawn from this result, or edited since", folder / name, hint)
    recordings = [name for name in names if name.endswith(RECORDING)]
    left = recordings if digests_only else ()
    results = [
        Member(f"{RESULTS}/{name}", _role_of_result(name), folder / name, kept=name not in left)
        for name in (*names, *reports)
    ]
    # A dataset holds its numbers itself.
    if identification.dataset is None:
        # Loads pandas.
        from labpipe.project.exports import write_dcc

        write_dcc(folder / IDENTIFICATION, scratch / CERTIFICATE)
        role = "result as XML after the Digital Calibration Certificate"
        results.append(Member(f"{RESULTS}/{CERTIFICATE}", role, scratch / CERTIFICATE))
    left_out = [path for path in artefacts_below(folder) if path.relative_to(folder).as_posix() not in names]
    noted = [reference for name in recordings for reference in read_header(folder / name).inputs]
    digests = {reference.path: reference.sha256 for reference in noted}
    digests |= {source["path"]: source["sha256"] for source in identification.sources}
    dated = identification.dataset is not None
    main, files = _project(pipeline, digests, dated=dated, digests_only=digests_only)
    of, of_results = (tuple(map(_digest, members)) for members in (files, results))
    return Contents(identification, main, of, of_results, tuple(left_out))


def _digest(member: Member) -> Member:
    """The member with digest and size; one that lies elsewhere keeps the digest that the result names."""
    if is_remote(member.path):
        return member
    digest = source_ref(member.path, member.path.parent).sha256
    return replace(member, sha256=digest, size=member.path.stat().st_size)


def _check_same(identification: Identification, pipeline: Pipeline, folder: Path) -> None:
    if identification.code != code_digest():
        what = f"was made by another build of labpipe ({identification.version or 'unknown'})"
        hint = "run `labpipe run` again, or make the archive with that build"
        raise DataError(what, folder / IDENTIFICATION, hint)
    if what := changed_settings(identification, pipeline, folder):
        raise DataError(what, pipeline.path, "write into the file what --set said, and run it again")


def changed_settings(identification: Identification, pipeline: Pipeline, folder: Path) -> str:
    """What a pipeline or its rig says that the result in a folder was not made with, empty for nothing."""
    stated, made = settings_entry(pipeline), dict(identification.settings)
    for entries in (stated, made):
        # With the conditions as the recordings showed them.
        entries.pop("tests", None)
    differing = [name for name in dict.fromkeys((*stated, *made)) if stated.get(name) != made.get(name)]
    differing += ["rig"] if rig_entry(pipeline) != identification.rig else []
    where = f"under '{differing[0]}'" if differing else ""
    return f"says something else {where} than the result in {folder} was made with" if where else ""


def _names_of_result(folder: Path, identification: Identification, pipeline: Pipeline) -> list[str]:
    """The artefacts of this very result by their names; what earlier pipelines left in the folder is none."""
    named = [reference["path"] for reference in identification.inputs]
    named.extend(name for test in pipeline.tests for name in files_of_test(test.name))
    there = {name for name in named if (folder / name).is_file() and ".." not in Path(name).parts}
    measured = [name for name in there if name.endswith(".parquet") and "/" not in name]
    inputs = [reference.path for name in measured for reference in read_header(folder / name).inputs]
    recordings = (f"recordings/{name}" for name in inputs)
    return sorted({IDENTIFICATION, *there, *(name for name in recordings if (folder / name).is_file())})


def _role_of_result(name: str) -> str:
    if name == IDENTIFICATION:
        return "result: parameters, standard errors, findings, outcomes of rules"
    if name.startswith("report."):
        return "report"
    kinds = {
        RECORDING: "calibrated recording",
        ".results.parquet": "results of many tests",
        ".json": "fits of a test",
        "": "measured response, decays or spectra of a test",
    }
    return next(role for suffix, role in kinds.items() if name.endswith(suffix))


def _project(
    pipeline: Pipeline, digests: Mapping[str, str], *, dated: bool, digests_only: bool
) -> tuple[str, list[Member]]:
    """The pipeline's name and its files in the archive; *digests*: of raw files; *dated*: days count."""
    raw = [path for test in pipeline.tests for path in files_of(test)]
    remote = next(filter(is_remote, raw), None)
    if remote is not None and not digests_only:
        what = "lies in an object storage, and is not brought into the archive"
        raise DataError(what, show(remote), "--digests-only keeps its digest")
    # The settings files that a settings file names, itself first; and all other files that these name
    settings, others = [_absolute(pipeline.path)], list[Path]()
    for file in settings:
        for node in _texts(load_marked(file)):
            target = _absolute(file.parent / node.text)
            if target in settings or not _is_named(node, file.parent):
                continue
            (settings if target.suffix in YAML else others).append(target)
    named = list(dict.fromkeys(others))
    roles = dict.fromkeys(map(_absolute, raw), "recording")
    roles |= {
        path: "table or file that the settings name"
        for path in map(_absolute, (*pipeline.side_files, *named))
        if path not in roles
    }
    roles |= dict.fromkeys(settings, "rig, bearing or other settings")
    roles |= {_absolute(pipeline.path): "pipeline: the procedure"}
    home = Path(os.path.commonpath([path.parent for path in roles if not is_remote(path)]))
    members = []
    for path, role in roles.items():
        kept = not (digests_only and role == "recording")
        name = show(path) if is_remote(path) else f"{PROJECT}/{path.relative_to(home).as_posix()}"
        day = change_day(path) if dated and role == "recording" and not is_remote(path) else ""
        members.append(Member(name, role, path, digests.get(name, ""), kept=kept, day=day))
    return f"{PROJECT}/{_absolute(pipeline.path).relative_to(home).as_posix()}", members


def _absolute(path: Path) -> Path:
    """The path without '..', links as they are; a URL as it is."""
    return path if is_remote(path) else Path(os.path.abspath(path))


def _is_named(node: Marked, folder: Path) -> bool:
    """Whether a text names a file; ConfigError where it does by a path that holds on this machine only."""
    try:
        address = path_of(node.text)
    except ConfigError:
        return False
    if is_remote(address) or len(node.text) > 1000 or "\n" in node.text or "\0" in node.text:
        return False
    if address.is_absolute() and (address.is_file() or (glob.has_magic(node.text) and glob.glob(node.text))):
        what = f"'{node.text}' holds on this machine only, and not in an archive"
        raise ConfigError(what, node.where, "name the file relative to the one that names it")
    try:
        return (folder / address).is_file()
    except OSError:
        return False


def _texts(node: Marked) -> Iterator[Marked]:
    content = list(node.content.values()) if isinstance(node.content, dict) else node.content
    if not isinstance(content, list):
        yield from [node] if node.text else []
        return
    for part in content:
        yield from _texts(part)


ZIP, ELN = ".zip", ".eln"
EPOCH = (1980, 1, 1, 0, 0, 0)
CHUNK = 1 << 20
LONGEST_METADATA = 1 << 28
ENCRYPTED = 0x1
NOT_OURS, NAME_ONE = "labpipe writes no such archive", "name a file that `labpipe archive` wrote"
# What reading a damaged member raises.
DAMAGE = (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, OSError, ValueError)


def is_archive(path: Path) -> bool:
    """Whether a path is that of an archive by its ending, and no folder."""
    return path.suffix.lower() in (ZIP, ELN) and not path.is_dir()


def check_output(path: Path) -> None:
    """ConfigError for the name of an archive that has another ending, or that is there already."""
    if path.suffix.lower() not in (ZIP, ELN):
        raise ConfigError(f"no archive has the ending '{path.suffix}'", path, f"known: {ZIP}, {ELN}")
    if path.exists():
        hint = "name another file, or remove this one; an archive is never replaced"
        raise ConfigError("is there already", path, hint)


def pack(contents: Contents, path: Path, date: str) -> None:
    """Write the archive, an .eln with one folder around all. DataError where a file changes meanwhile."""
    check_output(path)
    around = f"{path.stem}/" if path.suffix.lower() == ELN else ""
    with output_file(path) as target, zipfile.ZipFile(target, "x") as archive:
        for member in (member for member in contents.members if member.kept):
            name, size = around + member.name, member.size or 0
            with member.path.open("rb") as source, _open(archive, name, size) as goal:
                sha256 = _copy(iter(partial(source.read, CHUNK), b""), goal)
            if sha256 != member.sha256:
                raise DataError("changes while it is archived", member.path, "try again when it is finished")
        content = metadata(contents, date)
        with _open(archive, around + NAME, len(content)) as goal:
            goal.write(content)


def _open(archive: zipfile.ZipFile, name: str, size: int) -> IO[bytes]:
    info = zipfile.ZipInfo(name, EPOCH)
    info.create_system, info.external_attr, info.file_size = 3, (stat.S_IFREG | 0o644) << 16, size
    return archive.open(info, "w")


def _copy(chunks: Iterable[bytes], goal: IO[bytes]) -> str:
    digest = hashlib.sha256()
    for chunk in chunks:
        digest.update(chunk)
        goal.write(chunk)
    return digest.hexdigest()


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
        try:
            with target.open("wb") as goal:
                same = _copy(self._chunks(info), goal) == listed.sha256
        except DamagedError as error:
            return error.what
        return "" if same else "is not the file that the archive lists: its SHA-256 is another"

    def _chunks(self, info: zipfile.ZipInfo) -> Iterator[bytes]:
        """The content of a member. DamagedError where it cannot be read, none where it cannot be written."""
        try:
            with self.archive.open(info) as stream:
                while chunk := stream.read(CHUNK):
                    yield chunk
        except DAMAGE as error:
            raise DamagedError(f"is damaged ({shorten(str(error))})", self.path) from None


@contextmanager
def open_archive(path: Path) -> Iterator[Opened]:
    """An archive to be read. DataError for no ZIP, for names that lead out of it, and without metadata."""
    if not path.is_file():
        what = "is not a regular file" if path.exists() else "no such file"
        raise DataError(what, path, NAME_ONE)
    try:
        archive = zipfile.ZipFile(path)
    except DAMAGE as error:
        what = f"is not a ZIP file, or a damaged one ({shorten(str(error))})"
        raise DataError(what, path, "have it sent again") from None
    with archive:
        members: dict[str, zipfile.ZipInfo] = {}
        for info in archive.infolist():
            _check_safe(info, members, path)
            if not info.is_dir():
                members[info.filename] = info
        for name in members:
            for above in map(str, PurePosixPath(name).parents):
                if above in members:
                    raise DataError("is a file and a folder", f"{path}: {shorten(above)!r}", NOT_OURS)
        around = _around(members, path)
        members = {name.removeprefix(around): info for name, info in members.items()}
        yield Opened(path, archive, members, _metadata(archive, members.pop(NAME), path))


def _check_safe(info: zipfile.ZipInfo, members: dict[str, zipfile.ZipInfo], path: Path) -> None:
    name = info.orig_filename
    parts = name.removesuffix("/").split("/")
    if "\0" in name or "\\" in name or ":" in parts[0] or any(part in ("", ".", "..") for part in parts):
        what = "has a name that is empty or leads out of the archive"
    elif stat.S_IFMT(info.external_attr >> 16) not in (0, stat.S_IFREG, stat.S_IFDIR):
        what = "is not a regular file"
    elif info.flag_bits & ENCRYPTED:
        what = "is encrypted"
    elif info.filename in members:
        what = "is there twice"
    else:
        return
    raise DataError(what, f"{path}: {shorten(name)!r}", NOT_OURS)


def _around(members: dict[str, zipfile.ZipInfo], path: Path) -> str:
    if NAME in members:
        return ""
    tops = {PurePosixPath(name).parts[0] for name in members}
    if len(tops) == 1 and f"{(top := tops.pop())}/{NAME}" in members:
        return f"{top}/"
    raise DataError(f"holds no {NAME}", path, NAME_ONE)


def _metadata(archive: zipfile.ZipFile, info: zipfile.ZipInfo, path: Path) -> bytes:
    if info.file_size > LONGEST_METADATA:
        raise DataError(f"has more than {LONGEST_METADATA >> 20} MB", f"{path}: {NAME}")
    try:
        return archive.read(info)
    except DAMAGE as error:
        raise DataError(
            f"is damaged ({shorten(str(error))})", f"{path}: {NAME}", "have it sent again"
        ) from None


@dataclass(frozen=True)
class Unpacked:
    """The folders of an archive, and what does not hold of its files, by their names. left_out: files of
    which it holds the digest alone, without which the pipeline cannot be run.
    """

    pipeline: Path
    results: Path
    files: int
    left_out: int
    faults: tuple[tuple[str, str], ...]

    def hindrance(self) -> str:
        """Why the pipeline would not give the same bytes again; empty where it would."""
        if self.left_out:
            return f"of {self.left_out} files the archive holds only the digests"
        result = read_identification(self.results / IDENTIFICATION)
        build = f"another build of labpipe ({result.version or 'unknown'}); this is {__version__}"
        return "" if result.code == code_digest() else f"it was made by {build}"


def unpack(path: Path, folder: Path) -> Unpacked:
    """Unpack an archive into a folder; DataError where it cannot be read as one."""
    with open_archive(path) as archive:
        crate = read_metadata(archive.metadata, f"{path}: {NAME}")
        listed = {file.name: file for file in crate.files}
        faults = [(name, "is not listed among the metadata") for name in archive.members.keys() - listed]
        for file in listed.values():
            if fault := archive.unpack(file, folder):
                faults.append((file.name, fault))
            else:
                _date(file, folder)
    pipeline, results = folder / crate.pipeline, folder / RESULTS
    return Unpacked(pipeline, results, len(listed), crate.left_out, tuple(sorted(faults)))


def _date(file: Listed, folder: Path) -> None:
    try:
        day = datetime.datetime.fromisoformat(file.day).replace(hour=12, tzinfo=datetime.UTC).timestamp()
    except ValueError:
        return
    os.utime(folder / file.name, (day, day))
