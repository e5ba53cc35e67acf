"""JSON of labpipe's files: null instead of not-a-number and missing values."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any


def write_json(path: Path, entries: dict[str, Any]) -> None:
    """Write the entries as UTF-8, one line for each entry and for each item of a list; the same bytes for the same entries."""
    lines = ",\n".join(f'"{key}": {_lines(entry)}' for key, entry in entries.items())
    path.write_text(f"{{\n{lines}\n}}\n", encoding="utf-8")


def _lines(entry: Any) -> str:
    if isinstance(entry, (list, tuple)) and entry:
        return "[\n" + ",\n".join(f" {_line(item)}" for item in entry) + "\n]"
    return _line(entry)


def _line(entry: Any) -> str:
    # With an indent, Python's json takes its slow way: ten times the time, a line for every number.
    try:
        return json.dumps(entry, allow_nan=False, ensure_ascii=False)
    except ValueError:
        return json.dumps(_without_nan(entry), allow_nan=False, ensure_ascii=False)


def _without_nan(entry: Any) -> Any:
    if isinstance(entry, dict):
        return {key: _without_nan(item) for key, item in entry.items()}
    if isinstance(entry, (list, tuple)):
        return [_without_nan(item) for item in entry]
    return None if isinstance(entry, float) and not math.isfinite(entry) else entry
