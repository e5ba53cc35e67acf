"""Choice is a visible table: name -> "module:attribute", extended by entry points, with the nearest known
name for an unknown one.
"""

from __future__ import annotations

import difflib
import functools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any

from labpipe.errors import ConfigError

# Names that a message lists.
MOST_LISTED = 20


def nearest(name: str, choices: Iterable[str]) -> str:
    """The hint for an unknown name: the nearest known name, or those that there are, up to a number."""
    names = [str(choice) for choice in choices]
    near = difflib.get_close_matches(name, names, 1, 0.6) or [k for k in names if k.lower() == name.lower()]
    return f"did you mean '{near[0]}'?" if near else f"known: {listed(names)}"


def listed(names: Sequence[str]) -> str:
    """Names in a message: the first MOST_LISTED, and how many more there are."""
    more = f" and {len(names) - MOST_LISTED} more" if len(names) > MOST_LISTED else ""
    return (", ".join(names[:MOST_LISTED]) or "none") + more


# The entry points of labpipe's own methods, which are also in the metadata of an installed labpipe.
SHIPPED = Path(__file__).with_name("methods") / "entry_points.txt"


@functools.cache
def _shipped() -> Mapping[str, Mapping[str, EntryPoint]]:
    """Group -> name -> entry of labpipe's own methods, read from their file: metadata of an earlier
    installation may lie beside it.
    """
    groups: dict[str, dict[str, EntryPoint]] = {}
    group = ""
    for line in SHIPPED.read_text(encoding="utf-8").splitlines():
        if line.startswith("["):
            group = line.strip("[]")
        elif "=" in line and not line.startswith("#"):
            name, value = (part.strip() for part in line.split("=", 1))
            groups.setdefault(group, {})[name] = EntryPoint(name, value, group)
    return groups


@functools.cache
def _added(kind: str) -> Mapping[str, EntryPoint]:
    """Entries of methods and of other packages.

    Cached, since it reads the metadata of every installed package.
    """
    group = group_of(kind)
    # Our own first, in the order of their file: results hold this order, and metadata come in any.
    shipped = _shipped().get(group, {})
    return {
        **shipped,
        **{entry.name: entry for entry in entry_points(group=group) if entry.name not in shipped},
    }


def group_of(kind: str) -> str:
    """The entry-point group of a table: "frf-reader" -> "labpipe.frf_reader", for groups hold letters, digits
    and underscores only.
    """
    return "labpipe." + kind.replace(" ", "_").replace("-", "_")


class Registry:
    """A table of choices whose targets are imported when they are used: name -> target.

    Other packages add entries under the entry-point group ``group_of(kind)``.
    """

    def __init__(self, kind: str, table: Mapping[str, str]) -> None:
        self.kind = kind
        self._table = dict(table)

    def names(self) -> tuple[str, ...]:
        """All known names, the built-in ones first."""
        return (*self._table, *(name for name in _added(self.kind) if name not in self._table))

    def load(self, name: str) -> Any:
        """The object of that name; ConfigError with the nearest known name for an unknown one."""
        if name in self._table:
            module, _, attribute = self._table[name].partition(":")
            return getattr(import_module(module), attribute)
        if name in _added(self.kind):
            return _added(self.kind)[name].load()
        raise ConfigError(f"unknown {self.kind} '{name}'", hint=nearest(name, self.names()))

    def __getitem__(self, name: str) -> Any:
        return self.load(name)

    def __iter__(self) -> Iterator[str]:
        return iter(self.names())

    def __contains__(self, name: object) -> bool:
        return name in self.names()
