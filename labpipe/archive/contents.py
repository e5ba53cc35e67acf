"""What an archive holds: the files of a result, the pipeline, and every file that the pipeline names, with all their digests."""

from __future__ import annotations

import datetime
import glob
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from labpipe.artefacts.code import code_digest
from labpipe.artefacts.header import source_ref
from labpipe.artefacts.identification_file import NAME, read_identification
from labpipe.artefacts.parquet import header_of
from labpipe.artefacts.recording_file import SUFFIX as RECORDING
from labpipe.artefacts.report_stamp import COMMENTS, drawn_from, is_drawn
from labpipe.config.pipeline import Pipeline
from labpipe.errors import ConfigError, DataError
from labpipe.marked_yaml import Marked, load_marked
from labpipe.places.address import is_remote, path_of, shown
from labpipe.records.identification import Identification
from labpipe.stages.identify import rig_entry, settings_entry
from labpipe.stages.measured import files_of_test
from labpipe.stages.verification import artefacts_below, verified

# The one folder of an archive, and the two in it.
EXPERIMENT = "experiment"
PROJECT, RESULTS = f"{EXPERIMENT}/project", f"{EXPERIMENT}/results"
YAML = (".yaml", ".yml")


@dataclass(frozen=True)
class Member:
    """A file of an archive: its *name* there, what it is in words, where it lies now, and its SHA-256.

    kept: it is in the archive itself, not only its digest. day: on which it was last changed, where the result depends on that.
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
    """The pipeline's name in the archive and the files: what the result was made *of*, and the *results*. left_out: of no result."""

    identification: Identification
    pipeline: str
    of: tuple[Member, ...]
    results: tuple[Member, ...]
    left_out: tuple[Path, ...] = ()

    @property
    def members(self) -> tuple[Member, ...]:
        """All files, in the order of their names."""
        return tuple(sorted((*self.of, *self.results), key=lambda member: member.name))


def contents(folder: Path, pipeline: Pipeline, *, digests_only: bool) -> Contents:
    """What an archive of the results in a folder holds; *digests_only*: of recordings the digests, not the recordings.

    DataError for results that do not hold, or that are not those of the pipeline; ConfigError for files that an archive cannot hold.
    """
    identification = read_identification(folder / NAME)
    _check_same(identification, pipeline, folder)
    for artefact in verified(folder, pipeline.folder):
        if artefact.faults:
            raise DataError(artefact.faults[0], where=str(artefact.path), hint="run `labpipe run` again")
    names = _names_of_result(folder, identification, pipeline)
    reports = [f"report.{name}" for name in COMMENTS if (folder / f"report.{name}").is_file()]
    for name in reports:
        if not is_drawn(folder / name, drawn_from(folder / NAME)):
            hint = f"remove it or draw it again by `labpipe report {folder}`"
            raise DataError("was not drawn from this result, or edited since", where=str(folder / name), hint=hint)
    recordings = [name for name in names if name.endswith(RECORDING)]
    results = [
        Member(f"{RESULTS}/{name}", _role_of_result(name), folder / name, kept=not (digests_only and name in recordings))
        for name in (*names, *reports)
    ]
    left_out = [path for path in artefacts_below(folder) if path.relative_to(folder).as_posix() not in names]
    noted = [reference for name in recordings for reference in header_of(folder / name).inputs]
    digests = {reference.path: reference.sha256 for reference in noted} | {
        source["path"]: source["sha256"] for source in identification.sources
    }
    main, files = _project(pipeline, digests, dated=identification.dataset is not None, digests_only=digests_only)
    return Contents(identification, main, tuple(map(_digested, files)), tuple(map(_digested, results)), tuple(left_out))


def _digested(member: Member) -> Member:
    """The member with digest and size; one that is not kept and lies elsewhere has the digest that the result names."""
    if is_remote(member.path):
        return member
    return replace(member, sha256=source_ref(member.path, member.path.parent).sha256, size=member.path.stat().st_size)


def _check_same(identification: Identification, pipeline: Pipeline, folder: Path) -> None:
    """DataError where the result was made by another build, or by a pipeline that says something else."""
    if identification.code != code_digest():
        what = f"was made by another build of labpipe ({identification.version or 'unknown'})"
        raise DataError(what, where=str(folder / NAME), hint="run `labpipe run` again, or make the archive with that build")
    stated, made = settings_entry(pipeline), dict(identification.settings)
    for entries in (stated, made):
        # With the conditions as the recordings showed them.
        entries.pop("tests", None)
    differing = [name for name in dict.fromkeys((*stated, *made)) if stated.get(name) != made.get(name)]
    differing += ["rig"] if rig_entry(pipeline) != identification.rig else []
    if differing:
        what = f"says something else under '{differing[0]}' than the result in {folder} was made with"
        raise DataError(what, where=str(pipeline.path), hint="write into the file what --set said, and run it again")


