"""Rows of records as CSV."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path

from labpipe.artefacts.writing import output_file


def write_rows(path: Path, rows: Sequence[Mapping[str, object]]) -> None:
    """Write rows that may lack some columns; columns in the order of first appearance."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    with output_file(path) as target, target.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, names, restval="", lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
