"""Texts as cells of a CSV file: none of them is a formula to the spreadsheet that opens it.

A text that begins with = + - @, a tabulator or an apostrophe gets an apostrophe in front, unless it is a number with its unit
("-5 N"). Whoever reads the cell takes one leading apostrophe away.
"""

from __future__ import annotations

import re

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
