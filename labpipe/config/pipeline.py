"""Reading a pipeline file: what to do with which recordings."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from labpipe.campaign.settings import CompareSettings
from labpipe.config.calibration import CalibrationSettings
from labpipe.config.compare import bearing_files, read_comparisons
from labpipe.config.faults import Faults, join
from labpipe.config.reader import read_settings
from labpipe.config.rotor import with_rotor
from labpipe.config.rules import STUDY, Rule, read_rules
from labpipe.config.run_ups import RUN_UPS, files_of_run_ups, read_run_ups
from labpipe.config.tests import Test, TestReader, read_rig
from labpipe.config.unbalance import UNBALANCE, read_unbalance
from labpipe.config.virtual_rig import load_virtual_rig
from labpipe.errors import ConfigError
from labpipe.identify.settings import FitSettings
from labpipe.marked_yaml import Marked, load_marked, set_entry
from labpipe.records.rig import Rig
from labpipe.records.settings import setting
from labpipe.registry import nearest
from labpipe.rigs.unbalance_runs import UnbalanceSettings
from labpipe.run_ups.settings import RunUpSettings
from labpipe.spectra.settings import FrfSettings
from labpipe.study.settings import StudySettings

SECTIONS = (
    "title",
    "rig",
    "recordings",
    "tests",
    "frfs",
    "conditions",
    "frf",
    "identify",
    "calibrate",
    "compare",
    "study",
    "unbalance",
    "run_ups",
    "report",
    "accept",
    "expect",
)
REPORT_FORMATS = ("html", "md", "pdf")


@dataclass(frozen=True)
class ReportSettings:
    """The ``report:`` section."""

    formats: tuple[str, ...] = setting("names", "formats written by `labpipe run`", default=("html",))


@dataclass(frozen=True)
class StudyPlan:
    """The ``study:`` section, and the virtual rig it names."""

    settings: StudySettings
    rig: Any


@dataclass(frozen=True)
class Pipeline:
    """A pipeline file with everything it names."""

    path: Path
    title: str
    tests: tuple[Test, ...]
    frf: FrfSettings | None
    fits: tuple[FitSettings, ...]
    calibrations: tuple[CalibrationSettings, ...]
    report: ReportSettings
    rules: tuple[Rule, ...]
    rig: Rig | None
    study: StudyPlan | None = None
    comparisons: tuple[CompareSettings, ...] = ()
    unbalance: UnbalanceSettings | None = None
    run_ups: RunUpSettings | None = None

    @property
    def folder(self) -> Path:
        return self.path.parent

    @property
    def side_files(self) -> list[Path]:
        """Tables, bearing and rotor files and run-ups that the result depends on beside recordings and FRFs."""
        rotors = [] if self.unbalance is None else [self.folder / self.unbalance.rotor]
        rotors += [] if self.run_ups is None else files_of_run_ups(self.run_ups)
        return [*(calibration.path for calibration in self.calibrations), *bearing_files(self.comparisons, self.folder), *rotors]


def load_pipeline(path: Path, overrides: Iterable[str] = ()) -> Pipeline:
    """The pipeline of a pipeline file, its rig files read along; ConfigErrors with every fault of all files at its place."""
    tree = load_marked(path)
    for assignment in overrides:
        set_entry(tree, assignment)
    faults = Faults()
    entries = faults.mapping(tree, "")
    if entries:
        faults.unknown_keys(tree, "", SECTIONS)
    rig = read_rig(entries.get("rig"), path.parent, faults, "rig")
    tests = TestReader(entries, path.parent, rig, faults).tests()
    frf = read_settings(FrfSettings, entries["frf"], "frf", faults) if "frf" in entries else None
    fits = _fits(entries.get("identify"), path.parent, rig, faults)
    calibrations = _calibrations(entries.get("calibrate"), path.parent, faults)
    report = read_settings(ReportSettings, entries["report"], "report", faults) if "report" in entries else ReportSettings()
    _check_formats(entries.get("report"), report, faults)
    study = _study(entries.get("study"), path.parent, faults)
    names = tuple(name for section in ("identify", "calibrate") if section in entries for name in faults.mapping(entries[section], section))
    comparisons = read_comparisons(entries.get("compare"), path.parent, faults, names)
    names = (*names, *(settings.name for settings in comparisons))
    unbalance = read_unbalance(entries.get(UNBALANCE), path.parent, faults)
    run_ups = read_run_ups(entries.get(RUN_UPS), path.parent, faults)
    names = (*names, *(name for name in (STUDY, UNBALANCE, RUN_UPS) if name in entries))
    rules = tuple(rule for section in ("accept", "expect") for rule in read_rules(section, entries.get(section), faults, names))
    _check_whole(tree, entries, tests, frf, faults)
    faults.raise_any()
    assert report is not None
    return Pipeline(path, _title(entries, path), tests, frf, fits, calibrations, report, rules, rig, study, comparisons, unbalance, run_ups)


def _title(entries: dict[str, Marked], path: Path) -> str:
    return entries["title"].text if "title" in entries and entries["title"].text else path.stem


def _check_whole(tree: Marked, entries: dict[str, Marked], tests: tuple[Test, ...], frf: FrfSettings | None, faults: Faults) -> None:
    """What only the whole file shows: something to do, and all that doing it needs."""
    if not any(key in entries for key in ("recordings", "tests", "frfs", "calibrate", "study", UNBALANCE, RUN_UPS)):
        faults.add(tree, "", "nothing to work on", "name recordings, tests, frfs, calibrate, study, unbalance or run_ups")
    if "study" in entries and not (entries["identify"].content if "identify" in entries else None):
        faults.add(entries["study"], "study", "there is nothing to study", "name fits under identify")
    if any(test.recordings for test in tests) and frf is None and "frf" not in entries:
        faults.add(tree, "frf", "is missing", "say how the recordings become FRFs: excitation and period or block")


def _check_formats(node: Marked | None, report: ReportSettings | None, faults: Faults) -> None:
    for name in report.formats if report else ():
        if name not in REPORT_FORMATS and node is not None:
            faults.add(node.content["formats"], "report.formats", f"unknown format '{name}'", nearest(name, REPORT_FORMATS))


def _fits(node: Marked | None, folder: Path, rig: Rig | None, faults: Faults) -> tuple[FitSettings, ...]:
    """The fits in their order; a fit that does not say its mass takes the rig's."""
    fits = []
    for name, entry in (faults.mapping(node, "identify") if node is not None else {}).items():
        fit = read_settings(FitSettings, entry, join("identify", name), faults, name=name)
        if fit is None:
            continue
        fit = with_rotor(fit, entry, folder, join("identify", name), faults)
        own_mass = isinstance(entry.content, dict) and "mass" in entry.content
        fits.append(fit if own_mass or rig is None or rig.mass is None else replace(fit, mass=rig.mass))
    return tuple(fits)


def _study(node: Marked | None, folder: Path, faults: Faults) -> StudyPlan | None:
    if node is None:
        return None
    settings = read_settings(StudySettings, node, "study", faults)
    if settings is None:
        return None
    try:
        return StudyPlan(settings, load_virtual_rig(folder / settings.rig))
    except ConfigError as error:
        if error.what == "no such file":
            faults.add(node.content["rig"], "study.rig", f"no such file '{settings.rig}'", "paths are relative to the pipeline file")
        else:
            faults.merge(error)
    return None


def _calibrations(node: Marked | None, folder: Path, faults: Faults) -> tuple[CalibrationSettings, ...]:
    calibrations = []
    for name, entry in (faults.mapping(node, "calibrate") if node is not None else {}).items():
        key = join("calibrate", name)
        known = read_settings(CalibrationSettings, entry, key, faults, name=name)
        if known is None:
            continue
        if not (folder / known.table).exists():
            faults.add(entry.content["table"], join(key, "table"), f"no such file '{known.table}'", "paths are relative to this file")
        calibrations.append(replace(known, path=folder / known.table))
    return tuple(calibrations)
