"""Reading the tests of a pipeline file: recordings of one FRF matrix each, and their conditions."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from labpipe.config.faults import Faults, join
from labpipe.config.file_names import conditions_in, files_of, listed
from labpipe.config.ready_frf import ReadyFrf, read_ready_frfs
from labpipe.config.rig import load_rig, override_channels
from labpipe.errors import ConfigError
from labpipe.marked_yaml import Marked
from labpipe.records.rig import Rig

SINGLE = ("recordings", "frfs", "conditions")
LISTED = ("name", *SINGLE)
EACH = ("each", "pattern", "conditions")


@dataclass(frozen=True)
class SourceFile:
    """One recorded file and the rig that recorded it."""

    path: Path
    rig: Rig


@dataclass(frozen=True)
class Test:
    """One test: recordings that together give one FRF matrix, or ready FRFs; *conditions* as text of the file."""

    name: str
    recordings: tuple[SourceFile, ...] = ()
    frfs: tuple[ReadyFrf, ...] = ()
    conditions: dict[str, str] = field(default_factory=dict)


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
class TestReader:
    """Reads the tests of one pipeline file: *top* are its entries, *rig* the rig that it names for all recordings."""

    top: dict[str, Marked]
    folder: Path
    rig: Rig | None
    faults: Faults

    def tests(self) -> tuple[Test, ...]:
        """All tests in their order; the recordings of a file without `tests:` are one test without a name."""
        if "tests" not in self.top:
            single = {key: self.top[key] for key in SINGLE if key in self.top}
            return (self._test("", Marked(single, "", ""), ""),) if single else ()
        node = self.top["tests"]
        if not isinstance(node.content, list):
            self.faults.add(node, "tests", "a list of tests is needed", "each begins with '- name: ...'")
            return ()
        tests: dict[str, Test] = {}
        for number, entry in enumerate(node.content, 1):
            for test in self._entry(entry, number):
                if test.name in tests:
                    self.faults.add(entry, f"tests.{number}", f"a second test named '{test.name}'")
                tests[test.name] = test
        return tuple(tests.values())

    def _entry(self, node: Marked, number: int) -> Iterator[Test]:
        """The test of an entry, or one test per file of an entry with `each:`."""
        key = f"tests.{number}"
        entries = self.faults.mapping(node, key)
        if entries:
            self.faults.unknown_keys(node, key, EACH if "each" in entries else LISTED)
        if "each" in entries:
            yield from self._tests_per_file(entries, key)
        else:
            name = entries["name"].text if "name" in entries and entries["name"].text else str(number)
            yield self._test(name, node, key)

    def _tests_per_file(self, entries: dict[str, Marked], key: str) -> Iterator[Test]:
        """One test per file, named after it; conditions from the name by the pattern."""
        common = self._conditions(entries)
        for source in self._source_files(entries["each"], join(key, "each")):
            name = source.path.name.split(".")[0]
            conditions = conditions_in(name, entries["pattern"].text) if "pattern" in entries else {}
            if conditions is None:
                self.faults.add(entries["pattern"], join(key, "pattern"), f"does not match '{name}'", "for example '{preload}-{direction}'")
            yield Test(name, (source,), (), {**common, **(conditions or {})})

    def _test(self, name: str, node: Marked, key: str) -> Test:
        entries = node.content if isinstance(node.content, dict) else {}
        recordings = self._source_files(entries["recordings"], join(key, "recordings")) if "recordings" in entries else []
        frfs = read_ready_frfs(entries["frfs"], join(key, "frfs"), self.faults) if "frfs" in entries else []
        if not recordings and not frfs and not len(self.faults):
            self.faults.add(node if node.place else self.top["title"], key, "neither recordings nor frfs")
        return Test(name, tuple(recordings), tuple(frfs), self._conditions(entries))

    def _conditions(self, entries: dict[str, Marked]) -> dict[str, str]:
        if "conditions" not in entries:
            return {}
        return {key: node.text for key, node in self.faults.mapping(entries["conditions"], "conditions").items()}

    def _source_files(self, node: Marked, key: str) -> list[SourceFile]:
        sources: list[SourceFile] = []
        for entry in listed(node):
            rig, file = self.rig, entry
            if isinstance(entry.content, dict):
                self.faults.unknown_keys(entry, key, ("file", "rig", "channels"))
                file = entry.content.get("file", Marked(None, entry.where))
                rig = self._recording_rig(entry, key)
            elif rig is None and "rig" not in self.top:
                self.faults.add(node, key, "no rig file is named", "add rig: FILE")
            paths = files_of(file, key, self.faults)
            sources.extend(SourceFile(path, rig) for path in paths if rig is not None)
        return sources

    def _recording_rig(self, entry: Marked, key: str) -> Rig | None:
        """The rig of one recording: its rig file, with the recording's channel entries."""
        rig_node = entry.content.get("rig", self.top.get("rig"))
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
