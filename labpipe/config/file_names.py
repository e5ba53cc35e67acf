"""Files that an entry names, by path or glob, and what their names say."""

from __future__ import annotations

import glob
import re
from pathlib import Path

from labpipe.config.faults import Faults
from labpipe.marked_yaml import Marked


def files_of(node: Marked, key: str, faults: Faults) -> list[Path]:
    """The files that a path or glob names, sorted; a fault when there is none."""
    if not node.text:
        faults.add(node, key, "a file name is needed")
        return []
    path = faults.folder / node.text
    if glob.has_magic(node.text):
        matches = sorted(Path(name) for name in glob.glob(str(path), recursive=True))
        if not matches:
            faults.add(node, key, f"no file matches '{node.text}'", "paths are relative to the pipeline file")
        return matches
    if not path.exists():
        faults.add(node, key, f"no such file '{node.text}'", "paths are relative to the pipeline file")
        return []
    return [path]


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
