"""The section run_ups: tables or tracked recordings -> journal coefficients by several methods."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from labpipe.artefacts.recording_file import StoredRecording
from labpipe.artefacts.writing import OutputFolder
from labpipe.errors import DataError, locate_errors
from labpipe.methods.run_ups import records
from labpipe.methods.run_ups.measured import ReadRun, column, difference, run_up_of, weight_effect
from labpipe.methods.run_ups.report import cover_facts, run_up_sections
from labpipe.methods.run_ups.result import Tell, listed_speeds_and_parameters, run_up_result
from labpipe.methods.run_ups.rotor import RunUpRotor
from labpipe.methods.run_ups.run_up_csv import read_run_up_csv
from labpipe.methods.run_ups.settings import ProbeUncertainties, RunSettings, RunUpSettings, turning
from labpipe.project.deciding import Compared
from labpipe.project.ingest import SourceFile, ingest, is_recording
from labpipe.project.judging import CompareNumber, compare_covers, compare_warnings
from labpipe.project.measured import file_stem, file_stems
from labpipe.project.rules import Rule
from labpipe.records.identification import RuleOutcome
from labpipe.records.rig import Rig
from labpipe.records.sections import PipelineSection
from labpipe.records.uncertain import COURSES, Uncertain
from labpipe.registry import nearest
from labpipe.spectra.orders import cascade_spectra, track_order
from labpipe.spectra.settings import ShaftLines

# Lines of a stored cascade, more than a figure can show.
MOST_LINES = 240
NO_UNCERTAINTIES = ProbeUncertainties()
HZ = 1 / (2 * np.pi)


def read_run(
    settings: RunSettings,
    rig: RunUpRotor,
    output: OutputFolder,
    folder: Path,
    probes: ProbeUncertainties = NO_UNCERTAINTIES,
) -> ReadRun:
    """The run of a pipeline's entry, less its residual run; LabpipeError names it. *probes*: of tables."""
    with locate_errors(f"run_ups, run '{settings.name}'"):
        read = read_measured_run(settings, output, folder, probes)
        rig.excite(read.run)
        return read


def read_measured_run(
    settings: RunSettings, output: OutputFolder, folder: Path, probes: ProbeUncertainties = NO_UNCERTAINTIES
) -> ReadRun:
    """The run of an entry, on whatever rotor."""
    return _record(settings, output, folder) if settings.recording else _tabulate(settings, probes)


def _tabulate(settings: RunSettings, probes: ProbeUncertainties) -> ReadRun:
    table = read_run_up_csv(settings.path, settings.name, dict(settings.unbalance) or None, settings.load)
    run = replace(_statement(settings, table), uncertainties=probes.errors(table.planes))
    if settings.subtracted is not None:
        residual = read_run_up_csv(settings.subtracted, settings.subtracted.stem, {}, settings.load)
        run = difference(run, replace(residual, load=settings.load or residual.load))
    return ReadRun(settings, run)


def _statement(settings: RunSettings, run: records.RunUp) -> records.RunUp:
    threshold = run.threshold
    if settings.threshold is not None:
        threshold = Uncertain(settings.threshold.value / HZ, settings.threshold.std_error / HZ)
    return replace(
        run,
        load=run.load if settings.load is None else settings.load,
        unbalance=dict(settings.unbalance) or run.unbalance,
        threshold=threshold,
    )


def _record(settings: RunSettings, output: OutputFolder, folder: Path) -> ReadRun:
    lines = ShaftLines(tacho=settings.tacho, pulses=settings.pulses, harmonics=settings.harmonics)
    recording = _open(settings.path, settings.name, settings, output, folder)
    run = _track(recording, lines, settings, dict(settings.unbalance))
    if settings.subtracted is not None:
        residual = _open(settings.subtracted, f"{settings.name}-residual", settings, output, folder)
        run = weight_effect(_track(residual, lines, settings, dict(settings.unbalance)), run)
    return ReadRun(settings, _statement(settings, run), _cascades(recording, lines))


def _open(
    path: Path, name: str, settings: RunSettings, output: OutputFolder, folder: Path
) -> StoredRecording:
    if settings.recorded_by is None and not is_recording(path):
        raise DataError("a raw file needs its rig file", path, "add rig: FILE to the entry")
    source = SourceFile(path, settings.recorded_by or Rig("", ()))
    return ingest(source, output, f"recordings/{file_stem(name)}", folder)


