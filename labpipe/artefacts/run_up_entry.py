"""Run-ups as they stand in identification.json: plain records, read back by the types that they declare."""

from __future__ import annotations

import dataclasses
import math
import types
from typing import Any, get_args, get_origin, get_type_hints

from labpipe.records.run_up_result import RunUpResult


def run_up_entry(result: RunUpResult) -> dict[str, Any]:
    return dataclasses.asdict(result)


def read_run_ups(entry: dict[str, Any]) -> RunUpResult:
    """The result of its entry; a null where a number is meant is not a number (JSON has none)."""
    found: RunUpResult = _read(entry, RunUpResult)
    return found


def _read(value: Any, kind: Any) -> Any:
    if get_origin(kind) in (types.UnionType,):
        inner = next(one for one in get_args(kind) if one is not types.NoneType)
        return None if value is None else _read(value, inner)
    if get_origin(kind) is tuple:
        return _tuple(value, get_args(kind))
    if dataclasses.is_dataclass(kind):
        hints = get_type_hints(kind)
        return kind(**{name: _read(one, hints[name]) for name, one in value.items()})  # type: ignore[operator]
    return math.nan if value is None and kind is float else value


def _tuple(value: list[Any], kinds: tuple[Any, ...]) -> tuple[Any, ...]:
    if kinds[-1] is not Ellipsis:
        return tuple(_read(one, kind) for one, kind in zip(value, kinds, strict=True))
    if kinds[0] is float:
        # Columns are long, and their numbers are what they are.
        return tuple(math.nan if one is None else one for one in value)
    return tuple(_read(one, kinds[0]) for one in value)
