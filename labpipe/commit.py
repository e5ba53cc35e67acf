"""The commit that this code is of, where that is known: of a checkout, or of what was installed from a repository."""

from __future__ import annotations

import json
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

# Letters of a commit that people write.
SHORT = 10


def commit(package: Path = Path(__file__).parent) -> str:
    """The first SHORT letters of the commit, empty where nothing names it; *package*: the folder of the code."""
    return (of_checkout(package.parent / ".git") or _of_installation())[:SHORT]


def of_checkout(git: Path) -> str:
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


def _of_installation() -> str:
    """The commit that pip notes for what it installed from a repository (PEP 610)."""
    try:
        noted = distribution("labpipe").read_text("direct_url.json")
        return str(json.loads(noted or "{}").get("vcs_info", {}).get("commit_id", ""))
    except (PackageNotFoundError, ValueError, AttributeError):
        return ""
