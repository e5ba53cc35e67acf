"""Reading the tests of a pipeline file: recordings of one FRF matrix each, and their conditions."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

from labpipe.config.faults import Faults, join
from labpipe.config.file_names import conditions_in, listed
from labpipe.config.reader import read_settings
from labpipe.config.ready_frf import ReadyFrf, read_ready_frfs
from labpipe.config.recordings import RecordingReader, SourceFile
from labpipe.errors import ConfigError
from labpipe.marked_yaml import Marked
from labpipe.records.recorded_condition import RecordedCondition
from labpipe.records.rig import Rig
from labpipe.spectra.settings import FrfSettings

SINGLE = ("recordings", "frfs", "conditions")
LISTED = ("name", *SINGLE, "frf")
EACH = ("each", "pattern", "together", "conditions", "frf")


@dataclass(frozen=True)
class Test:
    """One test: recordings that together give one FRF matrix, or ready FRFs; *conditions* as text of the file.

    recorded: further conditions, which the recordings themselves show. frf: how this test's spectra are made, where it differs from the
    pipeline's.
    """

    name: str
    recordings: tuple[SourceFile, ...] = ()
    frfs: tuple[ReadyFrf, ...] = ()
    conditions: dict[str, str] = field(default_factory=dict)
    recorded: dict[str, RecordedCondition] = field(default_factory=dict)
    frf: FrfSettings | None = None


@dataclass(frozen=True)
class EachFile:
    """What a file becomes that is a test by itself: conditions that all have, those from its name by the *pattern*, how it is measured."""

    conditions: dict[str, str] = field(default_factory=dict)
    recorded: dict[str, RecordedCondition] = field(default_factory=dict)
    frf: FrfSettings | None = None
    pattern: str = ""

    def named(self, path: Path) -> dict[str, str]:
        """The conditions that a file's name says; none where it does not match the pattern."""
        return (conditions_in(_stem(path), self.pattern) or {}) if self.pattern else {}

    def test(self, source: SourceFile, name: str = "") -> Test:
        """The test of a recording, by default named after its file; ConfigError for a name that does not match the pattern."""
        stem = _stem(source.path)
        if self.pattern and conditions_in(stem, self.pattern) is None:
            raise ConfigError(f"does not match '{stem}'", hint="for example '{preload}-{direction}'")
        return Test(name or stem, (source,), (), {**self.conditions, **self.named(source.path)}, self.recorded, self.frf)


def _stem(path: Path) -> str:
    """A file's name up to its first point."""
    return path.name.split(".")[0]


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
        """One test per file, named after it; conditions from the name by the pattern.

        Files whose names differ only in the parts named by `together` are recordings of one test.
        """
        per_file = self._each(entries, key)
        together = self._together(entries, key)
        tests: dict[tuple[tuple[str, str], ...], Test] = {}
        for source in self._recordings(entries["each"], join(key, "each")):
            try:
                test = per_file.test(source)
            except ConfigError as error:
                self.faults.add(entries["pattern"], join(key, "pattern"), error.what, error.hint)
                test = Test(source.path.name)
            conditions = {part: text for part, text in per_file.named(source.path).items() if part not in together}
            place = tuple(conditions.items()) if together else (("file", str(source.path)),)
            first = tests.get(place, replace(test, name="-".join(conditions.values()) if together else test.name, recordings=()))
            common = {name: text for name, text in test.conditions.items() if name not in together}
            tests[place] = replace(first, recordings=(*first.recordings, source), conditions=common)
        yield from tests.values()

    def _each(self, entries: dict[str, Marked], key: str) -> EachFile:
        common, recorded = self._conditions(entries, key)
        pattern = entries["pattern"].text if "pattern" in entries else ""
        return EachFile(common, recorded, self._frf(entries, key), pattern)

    def each_file(self) -> EachFile:
        """What every file to come will be, by the only entry of `tests:`, which has `each:`."""
        node = self.top.get("tests", Marked(None, "", ""))
        entries = node.content[0].content if isinstance(node.content, list) and len(node.content) == 1 else None
        if not isinstance(entries, dict) or "each" not in entries:
            self.faults.add(node, "tests", "cannot be of recordings to come", "write one entry: - {each: '*.parquet'}")
            return EachFile()
        self.faults.unknown_keys(node.content[0], "tests.1", EACH)
        if "together" in entries:
            self.faults.add(entries["together"], "tests.1.together", "recordings to come are tests of their own", "leave it out")
        return self._each(entries, "tests.1")

    def _together(self, entries: dict[str, Marked], key: str) -> list[str]:
        """The parts of the pattern that tell the recordings of one test apart."""
        if "together" not in entries:
            return []
        pattern = entries["pattern"].text if "pattern" in entries else ""
        parts = [node.text for node in listed(entries["together"])]
        for part in parts:
            if f"{{{part}}}" not in pattern:
                self.faults.add(entries["together"], join(key, "together"), f"the pattern has no part '{{{part}}}'", f"pattern: {pattern}")
        return parts

    def _test(self, name: str, node: Marked, key: str) -> Test:
        entries = node.content if isinstance(node.content, dict) else {}
        recordings = self._recordings(entries["recordings"], join(key, "recordings")) if "recordings" in entries else []
        frfs = read_ready_frfs(entries["frfs"], join(key, "frfs"), self.faults) if "frfs" in entries else []
        if not recordings and not frfs and not len(self.faults):
            self.faults.add(node if node.place else next(iter(self.top.values())), key, "neither recordings nor frfs")
        conditions, recorded = self._conditions(entries, key)
        if frfs and recorded:
            what = "a ready FRF has no channels to take conditions from"
            self.faults.add(entries["conditions"], join(key, "conditions"), what, "write the amount, e.g. load: 1 kN")
        return Test(name, tuple(recordings), tuple(frfs), conditions, recorded, self._frf(entries, key))

    def _frf(self, entries: dict[str, Marked], key: str) -> FrfSettings | None:
        """The pipeline's frf: with the entries that the test itself gives; an entry without a value takes that of the pipeline away."""
        if "frf" not in entries or key == "":
            return None
        common = self.top["frf"].content if "frf" in self.top and isinstance(self.top["frf"].content, dict) else {}
        frf_entries = self.faults.mapping(entries["frf"], join(key, "frf"))
        whole = {name: node for name, node in {**common, **frf_entries}.items() if node.content is not None}
        return read_settings(FrfSettings, Marked(whole, entries["frf"].where, entries["frf"].key_where), join(key, "frf"), self.faults)

    def _recordings(self, node: Marked, key: str) -> list[SourceFile]:
        return RecordingReader(self.rig, self.top.get("rig"), self.folder, self.faults).sources(node, key)

    def _conditions(self, entries: dict[str, Marked], key: str) -> tuple[dict[str, str], dict[str, RecordedCondition]]:
        """Conditions as they are written, and those that are recorded: {channel: NAME} or {tacho: NAME}."""
        written: dict[str, str] = {}
        recorded: dict[str, RecordedCondition] = {}
        if "conditions" not in entries:
            return written, recorded
        for name, node in self.faults.mapping(entries["conditions"], "conditions").items():
            if not isinstance(node.content, dict):
                written[name] = node.text
                continue
            source = read_settings(RecordedCondition, node, join(join(key, "conditions"), name), self.faults)
            if source is not None:
                recorded[name] = source
        return written, recorded