def _track(
    recording: StoredRecording, lines: ShaftLines, settings: RunSettings, unbalance: dict[str, complex]
) -> records.RunUp:
    track = track_order(recording, lines, revolutions=settings.revolutions)
    assert settings.load is not None
    run = run_up_of(track, recording.channels, settings.name, settings.load, unbalance)
    tacho = next(channel for channel in recording.channels if channel.name == settings.tacho)
    # A pulse that is late makes every response early.
    turned = [
        turning(error.uncertainty, len(run.planes), -COURSES[error.effect][0], COURSES[error.effect][1])
        for error in tacho.uncertainties
        if error.effect in ("phase", "delay")
    ]
    return replace(run, uncertainties=(*run.uncertainties, *turned))


def _cascades(recording: StoredRecording, lines: ShaftLines) -> tuple[records.Cascade, ...]:
    """Of every displacement; groups of lines are reduced to their maximum, so that no peak is lost."""
    spectra = cascade_spectra(recording, lines)
    group = -(-spectra.frequency.size // MOST_LINES)
    whole = spectra.frequency.size // group * group
    frequency = spectra.frequency[:whole].reshape(-1, group).mean(axis=1)
    lines_of = spectra.amplitude[:, :whole].reshape(len(spectra.speed), -1, group, len(spectra.labels))
    thinned, places = lines_of.max(axis=2), (column(spectra.speed), column(frequency))
    moved = {channel.name for channel in recording.channels if channel.quantity == "displacement"}
    return tuple(
        records.Cascade(label, *places, tuple(column(row) for row in thinned[:, :, number]))
        for number, label in enumerate(spectra.labels)
        if label in moved
    )


def identify_run_ups(
    settings: RunUpSettings, output: OutputFolder, folder: Path, tell: Tell = lambda _: None
) -> records.RunUpResult:
    """All methods of the section on every run; *folder*: of the pipeline file."""
    rig = settings.rig
    assert rig is not None
    recorded = [run for run in settings.runs if run.recording]
    residuals = [f"{run.name}-residual" for run in recorded if run.subtracted]
    file_stems([*(run.name for run in recorded), *residuals], "recordings of runs")
    runs = [read_run(run, rig, output, folder, settings.probes.uncertainties) for run in settings.runs]
    return run_up_result(settings, rig, runs, tell)


MEASURED = "measured"
SPEEDS = ("critical_speed", "threshold")
ATTRIBUTES = ("std_error", "covers", "difference")
# Names in rules -> in the record of a method.
METHOD_VALUES = {
    "rank": "rank",
    "condition_number": "condition",
    "chi2_reduced": "chi2_per_datum",
    "chi2_p": "chi2_p",
    "share_at_bound": "share_at_bound",
}
_ADDRESS = re.compile(
    r"^(?P<method>[^.\[\]]+)(?:\[(?P<run>[^\]]*)\])?\.(?P<item>\w+)(?:\.(?P<attribute>\w+))?$"
)


@dataclass(frozen=True)
class _Address:
    method: str
    run: str
    item: str
    attribute: str


def run_up_outcome(rule: Rule, result: records.RunUpResult, compare_number: CompareNumber) -> RuleOutcome:
    """Of a rule; ConfigError at its place for what the result does not have."""
    if rule.item == "warnings":
        return rule.outcome(*compare_warnings(rule, result.findings))
    match = _ADDRESS.match(rule.item)
    if match is None:
        raise rule.fault("is not an address", "write run_ups.joint[held-out].critical_speed")
    address = _Address(*(part or "" for part in match.groups()))
    names = [run.name for run in result.runs]
    if address.run and address.run not in names:
        raise rule.fault(f"there is no run '{address.run}'", nearest(address.run, names))
    if address.item in SPEEDS:
        if address.attribute and address.attribute not in ATTRIBUTES:
            raise rule.fault(f"a speed has no '{address.attribute}'", nearest(address.attribute, ATTRIBUTES))
        runs = [run for run in result.runs if address.run in ("", run.name)]
        candidates = [(run, _amount(rule, address, result, run)) for run in runs]
        selected = [(run, amount) for run, amount in candidates if amount is not None] or candidates[:1]
        outcomes = [_attribute(rule, address, run, amount, compare_number) for run, amount in selected]
        return rule.outcome_of_all(outcomes)
    outcome = _judge_method(rule, address, result, compare_number)
    if address.run or address.attribute:
        what = f"'{address.item}' is that of all runs, by itself"
        raise rule.fault(what, f"write run_ups.{address.method}.{address.item}")
    return outcome


def _judge_method(
    rule: Rule, address: _Address, result: records.RunUpResult, compare_number: CompareNumber
) -> RuleOutcome:
    predictor = _predictor(rule, address, result)
    if isinstance(predictor, records.MetamodelResult):
        if address.item != "left_out":
            hint = nearest(address.item, [*SPEEDS, "left_out"])
            raise rule.fault(f"a metamodel has no '{address.item}'", hint)
        # Not a number where a fit without one of the loads failed.
        worst = float(np.max([validation.rms for validation in predictor.left_out]))
        return rule.outcome(*compare_number(rule, worst, "1"))
    if address.item == "verdict":
        return rule.outcome(predictor.verdict, predictor.verdict == rule.bound)
    if address.item not in METHOD_VALUES:
        hint = nearest(address.item, [*SPEEDS, *METHOD_VALUES, "verdict"])
        raise rule.fault(f"a method has no '{address.item}'", hint)
    number: float | None = getattr(predictor, METHOD_VALUES[address.item])
    return rule.outcome(*compare_number(rule, None if number is None else float(number), "1"))


def _predictor(rule: Rule, address: _Address, result: records.RunUpResult) -> records.Model:
    predictors = {predictor.name: predictor for predictor in result.predictors}
    if address.method not in predictors:
        hint = nearest(address.method, [*predictors, MEASURED])
        raise rule.fault(f"there is no method '{address.method}'", hint)
    return predictors[address.method]


def _amount(
    rule: Rule, address: _Address, result: records.RunUpResult, run: records.MeasuredRun
) -> records.UncertainAmount | None:
    if address.method == MEASURED:
        return getattr(run, address.item)
    return getattr(_predictor(rule, address, result).prediction(run.name), address.item, None)


def _attribute(
    rule: Rule,
    address: _Address,
    run: records.MeasuredRun,
    amount: records.UncertainAmount | None,
    compare_number: CompareNumber,
) -> Compared:
    if address.attribute == "difference":
        measured: records.UncertainAmount | None = getattr(run, address.item)
        there = None if amount is None or measured is None else abs(amount.value / measured.value - 1)
        return compare_number(rule, there, "1")
    value = error = interval = None
    if amount is not None:
        error = None if amount.std_error is None else HZ * amount.std_error
        value, interval = HZ * amount.value, records.UncertainAmount(HZ * amount.value, error).ci95
    if address.attribute == "covers":
        return compare_covers(rule, interval, "Hz")
    if address.attribute == "std_error":
        return compare_number(rule, error, "Hz")
    return compare_number(rule, value, "Hz", error)


def run_up_lines(result: records.RunUpResult) -> Iterator[str]:
    yield f"run-ups of {result.rotor}: critical speed / threshold [rpm]"
    rejected = {method.name for method in result.methods if method.verdict == records.REJECTED}
    names = [method.name + f" {records.REJECTED}" * (method.name in rejected) for method in result.methods]
    names.insert(0, MEASURED)
    yield f"  {'run':<12}{'load [N]':>9}" + "".join(f"{name:>17}" for name in names)
    for run in result.runs:
        columns = [run, *(method.prediction(run.name) for method in result.methods)]
        yield f"  {run.name:<12}{run.load:>9.4g}" + "".join(f"{_speeds(column):>17}" for column in columns)
    for method in result.methods:
        if method.rank is not None:
            chi2 = "" if method.chi2_per_datum is None else f", chi2 per datum {method.chi2_per_datum:.2f}"
            yield f"  {method.title}: {method.verdict}, rank {method.rank} of {method.unknowns}{chi2}"


def _speeds(owner: records.MeasuredRun | records.RunPrediction | None) -> str:
    speeds = () if owner is None else (owner.critical_speed, owner.threshold)
    return " / ".join("-" if speed is None else f"{60 * HZ * speed.value:.0f}" for speed in speeds) or "-"


RUN_UPS = PipelineSection(
    words="Coefficients from unbalance run-ups.",
    settings=RunUpSettings,
    standalone=True,
    run=lambda settings, work: identify_run_ups(settings, work.output, work.pipeline.folder, work.tell),
    record=records.RunUpResult,
    entry="run_ups",
    verdicts=lambda _: [("run_ups", records.VERDICTS)],
    outcome=run_up_outcome,
    findings=records.findings,
    parameters=listed_speeds_and_parameters,
    report=run_up_sections,
    cover=cover_facts,
    terminal=run_up_lines,
)
