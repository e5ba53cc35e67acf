"""Reading a pipeline file: tests, sections, rules, report."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Container, Iterable, Mapping
from dataclasses import KW_ONLY, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from labpipe.errors import ConfigError, SettingError
from labpipe.estimation.settings import FEWEST, MODELS, FitSettings, check_kind, model_kind
from labpipe.project.calibrations import readable_result
from labpipe.project.ingest import SourceFile
from labpipe.project.marked_yaml import Marked, load_marked, text_of
from labpipe.project.rules import Rule, read_rules
from labpipe.project.settings_reader import TYPED, Faults, Reading, join, named_files, read_settings
from labpipe.project.tests import SINGLE, EachFile, Test, TestReader, read_rig
from labpipe.quantities import UnitError
from labpipe.records.rig import Rig
from labpipe.records.sections import SECTIONS, PipelineSection, names_of, sections
from labpipe.records.settings import Settings, choice, integer, quantity, setting, settings_of, text
from labpipe.records.uncertain import RepeatSource, parse_uncertain
from labpipe.registry import nearest
from labpipe.spectra.settings import FrfSettings
from labpipe.uncertainty.settings import COMPARISONS, CompareSettings, MatrixSettings, comparison_kind


@dataclass(frozen=True)
class RepeatSettings(Settings):
    """What changes a parameter between repeats: as known, or as a repeatability test found it."""

    parameter: str = text("the coefficient that scatters, of every fit that has it: k")
    size: str = text("its standard uncertainty, relative: 0.5 %, or 0.5 % (dof=4)")
    file: str = setting(
        "file",
        "instead of parameter and size: identification.json of a comparison of kind repeatability",
        default="",
    )
    comparison: str = text("name of the comparison in that file; its scatter between settings is taken")
    per: str = text(
        "condition; tests of one value of it have the error in common. Default: each test has its own"
    )

    def __post_init__(self) -> None:
        if self.file and (self.parameter or self.size):
            what = "'file' says which parameter scatters and by how much"
            raise SettingError("file", what, "leave 'parameter' and 'size' out")
        if not self.file and not (self.parameter and self.size):
            what = "'parameter' and 'size' are needed, or the 'file' of a repeatability test"
            raise ConfigError(what, hint="parameter: k, size: 0.5 %")
        if bool(self.file) != bool(self.comparison):
            hint = "comparison: the name under `compare`"
            raise SettingError("comparison", "'file' and 'comparison' go together", hint)


METHODS = ("first-order", "monte-carlo")


@dataclass(frozen=True)
class UncertaintySettings(Settings):
    """The ``uncertainty:`` section: how uncertainties are propagated in fits that do not say it."""

    coverage: float = quantity("probability of expanded uncertainties", "1", 0.95)
    method: str = choice(
        "first order, or draws of noise and all uncertainties beside it", METHODS, "first-order"
    )
    draws: int = integer("draws of method monte-carlo", 2000)
    repeatability: tuple[tuple[str, RepeatSettings], ...] = setting(
        "sections",
        "scatter between repeats, by name: {remounting: {parameter: k, size: 0.5 %, per: mounting}}",
        section=RepeatSettings,
        default=(),
    )

    def __post_init__(self) -> None:
        self.require_share("coverage")
        if self.draws != UncertaintySettings.draws and self.method == METHODS[0]:
            hint = "method: monte-carlo, or leave it out"
            raise SettingError("draws", "'draws' are of method monte-carlo", hint)
        if self.draws < FEWEST["monte_carlo"]:
            what = f"{self.draws} draws give no 95 % interval"
            raise SettingError("draws", what, f"at least {FEWEST['monte_carlo']}")

    def of(
        self, fit: FitSettings, stated: Container[str], repeats: tuple[RepeatSource, ...] = ()
    ) -> FitSettings:
        """A fit with these settings but those *stated* by it, and with the scatter between *repeats*."""
        by_draws = self.method != METHODS[0] and "monte_carlo" in fit.kind.keys
        draws = self.draws if by_draws and "monte_carlo" not in stated else fit.monte_carlo
        coverage = fit.coverage if "coverage" in stated else self.coverage
        return replace(fit, coverage=coverage, monte_carlo=draws, between=repeats)


def read_uncertainty(node: Marked, faults: Faults) -> Callable[..., FitSettings] | None:
    """What the section makes of a fit and its keys; None and faults where it cannot be read."""
    before = len(faults)
    settings = read_settings(UncertaintySettings, node, "uncertainty", faults)
    if settings is None:
        return None
    repeats: list[RepeatSource] = []
    for name, entry in settings.repeatability:
        key = join("uncertainty.repeatability", name)
        written = node.content["repeatability"].content[name]
        at = "file" if entry.file else "size"
        with faults.of_unit(written.content[at], join(key, at)):
            repeats.append(
                _measured_source(name, entry, faults.folder) if entry.file else _known_source(name, entry)
            )
    return partial(settings.of, repeats=tuple(repeats)) if len(faults) == before else None


def _known_source(name: str, settings: RepeatSettings) -> RepeatSource:
    size, _, _ = settings.size.partition("(")
    if not size.strip().endswith("%"):
        what = f"'{settings.size}' is not relative to the parameter"
        raise UnitError(what, "for example 0.5 %, or 0.5 % (dof=4)")
    number = parse_uncertain(f"1 +- {settings.size}", "1")
    return RepeatSource(name, settings.parameter, number.std_error, settings.per, number.dof)


def _measured_source(name: str, settings: RepeatSettings, folder: Path) -> RepeatSource:
    """The relative scatter between settings of a repeatability test, with one dof less than settings."""
    unreadable = f"'{settings.file}' is not a readable identification.json"
    with readable_result(folder / settings.file, unreadable) as result:
        repeatable = (e for e in result.get("comparisons") or [] if e["kind"] == "repeatability")
        repeatabilities: Mapping[str, Any] = {entry["name"]: entry for entry in repeatable}
    if settings.comparison not in repeatabilities:
        hint = "it needs a comparison of kind: repeatability"
        hint = nearest(settings.comparison, repeatabilities) if repeatabilities else hint
        raise UnitError(f"'{settings.file}' holds no repeatability '{settings.comparison}'", hint)
    comparison = repeatabilities[settings.comparison]
    try:
        amounts = {amount["name"]: float(amount["value"]) for amount in comparison["amounts"]}
        groups = {point["group"] for point in comparison["points"]}
        parameter = str(comparison["subject"]).split(",")[0].strip()
        relative = abs(amounts["between"] / amounts["mean"])
        return RepeatSource(name, parameter, relative, settings.per, float(len(groups) - 1))
    except (KeyError, TypeError, ValueError, ZeroDivisionError):
        what = f"the repeatability '{settings.comparison}' in '{settings.file}' cannot be read"
        raise UnitError(what) from None


def read_fit(node: Marked, key: str, name: str, reading: Reading) -> FitSettings | None:
    """The settings of a fit, `mass` by default that of the rig. None and faults where they cannot be read."""
    faults, before = reading.faults, len(reading.faults)
    entries = faults.mapping(node, key)
    presets: dict[str, Any] = {"name": name}
    section = _section_of(entries)
    entries = _move_to_section(entries) if not section else entries
    section = section or _section_of(entries)
    if section:
        model, entry = section
        if entries["model"].text != model:
            what = f"the section '{entry}' goes with model {model}"
            faults.add_at(entries, key, entry, what, model_kind(model).example)
        else:
            owner = model_kind(model).settings
            assert owner is not None
            presets["model_settings"] = read_settings(owner, entries[entry], join(key, entry), faults)
    rig, named = reading.rig, text_of(entries, "model")
    takes_mass = "mass" not in entries and named in MODELS and "mass" in model_kind(named).keys
    if rig is not None and rig.mass is not None and takes_mass:
        uncertain = () if rig.mass_uncertainty is None else (("mass", rig.mass_uncertainty),)
        presets |= {"mass": rig.mass, "uncertainties": uncertain}
    if len(faults) > before:
        return None
    if named and named not in MODELS:
        # Which keys an unknown model takes is unknown.
        entries = {name: entry for name, entry in entries.items() if name in settings_of(FitSettings)}
    plain = replace(node, content=entries).without(*section[1:] if section else ())
    return read_settings(FitSettings, plain, key, faults, **presets)


def _move_to_section(entries: dict[str, Marked]) -> dict[str, Marked]:
    """The entries of a fit, with the settings of a model that needs no section moved into its section."""
    model = text_of(entries, "model")
    kind = model_kind(model) if model in MODELS else None
    if kind is None or kind.settings is None or not kind.optional:
        return entries
    own, of_model = settings_of(FitSettings), settings_of(kind.settings)
    # A typing error goes with the key that it is nearest to.
    meant = {
        key: difflib.get_close_matches(key, [*own, *of_model], 1, TYPED) for key in entries if key not in own
    }
    moved = [key for key, near in meant.items() if near and near[0] in of_model]
    if not moved:
        return entries
    first = entries[moved[0]]
    inner = Marked({key: entries[key] for key in moved}, first.where, first.key_where)
    return {**{key: node for key, node in entries.items() if key not in moved}, kind.section: inner}


def _section_of(entries: dict[str, Marked]) -> tuple[str, str] | None:
    """(model, key) of a model's section in a fit. Other models are loaded for an unknown key alone."""
    if "model" not in entries:
        return None
    unknown = entries.keys() - settings_of(FitSettings).keys()
    if (
        unknown
        and (named := entries["model"].text) in MODELS
        and (owner := model_kind(named).settings) is not None
    ):
        if (section := model_kind(named).section) in entries:
            return named, section
        unknown -= settings_of(owner).keys()
    kinds = ((model, model_kind(model).section) for model in MODELS) if unknown else ()
    return next(((model, section) for model, section in kinds if section and section in entries), None)


