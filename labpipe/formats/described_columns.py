"""The columns of a table, or the variables of a file, by the name or number under which an entry describes them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.errors import DataError
from labpipe.formats.hdf5_variables import hdf5_names, load_hdf5_variables
from labpipe.formats.mat_file import is_hdf5, load_fields
from labpipe.formats.numpy_table import load_arrays
from labpipe.formats.packed import plain_suffix
from labpipe.formats.table import TEXT_SUFFIXES, open_table
from labpipe.formats.text_columns import TextColumns
from labpipe.quantities import UnitError, parse_unit
from labpipe.registry import nearest

VARIABLE_SUFFIXES = (".mat", ".h5", ".hdf5", ".hdf", ".npz")


class DescribedColumns:
    """*names* of columns or variables, their *units* where the file states them, and what reads one by its place among the names."""

    def __init__(
        self,
        path: Path,
        names: Sequence[str],
        units: dict[str, str],
        read: Callable[[int], Any],
        place: Callable[[int], str],
        word: str = "column",
    ) -> None:
        self.path, self.names, self.word = path, tuple(names), word
        self.place = place
        self._units, self._read = units, read

    def _index(self, described: str) -> int:
        """The place of a name, else of a number from 1; DataError with the nearest name."""
        count = self.names.count(described)
        if count == 1:
            return self.names.index(described)
        if count > 1:
            what = f"the {self.word} '{described}' appears {count} times"
            raise DataError(what, where=str(self.path), hint="write its number, counted from 1")
        if described.isdigit() and self.word == "column":
            if 1 <= int(described) <= len(self.names):
                return int(described) - 1
            raise DataError(f"no column {described}: the table has {len(self.names)}", where=str(self.path))
        raise DataError(f"no {self.word} '{described}'", where=str(self.path), hint=nearest(described, [n for n in self.names if n]))

    def unit(self, described: str) -> str:
        """The unit that the file states, '' for none or an unknown one."""
        unit = self._units.get(self.names[self._index(described)], "")
        try:
            parse_unit(unit) if unit else None
        except UnitError:
            return ""
        return unit

    def values(self, described: str) -> Any:
        """The numbers [unit of the file], complex, (n_value,) or of any shape; DataError with the place of the first that is missing."""
        numbers = np.asarray(self._read(self._index(described)))
        if numbers.dtype.kind not in "iufc" or not numbers.size:
            raise DataError(f"{self.word} '{described}' holds no numbers", where=str(self.path))
        numbers = numbers.astype(np.complex128)
        numbers = numbers.ravel() if numbers.size == max(numbers.shape, default=1) else numbers
        if not np.all(np.isfinite(numbers)):
            row = int(np.argmax(~np.isfinite(numbers.ravel())))
            raise DataError(f"{self.word} '{described}' has no number at value {row + 1}", where=self.place(row))
        return numbers

    def real(self, described: str) -> FloatArray:
        """Real numbers [unit of the file], (n_value,) or of any shape; DataError for complex ones."""
        numbers = self.values(described)
        if np.any(numbers.imag):
            row = int(np.argmax(numbers.imag.ravel() != 0))
            raise DataError(f"{self.word} '{described}' holds complex numbers, real ones are needed", where=self.place(row))
        return np.asarray(numbers.real, np.float64)


def columns_of_table(path: Path) -> DescribedColumns:
    """The columns of a text or another table; DataError where the file holds variables."""
    if plain_suffix(path) in VARIABLE_SUFFIXES:
        raise DataError("holds variables, no columns", where=str(path), hint="write 'variables' in place of 'columns'")
    if plain_suffix(path) in TEXT_SUFFIXES:
        if not path.is_file():
            raise DataError("is a folder, a file is needed", where=str(path))
        text = TextColumns(path)
        return DescribedColumns(path, text.columns, text.units, text.column, text.line)
    table = open_table(path)

    def read(index: int) -> FloatArray:
        if table.columns.count(table.columns[index]) > 1:
            raise DataError(f"the column '{table.columns[index]}' appears several times", where=str(path), hint="rename one of them")
        return np.concatenate(list(table.chunks([table.columns[index]])))[:, 0]

    return DescribedColumns(path, table.columns, table.units, read, lambda row: f"{path}: row {row + 1}")


def columns_of_variables(path: Path) -> DescribedColumns:
    """The variables of a MATLAB, HDF5 or .npz file; fields of structures are named with dots: FRF.y_values.values."""
    if plain_suffix(path) not in VARIABLE_SUFFIXES:
        what = f"files with the ending '{plain_suffix(path)}' hold columns, no variables"
        raise DataError(what, where=str(path), hint="write 'columns' in place of 'variables'")
    if plain_suffix(path) == ".npz":
        arrays = load_arrays(path)
        names = list(arrays)

        def read(index: int) -> Any:
            return arrays[names[index]]

    elif is_hdf5(path):
        names = [name.replace("/", ".") for name in hdf5_names(path)]

        def read(index: int) -> Any:
            stored = names[index].replace(".", "/")
            return load_hdf5_variables(path, [stored])[stored]

    else:
        fields = load_fields(path)
        names = list(fields)

        def read(index: int) -> Any:
            return fields[names[index]]

    return DescribedColumns(path, names, {}, read, lambda _row: str(path), "variable")
