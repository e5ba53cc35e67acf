"""Frequency responses in tables and variables of any layout, as an entry under ``frfs:`` describes it."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import DataError
from labpipe.quantities import NONE, UnitError, locate_units, may_agree, parse_unit, parse_value, unit_of
from labpipe.raw_files.arrays_table import load_arrays
from labpipe.raw_files.frf_csv import checked_coherence, cube, port_of
from labpipe.raw_files.mat import hdf5_names, is_hdf5, load_fields, load_hdf5_variables
from labpipe.raw_files.simcenter import Signals, signals_of
from labpipe.raw_files.table import TEXT_SUFFIXES, open_table
from labpipe.raw_files.text_table import find_layout, plain_suffix, rows_of_fields
from labpipe.records.frf_layout import AXES, OF_AN_FRF, ElementColumns, FrfColumns, FrfLayout, form_of_unit
from labpipe.records.response import FORMS, FrequencyResponse
from labpipe.registry import nearest


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
        self._rows = list(rows_of_fields(path, self.layout))

    def column(self, index: int) -> ComplexArray:
        """The numbers of a column (n_row,) [unit of the file]. DataError names the line of the first that is
        none.
        """
        values = np.empty(len(self._rows), np.complex128)
        for place, (number, fields) in enumerate(self._rows):
            try:
                values[place] = complex_of(fields[index], self.layout.decimal)
            except ValueError:
                name = self.columns[index] or str(index + 1)
                what = f"column '{name}': '{fields[index].strip()[:40]}' is not a number"
                raise DataError(what, f"{self.path}:{number}") from None
        return values

    def line(self, row: int) -> str:
        return f"{self.path}:{self._rows[row][0]}"


VARIABLE_SUFFIXES = (".mat", ".h5", ".hdf5", ".hdf", ".npz")


class DescribedColumns:
    """*names* of columns or variables, their *units* where the file states them, and what reads one by its
    place; *signals*: structures of Simcenter Test.Lab among the variables.
    """

    def __init__(
        self,
        path: Path,
        names: Sequence[str],
        units: dict[str, str],
        read: Callable[[int], Any],
        place: Callable[[int], str],
        word: str = "column",
        signals: Sequence[Signals] = (),
    ) -> None:
        self.path, self.names, self.word, self.signals = path, tuple(names), word, signals
        self.place = place
        self._units, self._read = units, read

    def _index(self, described: str) -> int:
        count = self.names.count(described)
        if count == 1:
            return self.names.index(described)
        if count > 1:
            what = f"the {self.word} '{described}' appears {count} times"
            raise DataError(what, self.path, "write its number, counted from 1")
        if described.isdigit() and self.word == "column":
            if 1 <= int(described) <= len(self.names):
                return int(described) - 1
            raise DataError(f"no column {described}: the table has {len(self.names)}", self.path)
        names = [name for name in self.names if name]
        raise DataError(f"no {self.word} '{described}'", self.path, nearest(described, names))

    def _number(self, described: str) -> tuple[str, int] | None:
        """The variable and the column (or row) of a matrix that is named as `inspect` does: H_2."""
        base, _, number = described.rpartition("_")
        if self.word == "column" or described in self.names or base not in self.names or not number.isdigit():
            return None
        return base, int(number)

    def _numbers(self, described: str) -> Any:
        numbered = self._number(described)
        if numbered is None:
            return self._read(self._index(described))
        base, number = numbered
        matrix = np.asarray(self._read(self._index(base)))
        columns = matrix if matrix.ndim == 2 and matrix.shape[0] >= matrix.shape[1] else matrix.T
        if matrix.ndim != 2 or not 1 <= number <= columns.shape[1]:
            raise DataError(f"the variable '{base}' of size {matrix.shape} has no column {number}", self.path)
        return columns[:, number - 1]

    def unit(self, described: str) -> str:
        """The unit that the file states, '' for none or an unknown one."""
        numbered = self._number(described)
        unit = self._units.get(numbered[0] if numbered else self.names[self._index(described)], "")
        try:
            parse_unit(unit) if unit else None
        except UnitError:
            return ""
        return unit

    def in_decibels(self, described: str) -> bool:
        return self.word == "column" and re.search(r"\bdB\b", self.names[self._index(described)]) is not None

    def values(self, described: str) -> Any:
        """The numbers [unit of the file], complex, (n_value,) or of any shape. DataError with the place of
        the first that is missing.
        """
        numbers = self._numbers(described)
        if numbers.dtype.kind not in "iufc" or not numbers.size:
            raise DataError(f"{self.word} '{described}' holds no numbers", self.path)
        numbers = numbers.astype(np.complex128)
        numbers = numbers.ravel() if numbers.size == max(numbers.shape, default=1) else numbers
        if not np.all(np.isfinite(numbers)):
            row = int(np.argmax(~np.isfinite(numbers.ravel())))
            raise DataError(f"{self.word} '{described}' has no number at value {row + 1}", self.place(row))
        return numbers

    def real(self, described: str) -> FloatArray:
        """Real numbers [unit of the file], (n_value,) or of any shape; DataError for complex ones."""
        numbers = self.values(described)
        if np.any(numbers.imag):
            row = int(np.argmax(numbers.imag.ravel() != 0))
            what = f"{self.word} '{described}' holds complex numbers, real ones are needed"
            raise DataError(what, self.place(row))
        return np.asarray(numbers.real, np.float64)


def columns_of_table(path: Path) -> DescribedColumns:
    """The columns of a text or another table; DataError where the file holds variables."""
    if plain_suffix(path) in VARIABLE_SUFFIXES:
        raise DataError("holds variables, no columns", path, "write 'variables' in place of 'columns'")
    if plain_suffix(path) in TEXT_SUFFIXES:
        if not path.is_file():
            raise DataError("is a folder, a file is needed", path)
        text = TextColumns(path)
        return DescribedColumns(path, text.columns, text.units, text.column, text.line)
    table = open_table(path)

    def read(index: int) -> FloatArray:
        if table.columns.count(table.columns[index]) > 1:
            what = f"the column '{table.columns[index]}' appears several times"
            raise DataError(what, path, "rename one of them")
        return np.concatenate(list(table.chunks([table.columns[index]])))[:, 0]

    return DescribedColumns(path, table.columns, table.units, read, lambda row: f"{path}: row {row + 1}")


def columns_of_variables(path: Path) -> DescribedColumns:
    """The variables of a MATLAB, HDF5 or .npz file; fields of structures are named with dots:
    FRF.y_values.values.
    """
    if plain_suffix(path) not in VARIABLE_SUFFIXES:
        what = f"files with the ending '{plain_suffix(path)}' hold columns, no variables"
        raise DataError(what, path, "write 'columns' in place of 'variables'")
    in_hdf5 = plain_suffix(path) != ".npz" and is_hdf5(path)
    fields: dict[str, Any] = {}
    if not in_hdf5:
        fields = load_arrays(path) if plain_suffix(path) == ".npz" else load_fields(path)
    names = [name.replace("/", ".") for name in hdf5_names(path)] if in_hdf5 else list(fields)

    def read(index: int) -> Any:
        stored = names[index].replace(".", "/")
        return load_hdf5_variables(path, [stored])[stored] if in_hdf5 else fields[names[index]]

    signals = signals_of(fields)
    units = {part.values: part.unit for part in signals}
    return DescribedColumns(path, names, units, read, lambda _row: str(path), "variable", signals)


def equal_steps(source: DescribedColumns, size: int) -> tuple[dict[str, str], FloatArray]:
    """What an entry says of *size* lines of equal distance, and their frequencies (n_line,) [Hz]; nothing
    where the file does not tell it.
    """
    for part in source.signals:
        if part.axis == "Hz" and max(source.values(part.values).shape) == size:
            start, step = (f"{part.place}.x_values.{name}" for name in ("start_value", "increment"))
            first = float(source.real(start).flat[0])
            return {"start": start, "step": step}, first + part.step * np.arange(size)
    spacing = _step_by_scalars(source, size)
    lines = {"start": "0 Hz", "step": f"{spacing:.12g} Hz"} if spacing else {}
    return lines, spacing * np.arange(size)


def _step_by_scalars(source: DescribedColumns, size: int) -> float:
    """The distance of *size* lines [Hz] by the samples of a block and their rate among the numbers of the
    file; 0 without.
    """
    scalars: dict[str, float] = {}
    for name in source.names:
        try:
            values = source.values(name)
        except DataError:
            continue
        if values.size == 1:
            scalars[name.rpartition(".")[2].lower()] = float(values.real.flat[0])
    for block in ("npts", "nfft", "n_fft", "blocksize"):
        for rate in ("fs", "freq", "rate", "fsamp", "sample_rate"):
            if scalars.get(block, 0) // 2 + 1 == size and scalars.get(rate, 0) > 0:
                return scalars[rate] / scalars[block]
    return 0.0


@dataclass(frozen=True)
class Dofs:
    """Dofs of one file's rows and columns, from its name or from the entry."""

    outputs: tuple[str, ...]
    inputs: tuple[str, ...]


