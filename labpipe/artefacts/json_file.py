"""JSON as all of labpipe's files have it: not-a-number has no place in it, what cannot be given is null."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any


def write_json(path: Path, entries: dict[str, Any]) -> None:
    """Write the entries as UTF-8, the same bytes for the same entries."""
    path.write_text(json.dumps(_without_nan(entries), indent=1, allow_nan=False, ensure_ascii=False) + "\n", encoding="utf-8")


def _without_nan(entry: Any) -> Any:
    if isinstance(entry, dict):
        return {key: _without_nan(item) for key, item in entry.items()}
    if isinstance(entry, (list, tuple)):
        return [_without_nan(item) for item in entry]
    return None if isinstance(entry, float) and not math.isfinite(entry) else entry