def read_comparison(node: Marked, key: str, name: str, reading: Reading) -> CompareSettings | None:
    """The settings of a comparison. Faults for a taken name, another kind's section, no such fit."""
    faults = reading.faults
    if name in reading.names:
        faults.add(node, key, "a fit or calibration has this name already", "rules could not tell them apart")
    entries, before = faults.mapping(node, key), len(faults)
    kind = text_of(entries, "kind")
    comparison = comparison_kind(kind) if kind in COMPARISONS else None
    presets: dict[str, Any] = {"name": name}
    if comparison is not None and comparison.settings is not None and comparison.section in entries:
        section = comparison.section
        inner = read_settings(comparison.settings, entries[section], join(key, section), faults)
        presets["kind_settings"], node = inner, node.without(section)
    for entry in sorted(set(node.content if comparison else ()) - set(settings_of(CompareSettings))):
        kinds = [name for name in COMPARISONS if comparison_kind(name).section == entry]
        if kinds:
            faults.add_at(entries, key, entry, f"is not for the kind {kind}", f"kind: {' or '.join(kinds)}")
    if len(faults) > before:
        return None
    return _fit_reference(read_settings(CompareSettings, node, key, faults, **presets), node, key, reading)


def read_matrix(node: Marked, key: str, name: str, reading: Reading) -> MatrixSettings | None:
    """The settings of a matrix; faults for a name that is taken already, and for a fit that is not there."""
    faults = reading.faults
    if name in reading.names:
        faults.add(node, key, f"the name '{name}' is taken already", "rules could not tell them apart")
    return _fit_reference(read_settings(MatrixSettings, node, key, faults, name=name), node, key, reading)


