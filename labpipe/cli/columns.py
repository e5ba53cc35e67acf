"""Tables on the terminal: columns of minimum width, empty ones omitted."""

from __future__ import annotations

from collections.abc import Sequence

import click

from labpipe.quantities import display_unit, to_display


def echo_table(header: Sequence[str], rows: Sequence[Sequence[str]], right: Sequence[int] = ()) -> None:
    """The rows below their header; the columns in *right* are numbers."""
    columns = [number for number in range(len(header)) if any(row[number] for row in rows)]
    widths = {number: max(len(header[number]), *(len(row[number]) for row in rows)) for number in columns}
    for row in (header, *rows):
        cells = (row[number].rjust(widths[number]) if number in right else row[number].ljust(widths[number]) for number in columns)
        click.echo("  ".join(cells).rstrip())


def value_cells(value: float, std_error: float | None, unit: str) -> tuple[str, str, str]:
    """A value, its standard error and its unit in display units."""
    displayed = display_unit(unit, value)
    error = "" if std_error is None else f"{to_display(std_error, displayed):.2g}"
    return f"{to_display(value, displayed):.6g}", error, "" if displayed == "1" else displayed
