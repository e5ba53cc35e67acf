"""From a YAML mapping to a settings dataclass, by its declared settings alone."""

from __future__ import annotations

import dataclasses
import re
from dataclasses import MISSING
from typing import Any, TypeVar

from labpipe.config.faults import Faults, join
from labpipe.config.file_kinds import FILE_KINDS
from labpipe.config.values import read_value
from labpipe.errors import ConfigError, ConfigErrors
from labpipe.marked_yaml import Marked
from labpipe.quantities import UnitError
from labpipe.records.settings import Setting, settings_of, takes_doubt
from labpipe.records.uncertain import is_doubtful, parse_uncertain

Owner = TypeVar("Owner")

# Kinds of settings that may be given in the long form of a number with its doubt, and the entries of that form.
LONG_KINDS = ("value", "mass", "uncertain", "text")
SIZES = ("std", "limits", "expanded")
LONG_FORM = ("value", *SIZES, "shape", "k", "dof", "source")

# Placeholder of an entry that the user must fill in; see stages/scaffold.py.
DECIDE = "DECIDE"


def read_settings(owner: type[Owner], node: Marked, key: str, faults: Faults, **presets: Any) -> Owner | None:
    """An instance of the settings dataclass *owner* from the mapping *node*; None and faults where it cannot be read.

    *presets* are further fields that the file does not hold (a name, say), or defaults that take the place of missing entries.
    """
    before = len(faults)
    entries = faults.mapping(node, key)
    settings = settings_of(owner)
    if entries:
        faults.unknown_keys(node, key, tuple(settings))
    fields: dict[str, Any] = dict(presets)
    unread: set[str] = set()
    for name, (setting, required) in settings.items():
        count = len(faults)
        if name in entries:
            node_of = in_one_line(entries[name], setting)
            read = _read_doubtful if takes_doubt(owner, setting) and is_doubtful(node_of.text) else read_setting
            fields[name] = read(node_of, setting, join(key, name), faults)
            if setting.into:
                fields[setting.into] = _content(entries[name], fields[name], setting, join(key, name), faults)
        elif required and name not in presets:
            faults.add(node, join(key, name), "is missing", setting.help)
        if len(faults) > count:
            unread |= {name, setting.into}
    instance = _instance(owner, {name: value for name, value in fields.items() if name not in unread}, node, key, faults, unread)
    return instance if len(faults) == before else None


def _instance(owner: type[Owner], fields: dict[str, Any], node: Marked, key: str, faults: Faults, unread: set[str]) -> Owner | None:
    """The dataclass, its faults added to those of its fields; None without a second fault for unread entries."""
    if any(field.default is MISSING and field.name not in fields for field in dataclasses.fields(owner)):  # type: ignore[arg-type]
        return None
    try:
        return owner(**fields)
    except ConfigError as error:
        # A complaint that names what could not be read would be one of the same fault.
        if any(name and re.search(rf"\b{name}\b", f"{error.field} {error.what}") for name in unread):
            return None
        faults.add_of_field(error, node, key)
        return None


def in_one_line(node: Marked, setting: Setting) -> Marked:
    """A number in its long form {value, std | limits | expanded, shape, k, dof, source} as the text that stands for it."""
    if setting.kind not in LONG_KINDS or not isinstance(node.content, dict) or "value" not in node.content:
        return node
    parts = {name: part.text for name, part in node.content.items()}
    size = next((parts[name] for name in SIZES if name in parts), "")
    shape = parts.get("shape", "rectangular" if "limits" in parts else "")
    expanded = [f"k={parts.get('k', '2')}"] if "expanded" in parts or "k" in parts else []
    qualities = [*([shape] if shape else []), *expanded, *(f"{name}={parts[name]}" for name in ("dof", "source") if name in parts)]
    unknown = [f"{name}={parts[name]}" for name in parts if name not in LONG_FORM]
    text = f"{parts['value']} +- {size} ({', '.join([*qualities, *unknown])})" if qualities or unknown else f"{parts['value']} +- {size}"
    return Marked(text, node.where, node.key_where, text)


def _read_doubtful(node: Marked, setting: Setting, key: str, faults: Faults) -> str | None:
    """The text of a number with its doubt, which the settings take apart; None and a fault where it cannot be read."""
    try:
        parse_uncertain(node.text, setting.unit)
    except UnitError as error:
        faults.add_unit(node, key, error)
        return None
    return node.text


def read_setting(node: Marked, setting: Setting, key: str, faults: Faults) -> Any:
    """One value of the setting's kind; None and a fault where it cannot be read or is still to be decided."""
    if node.text == DECIDE:
        faults.add(node, key, "is still to be decided", setting.help)
        return None
    if setting.section is not None:
        return _sections(node, setting, key, faults)
    try:
        value = read_value(node, setting)
    except UnitError as error:
        faults.add_unit(node, key, error)
        return None
    if setting.kind == "file" and not (faults.folder / value).is_file():
        faults.add_missing_file(node, key)
        return None
    return value


def _sections(node: Marked, setting: Setting, key: str, faults: Faults) -> Any:
    """A section, sections by name (pairs), or a list of sections; None and faults where one cannot be read."""
    assert setting.section is not None
    if setting.kind == "section":
        return read_settings(setting.section, node, key, faults)
    before = len(faults)
    if setting.kind == "sections":
        named = {name: read_settings(setting.section, entry, join(key, name), faults) for name, entry in faults.mapping(node, key).items()}
        return None if len(faults) > before else tuple(named.items())
    if not isinstance(node.content, list):
        faults.add(node, key, "a list is needed", "each entry begins with '- '")
        return None
    listed = [read_settings(setting.section, entry, f"{key}.{number}", faults) for number, entry in enumerate(node.content, 1)]
    return None if len(faults) > before else tuple(listed)


def _content(node: Marked, name: str | None, setting: Setting, key: str, faults: Faults) -> Any:
    """What the named file holds; None and its faults where it cannot be read."""
    if name is None:
        return None
    try:
        return FILE_KINDS[setting.file_kind].load(faults.folder / name)
    except ConfigError as error:
        # A fault without a place of its own is reported at the entry that names the file.
        if error.where or isinstance(error, ConfigErrors):
            faults.merge(error)
        else:
            faults.add(node, key, error.what, error.hint)
        return None
