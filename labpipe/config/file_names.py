"""Files that an entry names, by path or glob, and what their names say."""

from __future__ import annotations

import glob
import re
from collections.abc import Sequence
from fnmatch import fnmatchcase
from pathlib import Path

from labpipe.config.faults import Faults
from labpipe.errors import ConfigError
from labpipe.marked_yaml import Marked
from labpipe.places.address import is_remote, path_of


def files_of(node: Marked, key: str, faults: Faults, *, elsewhere: bool = False) -> list[Path]:
    """The files that a path or glob names, sorted; a fault when there is none. *elsewhere*: they may be objects of a storage, by URL."""
    if not node.text:
        faults.add(node, key, "a file name is needed")
        return []
    try:
        address = path_of(node.text)
    except ConfigError as error:
        faults.add(node, key, f"'{node.text}' {error.what}", error.hint)
        return []
    if is_remote(address):
        return _objects(address, node, key, faults) if elsewhere else _only_here(node, key, faults)
    path = faults.folder / address
    if glob.has_magic(node.text):
        matches = sorted(Path(name) for name in glob.glob(str(path), recursive=True))
        if not matches:
            faults.add(node, key, f"no file matches '{node.text}'", "paths are relative to the pipeline file")
        return matches
    if not path.exists():
        faults.add(node, key, f"no such file '{node.text}'", "paths are relative to the pipeline file")
        return []
    return [path]


def _only_here(node: Marked, key: str, faults: Faults) -> list[Path]:
    faults.add(node, key, "is read from this machine only", "recordings may be named by URL; copy this file here")
    return []


def _objects(address: Path, node: Marked, key: str, faults: Faults) -> list[Path]:
    """The objects that a URL names, as `files_of`; StorageError where the storage does not answer."""
    # Recordings of this machine are found without an object storage.
    from labpipe.places.storage import below, status

    if not glob.has_magic(str(address)):
        objects = [address] if status(address) else []
    else:
        plain = next(number for number, part in enumerate(address.parts) if glob.has_magic(part))
        folder, pattern = Path(*address.parts[:plain]), address.parts[plain:]
        objects = [status_of_object.path for status_of_object in below(folder) if _matches(status_of_object.path.parts[plain:], pattern)]
    if not objects:
        what = f"no object matches '{node.text}'" if glob.has_magic(node.text) else f"no such object '{node.text}'"
        faults.add(node, key, what, "names are those that the storage lists, capitals included")
    return objects


def _matches(names: Sequence[str], pattern: Sequence[str]) -> bool:
    """Whether a path is of a glob, both part by part: '**' stands for any folders; what begins with a point is hidden, as on a disk."""
    if not pattern or not names:
        return not names and all(part == "**" for part in pattern)
    hidden = names[0].startswith(".") and not pattern[0].startswith(".")
    if pattern[0] == "**":
        return _matches(names, pattern[1:]) or (not hidden and _matches(names[1:], pattern))
    return not hidden and fnmatchcase(names[0], pattern[0]) and _matches(names[1:], pattern[1:])


def plain_stem(path: Path) -> str:
    """The name of a file without its ending, nor that of its compression."""
    name = path.name[: -len(path.suffix)] if path.suffix.lower() in (".gz", ".zst") else path.name
    return Path(name).stem.removesuffix(".frf")


def listed(node: Marked) -> list[Marked]:
    """The entries of a list, or the only entry."""
    return node.content if isinstance(node.content, list) else [node]


def conditions_in(name: str, pattern: str) -> dict[str, str] | None:
    """The conditions in a file's *name*: '427N-up' by '{preload}-{direction}' is preload 427N, direction up; None where it differs.

    '{}' stands for a part that is no condition.
    """
    parts = re.split(r"\{(\w*)\}", pattern)
    wanted = [part for part in parts[1::2] if part]
    groups = iter(parts[1::2])
    expression = "".join(re.escape(part) + ("(.+?)" if next(groups, "") else ".+?") for part in parts[:-1:2]) + re.escape(parts[-1])
    match = re.fullmatch(expression, name)
    return None if match is None else dict(zip(wanted, match.groups(), strict=True))
