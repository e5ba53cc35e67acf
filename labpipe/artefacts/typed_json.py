"""Records as JSON, read back by the types that they declare.

Dataclasses are objects, tuples lists, complex numbers and arrays {"re", "im"}; a null where a number is meant is not-a-number, or what
the field's metadata says under "null". Entries that a type does not declare are passed over; those that are missing take the default.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import types
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Union, get_args, get_origin, get_type_hints

import numpy as np

from labpipe.errors import cut
from labpipe.records.settings import Settings, settings_of

# What an entry of another type than the declared one raises, here and where its record is checked at birth.
RECORD_FAULTS = (KeyError, TypeError, IndexError, ValueError, AttributeError, OverflowError, RecursionError, MemoryError)

LARGEST_COUNT = 1 << 63
PLAIN = frozenset((str, bool, int, float))


def entry_of(record: Any) -> Any:
    """JSON entries of a record; TypeError for a type without a JSON form."""
    if record is None or type(record) in PLAIN:
        return record
    if dataclasses.is_dataclass(record) and not isinstance(record, type):
        skipped = _contents_elsewhere(record)
        return {name: entry_of(getattr(record, name)) for name in _stored_fields(type(record)) if name not in skipped}
    if isinstance(record, np.ndarray):
        return {"re": record.real.tolist(), "im": record.imag.tolist()} if np.iscomplexobj(record) else record.tolist()
    if isinstance(record, Mapping):
        return {str(key): entry_of(value) for key, value in record.items()}
    if isinstance(record, (tuple, list)):
        return [entry_of(item) for item in record]
    if isinstance(record, complex):
        return {"re": record.real, "im": record.imag}
    if isinstance(record, np.generic):
        return record.item()
    if isinstance(record, (str, int, float)):
        return record
    raise TypeError(f"a {type(record).__name__} has no place in JSON")


@functools.cache
def _stored_fields(owner: type) -> tuple[str, ...]:
    return tuple(field.name for field in dataclasses.fields(owner) if field.metadata.get("entry", True))


def _contents_elsewhere(record: Any) -> set[str]:
    """Fields with the full path of a file that another setting names."""
    if not isinstance(record, Settings):
        return set()
    named = [setting.into for setting, _ in settings_of(type(record)).values() if setting.into]
    return {name for name in named if isinstance(getattr(record, name), Path)}


def record_of(entry: Any, kind: Any) -> Any:
    """The record of a declared type from its entry; KeyError, TypeError or ValueError where the entry is not of that type."""
    origin = get_origin(kind)
    if kind is Any:
        return entry
    if origin in (types.UnionType, Union):
        return None if entry is None else record_of(entry, _present(kind, entry))
    if origin is tuple:
        return _tuple(entry, get_args(kind))
    if origin in (dict, Mapping):
        return {key: record_of(value, get_args(kind)[1]) for key, value in _need(entry, dict).items()}
    if origin is np.ndarray:
        return _array(entry, kind)
    if dataclasses.is_dataclass(kind):
        return _dataclass(entry, kind)
    return _scalar(entry, kind)


def _present(kind: Any, entry: Any) -> Any:
    """The type of a value that may be missing: of several text for a text, where that may be, else the first."""
    kinds = [part for part in get_args(kind) if part is not types.NoneType]
    return str if isinstance(entry, str) and str in kinds else kinds[0]


def _dataclass(entry: Any, kind: Any) -> Any:
    hints = _hints(kind)
    values: dict[str, Any] = {}
    for field in dataclasses.fields(kind):
        if field.name not in _need(entry, dict):
            continue
        value = entry[field.name]
        if value is None and "null" in field.metadata:
            values[field.name] = field.metadata["null"]
        else:
            values[field.name] = record_of(value, hints[field.name])
    return kind(**values)


@functools.cache
def _hints(kind: Any) -> dict[str, Any]:
    return get_type_hints(kind)


def _tuple(entry: Any, kinds: tuple[Any, ...]) -> tuple[Any, ...]:
    items = _need(entry, list)
    if kinds[-1] is not Ellipsis:
        return tuple(record_of(item, kind) for item, kind in zip(items, kinds, strict=True))
    if kinds[0] is float:
        # Long columns of numbers need no conversion item by item.
        return tuple(math.nan if item is None else float(item) for item in items)
    return tuple(record_of(item, kinds[0]) for item in items)


def _array(entry: Any, kind: Any) -> Any:
    """An array of the declared type, complex from its parts."""
    (declared,) = get_args(get_args(kind)[1])
    element = get_origin(declared) or declared
    if issubclass(element, np.complexfloating):
        real, imaginary = (entry["re"], entry["im"]) if isinstance(entry, dict) else (_need(entry, list), 0.0)
        values = np.empty(np.shape(real), np.complex128)
        # A sum re + 1j im would lose the sign of a zero, and the written file would differ.
        values.real, values.imag = real, imaginary
        return values
    return np.array(entry, {np.floating: np.float64, np.bool_: np.bool_, np.intp: np.intp}.get(element, np.float64))


def _scalar(entry: Any, kind: Any) -> Any:
    if kind is float:
        if isinstance(entry, bool) or not isinstance(entry, (int, float, types.NoneType)):
            raise TypeError(f"{cut(repr(entry))} is not a number")
        if entry is not None:
            # OverflowError for an integer that is larger than any number.
            float(entry)
        return math.nan if entry is None else entry
    if kind in (str, bool, int) and (not isinstance(entry, kind) or (kind is int and isinstance(entry, bool))):
        raise TypeError(f"{cut(repr(entry))} is not a {kind.__name__}")
    if kind is int and abs(entry) >= LARGEST_COUNT:
        raise OverflowError(f"{cut(str(entry))} is no count")
    if kind is str:
        # UnicodeEncodeError for half a letter, which no file or terminal takes.
        entry.encode()
    return entry


def _need(entry: Any, kind: type) -> Any:
    if not isinstance(entry, kind):
        raise TypeError(f"{cut(repr(entry))} is not a {kind.__name__}")
    return entry
