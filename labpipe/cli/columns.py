"""Tables on the terminal: columns of minimum width, empty ones omitted."""

from __future__ import annotations

from collections.abc import Sequence

from labpipe.cli.output import echo, printable
from labpipe.display import difference_in, shown_unit, unit_label, written
from labpipe.quantities import to_display


def echo_table(header: Sequence[str], rows: Sequence[Sequence[str]], right: Sequence[int] = ()) -> None:
    """The rows below their header; the columns in *right* are numbers."""
    rows = [[printable(cell) for cell in row] for row in rows]
    columns = [number for number in range(len(header)) if any(row[number] for row in rows)]
    widths = {number: max(len(header[number]), *(len(row[number]) for row in rows)) for number in columns}
    for row in (header, *rows):
        cells = (row[number].rjust(widths[number]) if number in right else row[number].ljust(widths[number]) for number in columns)
        echo("  ".join(cells).rstrip())


def value_cells(value: float, std_error: float | None, unit: str, shown: str = "") -> tuple[str, str, str]:
    """A value, its standard error and its unit, in the unit *shown* of a whole column or else in the one that suits them."""
    shown = shown or shown_unit(unit, value, std_error)
    error = None if std_error is None else difference_in(std_error, shown)
    number, doubt = written(to_display(value, shown), error)
    return number, doubt, unit_label(shown)
