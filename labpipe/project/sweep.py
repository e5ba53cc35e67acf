"""A sweep: one entry of a file over a row of values, written ``loads.z=0:2000:50`` (start, stop, step)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.errors import ConfigError
from labpipe.quantities import UnitError, is_number, parse_value
from labpipe.records.settings import Setting, settings_of
from labpipe.registry import nearest

MAX_VALUES = 20_000


@dataclass(frozen=True)
class Sweep:
    """Key of the swept entry, its values (n_value,) [SI unit]."""

    key: str
    unit: str
    values: FloatArray

    @property
    def label(self) -> str:
        return f"{self.key} [{self.unit}]"


def parse_sweep(text: str, owner: type) -> Sweep:
    """The sweep of an entry of the settings dataclass *owner*; numbers without a unit have the last one's, or
    the entry's SI unit.

    Raises ConfigError for an entry that is unknown or has no unit, unreadable numbers, and a step that does
    not lead from start to stop.
    """
    where = f"--sweep {text}"
    key, equals, span = (part.strip() for part in text.partition("="))
    parts = [part.strip() for part in span.split(":")]
    if not equals or len(parts) != 3:
        raise ConfigError(
            "not a sweep", where=where, hint="write --sweep loads.z=0:2000:50 (start, stop, step)"
        )
    unit = _setting(key, owner, where).unit
    try:
        start, stop, step = (parse_value(_with_unit(part, parts[-1], unit), unit) for part in parts)
    except UnitError as error:
        raise ConfigError(f"{key}: {error.what}", where=where, hint=error.hint) from None
    return Sweep(key, unit, _values(start, stop, step, where))


def _with_unit(part: str, last: str, unit: str) -> str:
    if not is_number(part):
        return part
    return f"{part} {unit}" if is_number(last) else f"{part} {last.lstrip('+-.0123456789eE ')}"


def _values(start: float, stop: float, step: float, where: str) -> FloatArray:
    if step == 0 or (stop - start) / step < 0.5:
        raise ConfigError("the step does not lead from start to stop", where=where)
    # A step that misses the stop ends before it; rounding must not lose the stop itself.
    number = int((stop - start) / step * (1 + 1e-12) + 1e-9) + 1
    if number > MAX_VALUES:
        raise ConfigError(f"{number} values are too many", where=where, hint=f"at most {MAX_VALUES}")
    return start + step * np.arange(number)


def _setting(key: str, owner: type, where: str) -> Setting:
    """The setting of a dotted key; ConfigError with the nearest known key."""
    sweepable = dict(_swept_keys(owner))
    if key not in sweepable:
        raise ConfigError(f"{key}: cannot be swept", where=where, hint=nearest(key, sweepable))
    return sweepable[key]


def _swept_keys(owner: type, above: str = "") -> list[tuple[str, Setting]]:
    """(dotted key, setting) of every entry that is a value with a unit."""
    keys: list[tuple[str, Setting]] = []
    for name, (setting, _) in settings_of(owner).items():
        if setting.kind == "value":
            keys.append((f"{above}{name}", setting))
        elif setting.section is not None:
            keys.extend(_swept_keys(setting.section, f"{above}{name}."))
    return keys
