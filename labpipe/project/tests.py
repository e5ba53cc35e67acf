"""Reading the tests of a pipeline file: recordings of one FRF matrix each, ready FRFs, and conditions."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

from labpipe.errors import ConfigError
from labpipe.project.ingest import SourceFile, is_recording
from labpipe.project.marked_yaml import Marked, text_of
from labpipe.project.rig_file import load_rig, move, override_channels
from labpipe.project.settings_reader import (
    Faults,
    conditions_in,
    files_of,
    has_file,
    join,
    list_entries,
    plain_stem,
    read_settings,
)
from labpipe.records.frf_layout import FrfLayout
from labpipe.records.rig import RecordedCondition, Rig, Span
from labpipe.records.settings import settings_of
from labpipe.spectra.settings import KEYS as KEYS_OF_EXCITATION, FrfSettings


@dataclass(frozen=True)
class ReadyFrf:
    """Files of one ready FRF matrix: one file, or one for each element, row or column. *layout* describes
    files that do not describe themselves; *outputs*, *inputs*: the dofs of every file.
    """

    paths: tuple[Path, ...]
    layout: FrfLayout | None = None
    outputs: tuple[tuple[str, ...], ...] = ()
    inputs: tuple[tuple[str, ...], ...] = ()

    @property
    def name(self) -> str:
        """What the names of the files have in common."""
        stems = [path.stem for path in self.paths]
        common = next(
            (n for n, letters in enumerate(zip(*stems, strict=False)) if len(set(letters)) > 1),
            min(map(len, stems)),
        )
        return stems[0][:common].strip("-_ .") or stems[0]

    def absolute(self) -> ReadyFrf:
        return replace(self, paths=tuple(path.absolute() for path in self.paths))


def read_ready_frfs(node: Marked, key: str, faults: Faults) -> list[ReadyFrf]:
    """The responses of the entry *key*: a file, a description, or a list; faults for unreadable ones."""
    frfs: list[ReadyFrf] = []
    for entry in list_entries(node):
        if isinstance(entry.content, dict):
            frfs.extend(_describe(entry, key, faults))
        else:
            frfs.extend(ReadyFrf((path,)) for path in files_of(entry, key, faults))
    return frfs


def _all_files(node: Marked, key: str, faults: Faults, *, elsewhere: bool = False) -> list[Path]:
    items = list_entries(node)
    return [p for item in items for p in files_of(item, key, faults, elsewhere=elsewhere)]


def _describe(node: Marked, key: str, faults: Faults) -> list[ReadyFrf]:
    layout = read_settings(FrfLayout, node, key, faults)
    if layout is None:
        return []
    word = "file" if layout.file else "each"
    named = _all_files(node.content[word], join(key, word), faults)
    frfs = []
    for paths in filter(None, [(path,) for path in named] if layout.file else [tuple(named)]):
        before = len(faults)
        # Files of one pattern do not match it alike; the first says so.
        dofs = [_dofs(path, layout, node, key, faults) for path in paths if len(faults) == before]
        outputs, inputs = zip(*dofs, strict=True)
        if layout.table is not None:
            for word, names in (("output", outputs[0]), ("input", inputs[0])):
                _check_dofs(word, names, layout, node, key, faults)
        frfs.append(ReadyFrf(paths, layout, outputs, inputs))
    return frfs


def _dofs(
    path: Path, layout: FrfLayout, node: Marked, key: str, faults: Faults
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    stem = plain_stem(path)
    named = conditions_in(stem, layout.pattern) if layout.pattern else {}
    if named is None or not set(named) <= {"output", "input"}:
        what = f"does not match '{stem}'" if named is None else "holds more than {output} and {input}"
        hint = "for example 'H_{output}_{input}'; {} stands for any other part"
        faults.add_at(node.content, key, "pattern", what, hint)
        named = {"output": "?", "input": "?"}
    outputs = (named["output"],) if "output" in named else layout.output
    inputs = (named["input"],) if "input" in named else layout.input
    return outputs, inputs


def _check_dofs(
    word: str, names: tuple[str, ...], layout: FrfLayout, node: Marked, key: str, faults: Faults
) -> None:
    assert layout.table is not None
    # An element named o/i has both dofs, one named o has its input from the entry.
    has_all = bool(layout.elements) and (word == "output" or all("/" in name for name, _ in layout.elements))
    if not names and not has_all:
        hint = f"name the dof, or its place in the files' names by pattern: '{{{word}}}'"
        faults.add(node, join(key, word), "is missing", hint)
    elif len(names) > 1 and not layout.table.matrix:
        hint = "several are the rows or columns of a matrix"
        faults.add_at(node.content, key, word, "one dof is needed", hint)


KEYS = ("file", "each", "join", "by", "pattern", "rig", "channels", *settings_of(Span))
BY = ("time", "sample")


def read_rig(node: Marked | None, faults: Faults, key: str) -> Rig | None:
    """The rig of a rig file that an entry names; None and a fault when it cannot be read."""
    if node is None or not has_file(node, key, faults):
        return None
    try:
        return load_rig(faults.folder / node.text)
    except ConfigError as error:
        if error.what == "no such file":
            faults.add_missing_file(node, key)
        else:
            faults.merge(error)
    return None


@dataclass(frozen=True)
class RecordingReader:
    """Reads entries of recordings; *rig*: the one that the pipeline names for all in *rig_node*."""

    rig: Rig | None
    rig_node: Marked | None
    faults: Faults

    def sources(self, node: Marked, key: str) -> list[SourceFile]:
        sources: list[SourceFile] = []
        seen: dict[tuple[Path, ...], SourceFile] = {}
        for entry in list_entries(node):
            for source in self._of_entry(entry, node, key):
                if seen.get(source.paths) == source:
                    what = f"'{source.path.name}' is named twice"
                    self.faults.add(entry, key, what, "a recording counts once")
                seen[source.paths] = source
                sources.append(source)
        return sources

    def _of_entry(self, entry: Marked, node: Marked, key: str) -> list[SourceFile]:
        if isinstance(entry.content, dict):
            return self._describe(entry, key)
        if self.rig is None and self.rig_node is None:
            self.faults.add(node, key, "no rig file is named", "add rig: FILE")
        paths = files_of(entry, key, self.faults, elsewhere=True)
        return [SourceFile(path, self.rig) for path in paths if self.rig is not None]

    def _describe(self, entry: Marked, key: str) -> list[SourceFile]:
        self.faults.unknown_keys(entry, key, KEYS)
        named = [word for word in ("file", "each", "join") if word in entry.content]
        if len(named) > 1:
            what = f"'{named[0]}' and '{named[1]}' are both named"
            self.faults.add_at(entry.content, key, named[1], what, "leave one out")
        file = entry.content[named[0]] if named else Marked(None, entry.where)
        rig, span = self._rig(entry, key), self._span(entry, key)
        paths = _all_files(file, key, self.faults, elsewhere=True)
        if rig is None or span is None or not paths:
            return []
        if named == ["join"]:
            moved = self._move(rig, paths[0], entry, key)
            return [SourceFile(paths[0], moved, tuple(paths[1:]), self._by(entry, key), span)]
        if "by" in entry.content:
            what, hint = "belongs to files that are joined", "write join: [a.csv, b.csv]"
            self.faults.add_at(entry.content, key, "by", what, hint)
        changing = ("channels", "pattern", *settings_of(Span))
        changed = next((word for word in changing if word in entry.content), "")
        sources: list[SourceFile] = []
        before = len(self.faults)
        for path in paths:
            if changed and is_recording(path):
                what = f"'{path.name}' is calibrated and stays as it is"
                self.faults.add_at(entry.content, key, changed, what, "name the raw file, or leave it out")
            sources.append(SourceFile(path, self._move(rig, path, entry, key), span=span))
            if len(self.faults) > before:
                # The other files would say the same.
                break
        return sources

    def _span(self, entry: Marked, key: str) -> Span | None:
        stated = {word: node for word, node in entry.content.items() if word in settings_of(Span)}
        return read_settings(Span, replace(entry, content=stated), key, self.faults)

    def _by(self, entry: Marked, key: str) -> str:
        by = text_of(entry.content, "by")
        if "by" in entry.content and by not in BY:
            self.faults.add_at(entry.content, key, "by", f"unknown '{by}'", f"known: {', '.join(BY)}")
        return by

    def _move(self, rig: Rig, path: Path, entry: Marked, key: str) -> Rig:
        node = entry.content.get("pattern")
        if node is None:
            return rig
        stem = plain_stem(path)
        dofs = conditions_in(stem, node.text)
        try:
            if dofs is None:
                raise ConfigError(f"does not match '{stem}'", hint="for example '{}_{output}_{input}'")
            return move(rig, dofs)
        except ConfigError as error:
            self.faults.add_at(entry.content, key, "pattern", error.what, error.hint)
            return rig

    def _rig(self, entry: Marked, key: str) -> Rig | None:
        rig_node = entry.content.get("rig", self.rig_node)
        if rig_node is None:
            self.faults.add(entry, key, "no rig file is named", "add rig: FILE")
            return None
        if "channels" not in entry.content:
            if "rig" not in entry.content:
                return self.rig
            return read_rig(rig_node, self.faults, join(key, "rig"))
        if not has_file(rig_node, join(key, "rig"), self.faults):
            return None
        try:
            path, channels = self.faults.folder / rig_node.text, entry.content["channels"]
            return override_channels(path, channels, self.faults, join(key, "channels"))
        except ConfigError as error:
            self.faults.merge(error)
            return None


SINGLE = ("recordings", "frfs", "conditions")
LISTED = ("name", *SINGLE, "frf", "repeats")
EACH = ("each", "pattern", "together", "conditions", "frf", "repeats")
REPEATS = ("each", "pool")


@dataclass(frozen=True)
class Test:
    """One test: recordings that together give one FRF matrix, or ready FRFs; *conditions* as text of the
    file. recorded: those that the recordings show. frf: how its spectra are made, where that differs.
    repeats: what fits make of several recordings, `each` or `pool`; empty where the fits say it.
    """

    name: str
    recordings: tuple[SourceFile, ...] = ()
    frfs: tuple[ReadyFrf, ...] = ()
    conditions: dict[str, str] = field(default_factory=dict)
    recorded: dict[str, RecordedCondition] = field(default_factory=dict)
    frf: FrfSettings | None = None
    repeats: str = ""


@dataclass(frozen=True)
class EachFile:
    """What a file becomes that is a test: what is *common* to all, and its name by the *pattern*."""

    common: Test = Test("")
    pattern: str = ""

    def conditions_in_name(self, path: Path) -> dict[str, str]:
        """The conditions that a file's name says; none where it does not match the pattern."""
        return conditions_in(plain_stem(path), self.pattern) or {}

    def test(self, source: SourceFile, name: str = "") -> Test:
        """The test of a recording, named after its file. ConfigError where the pattern does not match."""
        stem = plain_stem(source.path)
        if self.pattern and conditions_in(stem, self.pattern) is None:
            where, hint = f"pattern '{self.pattern}'", "for example '{preload}-{direction}'"
            raise ConfigError(f"does not match '{stem}'", where, hint)
        conditions = {**self.common.conditions, **self.conditions_in_name(source.path)}
        return replace(self.common, name=name or stem, recordings=(source,), conditions=conditions)