OfFit = TypeVar("OfFit", CompareSettings, MatrixSettings)


def _fit_reference(settings: OfFit | None, node: Marked, key: str, reading: Reading) -> OfFit | None:
    if settings is not None and settings.fit and settings.fit not in reading.names:
        hint = nearest(settings.fit, reading.names)
        reading.faults.add_at(node.content, key, "fit", f"there is no fit '{settings.fit}'", hint)
    return settings


BEFORE = ("title", "rig", "recordings", "tests", "frfs", "conditions", "frf", "uncertainty", "results")
AFTER = ("report", "accept", "expect")
RECORDED = ("recordings", "tests", "frfs")
REPORT_FORMATS = ("html", "md", "pdf")
# How results are kept: all in identification.json, or as a dataset. What a result is does not depend on the
# number of tests.
RESULTS = ("whole", "dataset")


@dataclass(frozen=True)
class ReportSettings(Settings):
    """The ``report:`` section."""

    formats: tuple[str, ...] = setting(
        "names", "formats written by `labpipe run`", default=("html",), may_be_empty=True
    )

    def __post_init__(self) -> None:
        for name in self.formats:
            if name not in REPORT_FORMATS:
                raise SettingError("formats", f"unknown format '{name}'", nearest(name, REPORT_FORMATS))


