"""What other programs were recorded to say."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

RECORDED = Path(__file__).parent / "recorded"


@cache
def recorded(name: str) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((RECORDED / f"{name}.json").read_text(encoding="utf-8"))
    return found


def words(name: str) -> str:
    """The sentence below a table of recorded rows."""
    file = recorded(name)
    return f"{file['program']}, rerun with `{file['command']}`; labpipe's side is computed each time."
