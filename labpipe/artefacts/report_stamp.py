"""The last line of a report: what it was drawn from, and the digest of all before it. A report of the same result is not drawn again."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path

from labpipe.artefacts.code import code_digest
from labpipe.artefacts.json_file import DIGEST

# How a format writes what its readers pass over; a format of another package has no stamp and is always drawn.
COMMENTS = {"html": (b"<!-- ", b" -->\n"), "md": (b"<!-- ", b" -->\n"), "pdf": (b"% ", b"\n")}
LONGEST = 200
_RESULT = re.compile(rb'^"' + DIGEST.encode() + rb'": "([0-9a-f]{64})"', re.MULTILINE)
_STAMP = re.compile(rb"labpipe drew this from ([0-9a-f]{64}), content ([0-9a-f]{64})")


def drawn_from(result: Path) -> str:
    """What the report of a result file depends on, as a digest: its content and the code that draws; empty where it carries no digest."""
    with result.open("rb") as stream:
        match = _RESULT.search(stream.read(4096))
    return hashlib.sha256(match[1] + code_digest().encode()).hexdigest() if match else ""


def stamped(content: bytes, source: str, report_format: str) -> bytes:
    """The bytes of a report with its last line; as they are without a *source* or for a format that has no comments."""
    if not source or report_format not in COMMENTS:
        return content
    begin, end = COMMENTS[report_format]
    content = content if content.endswith(b"\n") else content + b"\n"
    digest = hashlib.sha256(content).hexdigest()
    return content + begin + f"labpipe drew this from {source}, content {digest}".encode() + end


def is_drawn(path: Path, source: str) -> bool:
    """Whether a report was drawn from this source and is whole: neither edited nor damaged since."""
    if not source or not path.is_file():
        return False
    content = path.read_bytes()
    matches = list(_STAMP.finditer(content, max(len(content) - LONGEST, 0)))
    if not matches or matches[-1][1].decode() != source:
        return False
    start = content.rfind(b"\n", 0, matches[-1].start()) + 1
    line = content[start : matches[-1].start()], content[matches[-1].end() :]
    return line in COMMENTS.values() and hashlib.sha256(content[:start]).hexdigest() == matches[-1][2].decode()
