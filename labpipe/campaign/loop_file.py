"""Unknowns of a magnetic-bearing file by name: their values in the file, and the file with other values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from labpipe.bearings.controller_blocks import ControllerBlock
from labpipe.bearings.magnetic_circuit import Magnet
from labpipe.bearings.magnetic_kind import MagneticFile
from labpipe.bearings.magnetic_loop import ControlLoop
from labpipe.errors import ConfigError
from labpipe.records.settings import settings_of
from labpipe.registry import nearest

ALIASES = {"gain": "amplifier"}
FACTORS = ("force_per_current", "negative_stiffness")
_LOOP = {name: entry.unit for name, (entry, _) in settings_of(ControlLoop).items() if entry.kind == "value"}
_MAGNET = {name: entry.unit for name, (entry, _) in settings_of(Magnet).items() if entry.kind == "value"}


# An entry of the controller's blocks, "controller.2.frequency"; they count from 1.
BLOCK = "controller."
_BLOCK_ENTRIES = {name: entry.unit for name, (entry, _) in settings_of(ControllerBlock).items() if entry.kind == "value"}


@dataclass(frozen=True)
class Unknown:
    """An entry of the file to be fitted: its *name* as written, *value* in the file and *unit* [SI]."""

    name: str
    value: float
    unit: str


def unknown(file: MagneticFile, name: str) -> Unknown:
    """The unknown of that name; ConfigError where the file has no such entry, or zero as a start value."""
    field = ALIASES.get(name, name)
    value_and_unit: tuple[float | None, str] | None
    if field.startswith(BLOCK):
        value_and_unit = _block_entry(file, name)
    elif field == "static_stiffness":
        value_and_unit = None if file.static_stiffness is None else (file.static_stiffness, "N/m")
    elif field in FACTORS:
        plant = file.levitated()
        value_and_unit = (plant.loop.force_per_current, "N/A") if field == "force_per_current" else (plant.negative_stiffness, "N/m")
    elif field in _LOOP:
        value_and_unit = (getattr(file.loop, field), _LOOP[field])
    elif field in _MAGNET:
        value_and_unit = None if file.magnet is None else (getattr(file.magnet, field), _MAGNET[field])
    else:
        entries = list(dict.fromkeys([*ALIASES, *FACTORS, *_LOOP, *_MAGNET]))
        raise ConfigError(f"estimate: '{name}' is no unknown of a magnetic bearing", hint=nearest(name, entries))
    if value_and_unit is None or value_and_unit[0] is None:
        where = "static_stiffness" if field == "static_stiffness" else f"magnet: {{{field}: ...}}" if field in _MAGNET else f"loop.{field}"
        raise ConfigError(f"estimate: the bearing file has no '{name}'", hint=f"give it as {where}")
    if value_and_unit[0] == 0:
        raise ConfigError(f"estimate: '{name}' is zero in the bearing file", hint="a value near the expected one is needed to start from")
    return Unknown(name, float(value_and_unit[0]), value_and_unit[1])


def _block_entry(file: MagneticFile, name: str) -> tuple[float | None, str]:
    """Value and unit of an entry of a block; ConfigError where there is no such block or entry."""
    place, _, entry = name.removeprefix(BLOCK).partition(".")
    count = len(file.loop.controller)
    if not place.isdigit() or not 1 <= int(place) <= count:
        hint = f"controller.1 to controller.{count}" if count else ""
        raise ConfigError(f"estimate: '{name}' names no block of the controller", hint=hint)
    if entry not in _BLOCK_ENTRIES:
        raise ConfigError(f"estimate: '{name}' is no number of a block", hint=nearest(entry, list(_BLOCK_ENTRIES)))
    return getattr(file.loop.controller[int(place) - 1], entry), _BLOCK_ENTRIES[entry]


def _with_block(blocks: tuple[ControllerBlock, ...], name: str, value: float) -> tuple[ControllerBlock, ...]:
    place, _, entry = name.removeprefix(BLOCK).partition(".")
    number = int(place) - 1
    return (*blocks[:number], replace(blocks[number], **{entry: value}), *blocks[number + 1 :])  # type: ignore[arg-type]


def with_unknowns(file: MagneticFile, values: Mapping[str, float]) -> MagneticFile:
    """The file with other values of its unknowns; ConfigError for impossible values (a negative gap)."""
    loop: dict[str, Any] = {}
    magnet: dict[str, float] = {}
    factors: dict[str, float] = {}
    for name, value in values.items():
        field = ALIASES.get(name, name)
        if field.startswith(BLOCK):
            loop["controller"] = _with_block(loop.get("controller", file.loop.controller), name, value)
        elif field in (*FACTORS, "static_stiffness"):
            factors[field] = value
        elif field in _LOOP:
            loop[field] = value
        else:
            magnet[field] = value
    # An explicit negative stiffness replaces the one inferred from the static stiffness.
    freed = {"static_stiffness": None} if "negative_stiffness" in factors else {}
    changed = replace(file, loop=replace(file.loop, **loop), **freed, **factors)  # type: ignore[arg-type]
    return replace(changed, magnet=replace(file.magnet, **magnet)) if magnet and file.magnet is not None else changed  # type: ignore[arg-type]
