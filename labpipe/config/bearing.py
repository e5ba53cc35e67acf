"""Reading a bearing file: its kind, and the entries of that kind."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from labpipe.bearings.coefficients import BearingCoefficients
from labpipe.bearings.kinds import BEARINGS, BearingKind
from labpipe.config.faults import Faults, join
from labpipe.config.reader import read_settings
from labpipe.errors import LabpipeError
from labpipe.marked_yaml import Marked, load_marked, set_entry
from labpipe.records.file_kind import FileKind
from labpipe.registry import nearest


@dataclass(frozen=True)
class BearingFile:
    """A bearing file that is being read: its path, kind, and the tree of its entries."""

    path: Path
    kind_name: str
    kind: BearingKind
    tree: Marked

    def settings(self) -> Any:
        """The settings as the file has them now; ConfigErrors with every fault at its place."""
        faults = Faults(self.path.parent)
        settings = read_settings(self.kind.settings, self.tree, "", faults)
        faults.raise_any()
        return settings

    def coefficients(self, settings: list[Any]) -> list[BearingCoefficients]:
        """The coefficients of every settings; errors say which file."""
        try:
            return self.kind.coefficients(settings)
        except LabpipeError as error:
            error.where = error.where or str(self.path)
            raise


def open_bearing(path: Path, overrides: Iterable[str] = ()) -> BearingFile:
    """The bearing file with its kind known; ConfigError where the file or its kind cannot be read."""
    tree = load_marked(path)
    for assignment in overrides:
        set_entry(tree, assignment)
    faults = Faults(path.parent)
    kind = kind_of(tree, "", faults)
    faults.raise_any()
    assert kind is not None
    return BearingFile(path, tree.content["kind"].text, kind, tree)


def kind_of(tree: Marked, key: str, faults: Faults) -> BearingKind | None:
    """The kind that the entry `kind` of a bearing names; None and a fault where there is none of that name."""
    entries = faults.mapping(tree, key)
    if "kind" not in entries:
        faults.add(tree, join(key, "kind"), "is missing", f"known: {', '.join(BEARINGS.names())}")
        return None
    name = entries["kind"].text
    if name not in BEARINGS.names():
        faults.add(entries["kind"], join(key, "kind"), f"unknown bearing '{name}'", nearest(name, BEARINGS.names()))
        return None
    kind: BearingKind = BEARINGS.load(name)
    for entry, unit in kind.bare_units.items():
        if entry in entries and isinstance(entries[entry].content, (int, float)):
            entries[entry].text += f" {unit}"
    return kind


BEARING_FILE = FileKind(open_bearing)
