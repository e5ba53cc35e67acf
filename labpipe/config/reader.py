"""From a YAML mapping to a settings dataclass, by its declared settings alone."""

from __future__ import annotations

from typing import Any, TypeVar

from labpipe.config.faults import Faults, join
from labpipe.config.values import READERS
from labpipe.errors import ConfigError
from labpipe.marked_yaml import Marked
from labpipe.quantities import UnitError
from labpipe.records.settings import Setting, settings_of

Owner = TypeVar("Owner")

# Stands in a new project where nobody but the user knows; see stages/scaffold.py.
DECIDE = "DECIDE"


def read_settings(owner: type[Owner], node: Marked, key: str, faults: Faults, **given: Any) -> Owner | None:
    """An instance of the settings dataclass *owner* from the mapping *node*; None and faults where it cannot be read.

    *given* are further fields that the file does not hold (a name, say), or defaults that take the place of missing entries.
    """
    before = len(faults)
    entries = faults.mapping(node, key)
    settings = settings_of(owner)
    if entries:
        faults.unknown_keys(node, key, tuple(settings))
    fields: dict[str, Any] = dict(given)
    for name, (setting, required) in settings.items():
        if name in entries:
            fields[name] = read_setting(entries[name], setting, join(key, name), faults)
        elif required and name not in given:
            faults.add(node, join(key, name), "is missing", setting.help)
    if len(faults) > before:
        return None
    try:
        return owner(**fields)
    except ConfigError as error:
        faults.add(node, key, error.what, error.hint)
        return None


def read_setting(node: Marked, setting: Setting, key: str, faults: Faults) -> Any:
    """One value of the setting's kind; None and a fault where it cannot be read or is still to be decided."""
    if node.text == DECIDE:
        faults.add(node, key, "is still to be decided", setting.help)
        return None
    if setting.kind == "section":
        assert setting.section is not None
        return read_settings(setting.section, node, key, faults)
    try:
        return READERS[setting.kind](node, setting)
    except UnitError as error:
        faults.add_unit(node, key, error)
        return None