def read_described(path: Path, layout: FrfLayout, dofs: Dofs) -> FrequencyResponse:
    """The response of a file by the description of its columns or variables, in SI units. DataError with file
    and line for a missing column, a cell without a number, a unit that the file contradicts.
    """
    table = layout.table
    assert table is not None
    form, scale = layout.scale
    source = columns_of_table(path) if layout.columns is not None else columns_of_variables(path)
    if table.matrix:
        frequency = _frequency(source, table, None)
        outputs, inputs = dofs.outputs, dofs.inputs
        shape = (frequency.size, len(outputs), len(inputs))
        matrix = _whole(source.values(table.matrix), shape, layout.axes, source, table.matrix)
        coherence = None
        if table.coherence:
            coherence = _whole(source.real(table.coherence), shape, layout.axes, source, table.coherence)
    else:
        elements = _elements(layout, table, dofs)
        values = {pair: _element(source, columns, layout) for pair, columns in elements.items()}
        outputs, inputs = _labels(elements, source)
        frequency = _frequency(source, table, next(iter(values.values())).size)
        for (output, reference), element in values.items():
            if element.shape != frequency.shape:
                what = f"{output}/{reference} has {element.size} values, the frequency axis {frequency.size}"
                raise DataError(what, source.path)
        matrix = cube(outputs, inputs, lambda o, i: values[o, i])
        coherence = None
        if all(columns.coherence for columns in elements.values()):
            coherence = cube(outputs, inputs, lambda o, i: source.real(elements[o, i].coherence))
    return FrequencyResponse(
        frequency,
        (matrix.conj() if layout.conjugate else matrix) * scale,
        tuple(map(port_of, outputs)),
        tuple(map(port_of, inputs)),
        form=form,
        coherence=checked_coherence(coherence, path),
    )


