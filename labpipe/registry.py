"""Choice is a visible table: name -> "module:attribute", extended by entry points, with the nearest known
name for an unknown one.
"""

from __future__ import annotations

import functools
import os
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from labpipe.errors import ConfigError

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

# Names that a message lists.
MOST_LISTED = 20


def nearest(name: str, choices: Iterable[str]) -> str:
    """The hint for an unknown name: the nearest known name, or those that there are, up to a number."""
    # Imported here, since `labpipe --help` needs none of it.
    import difflib

    names = [str(choice) for choice in choices]
    near = difflib.get_close_matches(name, names, 1, 0.6) or [k for k in names if k.lower() == name.lower()]
    return f"did you mean '{near[0]}'?" if near else f"known: {list_names(names)}"


def list_names(names: Sequence[str]) -> str:
    """Names in a message: the first MOST_LISTED, and how many more there are."""
    return few(names, MOST_LISTED) or "none"


def few(texts: Sequence[str], most: int, mark: str = ", ") -> str:
    """The first *most* of the texts, and how many more there are."""
    more = f" and {len(texts) - most} more" if len(texts) > most else ""
    return mark.join(texts[:most]) + more


# Every choice that comes with labpipe; also in the metadata of an installed labpipe.
SHIPPED = Path(__file__).with_name("entry_points.txt")


@functools.cache
def _shipped_groups() -> Mapping[str, Mapping[str, tuple[str, str]]]:
    """Group -> name -> ("module:attribute", the comment right above) of labpipe's own tables, read from their
    file: metadata of an earlier installation may lie beside it.
    """
    groups: dict[str, dict[str, tuple[str, str]]] = {}
    group = above = ""
    for line in SHIPPED.read_text(encoding="utf-8").splitlines():
        if line.startswith("["):
            group = line.strip("[]")
        elif "=" in line and not line.startswith("#"):
            name, value = (part.strip() for part in line.split("=", 1))
            groups.setdefault(group, {})[name] = (value, above)
        above = line.removeprefix("# ") if line.startswith("#") else ""
    return groups


def _may_add(place: str) -> bool:
    """Whether a package in this place of sys.path may add to a table: its list of entry points names a group
    of labpipe, or it is no plain folder.
    """
    try:
        names = os.listdir(place or ".")
    except NotADirectoryError:
        return True
    except OSError:
        return False
    for name in names:
        if name.endswith(".egg"):
            return True
        if name.endswith((".dist-info", ".egg-info")) and not name.startswith(("labpipe-", "labpipe.egg")):
            lists = Path(place, name, "entry_points.txt")
            if lists.is_file() and b"[labpipe." in lists.read_bytes():
                return True
    return False


@functools.cache
def _groups_of_others() -> Mapping[str, Mapping[str, EntryPoint]]:
    """Group -> name -> entry of other packages.

    Cached, since it looks at every installed package. importlib.metadata takes as long to be imported as all
    else that `labpipe --help` does, so it is asked only where some package may add to a table.
    """
    if not any(_may_add(place) for place in sys.path):
        return {}
    from importlib.metadata import entry_points

    every, shipped = entry_points(), _shipped_groups()
    return {
        group: {
            entry.name: entry
            for entry in every.select(group=group)
            if entry.name not in shipped.get(group, {})
        }
        for group in every.groups
        if group.startswith("labpipe.")
    }


def group_of(kind: str) -> str:
    """The entry-point group of a table: "frf-reader" -> "labpipe.frf_reader", for groups hold letters, digits
    and underscores only.
    """
    return "labpipe." + kind.replace(" ", "_").replace("-", "_")


class Registry:
    """A table of choices whose targets are imported when they are used: name -> target.

    Its entries stand in entry_points.txt, those of other packages in their own metadata, under the group
    ``group_of(kind)``.
    """

    def __init__(self, kind: str) -> None:
        self.kind = kind
        self._loaded: dict[str, Any] = {}

    @property
    def _shipped(self) -> Mapping[str, tuple[str, str]]:
        return _shipped_groups().get(group_of(self.kind), {})

    @property
    def _of_others(self) -> Mapping[str, EntryPoint]:
        return _groups_of_others().get(group_of(self.kind), {})

    def names(self) -> tuple[str, ...]:
        """All known names, the built-in ones first, in the order of their file."""
        return tuple(dict.fromkeys((*self._shipped, *self._of_others)))

    def load(self, name: str) -> Any:
        """The object of that name; ConfigError with the nearest known name for an unknown one."""
        if name in self._loaded:
            return self._loaded[name]
        if name in self._shipped:
            # Asked for thousands of times in a study; entries of others may be installed anew.
            module, attribute = self._shipped[name][0].split(":")
            return self._loaded.setdefault(name, getattr(import_module(module), attribute))
        entry = self._of_others.get(name)
        if entry is None:
            raise ConfigError(f"unknown {self.kind} '{name}'", hint=nearest(name, self.names()))
        return entry.load()

    def words(self, name: str) -> str:
        """What entry_points.txt says above an entry; empty of other packages' entries."""
        return self._shipped[name][1] if name in self._shipped else ""

    def __getitem__(self, name: str) -> Any:
        return self.load(name)

    def __iter__(self) -> Iterator[str]:
        return iter(self.names())

    def __contains__(self, name: object) -> bool:
        return name in self.names()
