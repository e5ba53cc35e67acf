"""JSON of labpipe's files: records by the types that they declare, null for missing numbers, a digest of the
content.

Dataclasses are objects, tuples lists, complex numbers and arrays {"re", "im"}; a null where a number is meant
is not-a-number, or what the field's metadata says under "null". Entries that a type does not declare are
passed over; those that are missing take the default.
"""

from __future__ import annotations

import functools
import hashlib
import json
import math
import re
import types
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from itertools import islice
from pathlib import Path
from typing import Any, Union, get_args, get_origin, get_type_hints

import numpy as np

from labpipe.artefacts.digest import AGAIN, DamagedError, mismatch
from labpipe.errors import shorten
from labpipe.quantities import parse_unit
from labpipe.records.settings import Settings, settings_of

# What an entry of another type than the declared one raises, here and where its record is checked at birth.
BAD_ENTRY = (LookupError, TypeError, ValueError, AttributeError, OverflowError, RecursionError, MemoryError)

LARGEST_COUNT = 1 << 63
PLAIN = frozenset((str, bool, int, float))


def entry_of(record: Any) -> Any:
    """JSON entries of a record; TypeError for a type without a JSON form."""
    if record is None or type(record) in PLAIN:
        return record
    if is_dataclass(record) and not isinstance(record, type):
        elsewhere = _contents_elsewhere(record)
        names = (name for name in _stored_fields(type(record)) if name not in elsewhere)
        return {name: entry_of(getattr(record, name)) for name in names}
    if isinstance(record, np.ndarray) and np.iscomplexobj(record):
        return {"re": record.real.tolist(), "im": record.imag.tolist()}
    if isinstance(record, np.ndarray):
        return record.tolist()
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
    return tuple(field.name for field in fields(owner) if field.metadata.get("entry", True))


def _contents_elsewhere(record: Any) -> set[str]:
    """Fields with the full path of a file that another setting names."""
    if not isinstance(record, Settings):
        return set()
    named = [setting.into for setting, _ in settings_of(type(record)).values() if setting.into]
    return {name for name in named if isinstance(getattr(record, name), Path)}


def record_of(entry: Any, kind: Any) -> Any:
    """The record of a declared type; KeyError, TypeError or ValueError for an entry of another type."""
    origin = get_origin(kind)
    if kind is Any:
        return entry
    if origin in (types.UnionType, Union):
        return None if entry is None else record_of(entry, _kind_of_value(kind, isinstance(entry, str)))
    if origin is tuple:
        return _tuple(entry, get_args(kind))
    if origin in (dict, Mapping):
        return {key: record_of(value, get_args(kind)[1]) for key, value in _need(entry, dict).items()}
    if origin is np.ndarray:
        return _array(entry, kind)
    if is_dataclass(kind):
        owner: Any = kind
        return owner(**values_of(entry, owner))
    if hasattr(origin, "__value__"):
        # The fields of a plug-in's record may be NDArray.
        return record_of(entry, origin.__value__[get_args(kind)])
    return _scalar(entry, kind)


@functools.cache
def _kind_of_value(kind: Any, is_text: bool) -> Any:
    """The type of a value that may be missing: of several text for a text, where that may be, else the
    first.
    """
    kinds = [part for part in get_args(kind) if part is not types.NoneType]
    return str if is_text and str in kinds else kinds[0]


def named_entries(record: Any, *names: str) -> dict[str, Any]:
    """JSON entries of some fields of a record."""
    return {name: entry_of(getattr(record, name)) for name in names}


def values_of(entry: Any, kind: Any) -> dict[str, Any]:
    """The values of those fields of a record that the entries give; errors as of `record_of`."""
    hints = _hints(kind)
    values: dict[str, Any] = {}
    for field in fields(kind):
        if field.name not in _need(entry, dict):
            continue
        value = entry[field.name]
        if value is None and "null" in field.metadata:
            values[field.name] = field.metadata["null"]
        else:
            values[field.name] = record_of(value, hints[field.name])
        if field.name.endswith("unit") and value and kind.__module__.startswith("labpipe."):
            # UnitError, a ValueError, for one that nobody could show; plug-ins may have units of their own.
            parse_unit(value)
    return values


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
    return np.array(entry, element if element in (np.bool_, np.intp) else np.float64)


def _scalar(entry: Any, kind: Any) -> Any:
    if kind is float:
        if isinstance(entry, bool) or not isinstance(entry, (int, float, types.NoneType)):
            raise TypeError(f"{shorten(repr(entry))} is not a number")
        if entry is not None:
            # OverflowError for an integer that is larger than any number.
            float(entry)
        return math.nan if entry is None else entry
    if kind in (str, bool, int):
        _need(entry, kind)
    if kind is int and abs(entry) >= LARGEST_COUNT:
        raise OverflowError(f"{shorten(str(entry))} is not a count")
    if kind is str:
        # UnicodeEncodeError for half a letter, which no file or terminal takes.
        entry.encode()
    return entry


