"""The code behind a result, as a digest: results of another build count as stale, whatever its version number says."""

from __future__ import annotations

import functools
import hashlib
from importlib.metadata import entry_points
from pathlib import Path

import labpipe

PLUG_IN_GROUPS = "labpipe."


@functools.cache
def code_digest() -> str:
    """SHA-256 over the source of labpipe, and name and version of every package that adds to its tables."""
    digest = hashlib.sha256()
    root = Path(labpipe.__file__).parent
    for path in sorted(root.rglob("*.py")):
        digest.update(path.relative_to(root).as_posix().encode())
        digest.update(path.read_bytes())
    for name in sorted(_plug_ins()):
        digest.update(name.encode())
    return digest.hexdigest()


def _plug_ins() -> set[str]:
    every = entry_points()
    added = (entry for group in every.groups if group.startswith(PLUG_IN_GROUPS) for entry in every.select(group=group))
    return {f"{entry.value} {entry.dist.name} {entry.dist.version}" if entry.dist else entry.value for entry in added}