@dataclass(frozen=True)
class Pipeline:
    """A pipeline file with everything it names; *sections*: settings by the key of their section, in the
    order in which they are run, a tuple for named entries, else one dataclass. *results*: how those of many
    tests are kept.
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
    results: str = "whole"

    @property
    def folder(self) -> Path:
        return self.path.parent

    @property
    def first_rig(self) -> Rig | None:
        """Its rig, or else that of the first recording; None where there is no recording."""
        return self.rig or next((source.rig for test in self.tests for source in test.recordings), None)

    @property
    def fits(self) -> tuple[FitSettings, ...]:
        return tuple(self.sections.get("identify", ()))

    @property
    def side_files(self) -> list[Path]:
        """Tables, bearing and rotor files and run-ups that the result depends on beside its data."""
        others = [settings for name, settings in self.sections.items() if name != "identify"]
        owners = [owner for part in others for owner in (part if isinstance(part, tuple) else (part,))]
        return list(dict.fromkeys(path for owner in owners for path in named_files(owner, self.folder)))


def section_names() -> tuple[str, ...]:
    """Every key that a pipeline file may have."""
    return (*BEFORE, *SECTIONS.names(), *AFTER)


def load_pipeline(path: Path, overrides: Iterable[str] = ()) -> Pipeline:
    """The pipeline of a file, rig files read along. ConfigErrors with every fault at its place."""
    return _load(path, overrides, TestReader.tests)


def load_for_files_to_come(path: Path, overrides: Iterable[str] = ()) -> tuple[Pipeline, EachFile]:
    """The pipeline of files to come, and what each becomes. Errors as of `load_pipeline`."""
    per_file: list[EachFile] = []

    def imagine_tests(reader: TestReader) -> tuple[Test, ...]:
        """A test as each will be, so that settings are compared with it."""
        per_file.append(reader.each_file())
        if reader.rig is None and not len(reader.faults):
            raise ConfigError("no rig file is named", path, "add rig: FILE")
        source = () if reader.rig is None else (SourceFile(path, reader.rig),)
        return (Test("", source, frf=per_file[0].common.frf),)

    return replace(_load(path, overrides, imagine_tests), tests=()), per_file[0]


def load_for_stream(path: Path, overrides: Iterable[str]) -> Pipeline:
    """The pipeline of a test followed while it runs: its rig is read. Errors as of `load_pipeline`."""

    def tests_to_come(reader: TestReader) -> tuple[Test, ...]:
        return () if reader.rig is None else (Test("", (SourceFile(path, reader.rig),)),)

    return replace(_load(path, overrides, tests_to_come), tests=())


def _load(
    path: Path, overrides: Iterable[str], tests_of: Callable[[TestReader], tuple[Test, ...]]
) -> Pipeline:
    tree = load_marked(path, overrides)
    faults = Faults(path.parent)
    entries = faults.mapping(tree, "")
    if entries:
        faults.unknown_keys(tree, "", section_names())
    rig = read_rig(entries.get("rig"), faults, "rig")
    tests = tests_of(TestReader(entries, rig, faults))
    frf = read_settings(FrfSettings, entries["frf"], "frf", faults) if "frf" in entries else None
    report: ReportSettings | None = ReportSettings()
    if "report" in entries:
        report = read_settings(ReportSettings, entries["report"], "report", faults)
    settings, names, verdicts = _sections(entries, rig, faults)
    if "uncertainty" in entries:
        of_all = read_uncertainty(entries["uncertainty"], faults)
        if of_all is not None and "identify" in settings:
            fits, written = settings["identify"], entries["identify"].content
            settings["identify"] = tuple(of_all(fit, written[fit.name].content) for fit in fits)
    rules = tuple(
        rule
        for key in ("accept", "expect")
        for rule in read_rules(key, entries.get(key), faults, names, verdicts)
    )
    results = text_of(entries, "results", "whole")
    # Of files written before: by the number of tests.
    results = "whole" if results == "auto" else results
    if results not in RESULTS:
        what = f"no way '{results}' to keep results"
        faults.add_at(entries, "", "results", what, nearest(results, RESULTS))
    title = faults.text(entries, "", "title")
    _check_whole(tree, entries, tests, frf, faults)
    _check_kinds(entries, settings.get("identify", ()), tests, frf, faults)
    _check_conditions(entries, settings.get("matrix", ()), tests, faults)
    faults.raise_any()
    assert report is not None
    return Pipeline(
        path,
        title=title or path.stem,
        tests=tests,
        frf=frf,
        report=report,
        rules=rules,
        rig=rig,
        sections=settings,
        results=results,
    )


def _sections(
    entries: dict[str, Marked], rig: Rig | None, faults: Faults
) -> tuple[dict[str, Any], tuple[str, ...], dict[str, tuple[str, ...]]]:
    settings: dict[str, Any] = {}
    names: tuple[str, ...] = ()
    verdicts: dict[str, tuple[str, ...]] = {}
    for name, entry in sections(entries):
        written = entries[name].content
        content = _section(entries[name], name, entry, Reading(faults, rig, names))
        # Names count even where their entries cannot be read, so that rules on them are not faults.
        by_name = entry.named and isinstance(written, dict)
        names = (*names, *(written if by_name else names_of(name, content)))
        if content is not None:
            settings[name] = content
            verdicts.update(entry.verdicts(content))
    return settings, names, verdicts


def _section(node: Marked, name: str, entry: PipelineSection, reading: Reading) -> Any:
    if not entry.named:
        return _read_entry(node, name, "", entry, reading)
    entries = reading.faults.mapping(node, name)
    named = (_read_entry(part, join(name, key), key, entry, reading) for key, part in entries.items())
    return tuple(settings for settings in named if settings is not None)


def _read_entry(node: Marked, key: str, name: str, entry: PipelineSection, reading: Reading) -> Any:
    if entry.read is not None:
        return entry.read(node, key, name, reading)
    return read_settings(entry.settings, node, key, reading.faults, **({"name": name} if entry.named else {}))


def _check_whole(
    tree: Marked, entries: dict[str, Marked], tests: tuple[Test, ...], frf: FrfSettings | None, faults: Faults
) -> None:
    for key in SINGLE:
        if key in entries and "tests" in entries:
            faults.add_at(entries, "", key, "has no effect beside tests:", "write it in each test")
    if (
        not tests
        and not any(key in entries for key in RECORDED)
        and not any(entry.standalone for _, entry in sections(entries))
    ):
        work = (*RECORDED, *(name for name, entry in sections() if entry.standalone))
        faults.add(tree, "", "nothing to work on", f"name {', '.join(work[:-1])} or {work[-1]}")
    if "study" in entries and not (entries["identify"].content if "identify" in entries else None):
        faults.add(entries["study"], "study", "there is nothing to study", "name fits under identify")
    if any(test.recordings for test in tests) and frf is None and "frf" not in entries:
        hint = "state excitation and period or block, from which FRFs are computed"
        faults.add(tree, "frf", "is missing", hint)


def _check_conditions(
    entries: dict[str, Marked], matrices: tuple[MatrixSettings, ...], tests: tuple[Test, ...], faults: Faults
) -> None:
    conditions = dict.fromkeys(name for test in tests for name in (*test.conditions, *test.recorded))
    for matrix in matrices:
        written, key = entries["matrix"].content[matrix.name].content, join("matrix", matrix.name)
        for part in ("over", "beside"):
            for name in getattr(matrix, part):
                # None of files to come, whose names may say them.
                if conditions and name not in conditions:
                    what = f"no test has the condition '{name}'"
                    faults.add_at(written, key, part, what, nearest(name, conditions))


def _check_kinds(
    entries: dict[str, Marked],
    fits: tuple[FitSettings, ...],
    tests: tuple[Test, ...],
    frf: FrfSettings | None,
    faults: Faults,
) -> None:
    if frf is None:
        return
    kinds = {test.name: (test.frf or frf).gives for test in tests if test.recordings}
    for fit in fits:
        for kind in dict.fromkeys(kinds[name] for name in fit.test or kinds if name in kinds):
            try:
                check_kind(fit, kind)
            except ConfigError as error:
                node = entries["identify"].content[fit.name].content["model"]
                faults.add(node, join("identify", fit.name, "model"), error.what, error.hint)
