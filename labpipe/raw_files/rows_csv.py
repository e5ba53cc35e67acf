"""Rows of records as CSV; none of their texts is a formula to the spreadsheet that opens it.

Texts as cells of a CSV file: none of them is a formula to the spreadsheet that opens it.

A text that begins with = + - @, a tabulator or an apostrophe gets an apostrophe in front, unless it is a
number with its unit ("-5 N"). Whoever reads the cell takes one leading apostrophe away.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from labpipe.artefacts.writing import output_file

if TYPE_CHECKING:
    import pandas as pd

# Texts as cells of a CSV file: none of them is a formula to the spreadsheet that opens it.

_ACTING = ("=", "+", "-", "@", "\t", "\r", "\n", "'")
_AMOUNT = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?(?: ?[A-Za-zµ°%./^0-9]{0,12})?|[+-]")


def cell(text: object) -> object:
    """A text as a cell that no spreadsheet computes; anything else as it is."""
    if isinstance(text, str) and text.startswith(_ACTING) and not _AMOUNT.fullmatch(text):
        return f"'{text}"
    return text


def text_of(written: str) -> str:
    """The text that `cell` wrote."""
    return written[1:] if written.startswith("'") and cell(written[1:]) == written else written


# Rows of records as CSV.


def write_rows(path: Path, rows: Sequence[Mapping[str, object]]) -> None:
    """Write rows that may lack some columns; columns in the order of first appearance."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    with output_file(path) as target, target.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, names, restval="", lineterminator="\n")
        writer.writerow({name: cell(name) for name in names})
        writer.writerows({name: cell(entry) for name, entry in row.items()} for row in rows)


def write_table_csv(table: pd.DataFrame, target: Path) -> None:
    """Write a table whose texts no spreadsheet takes for formulas."""
    import pandas as pd

    texts = {
        name: table[name].map(cell)
        for name in table.columns
        if not pd.api.types.is_numeric_dtype(table[name])
    }
    table.assign(**texts).rename(columns=cell).to_csv(target, index=False)
