"""Collecting the faults of a file, so that one run names them all."""

from __future__ import annotations

from pathlib import Path

from labpipe.errors import ConfigError, ConfigErrors
from labpipe.marked_yaml import Marked
from labpipe.quantities import UnitError
from labpipe.registry import nearest


class Faults:
    """The faults of one file so far; `raise_any` ends the pass. *folder*: of the file, to which the files that it names are relative."""

    def __init__(self, folder: Path = Path()) -> None:
        self.folder = folder
        self._faults: list[ConfigError] = []

    def add(self, node: Marked, key: str, message: str, hint: str = "") -> None:
        """A fault of the entry *key* at its place in the file."""
        text = f"{key}: {message}" if key else message
        self._faults.append(ConfigError(text, where=node.place, hint=hint))

    def add_unit(self, node: Marked, key: str, error: UnitError) -> None:
        """A value that could not be read, with the hint of the unit table."""
        self.add(node, key, error.what, error.hint)

    def add_of_field(self, error: ConfigError, node: Marked, key: str) -> None:
        """A fault of the settings that a mapping holds, at the entry that the error names, else at the mapping itself."""
        entry = node.content.get(error.field) if isinstance(node.content, dict) else None
        self.add(entry or node, join(key, error.field), error.what.removeprefix(f"{error.field}: "), error.hint)

    def add_missing_file(self, node: Marked, key: str) -> None:
        """A fault for the name of a file that is not there."""
        self.add(node, key, f"no such file '{node.text}'", "paths are relative to the file that names them")

    def merge(self, error: ConfigError) -> None:
        """Add the faults of a referenced file."""
        self._faults.extend(error.faults if isinstance(error, ConfigErrors) else [error])

    def unknown_keys(self, node: Marked, key: str, allowed: tuple[str, ...]) -> None:
        """A fault for every key of the mapping that is not *allowed*, with the nearest allowed key."""
        for name, entry in node.content.items():
            if name not in allowed:
                self.add(entry, join(key, name), "unknown key", nearest(name, allowed))

    def mapping(self, node: Marked, key: str) -> dict[str, Marked]:
        """The entries of a mapping, or none and a fault when the node is something else."""
        if isinstance(node.content, dict):
            return node.content
        self.add(node, key, "a mapping of keys to values is needed")
        return {}

    def raise_any(self) -> None:
        """Raise all faults together, in the order of the file."""
        if self._faults:
            raise ConfigErrors(self._faults)

    def __len__(self) -> int:
        return len(self._faults)


def join(*keys: str) -> str:
    """The dotted key of an entry."""
    return ".".join(key for key in keys if key)
