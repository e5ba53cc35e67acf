"""JSON of labpipe's files: null instead of not-a-number and missing values; a digest of the content on a line of its own."""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from labpipe.artefacts.digest import AGAIN, DamagedError, mismatch
from labpipe.errors import cut

DIGEST = "digest"
# Of files without a digest the second entry is a version or a list.
LONGEST_SECOND = 30
_DIGEST_LINE = re.compile(rb'^"digest": "([0-9a-f]{64})",?\n', re.MULTILINE)


def write_json(path: Path, entries: dict[str, Any]) -> None:
    """Write the entries as UTF-8, one line for each entry and for each item of a list; the same bytes for the same entries."""
    path.write_bytes(_content(entries))


def write_digested(path: Path, entries: dict[str, Any]) -> None:
    """Write the entries with the digest of the file without it as the second one."""
    texts = _texts(entries)
    digest = hashlib.sha256(_joined(texts)).hexdigest()
    path.write_bytes(_joined([texts[0], *_texts({DIGEST: digest}), *texts[1:]]))


def read_digested(path: Path, what: str) -> dict[str, Any]:
    """The entries of a file whose content matches its digest, or that carries none; DamagedError says that it is not a readable *what*.

    A file that another program wrote again with the same entries in the same order matches as well.
    """
    content = read_bytes(path)
    entries = parsed(content, path, what)
    stated = entries.get(DIGEST)
    # A long text in its place under another name is a digest whose name was damaged.
    second = next(islice(entries.values(), 1, None), "")
    if stated is None and not (isinstance(second, str) and len(second) > LONGEST_SECOND):
        return entries
    if not isinstance(stated, str) or stated not in _digests(content, entries):
        raise mismatch(path)
    return entries


def _digests(content: bytes, entries: dict[str, Any]) -> Iterator[str]:
    """The digest of the content, then that of the entries written again."""
    yield hashlib.sha256(_DIGEST_LINE.sub(b"", content, count=1)).hexdigest()
    yield hashlib.sha256(_content({key: entry for key, entry in entries.items() if key != DIGEST})).hexdigest()


def read_bytes(path: Path) -> bytes:
    """The content of a regular file; DataError for anything else, FileNotFoundError where there is none."""
    if path.exists() and not path.is_file():
        raise DamagedError("is a folder, a file is needed" if path.is_dir() else "is no regular file", where=str(path))
    return path.read_bytes()


def parsed(content: bytes, path: Path, what: str) -> dict[str, Any]:
    """The entries of a JSON object; DamagedError for anything else."""
    try:
        entries = json.loads(content.decode("utf-8"))
    except RecursionError:
        raise DamagedError(f"is not a readable {what} (nested too deeply)", where=str(path), hint=AGAIN) from None
    except ValueError as error:
        raise DamagedError(f"is not a readable {what} ({cut(str(error))})", where=str(path), hint=AGAIN) from None
    if not isinstance(entries, dict):
        raise DamagedError(f"is not a readable {what} (no JSON object)", where=str(path), hint=AGAIN)
    return entries


def _content(entries: dict[str, Any]) -> bytes:
    return _joined(_texts(entries))


def _texts(entries: dict[str, Any]) -> list[str]:
    return [f"{json.dumps(key, ensure_ascii=False)}: {_lines(entry)}" for key, entry in entries.items()]


def _joined(texts: list[str]) -> bytes:
    return ("{\n" + ",\n".join(texts) + "\n}\n").encode()


def _lines(entry: Any) -> str:
    if isinstance(entry, (list, tuple)) and entry:
        return "[\n" + ",\n".join(f" {_line(item)}" for item in entry) + "\n]"
    return _line(entry)


def _line(entry: Any) -> str:
    # With an indent, Python's json takes its slow way: ten times the time, a line for every number.
    try:
        return json.dumps(entry, allow_nan=False, ensure_ascii=False, default=plain)
    except ValueError:
        return json.dumps(without_nan(entry), allow_nan=False, ensure_ascii=False, default=plain)


def plain(entry: Any) -> Any:
    """The Python number of a numpy number, which JSON does not know; TypeError for anything else."""
    if isinstance(entry, np.generic):
        number = entry.item()
        return None if isinstance(number, float) and not math.isfinite(number) else number
    raise TypeError(f"a {type(entry).__name__} has no place in JSON")


def without_nan(entry: Any) -> Any:
    """The entry with None for what is not a number or infinite, which JSON does not know."""
    if isinstance(entry, dict):
        return {key: without_nan(item) for key, item in entry.items()}
    if isinstance(entry, (list, tuple)):
        return [without_nan(item) for item in entry]
    return None if isinstance(entry, float) and not math.isfinite(entry) else entry
