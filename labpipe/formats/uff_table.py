"""The time records of a universal file as a table of channels."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.errors import DataError
from labpipe.formats.names import unique
from labpipe.formats.uff import TIME, UffRecord, open_uff, read_uff
from labpipe.formats.uff_numbers import read_numbers
from labpipe.formats.uff_units import time_unit

CHUNK_ROWS = 1 << 17
# The time step is printed with six digits: rates are rounded to a whole number of hertz within this relative tolerance.
_STEP_DIGITS = 1e-5
_DIRECTIONS = ("", "X", "Y", "Z", "RX", "RY", "RZ")


class UffTable:
    """Time records of equal length of one file. Satisfies Table."""

    def __init__(self, path: Path) -> None:
        self.path = path
        records = [record for record in read_uff(path) if record.function == TIME or (record.function, record.abscissa.kind) == (0, 17)]
        if not records:
            raise DataError("holds no time records", where=str(path), hint="FRFs belong under frfs: in a pipeline")
        _check_alike(records, path)
        self.columns = unique([channel_name(record) for record in records])
        self._records = dict(zip(self.columns, records, strict=True))
        self.units = {name: unit for name, record in self._records.items() if (unit := time_unit(record)[0])}
        self.sample_rate: float | None = whole_rate(1 / records[0].step)

    def chunks(self, columns: Sequence[str]) -> Iterator[FloatArray]:
        """Consecutive chunks (n, n_column) [unit of the column]; DataError for a truncated record."""
        with open_uff(self.path) as buffer:
            try:
                table = [np.asarray(read_numbers(buffer, self._records[name].layout)[1], float) for name in columns]
            except ValueError as error:
                raise DataError(f"a time record cannot be read: {error}", where=str(self.path)) from None
        factors = np.array([time_unit(self._records[name])[1] for name in columns])
        for start in range(0, len(table[0]), CHUNK_ROWS):
            yield np.column_stack([column[start : start + CHUNK_ROWS] for column in table]) * factors


def _check_alike(records: list[UffRecord], path: Path) -> None:
    first = records[0]
    for record in records:
        if not record.even or not record.step > 0:
            raise DataError(f"{record.where}: its samples are not evenly spaced", where=str(path))
        if record.layout.parts != 1:
            raise DataError(f"{record.where}: a time record of complex values", where=str(path))
        if (record.n_value, record.step) != (first.n_value, first.step):
            what = f"{record.where} has {record.n_value} values, {record.step:g} s apart; {first.where} {first.n_value}, {first.step:g} s"
            raise DataError(what, where=str(path), hint="one file is one recording: split it")


def channel_name(record: UffRecord) -> str:
    """Entity name of the response, else its node and direction, else the axis label, the title or the record's number."""
    point = record.response
    sign = "-" if point.direction < 0 else "+"
    dof = f"{point.node}{sign}{_DIRECTIONS[abs(point.direction)]}" if point.direction else str(point.node)
    return point.name or (dof if point.node else "") or record.ordinate.label or record.title or str(record.number)


def whole_rate(rate: float) -> float:
    """The sampling rate [Hz], rounded to a whole number within the precision of the printed time step."""
    return float(round(rate)) if abs(round(rate) / rate - 1) < _STEP_DIGITS else rate