def _need(entry: Any, kind: type) -> Any:
    if not isinstance(entry, kind) or (kind is int and isinstance(entry, bool)):
        raise TypeError(f"{shorten(repr(entry))} is not a {kind.__name__}")
    return entry


# A digest of the content stands on a line of its own.
DIGEST = "digest"
# Of files without a digest the second entry is a version or a list.
LONGEST_SECOND = 30
_DIGEST_LINE = re.compile(rb'^"digest": "([0-9a-f]{64})",?\n', re.MULTILINE)


def write_digested(path: Path, entries: dict[str, Any]) -> None:
    """Write the entries with the digest of the file without it as the second one."""
    texts = _texts(entries)
    digest = hashlib.sha256(_join(texts)).hexdigest()
    path.write_bytes(_join([texts[0], *_texts({DIGEST: digest}), *texts[1:]]))


def read_digested(path: Path, what: str) -> dict[str, Any]:
    """The entries of a file whose content matches its digest, or that carries none; DamagedError says that it
    is not a readable *what*.

    A file that another program wrote again with the same entries in the same order matches as well.
    """
    content = read_bytes(path)
    entries = parse(content, path, what)
    stated = entries.get(DIGEST)
    # A long text in its place under another name is a digest whose name was damaged.
    second = next(islice(entries.values(), 1, None), "")
    if stated is None and not (isinstance(second, str) and len(second) > LONGEST_SECOND):
        return entries
    if not isinstance(stated, str) or stated not in _digests(content, entries):
        raise mismatch(path)
    return entries


def _digests(content: bytes, entries: dict[str, Any]) -> Iterator[str]:
    yield hashlib.sha256(_DIGEST_LINE.sub(b"", content, count=1)).hexdigest()
    others = {key: entry for key, entry in entries.items() if key != DIGEST}
    yield hashlib.sha256(json_bytes(others)).hexdigest()


def read_bytes(path: Path) -> bytes:
    """The content of a regular file; DataError for anything else, FileNotFoundError where there is none."""
    if path.exists() and not path.is_file():
        raise DamagedError(
            "is a folder, a file is needed" if path.is_dir() else "is not a regular file", path
        )
    return path.read_bytes()


def parse(content: bytes, path: Path, what: str) -> dict[str, Any]:
    """The entries of a JSON object; DamagedError for anything else."""
    try:
        entries = json_value(content.decode("utf-8"))
    except RecursionError:
        raise DamagedError(f"is not a readable {what} (nested too deeply)", path, AGAIN) from None
    except ValueError as error:
        raise DamagedError(f"is not a readable {what} ({shorten(str(error))})", path, AGAIN) from None
    if not isinstance(entries, dict):
        raise DamagedError(f"is not a readable {what} (no JSON object)", path, AGAIN)
    return entries


# What files call by another name that versions before wrote.
NAMES_BEFORE = {"doubt": "uncertainty", "doubts": "uncertainties"}


def json_value(text: str) -> Any:
    """The value of a JSON text, its entries under the names of this version; errors of json.loads."""
    old = any(f'"{name}"' in text for name in NAMES_BEFORE)
    return json.loads(text, object_hook=_rename_entries if old else None)


def _rename_entries(entries: dict[str, Any]) -> dict[str, Any]:
    return {NAMES_BEFORE.get(name, name): entry for name, entry in entries.items()}


def json_bytes(entries: dict[str, Any]) -> bytes:
    """The entries as UTF-8, one line for each and for each item of a list; always the same bytes."""
    return _join(_texts(entries))


def _texts(entries: dict[str, Any]) -> list[str]:
    return [f"{json.dumps(key, ensure_ascii=False)}: {_lines(entry)}" for key, entry in entries.items()]


def _join(texts: list[str]) -> bytes:
    return ("{\n" + ",\n".join(texts) + "\n}\n").encode()


def _lines(entry: Any) -> str:
    if isinstance(entry, (list, tuple)) and entry:
        return "[\n" + ",\n".join(f" {_line(item)}" for item in entry) + "\n]"
    return _line(entry)


def _line(entry: Any) -> str:
    # With an indent, Python's json takes its slow way: ten times the time, a line for every number.
    try:
        return json.dumps(entry, allow_nan=False, ensure_ascii=False, default=plain)
    except ValueError:
        return json.dumps(without_nan(entry), allow_nan=False, ensure_ascii=False, default=plain)


def plain(entry: Any) -> Any:
    """The Python number of a numpy number, which JSON does not know; TypeError for anything else."""
    if isinstance(entry, np.generic):
        number = entry.item()
        return None if isinstance(number, float) and not math.isfinite(number) else number
    raise TypeError(f"a {type(entry).__name__} has no place in JSON")


def without_nan(entry: Any) -> Any:
    """The entry with None for what is not a number or infinite, which JSON does not know."""
    if isinstance(entry, dict):
        return {key: without_nan(item) for key, item in entry.items()}
    if isinstance(entry, (list, tuple)):
        return [without_nan(item) for item in entry]
    return None if isinstance(entry, float) and not math.isfinite(entry) else entry
