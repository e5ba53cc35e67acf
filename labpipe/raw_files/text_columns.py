"""A text table whose columns may be complex, read as a whole: for FRFs, which are short."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from labpipe.arrays import ComplexArray
from labpipe.errors import DataError
from labpipe.raw_files.text_table import fields_of, find_layout, open_unpacked


def complex_of(field: str, decimal: str) -> complex:
    """The number in a field: 1.5, 1,5, 1+2j, (1 + 2i), 3e-4i; ValueError for none."""
    text = (
        field.strip().strip('"').strip("()").replace(" ", "").replace("i", "j")
        if field.strip() not in ("inf", "nan")
        else field
    )
    if decimal == ",":
        if "." in text:
            raise ValueError(field)
        text = text.replace(",", ".")
    if "_" in text:
        raise ValueError(field)
    return complex(text.replace("*", ""))


def is_complex(field: str, decimal: str) -> bool:
    """True if a field is one number, real or complex, with this decimal sign."""
    try:
        complex_of(field, decimal)
    except ValueError:
        return False
    return True


class TextColumns:
    """Columns of a text table by name or by number from 1; *units* where the header states them."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.layout = find_layout(path, is_complex)
        self.columns = self.layout.names
        self.units = self.layout.units
        self._rows = self._read()

    def _read(self) -> list[tuple[int, list[str]]]:
        """(line number from 1, fields) of every row; DataError for a row of another length."""
        layout, rows = self.layout, []
        with (
            open_unpacked(self.path) as stream,
            io.TextIOWrapper(stream, encoding=layout.encoding, errors="replace") as lines,
        ):
            for number, line in enumerate(lines, 1):
                if number <= layout.first_line or not line.strip():
                    continue
                fields = fields_of(line.rstrip("\r\n"), layout.delimiter)
                if len(fields) != len(layout.names):
                    what = f"{len(fields)} fields, {len(layout.names)} are needed as in the rows before"
                    raise DataError(what, where=f"{self.path}:{number}")
                rows.append((number, fields))
        return rows

    def column(self, index: int) -> ComplexArray:
        """The numbers of a column (n_row,) [unit of the file].

        DataError names the line of the first that is none.
        """
        values = np.empty(len(self._rows), np.complex128)
        for place, (number, fields) in enumerate(self._rows):
            try:
                values[place] = complex_of(fields[index], self.layout.decimal)
            except ValueError:
                name = self.columns[index] or str(index + 1)
                what = f"column '{name}': '{fields[index].strip()[:40]}' is not a number"
                raise DataError(what, where=f"{self.path}:{number}") from None
        return values

    def line(self, row: int) -> str:
        """The place of a row in the file."""
        return f"{self.path}:{self._rows[row][0]}"
