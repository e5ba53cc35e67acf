"""Named arrays of one file as a table of channels, and NumPy's .npy and .npz files."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.errors import DataError
from labpipe.quantities import UnitError, unit_of
from labpipe.raw_files.text_table import check_filled, reading

CHUNK_ROWS = 1 << 17
RATES = (
    "fs", "f_s", "fsamp", "rate", "samplerate", "sample_rate", "sampling_rate", "samplingrate",
    "sampling_frequency",
)  # fmt: skip
STEPS = ("dt", "delta_t", "deltat", "time_step", "timestep", "sample_interval")
_SAME = 1e-4


@dataclass(frozen=True)
class Column:
    """A vector in an array (or HDF5 data set): whole, or row or column *index* of a matrix with samples along
    *axis*.
    """

    array: Any
    axis: int
    index: int | None

    @property
    def n_value(self) -> int:
        return int(self.array.shape[self.axis])

    def part(self, start: int, stop: int) -> FloatArray:
        """Values *start* to *stop*, (n,) [unit of the file]."""
        where: list[int | slice] = [0 if self.index is None else self.index] * len(self.array.shape)
        where[self.axis] = slice(start, stop)
        return np.asarray(self.array[tuple(where)], np.float64)


def is_numeric(array: Any) -> bool:
    """True for an array of real numbers in one or two dimensions that is not sparse."""
    if getattr(array, "dtype", np.dtype(object)).kind not in "iuf" or hasattr(array, "tocsr"):
        return False
    return len(array.shape) in (1, 2) and min(array.shape) > 0


def columns_of(name: str, array: Any) -> dict[str, Column]:
    """One column of a vector; name_1, name_2, ... of a matrix, whose longer side is time."""
    axis = int(np.argmax(array.shape))
    others = 1 if len(array.shape) == 1 else int(array.shape[1 - axis])
    if others == 1:
        return {name: Column(array, axis, None)}
    return {f"{name}_{n + 1}": Column(array, axis, n) for n in range(others)}


def distinct(columns: Iterable[tuple[str, Column]], where: Path) -> dict[str, Column]:
    """Columns by name, of two with one name the longer; DataError where these are of one length."""
    by_name: dict[str, Column] = {}
    for name, column in columns:
        length = by_name[name].n_value if name in by_name else 0
        if length == column.n_value:
            raise DataError(f"two of its arrays make a column '{name}'", where, "rename one of them")
        if length < column.n_value:
            by_name[name] = column
    return by_name


def longest(columns: Mapping[str, Column], where: Path) -> dict[str, Column]:
    """The columns of the greatest length; DataError when none has two values."""
    length = max((column.n_value for column in columns.values()), default=0)
    if length < 2:
        raise DataError("holds no vector of numbers", where, "equally long vectors make a recording")
    return {name: column for name, column in columns.items() if column.n_value == length}


def rate_of(scalars: Mapping[str, float], where: Path, units: Mapping[str, str]) -> float | None:
    """The sampling rate [Hz] from scalars such as fs or dt, in Hz and s where no *units* say otherwise.
    DataError when they contradict each other or are not positive.
    """

    def name_columns(names: tuple[str, ...], si_unit: str) -> dict[str, float]:
        return {
            name: value * _factor(units.get(name, ""), si_unit)
            for name, value in scalars.items()
            if (last := _last(name).lower()) in names or last.removeprefix("time_") in names
        }

    steps = name_columns(STEPS, "s").items()
    rates_by_name = name_columns(RATES, "Hz") | {name: 1 / step if step else 0.0 for name, step in steps}
    rates = list(rates_by_name.values())
    if not rates:
        return None
    if not all(0 < rate < np.inf for rate in rates) or max(rates) > min(rates) * (1 + _SAME):
        contradictions = ", ".join(f"{name}: {rate:g} Hz" for name, rate in rates_by_name.items())
        raise DataError(f"has no valid sampling rate ({contradictions})", where)
    return rates[0]


def _factor(unit: str, si_unit: str) -> float:
    try:
        return unit_of(unit or si_unit, si_unit).factor
    except UnitError:
        return 1.0


def _last(name: str) -> str:
    return re.split("[./]", name)[-1]


# What lists of texts beside the channels are, by the last part of their name; and the words of an analyser
# that describes its signals in one text ("Signal X1, Real EU N").
_WHOSE = r"((channel|chan|ch|sensor|signal|column|y|eu)s?_?)"
_LISTS = (
    ("names", re.compile(rf"^({_WHOSE}(name|label)s?|names|labels)$", re.IGNORECASE)),
    ("units", re.compile(rf"^{_WHOSE}?(eu|units?)(_?(label|string|name)s?)?$", re.IGNORECASE)),
    ("sensitivities", re.compile(rf"^{_WHOSE}?sensitivit(y|ies)$", re.IGNORECASE)),
)
_SIGNAL = re.compile(r"Signal\s+(\w+)\b[^\n;]*?\bEU\s+([^\s,;]+)")


def describe(
    columns: Sequence[str], texts: Mapping[str, Sequence[str]]
) -> tuple[dict[str, str], dict[str, str], dict[str, str]]:
    """(names, units, sensitivities) of *columns* by *texts* beside them: a list of as many texts as there are
    columns, or columns of a matrix, is theirs in order; NAME_unit is that of NAME.
    """
    stated: dict[str, dict[str, str]] = {"names": {}, "units": {}, "sensitivities": {}}
    by_last = {_last(name): name for name in columns}
    matrices: dict[str, list[str]] = {}
    for name in columns:
        matrices.setdefault(re.sub(r"_\d+$", "", name), []).append(name)
    for key, entries in texts.items():
        last = _last(key)
        for name, unit in _SIGNAL.findall("\n".join(entries)):
            if name in by_last:
                stated["units"].setdefault(by_last[name], unit)
        kind = next((kind for kind, pattern in _LISTS if pattern.match(last)), "")
        group = next((g for g in (list(columns), *matrices.values()) if len(g) == len(entries) > 1), None)
        if kind and group is not None:
            stated[kind] |= {name: text for name, text in zip(group, entries, strict=True) if text}
        whose, _, word = last.rpartition("_")
        if word.lower() in ("unit", "units") and whose in by_last and len(entries) == 1:
            stated["units"].setdefault(by_last[whose], entries[0])
    names = stated["names"]
    if len(set(names.values())) < len(names):
        names = {}
    return names, stated["units"], stated["sensitivities"]


class ArraysTable:
    """Columns of named arrays. Satisfies RawTable. *unused*: vectors of other lengths, with these; *texts*
    beside the numbers may say names, units and sensitivities.
    """

    def __init__(
        self,
        path: Path,
        columns: Mapping[str, Column],
        units: dict[str, str],
        sample_rate: float | None,
        texts: Mapping[str, Sequence[str]] | None = None,
    ) -> None:
        self.path = path
        chosen = longest(columns, path)
        times = [name for name in chosen if _last(name).lower() in ("t", "time")]
        names, of_texts, sensitivities = describe([n for n in chosen if n not in times], texts or {})
        self._columns = distinct(((names.get(name, name), column) for name, column in chosen.items()), path)
        units = {names.get(name, name): unit for name, unit in (of_texts | units).items()}
        self.sensitivities = {names.get(name, name): text for name, text in sensitivities.items()}
        self.unused = {
            name: column.n_value
            for name, column in columns.items()
            if name not in chosen and column.n_value > 1
        }
        self.columns = tuple(self._columns)
        self.units = {name: unit for name, unit in units.items() if name in self._columns and unit}
        self.sample_rate = sample_rate

    def chunks(self, columns: Sequence[str]) -> Iterator[FloatArray]:
        """Consecutive chunks (n, n_column) [unit of the file]; DataError when the file is damaged."""
        length = self._columns[self.columns[0]].n_value
        for start in range(0, length, CHUNK_ROWS):
            try:
                yield np.column_stack(
                    [self._columns[name].part(start, start + CHUNK_ROWS) for name in columns]
                )
            except OSError as error:
                raise DataError(f"cannot be read: {error}", self.path) from None


# NumPy's .npy and .npz files; nothing in them is unpickled.


def load_arrays(path: Path) -> dict[str, Any]:
    """The arrays of a .npz file by name, that of a .npy file under ''. DataError for a damaged file or one of
    pickled objects.
    """
    check_filled(path)
    with reading(path, "NumPy file of numbers"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        mode: Any = "r" if path.suffix.lower() == ".npy" else None
        stored = np.load(path, allow_pickle=False, mmap_mode=mode)
        if isinstance(stored, np.ndarray):
            return {"": stored}
        with stored:
            return {name: stored[name] for name in stored.files}


def numpy_table(path: Path) -> ArraysTable:
    """The vectors of a NumPy file, or the columns of its matrices: 1, 2, ... in a .npy file. Fields of a
    structured array by name.
    """
    arrays: dict[str, Any] = {}
    for name, array in load_arrays(path).items():
        if array.dtype.names:
            arrays |= {".".join(filter(None, (name, field))): array[field] for field in array.dtype.names}
        else:
            arrays[name] = array
    numeric = {name: array for name, array in arrays.items() if is_numeric(array)}
    columns = (
        (part.strip("_") or "1", column)
        for name, array in numeric.items()
        for part, column in columns_of(name, array).items()
    )
    scalars = {
        name: float(array.item())
        for name, array in arrays.items()
        if array.size == 1 and array.dtype.kind in "iuf"
    }
    return ArraysTable(path, distinct(columns, path), {}, rate_of(scalars, path, {}))
