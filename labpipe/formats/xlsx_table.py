"""Excel workbooks (.xlsx): the sheet that holds a table of numbers."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from datetime import datetime, time
from pathlib import Path
from typing import Any

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.errors import DataError
from labpipe.formats.csv_layout import header_of
from labpipe.formats.table import load_extra
from labpipe.formats.time_stamps import StampClock

Row = tuple[Any, ...]


class XlsxTable:
    """The columns of the only sheet with numbers; formulas count with the values that Excel stored. Satisfies Table."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._sheet, rows = self._rows_of_numbers()
        width = Counter(_width(row) for row in rows if _is_numeric(row)).most_common(1)[0][0]
        self._first = next(n for n, row in enumerate(rows) if _is_numeric(row) and _width(row) == width)
        above = ["\t".join(_text(cell) for cell in row[:width]) for row in rows[: self._first]]
        names, units = header_of(above, "\t", width)
        self._names, self._rows = names, [row[:width] for row in rows[self._first :]]
        self.columns = tuple(name for name in names if name)
        self.units = units
        self.sample_rate: float | None = None

    def _rows_of_numbers(self) -> tuple[str, list[Row]]:
        """Name and rows of the only sheet that holds numbers."""
        openpyxl = load_extra("openpyxl", "excel", self.path)
        if self.path.stat().st_size == 0:
            raise DataError("the file is empty", where=str(self.path))
        try:
            with warnings.catch_warnings():
                # Of styles and extensions that are no numbers.
                warnings.simplefilter("ignore")
                book = openpyxl.load_workbook(self.path, read_only=True, data_only=True)
                sheets = {sheet.title: list(sheet.iter_rows(values_only=True)) for sheet in book.worksheets}
                book.close()
        # The library has errors of many kinds for a damaged file.
        except Exception as error:
            reason = (str(error).splitlines() or ["damaged"])[0]
            raise DataError(f"is not a readable Excel workbook ({reason[:80]})", where=str(self.path)) from None
        numeric = {title: rows for title, rows in sheets.items() if any(map(_is_numeric, rows))}
        if len(numeric) != 1:
            what = "no sheet holds a row of numbers" if not numeric else f"several sheets hold numbers: {', '.join(numeric)}"
            raise DataError(what, where=str(self.path), hint="a workbook with one table is needed")
        return next(iter(numeric.items()))

    def chunks(self, columns: Sequence[str]) -> Iterator[FloatArray]:
        """The rows (n, n_column) [unit of the file] at once; DataError names the cell that is no number."""
        rows = [(number, row) for number, row in enumerate(self._rows, self._first + 1) if any(cell is not None for cell in row)]
        yield np.column_stack([self._column(self._names.index(name), rows) for name in columns])

    def _column(self, place: int, rows: Sequence[tuple[int, Row]]) -> FloatArray:
        clock = StampClock(self._names[place])
        values = np.empty(len(rows))
        for number, (row_number, row) in enumerate(rows):
            cell = row[place] if place < len(row) else None
            if isinstance(cell, (datetime, time)):
                values[number] = clock.seconds([str(cell)])[0]
            elif cell is None or (isinstance(cell, (int, float)) and not isinstance(cell, bool)):
                values[number] = np.nan if cell is None else cell
            else:
                what = f"column '{self._names[place]}': '{str(cell)[:40]}' is not a number"
                raise DataError(what, where=f"{self.path}: sheet {self._sheet}, row {row_number}")
        return values


def _is_numeric(row: Row) -> bool:
    """True for a row of numbers and dates, some of which may be missing."""
    cells = [cell for cell in row if cell is not None]
    is_value = all(isinstance(cell, (int, float, datetime, time)) and not isinstance(cell, bool) for cell in cells)
    return is_value and any(isinstance(cell, (int, float)) for cell in cells)


def _width(row: Row) -> int:
    """Cells up to the last filled one."""
    return max((number + 1 for number, cell in enumerate(row) if cell is not None), default=0)


def _text(cell: Any) -> str:
    return "" if cell is None else str(cell).replace("\t", " ").replace("\n", " ")