def _names_of_result(folder: Path, identification: Identification, pipeline: Pipeline) -> list[str]:
    """The artefacts of this very result by their names; what earlier pipelines left in the folder is none."""
    named = [reference["path"] for reference in identification.inputs]
    named.extend(name for test in pipeline.tests for name in files_of_test(test.name))
    files_there = [name for name in dict.fromkeys(named) if (folder / name).is_file() and ".." not in Path(name).parts]
    measured = [name for name in files_there if name.endswith(".parquet") and "/" not in name]
    recordings = [f"recordings/{reference.path}" for name in measured for reference in header_of(folder / name).inputs]
    return sorted({NAME, *files_there, *(name for name in recordings if (folder / name).is_file())})


def _role_of_result(name: str) -> str:
    if name == NAME:
        return "result: parameters, standard errors, findings, outcomes of rules"
    if name.startswith("report."):
        return "report"
    kinds = {RECORDING: "calibrated recording", ".results.parquet": "results of many tests", ".json": "fits of a test"}
    return next((role for suffix, role in kinds.items() if name.endswith(suffix)), "measured response, decays or spectra of a test")


def _project(pipeline: Pipeline, digests: Mapping[str, str], *, dated: bool, digests_only: bool) -> tuple[str, list[Member]]:
    """The pipeline's name in the archive, and it with all files that it names, in folders as they are.

    digests: of raw files by their paths or URLs. dated: the result depends on the days on which recordings were last changed.
    """
    raw = [path for test in pipeline.tests for source in test.recordings for path in (source.path, *source.joined)]
    ready = [path for test in pipeline.tests for frf in test.frfs for path in frf.paths]
    remote = next(filter(is_remote, raw), None)
    if remote is not None and not digests_only:
        what = "lies in an object storage, and is not brought into the archive"
        raise DataError(what, where=shown(remote), hint="--digests-only keeps its digest")
    settings, named = _named_by(pipeline.path)
    roles = dict.fromkeys(map(_absolute, (*raw, *ready)), "recording")
    roles |= {path: "table or file that the settings name" for path in map(_absolute, (*pipeline.side_files, *named)) if path not in roles}
    roles |= dict.fromkeys(settings, "rig, bearing or other settings")
    roles |= {_absolute(pipeline.path): "pipeline: the procedure"}
    home = Path(os.path.commonpath([path.parent for path in roles if not is_remote(path)]))
    members = []
    for path, role in roles.items():
        kept = not (digests_only and role == "recording")
        name = shown(path) if is_remote(path) else f"{PROJECT}/{path.relative_to(home).as_posix()}"
        day = _day(path) if dated and role == "recording" and not is_remote(path) else ""
        members.append(Member(name, role, path, digests.get(name, ""), kept=kept, day=day))
    return f"{PROJECT}/{_absolute(pipeline.path).relative_to(home).as_posix()}", members


def _absolute(path: Path) -> Path:
    """The path without '..', links as they are; a URL as it is."""
    return path if is_remote(path) else Path(os.path.abspath(path))


def _day(path: Path) -> str:
    """The day [UTC] on which a file was last changed: that of a test of a dataset that states none."""
    return datetime.datetime.fromtimestamp(path.stat().st_mtime, datetime.UTC).date().isoformat()


def _named_by(path: Path) -> tuple[list[Path], list[Path]]:
    """The settings files that a settings file names, itself first, and those that they name; all other files that any of them names."""
    settings, others = [_absolute(path)], list[Path]()
    for file in settings:
        for node in _texts(load_marked(file)):
            target = _absolute(file.parent / node.text)
            if target in settings or not _is_named(node, file.parent):
                continue
            (settings if target.suffix in YAML else others).append(target)
    return settings, list(dict.fromkeys(others))


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
        raise ConfigError(what, where=node.where, hint="name the file relative to the one that names it")
    try:
        return (folder / address).is_file()
    except OSError:
        return False


def _texts(node: Marked) -> Iterator[Marked]:
    """The texts in a tree."""
    parts: Sequence[Marked] = (
        tuple(node.content.values()) if isinstance(node.content, dict) else node.content if isinstance(node.content, list) else ()
    )
    if node.text and not parts:
        yield node
    for part in parts:
        yield from _texts(part)
