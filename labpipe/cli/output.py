"""What commands print: text from files never acts on a terminal; tables of columns of minimum width."""

from __future__ import annotations

import re
import sys
import unicodedata
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from labpipe.records.finding import Finding

# The colours that labpipe itself prints, by click.style.
_OWN = re.compile("(\x1b\\[(?:0|31|32|33|36)m)")
# Characters that reverse the order of what follows, or are not seen at all.
_ACTING = {"Cc", "Cf", "Cs", "Zl", "Zp"}
KEPT = "\n\t"
# Longest message, and longest echo of what stood in a file.
LONGEST, ECHO = 600, 80
_QUOTED = re.compile(rf"'([^'\n]{{{ECHO + 1},}})'")


def printable(text: str, kept: str = "") -> str:
    """The text with control, escape and bidirectional characters as their codes, except those *kept*."""
    if text.isascii() and text.isprintable():
        return text
    return "".join(
        _code(letter) if unicodedata.category(letter) in _ACTING and letter not in kept else letter
        for letter in text
    )


def _code(letter: str) -> str:
    number = ord(letter)
    width = 2 if number < 0x100 else 4 if number < 0x10000 else 8
    return f"\\{'xuU'[width // 4]}{number:0{width}x}"


def message_line(text: str) -> str:
    """A message on one line of at most LONGEST characters, in which no quotation is longer than ECHO."""
    short = _QUOTED.sub(lambda match: f"'{match[1][: ECHO - 3]}...'", text)
    line = printable(short)
    if len(line) <= LONGEST:
        return line
    # Place and cure stand at the ends.
    return f"{line[: LONGEST // 2]} ... {line[-LONGEST // 2 + 5 :]}"


def echo(text: object = "", *, err: bool = False, nl: bool = True) -> None:
    """Print a text; of control characters only ends of lines, tabulators and labpipe's own colours."""
    parts = enumerate(_OWN.split(str(text)))
    shown = "".join(part if number % 2 else printable(part, KEPT) for number, part in parts)
    click.echo(shown, err=err, nl=nl)


def for_terminal(text: str) -> str:
    """The text with powers and ± as a hand writes them, where the terminal takes UTF-8; else as it is."""
    from labpipe.display import as_printed

    encoding = (getattr(sys.stdout, "encoding", "") or "").lower().replace("-", "")
    return as_printed(text) if encoding == "utf8" else text


def echo_findings(findings: Iterable[Finding]) -> None:
    for finding in findings:
        echo(f"  {finding.level} {finding.code}: {finding.message}")


def echo_table(header: Sequence[str], rows: Sequence[Sequence[str]], right: Sequence[int] = ()) -> None:
    """The rows below their header; the columns in *right* are numbers."""
    rows = [[for_terminal(printable(cell)) for cell in row] for row in rows]
    columns = [number for number in range(len(header)) if any(row[number] for row in rows)]
    widths = {number: max(len(row[number]) for row in (header, *rows)) for number in columns}
    for row in (header, *rows):
        cells = (f"{row[n]:{'>' if n in right else '<'}{widths[n]}}" for n in columns)
        echo("  ".join(cells).rstrip())


def value_cells(value: float, std_error: float | None, unit: str, shown: str) -> tuple[str, str, str]:
    """A value, its standard error and its unit: *shown*, or else the one that suits them."""
    from labpipe.display import difference_in, shown_unit, unit_label, write_values
    from labpipe.quantities import to_display

    shown = shown or shown_unit(unit, value, std_error)
    error = None if std_error is None else difference_in(std_error, shown)
    number, uncertainty = write_values(to_display(value, shown), error)
    return number, uncertainty, unit_label(shown)
