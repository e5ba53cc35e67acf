"""Reading a bearing file: its kind, and the entries of that kind."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.bearings.kinds import BEARINGS, BearingCoefficients, BearingKind
from labpipe.errors import ConfigError, locate_errors
from labpipe.project.marked_yaml import Marked, load_marked, set_entry
from labpipe.project.settings_reader import Faults, join, read_kind, read_settings, shorten_number
from labpipe.quantities import is_number, locate_units, parse_value
from labpipe.records.settings import FileKind, Setting, settings_of
from labpipe.records.uncertain import Uncertain, is_uncertain, parse_uncertain, split_uncertainty
from labpipe.registry import nearest


@dataclass(frozen=True)
class BearingFile:
    """A bearing file as it is read: the tree of its entries, and *uncertainties* of its numbers by key."""

    path: Path
    kind_name: str
    kind: BearingKind
    tree: Marked
    uncertainties: Mapping[str, Uncertain] = field(default_factory=dict)

    def settings(self) -> Any:
        """The settings as the file has them now; ConfigErrors with every fault at its place."""
        faults = Faults(self.path.parent)
        settings = read_settings(self.kind.settings, self.tree, "", faults)
        faults.raise_any()
        return settings

    def settings_at(self, entries: Sequence[str], conditions: Sequence[tuple[float, str]]) -> Any:
        for entry, (value, unit) in zip(entries, conditions, strict=True):
            set_entry(self.tree, f"{entry}={value!r} {unit}")
        return self.settings()

    def ends(self, key: str) -> list[Any]:
        """The settings with the number of a key one standard uncertainty above its value, and below it."""
        number, unit = self.uncertainties[key], setting_at(self.kind.settings, key).unit
        ends = []
        for sign in (1.0, -1.0, 0.0):
            set_entry(self.tree, f"{key}={number.value + sign * number.std_error!r} {unit}".rstrip())
            if sign:
                ends.append(self.settings())
        return ends

    def coefficients(self, settings: list[Any]) -> list[BearingCoefficients]:
        """The coefficients of every settings; errors say which file."""
        with locate_errors(self.path):
            return self.kind.coefficients(settings)


def open_bearing(path: Path, overrides: Iterable[str] = ()) -> BearingFile:
    """The bearing file with its kind known; ConfigError where the file or its kind cannot be read."""
    tree = load_marked(path, overrides)
    faults = Faults(path.parent)
    kind = kind_of(tree, "", faults)
    faults.raise_any()
    assert kind is not None
    uncertainties = pop_uncertainties(tree, kind, "", kind.settings, faults)
    faults.raise_any()
    return BearingFile(path, tree.content["kind"].text, kind, tree, uncertainties)


def setting_at(owner: type, key: str) -> Setting:
    """The declared setting of a key such as loads.z; KeyError where there is none."""
    first, _, rest = key.partition(".")
    declared = settings_of(owner)[first][0]
    return declared if not rest or declared.section is None else setting_at(declared.section, rest)


def pop_uncertainties(
    node: Marked, kind: BearingKind, key: str, owner: type, faults: Faults
) -> dict[str, Uncertain]:
    """The uncertain numbers of a mapping by their keys; in the tree their values then stand alone."""
    uncertainties: dict[str, Uncertain] = {}
    if not isinstance(node.content, dict):
        return uncertainties
    for name, (declared, _) in settings_of(owner).items():
        entry = node.content.get(name)
        if entry is None:
            continue
        if declared.section is not None:
            uncertainties |= pop_uncertainties(entry, kind, join(key, name), declared.section, faults)
            continue
        entry = shorten_number(entry, declared.kind)
        if declared.kind != "value" or not is_uncertain(entry.text):
            continue
        value, uncertainty = split_uncertainty(entry.text)
        if name in kind.bare_units and is_number(value):
            value = f"{value} {kind.bare_units[name]}"
        with faults.of_unit(entry, join(key, name)):
            uncertainties[join(key, name)] = parse_uncertain(f"{value} +- {uncertainty}", declared.unit)
        node.content[name] = replace(entry, content=value, text=value)
    return uncertainties


def kind_of(tree: Marked, key: str, faults: Faults) -> BearingKind | None:
    """The kind that the entry `kind` of a bearing names. None and a fault for an unknown one."""
    entries = faults.mapping(tree, key)
    kind: BearingKind | None = read_kind(tree, key, BEARINGS, "bearing", faults)
    for entry, unit in kind.bare_units.items() if kind else ():
        if entry in entries and isinstance(entries[entry].content, (int, float)):
            entries[entry].text += f" {unit}"
    return kind


BEARING_FILE = FileKind(open_bearing)


MAX_VALUES = 20_000


@dataclass(frozen=True)
class BearingSweep:
    """Key of the swept entry, its values (n_value,) [SI unit]."""

    key: str
    unit: str
    values: FloatArray

    @property
    def label(self) -> str:
        return f"{self.key} [{self.unit}]"


def parse_sweep(text: str, owner: type) -> BearingSweep:
    """The sweep of an entry of the settings dataclass *owner*; numbers without a unit have the last one's, or
    the SI unit. ConfigError for an entry that cannot be swept, unreadable numbers, and a step that does not
    lead from start to stop.
    """
    where = f"--sweep {text}"
    key, equals, span = (part.strip() for part in text.partition("="))
    parts = [part.strip() for part in span.split(":")]
    if not equals or len(parts) != 3:
        raise ConfigError("not a sweep", where, "write --sweep loads.z=0:2000:50 (start, stop, step)")
    sweepable = dict(_swept_keys(owner))
    if key not in sweepable:
        raise ConfigError(f"{key}: cannot be swept", where, nearest(key, sweepable))
    unit = sweepable[key].unit
    unit_of_last = unit if is_number(parts[-1]) else parts[-1].lstrip("+-.0123456789eE ")
    texts = [f"{part} {unit_of_last}" if is_number(part) else part for part in parts]
    with locate_units(where, before=f"{key}: "):
        start, stop, step = (parse_value(text, unit) for text in texts)
        # A step is a difference: 10 degC are 10 K.
        step -= parse_value(f"0 {unit_of_last}", unit)
    if step == 0 or (stop - start) / step < 0.5:
        raise ConfigError("the step does not lead from start to stop", where)
    # A step that misses the stop ends before it; rounding must not lose the stop itself.
    number = int((stop - start) / step * (1 + 1e-12) + 1e-9) + 1
    if number > MAX_VALUES:
        raise ConfigError(f"{number} values are too many", where, f"at most {MAX_VALUES}")
    return BearingSweep(key, unit, start + step * np.arange(number))


def _swept_keys(owner: type, above: str = "") -> list[tuple[str, Setting]]:
    keys: list[tuple[str, Setting]] = []
    for name, (setting, _) in settings_of(owner).items():
        if setting.kind == "value":
            keys.append((f"{above}{name}", setting))
        elif setting.section is not None:
            keys.extend(_swept_keys(setting.section, f"{above}{name}."))
    return keys