def _elements(layout: FrfLayout, table: FrfColumns, dofs: Dofs) -> dict[tuple[str, str], ElementColumns]:
    if not layout.elements:
        return {(dofs.outputs[0], dofs.inputs[0]): table}
    elements = {}
    for name, columns in layout.elements:
        output, _, reference = name.partition("/")
        elements[output, reference or dofs.inputs[0]] = columns
    return elements


def _labels(
    elements: dict[tuple[str, str], Any], source: DescribedColumns
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    outputs, inputs = (tuple(dict.fromkeys(pair[side] for pair in elements)) for side in (0, 1))
    missing = [f"{o}/{i}" for o in outputs for i in inputs if (o, i) not in elements]
    if missing:
        raise DataError(f"'elements' do not name {missing[0]}", source.path, "a full matrix is required")
    return outputs, inputs


def _element(source: DescribedColumns, columns: ElementColumns, layout: FrfLayout) -> ComplexArray:
    first, *second = (getattr(columns, name) for name in columns.given)
    _check_stated(source, first, columns.given[0], layout)
    if not second:
        values = source.values(first)
        if not np.any(values.imag):
            what = f"{source.word} '{first}' has no imaginary part anywhere"
            raise DataError(what, source.path, "an amplitude needs its phase: amplitude and phase_deg")
        return values
    size, other = source.real(first), source.real(second[0])
    if size.shape != other.shape:
        raise DataError(f"'{first}' has {size.size} values, '{second[0]}' {other.size}", source.path)
    if columns.given == ("re", "im"):
        return size + 1j * other
    _check_phase(source, second[0], columns.given[1])
    if columns.given[0] == "amplitude_db":
        size = 10 ** (size / 20)
    elif np.any(size < 0):
        row = int(np.argmax(size < 0))
        what = f"{source.word} '{first}' holds the negative amplitude {size[row]:g}"
        raise DataError(what, source.place(row), "amplitude_db for decibels")
    phase = np.deg2rad(other) if columns.given[1] == "phase_deg" else other
    return np.asarray(size * np.exp(1j * phase), np.complex128)


def _check_stated(source: DescribedColumns, column: str, part: str, layout: FrfLayout) -> None:
    stated, described = source.unit(column), layout.unit or FORMS[layout.form]
    if part != "amplitude_db" and source.in_decibels(column):
        what = f"column '{column}' is in decibels by the file's own header"
        raise DataError(what, source.path, "write amplitude_db")
    if not stated or parse_unit(stated).dimension == NONE:
        return
    if part == "amplitude_db":
        what = f"{source.word} '{column}' is in {stated} by the file's own header, not in decibels"
        raise DataError(what, source.path, "write amplitude")
    if not may_agree(stated, described):
        what = (
            f"{source.word} '{column}' is in {stated} by the file's own header, in {described} by the "
            "entry under frfs"
        )
        raise DataError(what, source.path, f"write unit: {stated}" if form_of_unit(stated) else OF_AN_FRF)


def _check_phase(source: DescribedColumns, column: str, part: str) -> None:
    stated, needed = source.unit(column), part.removeprefix("phase_")
    if stated and parse_unit(stated).dimension != NONE and not may_agree(stated, needed):
        what = f"{source.word} '{column}' is in {stated} by the file's own header"
        raise DataError(what, source.path, "write phase_deg or phase_rad, as the file has it")


def _frequency(source: DescribedColumns, table: FrfColumns, n_line: int | None) -> FloatArray:
    column = table.frequency or table.omega
    if not column:
        if n_line is None:
            n_line = max(source.values(table.matrix).shape)
        return _scalar(source, table.start) + _scalar(source, table.step) * np.arange(n_line)
    numbers = source.real(column)
    stated = source.unit(column)
    try:
        unit = unit_of(stated, "Hz") if stated else parse_unit("rad/s" if table.omega else "Hz")
    except UnitError:
        what = f"{source.word} '{column}' is in {stated} by the file's own header, which is not a frequency"
        raise DataError(what, source.path) from None
    if table.omega and stated and not unit.dimension[5]:
        what = f"{source.word} '{column}' is in {stated} by the file's own header"
        raise DataError(what, source.path, "write frequency")
    frequency = numbers * unit.factor / ((2 * np.pi) if unit.dimension[5] else 1.0)
    falling = np.flatnonzero(np.diff(frequency) <= 0)
    if falling.size:
        row = int(falling[0]) + 1
        what = f"{source.word} '{column}': the frequency does not increase ({numbers[row]:g})"
        raise DataError(what, source.place(row))
    return np.asarray(frequency, np.float64)


def _scalar(source: DescribedColumns, text: str) -> float:
    if text[0].isdigit() or text[0] in ".+-":
        with locate_units(source.path, DataError):
            return parse_value(text, "Hz")
    values = source.real(text)
    if values.size != 1:
        raise DataError(f"{source.word} '{text}' holds {values.size} numbers, one is needed", source.path)
    return float(values.flat[0])


def _whole(
    values: Any, shape: tuple[int, int, int], axes: tuple[str, ...], source: DescribedColumns, name: str
) -> Any:
    """An array in the order frequency, output, input. DataError when its size or the order of its dimensions
    is not clear.
    """
    orders = [tuple(AXES.index(axis) for axis in axes)] if axes else list(permutations(range(3)))
    # MATLAB drops trailing dimensions of 1, and a vector may lie either way.
    fitting = [
        order for order in orders if _squeeze(tuple(shape[n] for n in order)) == _squeeze(values.shape)
    ]
    needed = f"{shape[0]} frequencies, {shape[1]} outputs, {shape[2]} inputs"
    if not fitting:
        what = f"the variable '{name}' has the size {values.shape}; needed are {needed}"
        raise DataError(what, source.path)
    arrays = [
        values.reshape(tuple(shape[n] for n in order)).transpose(np.argsort(order)) for order in fitting
    ]
    if any(not np.array_equal(arrays[0], other) for other in arrays[1:]):
        what = f"the dimensions {values.shape} of '{name}' could be ordered in several ways"
        raise DataError(what, source.path, "name their order, for example axes: [output, input, frequency]")
    return arrays[0]


def _squeeze(shape: tuple[int, ...]) -> tuple[int, ...]:
    return tuple(length for length in shape if length != 1)
