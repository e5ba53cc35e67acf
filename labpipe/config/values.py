"""From a YAML node to what the converters of settings take: texts with their units, whole numbers, flags, lists, mappings."""

from __future__ import annotations

from typing import Any

from labpipe.marked_yaml import Marked
from labpipe.quantities import UnitError
from labpipe.records.setting_values import CONVERTERS, Setting

# Kinds whose scalars are read as YAML has them; of all others the text counts, so that a number without its unit is seen.
BY_CONTENT = ("integer", "flag")


def read_value(node: Marked, setting: Setting) -> Any:
    """The value of a node; UnitError where it is not of the setting's kind."""
    if setting.kind in ("text", "file") and isinstance(node.content, (str, int, float)) and not node.text:
        raise UnitError("a text is missing")
    return CONVERTERS[setting.kind](_plain(node, setting.kind in BY_CONTENT), setting)


def _plain(node: Marked, by_content: bool) -> Any:
    if isinstance(node.content, dict):
        return {name: _plain(entry, by_content) for name, entry in node.content.items()}
    if isinstance(node.content, list):
        return [_plain(entry, by_content) for entry in node.content]
    return node.content if by_content or node.content is None else node.text