@dataclass(frozen=True)
class TestReader:
    """Reads the tests of a pipeline file by its entries *top*; *rig*: the one named for all recordings."""

    top: dict[str, Marked]
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
        key = f"tests.{number}"
        entries = self.faults.mapping(node, key)
        if entries:
            self.faults.unknown_keys(node, key, EACH if "each" in entries else LISTED)
        if "each" in entries:
            yield from self._tests_per_file(entries, key)
        else:
            yield self._test(self.faults.text(entries, key, "name") or str(number), node, key)

    def _tests_per_file(self, entries: dict[str, Marked], key: str) -> Iterator[Test]:
        """One test per file; files that differ in the parts of `together` alone are one test."""
        per_file = self._each(entries, key)
        together = self._joined_parts(entries, key)
        tests: dict[tuple[tuple[str, str], ...], Test] = {}
        unmatched: list[ConfigError] = []
        for source in self._recordings(entries["each"], join(key, "each")):
            try:
                test = per_file.test(source)
            except ConfigError as error:
                unmatched.append(error)
                test = Test(source.path.name)
            named = per_file.conditions_in_name(source.path).items()
            conditions = {part: text for part, text in named if part not in together}
            place = tuple(conditions.items()) if together else (("file", str(source.path)),)
            name = "-".join(conditions.values()) if together else test.name
            first = tests.get(place, replace(test, name=name, recordings=()))
            common = {name: text for name, text in test.conditions.items() if name not in together}
            tests[place] = replace(first, recordings=(*first.recordings, source), conditions=common)
        if unmatched:
            nor = f", nor {len(unmatched) - 1} more" if len(unmatched) > 1 else ""
            self.faults.add_at(entries, key, "pattern", f"{unmatched[0].what}{nor}", unmatched[0].hint)
        yield from tests.values()

    def _each(self, entries: dict[str, Marked], key: str) -> EachFile:
        common, recorded = self._conditions(entries, key)
        pattern = self.faults.text(entries, key, "pattern")
        for name in (*common, *recorded):
            if f"{{{name}}}" in pattern:
                what = "is in the pattern as well"
                self.faults.add_at(entries["conditions"].content, "conditions", name, what, "leave one out")
        frf, repeats = self._frf(entries, key), self._repeats(entries, key)
        return EachFile(Test("", (), (), common, recorded, frf, repeats), pattern)

    def each_file(self) -> EachFile:
        """What every file to come will be, by the only entry of `tests:`, which has `each:`."""
        node = self.top.get("tests", Marked(None, "", ""))
        is_one = isinstance(node.content, list) and len(node.content) == 1
        entries = node.content[0].content if is_one else None
        if not isinstance(entries, dict) or "each" not in entries:
            hint = "write one entry: - {each: '*.parquet'}"
            self.faults.add(node, "tests", "cannot be of recordings to come", hint)
            return EachFile()
        self.faults.unknown_keys(node.content[0], "tests.1", EACH)
        if "together" in entries:
            what = "recordings to come are tests of their own"
            self.faults.add_at(entries, "tests.1", "together", what, "leave it out")
        return self._each(entries, "tests.1")

    def _joined_parts(self, entries: dict[str, Marked], key: str) -> list[str]:
        if "together" not in entries:
            return []
        pattern = text_of(entries, "pattern")
        parts = [node.text for node in list_entries(entries["together"])]
        for part in parts:
            if f"{{{part}}}" not in pattern:
                what = f"the pattern has no part '{{{part}}}'"
                self.faults.add_at(entries, key, "together", what, f"pattern: {pattern}")
        return parts

    def _test(self, name: str, node: Marked, key: str) -> Test:
        entries = node.content if isinstance(node.content, dict) else {}
        recordings: list[SourceFile] = []
        if "recordings" in entries:
            recordings = self._recordings(entries["recordings"], join(key, "recordings"))
        frfs: list[ReadyFrf] = []
        if "frfs" in entries:
            frfs = read_ready_frfs(entries["frfs"], join(key, "frfs"), self.faults)
        if not recordings and not frfs and not len(self.faults):
            place = node if node.place else next(iter(self.top.values()))
            self.faults.add(place, key, "neither recordings nor frfs")
        conditions, recorded = self._conditions(entries, key)
        if frfs and recorded:
            what = "a ready FRF has no channels to take conditions from"
            self.faults.add_at(entries, key, "conditions", what, "write the amount, e.g. load: 1 kN")
        frf, repeats = self._frf(entries, key), self._repeats(entries, key)
        return Test(name, tuple(recordings), tuple(frfs), conditions, recorded, frf, repeats)

    def _repeats(self, entries: dict[str, Marked], key: str) -> str:
        repeats = text_of(entries, "repeats")
        if "repeats" in entries and repeats not in REPEATS:
            self.faults.add_at(entries, key, "repeats", f"unknown '{repeats}'", "write each or pool")
        return repeats

    def _frf(self, entries: dict[str, Marked], key: str) -> FrfSettings | None:
        """The pipeline's frf: with the test's own entries, of which one without a value takes it away; of
        another excitation only what that takes as well.
        """
        if "frf" not in entries or key == "":
            return None
        common = self.top["frf"].content if "frf" in self.top else {}
        frf_of_test = self.faults.mapping(entries["frf"], join(key, "frf"))
        others = KEYS_OF_EXCITATION.get(text_of(frf_of_test, "excitation"), common)
        inherited = common.items() if isinstance(common, dict) else ()
        both = {**{name: node for name, node in inherited if name in others}, **frf_of_test}
        whole = {name: node for name, node in both.items() if node.content is not None}
        node = replace(entries["frf"], content=whole)
        return read_settings(FrfSettings, node, join(key, "frf"), self.faults)

    def _recordings(self, node: Marked, key: str) -> list[SourceFile]:
        return RecordingReader(self.rig, self.top.get("rig"), self.faults).sources(node, key)

    def _conditions(
        self, entries: dict[str, Marked], key: str
    ) -> tuple[dict[str, str], dict[str, RecordedCondition]]:
        written: dict[str, str] = {}
        recorded: dict[str, RecordedCondition] = {}
        if "conditions" not in entries:
            return written, recorded
        for name, node in self.faults.mapping(entries["conditions"], "conditions").items():
            if not isinstance(node.content, dict):
                written[name] = node.text
                if node.content is None or not node.text:
                    what, hint = "an amount or a word is needed", "for example speed: 3000 rpm"
                    self.faults.add(node, join(key, "conditions", name), what, hint)
                continue
            at = join(key, "conditions", name)
            source = read_settings(RecordedCondition, node, at, self.faults)
            if source is not None:
                recorded[name] = source
        return written, recorded
