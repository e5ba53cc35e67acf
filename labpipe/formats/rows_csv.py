"""Rows of records as CSV."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path

import pandas as pd

from labpipe.artefacts.writing import output_file
from labpipe.spreadsheet_cells import cell


def write_rows(path: Path, rows: Sequence[Mapping[str, object]]) -> None:
    """Write rows that may lack some columns; columns in the order of first appearance."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    with output_file(path) as target, target.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, names, restval="", lineterminator="\n")
        writer.writerow({name: cell(name) for name in names})
        writer.writerows({name: cell(entry) for name, entry in row.items()} for row in rows)


def write_table_csv(table: pd.DataFrame, target: Path) -> None:
    """Write a table whose texts no spreadsheet takes for formulas."""
    texts = {name: table[name].map(cell) for name in table.columns if not pd.api.types.is_numeric_dtype(table[name])}
    table.assign(**texts).rename(columns=cell).to_csv(target, index=False)
