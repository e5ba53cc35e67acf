"""Reading a pipeline file: tests, sections, rules, report."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import KW_ONLY, dataclass, field, replace
from pathlib import Path
from typing import Any

from labpipe.config.faults import Faults, join
from labpipe.config.file_kinds import named_files
from labpipe.config.reader import read_settings
from labpipe.config.reading import Reading
from labpipe.config.recordings import SourceFile, read_rig
from labpipe.config.rules import Rule, read_rules
from labpipe.config.tests import EachFile, Test, TestReader
from labpipe.config.uncertainty import read_uncertainty
from labpipe.errors import ConfigError
from labpipe.identify.settings import FitSettings, check_kind
from labpipe.marked_yaml import Marked, load_marked, set_entry
from labpipe.records.rig import Rig
from labpipe.records.settings import Settings, setting
from labpipe.registry import nearest
from labpipe.sections import SECTIONS, PipelineSection, names_of, section, sections
from labpipe.spectra.settings import FrfSettings

BEFORE = ("title", "rig", "recordings", "tests", "frfs", "conditions", "frf", "uncertainty", "results")
AFTER = ("report", "accept", "expect")
RECORDED = ("recordings", "tests", "frfs")
REPORT_FORMATS = ("html", "md", "pdf")
# How the results of many tests are kept: all in identification.json, as a dataset, or by their number.
RESULTS = ("auto", "whole", "dataset")


@dataclass(frozen=True)
class ReportSettings(Settings):
    """The ``report:`` section."""

    formats: tuple[str, ...] = setting("names", "formats written by `labpipe run`", default=("html",))

    def __post_init__(self) -> None:
        for name in self.formats:
            if name not in REPORT_FORMATS:
                raise ConfigError(f"unknown format '{name}'", hint=nearest(name, REPORT_FORMATS), field="formats")


@dataclass(frozen=True)
class Pipeline:
    """A pipeline file with everything it names; *sections*: settings by the key of their section, in the order in which they are run.

    The settings of a section with named entries are a tuple, of others one dataclass. *results*: how those of many tests are kept.
    """

    path: Path
    _: KW_ONLY
    title: str
    tests: tuple[Test, ...]
    frf: FrfSettings | None
    report: ReportSettings
    rules: tuple[Rule, ...]
    rig: Rig | None
    sections: Mapping[str, Any] = field(default_factory=dict)
    results: str = "auto"

    @property
    def folder(self) -> Path:
        return self.path.parent

    @property
    def fits(self) -> tuple[FitSettings, ...]:
        """The fits in their order."""
        return tuple(self.sections.get("identify", ()))

    @property
    def side_files(self) -> list[Path]:
        """Tables, bearing and rotor files and run-ups that the result depends on beside recordings and FRFs."""
        owners = [owner for name, settings in self.sections.items() if name != "identify" for owner in _listed(settings)]
        return list(dict.fromkeys(path for owner in owners for path in named_files(owner, self.folder)))


def _listed(settings: Any) -> tuple[Any, ...]:
    return settings if isinstance(settings, tuple) else (settings,)


def section_names() -> tuple[str, ...]:
    """Every key that a pipeline file may have."""
    return (*BEFORE, *SECTIONS.names(), *AFTER)


def load_pipeline(path: Path, overrides: Iterable[str] = ()) -> Pipeline:
    """The pipeline of a pipeline file, its rig files read along; ConfigErrors with every fault of all files at its place."""
    return _loaded(path, overrides, TestReader.tests)


def load_for_files_to_come(path: Path, overrides: Iterable[str] = ()) -> tuple[Pipeline, EachFile]:
    """The pipeline of recordings that are not there yet, without tests, and what each of them becomes; errors as of `load_pipeline`."""
    per_file: list[EachFile] = []

    def imagined(reader: TestReader) -> tuple[Test, ...]:
        """A test as each will be, so that settings are held against it."""
        per_file.append(reader.each_file())
        if reader.rig is None and not len(reader.faults):
            raise ConfigError("no rig file is named", where=str(path), hint="add rig: FILE")
        source = () if reader.rig is None else (SourceFile(path, reader.rig),)
        return (Test("", source, frf=per_file[0].frf),)

    pipeline = _loaded(path, overrides, imagined)
    return replace(pipeline, tests=()), per_file[0]


def _loaded(path: Path, overrides: Iterable[str], tests_of: Callable[[TestReader], tuple[Test, ...]]) -> Pipeline:
    tree = load_marked(path)
    for assignment in overrides:
        set_entry(tree, assignment)
    faults = Faults(path.parent)
    entries = faults.mapping(tree, "")
    if entries:
        faults.unknown_keys(tree, "", section_names())
    rig = read_rig(entries.get("rig"), path.parent, faults, "rig")
    tests = tests_of(TestReader(entries, path.parent, rig, faults))
    frf = read_settings(FrfSettings, entries["frf"], "frf", faults) if "frf" in entries else None
    report = read_settings(ReportSettings, entries["report"], "report", faults) if "report" in entries else ReportSettings()
    settings, names = _sections(entries, rig, faults)
    if "uncertainty" in entries:
        of_all = read_uncertainty(entries["uncertainty"], faults)
        if of_all is not None and "identify" in settings:
            settings["identify"] = tuple(of_all(fit) for fit in settings["identify"])
    rules = tuple(rule for key in ("accept", "expect") for rule in read_rules(key, entries.get(key), faults, names))
    results = entries["results"].text if "results" in entries else "auto"
    if results not in RESULTS:
        faults.add(entries["results"], "results", f"no way '{results}' to keep results", nearest(results, RESULTS))
    _check_whole(tree, entries, tests, frf, faults)
    _check_kinds(entries, settings.get("identify", ()), tests, frf, faults)
    faults.raise_any()
    assert report is not None
    return Pipeline(
        path, title=_title(entries, path), tests=tests, frf=frf, report=report, rules=rules, rig=rig, sections=settings, results=results
    )


def _sections(entries: dict[str, Marked], rig: Rig | None, faults: Faults) -> tuple[dict[str, Any], tuple[str, ...]]:
    """The settings of every section that the file has, and the names by which rules address them."""
    settings: dict[str, Any] = {}
    names: tuple[str, ...] = ()
    for name, entry in sections():
        if name not in entries:
            continue
        content = _section(entries[name], name, entry, Reading(faults, rig, names))
        # Names count even where their entries cannot be read, so that rules on them are no faults.
        names = (*names, *(entries[name].content if entry.named and isinstance(entries[name].content, dict) else names_of(name, content)))
        if content is not None:
            settings[name] = content
    return settings, names


def _section(node: Marked, name: str, entry: PipelineSection, reading: Reading) -> Any:
    if not entry.named:
        return _read_entry(node, name, "", entry, reading)
    entries = reading.faults.mapping(node, name)
    named = (_read_entry(part, join(name, key), key, entry, reading) for key, part in entries.items())
    return tuple(settings for settings in named if settings is not None)


def _read_entry(node: Marked, key: str, name: str, entry: PipelineSection, reading: Reading) -> Any:
    read = entry.load("read")
    if read is not None:
        return read(node, key, name, reading)
    return read_settings(entry.load("settings"), node, key, reading.faults, **({"name": name} if entry.named else {}))


def _title(entries: dict[str, Marked], path: Path) -> str:
    return entries["title"].text if "title" in entries and entries["title"].text else path.stem


def _check_whole(tree: Marked, entries: dict[str, Marked], tests: tuple[Test, ...], frf: FrfSettings | None, faults: Faults) -> None:
    """Faults of the file as a whole: no work, missing sections."""
    work = (*RECORDED, *_standalone())
    if not any(key in entries for key in work):
        faults.add(tree, "", "nothing to work on", f"name {', '.join(work[:-1])} or {work[-1]}")
    if "study" in entries and not (entries["identify"].content if "identify" in entries else None):
        faults.add(entries["study"], "study", "there is nothing to study", "name fits under identify")
    if any(test.recordings for test in tests) and frf is None and "frf" not in entries:
        faults.add(tree, "frf", "is missing", "state excitation and period or block, from which FRFs are computed")


def _check_kinds(
    entries: dict[str, Marked], fits: tuple[FitSettings, ...], tests: tuple[Test, ...], frf: FrfSettings | None, faults: Faults
) -> None:
    """Faults of fits whose model is not of what the recordings give: free decays, spectra or responses."""
    if frf is None:
        return
    kinds = {test.name: (test.frf or frf).gives for test in tests if test.recordings}
    for fit in fits:
        for kind in dict.fromkeys(kinds[name] for name in fit.test or kinds if name in kinds):
            try:
                check_kind(fit, kind)
            except ConfigError as error:
                node = entries["identify"].content[fit.name].content["model"]
                faults.add(node, join(join("identify", fit.name), "model"), error.what, error.hint)


def _standalone() -> Iterator[str]:
    return (name for name in SECTIONS.names() if section(name).standalone)
