"""Reading the entries under ``recordings:``: files, the rig that recorded each, and dofs that the names of the files say."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from labpipe.config.faults import Faults, join
from labpipe.config.file_names import conditions_in, files_of, listed, plain_stem
from labpipe.config.rig import load_rig, moved, override_channels
from labpipe.errors import ConfigError
from labpipe.marked_yaml import Marked
from labpipe.places.address import is_remote
from labpipe.records.rig import Rig

KEYS = ("file", "each", "join", "by", "pattern", "rig", "channels")
BY = ("time", "sample")


@dataclass(frozen=True)
class SourceFile:
    """One recorded file and the rig that recorded it.

    *path* may be the URL of an object storage. *joined*: further files with channels of the same run, *by*: joined on time or by sample, by
    default on time where all have it.
    """

    path: Path
    rig: Rig
    joined: tuple[Path, ...] = ()
    by: str = ""

    def absolute(self) -> SourceFile:
        """The same for a process that works in another folder."""
        return self.at({path: path.absolute() for path in (self.path, *self.joined) if not is_remote(path)})

    def at(self, places: Mapping[Path, Path]) -> SourceFile:
        """The same, of files that lie at other places."""
        return replace(self, path=places.get(self.path, self.path), joined=tuple(places.get(path, path) for path in self.joined))


def read_rig(node: Marked | None, folder: Path, faults: Faults, key: str) -> Rig | None:
    """The rig of a rig file that an entry names; None and a fault when it cannot be read."""
    if node is None:
        return None
    try:
        return load_rig(folder / node.text)
    except ConfigError as error:
        if error.what == "no such file":
            faults.add(node, key, f"no such file '{node.text}'", "paths are relative to the pipeline file")
        else:
            faults.merge(error)
    return None


@dataclass(frozen=True)
class RecordingReader:
    """Reads the entries of recordings: *rig* is the rig that the pipeline names for all of them in *rig_node*."""

    rig: Rig | None
    rig_node: Marked | None
    folder: Path
    faults: Faults

    def sources(self, node: Marked, key: str) -> list[SourceFile]:
        """The recorded files of an entry or a list of entries; faults for those that cannot be read."""
        sources: list[SourceFile] = []
        for entry in listed(node):
            if isinstance(entry.content, dict):
                sources.extend(self._described(entry, key))
                continue
            if self.rig is None and self.rig_node is None:
                self.faults.add(node, key, "no rig file is named", "add rig: FILE")
            paths = files_of(entry, key, self.faults, elsewhere=True)
            sources.extend(SourceFile(path, self.rig) for path in paths if self.rig is not None)
        return sources

    def _described(self, entry: Marked, key: str) -> list[SourceFile]:
        self.faults.unknown_keys(entry, key, KEYS)
        named = [word for word in ("file", "each", "join") if word in entry.content]
        if len(named) > 1:
            self.faults.add(entry.content[named[1]], join(key, named[1]), f"'{named[0]}' and '{named[1]}' are both named", "leave one out")
        file = entry.content[named[0]] if named else Marked(None, entry.where)
        rig = self._rig(entry, key)
        paths = [path for item in listed(file) for path in files_of(item, key, self.faults, elsewhere=True)]
        if rig is None or not paths:
            return []
        if named == ["join"]:
            return [SourceFile(paths[0], self._moved(rig, paths[0], entry, key), tuple(paths[1:]), self._by(entry, key))]
        if "by" in entry.content:
            self.faults.add(entry.content["by"], join(key, "by"), "belongs to files that are joined", "write join: [a.csv, b.csv]")
        sources = []
        before = len(self.faults)
        for path in paths:
            sources.append(SourceFile(path, self._moved(rig, path, entry, key)))
            if len(self.faults) > before:
                # The other files would say the same.
                break
        return sources

    def _by(self, entry: Marked, key: str) -> str:
        node = entry.content.get("by")
        if node is not None and node.text not in BY:
            self.faults.add(node, join(key, "by"), f"unknown '{node.text}'", f"known: {', '.join(BY)}")
        return node.text if node is not None else ""

    def _moved(self, rig: Rig, path: Path, entry: Marked, key: str) -> Rig:
        """The rig with the dofs that the file's name says."""
        node = entry.content.get("pattern")
        if node is None:
            return rig
        dofs = conditions_in(plain_stem(path), node.text)
        if dofs is None:
            self.faults.add(node, join(key, "pattern"), f"does not match '{plain_stem(path)}'", "for example '{}_{output}_{input}'")
            return rig
        try:
            return moved(rig, dofs)
        except ConfigError as error:
            self.faults.add(node, join(key, "pattern"), error.what, error.hint)
            return rig

    def _rig(self, entry: Marked, key: str) -> Rig | None:
        """The rig of one recording: its rig file, with the recording's channel entries."""
        rig_node = entry.content.get("rig", self.rig_node)
        if rig_node is None:
            self.faults.add(entry, key, "no rig file is named", "add rig: FILE")
            return None
        if "channels" not in entry.content:
            return self.rig if "rig" not in entry.content else read_rig(rig_node, self.folder, self.faults, join(key, "rig"))
        try:
            return override_channels(self.folder / rig_node.text, entry.content["channels"], self.faults, join(key, "channels"))
        except ConfigError as error:
            self.faults.merge(error)
            return None
