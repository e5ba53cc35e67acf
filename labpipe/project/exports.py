"""Artefacts as tables for other programs, and test signals for a signal generator."""

from __future__ import annotations

import csv
import re
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.csv as pc
import pyarrow.parquet as pq
import scipy

from labpipe import __version__
from labpipe.arrays import FloatArray
from labpipe.artefacts import measured_files
from labpipe.artefacts.identification_file import read_identification
from labpipe.artefacts.parquet import arrow_array, open_parquet
from labpipe.artefacts.recording_file import SUFFIX as RECORDING_SUFFIX, open_recording
from labpipe.artefacts.writing import cell, output_file, with_endings, write_table_csv
from labpipe.errors import ConfigError, DataError
from labpipe.project.deciding import stated_error
from labpipe.project.one_test import stated_day
from labpipe.raw_files.certificate import DCC, SI, dsi_unit
from labpipe.raw_files.frf_csv import write_frf_csv
from labpipe.raw_files.mat import write_frf_mat, write_recording_mat
from labpipe.raw_files.uff_write import write_frf_uff, write_recording_uff, write_shapes_uff
from labpipe.records.comparison import Study
from labpipe.records.finding import Parameter
from labpipe.records.fit_details import Modes, RobustPlant
from labpipe.records.identification import Fit, Identification, RuleOutcome, listed_parameters
from labpipe.uncertainty.amounts import random_error

# Endings of names of tables as text, and of universal files.
TEXT, UNIVERSAL = (".csv", ".txt", ".dat", ".asc"), (".uff", ".unv", ".uf")


@with_endings(*TEXT)
def write_csv(artefact: Path, target: Path) -> None:
    """An FRF as labpipe reads it again; samples and spectra by "name [unit]"; results as parameters."""
    table = _table(artefact)
    if table is None:
        write_frf_csv(target, measured_files.read_response(artefact))
    else:
        write_table_csv(table, target)


@with_endings(".parquet")
def write_parquet(artefact: Path, target: Path) -> None:
    """The same tables as Parquet, without labpipe's header."""
    table = _table(artefact)
    if table is None:
        measured_files.read_response(artefact)  # DataError for a file that is not a response
        table = open_parquet(artefact).read().to_pandas()
    table.to_parquet(target, index=False)


def _table(artefact: Path) -> pd.DataFrame | None:
    tables = {
        ".json": parameter_table,
        measured_files.DECAY_SUFFIX: decay_table,
        measured_files.SPECTRA_SUFFIX: spectra_table,
        RECORDING_SUFFIX: recording_table,
    }
    return next((table(artefact) for suffix, table in tables.items() if artefact.name.endswith(suffix)), None)


@with_endings(*UNIVERSAL)
def write_uff(artefact: Path, target: Path, binary: bool = False) -> None:
    """A recording or FRF as a universal file; of a result its mode shapes (records 15, 82 and 55)."""
    if artefact.suffix == ".json":
        write_shapes_uff(target, modal_fits(artefact))
    else:
        writers = partial(write_recording_uff, binary=binary), partial(write_frf_uff, binary=binary)
        _write_measured(artefact, target, "a universal file", *writers)


@with_endings(*UNIVERSAL)
def write_uff58b(artefact: Path, target: Path) -> None:
    """`write_uff` with binary numbers."""
    write_uff(artefact, target, binary=True)


@with_endings(".mat")
def write_mat(artefact: Path, target: Path) -> None:
    """A recording or an FRF as a MATLAB file."""
    if artefact.suffix == ".json":
        raise DataError("parameters cannot be written as a MATLAB file", artefact, "known: csv, parquet")
    _write_measured(artefact, target, "a MATLAB file", write_recording_mat, write_frf_mat)


@with_endings(*TEXT)
def write_shapes(artefact: Path, target: Path) -> None:
    """The mode shapes of a result as a table: one row per mode and point."""
    write_table_csv(shape_table(modal_fits(artefact)), target)


def modal_fits(artefact: Path) -> tuple[Fit, ...]:
    """The fits of a result that have modes; DataError where there is none."""
    hint = "parameters are written as csv or parquet"
    return tuple(fit for fit, _ in _fits_with(Modes, artefact, "holds no mode shapes", hint))


def result_of(artefact: Path, what: str) -> Identification:
    """The result of a file; DataError that says *what* any other artefact lacks."""
    if artefact.suffix != ".json":
        raise DataError(what, artefact, "name an identification.json, which has it")
    identification = read_identification(artefact)
    if identification.dataset is not None:
        hint = f"`labpipe list {artefact.parent} -p '*' --csv FILE` writes its parameters"
        raise DataError("keeps its numbers in a dataset beside it", artefact, hint)
    return identification


def _fits_with(kind: type[Any], artefact: Path, what: str, hint: str) -> tuple[tuple[Fit, Any], ...]:
    pairs = ((fit, fit.detail(kind)) for fit in result_of(artefact, what).fits)
    with_detail = tuple(pair for pair in pairs if pair[1] is not None)
    if not with_detail:
        raise DataError(what, artefact, hint)
    return with_detail


def shape_table(fits: Sequence[Fit]) -> pd.DataFrame:
    """One row per fit, mode and point: complex shape, standard error, and the place of the point if known."""
    rows = []
    for fit in fits:
        modes = fit.detail(Modes)
        assert modes is not None
        geometry = modes.geometry
        places = geometry.positions[[geometry.place(dof)[0] for dof in modes.dofs]] if geometry else None
        for mode, (frequency, ratio) in enumerate(zip(modes.frequency, modes.damping_ratio, strict=True)):
            for n, point in enumerate(modes.points):
                head = {"fit": fit.name, "test": fit.test, "mode": mode + 1}
                head |= {"frequency_hz": frequency, "damping_ratio": ratio, "point": point}
                place = dict(zip(("x_m", "y_m", "z_m"), places[n], strict=True)) if places is not None else {}
                value, error = modes.shapes[n, mode], modes.shape_std_errors[n, mode]
                shape = {"real": value.real, "imaginary": value.imag, "std_error": error}
                rows.append({**head, "dof": modes.dofs[n], **place, **shape})
    return pd.DataFrame(rows)


def recording_table(artefact: Path) -> pd.DataFrame:
    """Time in seconds and the channels in SI units."""
    record = open_recording(artefact).in_memory()
    names = [f"{channel.name} [{channel.unit}]" for channel in record.channels]
    table = pd.DataFrame(record.samples, columns=names)
    table.insert(0, "t [s]", np.arange(record.n_sample) / record.sample_rate)
    return table


def decay_table(artefact: Path) -> pd.DataFrame:
    """One row per sample: number of the decay from 1, recording, time in it [s], responses [SI]."""
    decays = measured_files.read_decays(artefact)
    names = [f"{port.label} [{unit}]" for port, unit in zip(decays.outputs, decays.units, strict=True)]
    tables = []
    for number, decay in enumerate(decays.decays, 1):
        times = decay.start + np.arange(len(decay.samples)) / decays.sample_rate
        head = {"decay": number, "recording": decay.recording, "t [s]": times}
        tables.append(pd.concat([pd.DataFrame(head), pd.DataFrame(decay.samples, columns=names)], axis=1))
    return pd.concat(tables, ignore_index=True)


def _write_measured(
    artefact: Path, target: Path, what: str, recording: Callable[..., None], frf: Callable[..., None]
) -> None:
    tables = {
        measured_files.SPECTRA_SUFFIX: "spectra of all channels",
        measured_files.DECAY_SUFFIX: "free decays",
    }
    for suffix, name in tables.items():
        if artefact.name.endswith(suffix):
            raise DataError(f"{name} cannot be written as {what}", artefact, "known: csv, parquet")
    if artefact.name.endswith(RECORDING_SUFFIX):
        recording(target, open_recording(artefact).in_memory())
    else:
        frf(target, measured_files.read_response(artefact))


def spectra_table(artefact: Path) -> pd.DataFrame:
    """One row per run and line: real and imaginary part and deviation of every channel "name [unit]"."""
    spectra = measured_files.read_spectra(artefact)
    tables = []
    for number, run in enumerate(spectra.runs):
        table = pd.DataFrame({"run": run, "frequency_hz": spectra.frequency})
        for column, channel in enumerate(spectra.channels):
            values = spectra.vectors[:, number, column]
            variance = spectra.covariance[:, number, column, column].real
            parts = (("re", values.real), ("im", values.imag), ("std", variance.clip(min=0) ** 0.5))
            for part, amounts in parts:
                table[f"{channel.name}:{part} [{channel.unit}]"] = amounts
        tables.append(table)
    return pd.concat(tables, ignore_index=True)


def parameter_table(artefact: Path) -> pd.DataFrame:
    """One row per parameter of the fits and of all other sections; DataError where there is none."""
    rows = []
    for listed in listed_parameters(result_of(artefact, "holds no parameters")):
        parameter, (low, high) = listed.parameter, listed.band_hz
        row = {name: getattr(listed, name) for name in ("fit", "test", "term")}
        row |= {"centre_hz": (low + high) / 2 if high else None, "parameter": parameter.name}
        row |= {"value": parameter.value, "unit": parameter.unit, "std_error": parameter.full_error}
        row |= dict(zip(("ci95_low", "ci95_high"), parameter.ci95 or (None, None), strict=True))
        rows.append({**row, "warnings": " ".join(listed.warnings)})
    if not rows:
        raise DataError("holds no parameters", artefact)
    return pd.DataFrame(rows)


NOISE = "noise"


@with_endings(*TEXT)
def write_covariance_csv(artefact: Path, target: Path) -> None:
    write_table_csv(covariance_table(artefact), target)


@with_endings(".parquet")
def write_covariance_parquet(artefact: Path, target: Path) -> None:
    covariance_table(artefact).to_parquet(target, index=False)


def covariance_table(artefact: Path) -> pd.DataFrame:
    """One row per test, fit, source and pair of parameters: covariance [product of the parameters' SI units];
    summed over the sources that of the combined uncertainties. Sources of one name are one error in all fits:
    between two they add the product of `change`, by one standard uncertainty. DataError for another artefact.
    """
    rows = [row for fit in result_of(artefact, "holds no parameters").fits for row in _rows(fit)]
    if not rows:
        raise DataError("no parameter of it has an uncertainty", artefact)
    return pd.DataFrame(rows)


def _rows(fit: Fit) -> Iterator[dict[str, object]]:
    names = [parameter.name for parameter in fit.parameters]
    low, high = fit.band_hz
    head = {"test": fit.test, "fit": fit.name, "term": fit.term, "band_low_hz": low, "band_high_hz": high}
    for source, matrix, changes in _covariance_by_source(fit):
        for row, column in zip(*np.nonzero(np.triu(np.isfinite(matrix) & (matrix != 0))), strict=True):
            pair = {"source": source, "parameter_1": names[row], "parameter_2": names[column]}
            size = {"covariance": matrix[row, column], "change_1": changes[row], "change_2": changes[column]}
            yield {**head, **pair, **size}


def _covariance_by_source(fit: Fit) -> Iterator[tuple[str, FloatArray, FloatArray]]:
    """Source, covariance (n, n) and change (n,) of all parameters by it [SI]; noise has no change."""
    # None becomes not-a-number.
    errors = np.array([random_error(fit, parameter) for parameter in fit.parameters], np.float64)
    correlation = np.eye(errors.size)
    n = min(fit.correlation.shape[0], errors.size)
    correlation[:n, :n] = fit.correlation[:n, :n]
    yield NOISE, correlation * np.outer(errors, errors), np.full(errors.size, np.nan)
    if fit.budget is not None:
        for source, changes in zip(fit.budget.sources, fit.budget.changes, strict=True):
            yield source.source, np.outer(changes, changes), changes


HEADER = (
    "fit,estimator,noise,lines,repeats,failed,parameter,unit,truth,mean,rmse,cramer_rao_bound,mean_std_error,"
    "coverage\n"
)


def write_study_csv(path: Path, study: Study) -> None:
    """Write the table; unknown values are left empty."""
    with path.open("w", encoding="utf-8", newline="") as stream:
        stream.write(HEADER)
        table = csv.writer(stream, lineterminator="\n")
        for case in study.cases:
            head = (case.fit, case.estimator, case.noise, case.lines, case.repeats, case.failed)
            for p in case.parameters:
                numbers = (p.unit, p.truth, p.mean, p.rmse, p.bound, p.std_error, p.coverage)
                table.writerow((*map(cell, (*head, p.name)), *numbers))


@with_endings(*TEXT)
def write_band_csv(artefact: Path, target: Path) -> None:
    """One row per fit, line, output and input: nominal plant, radius of its band, weight and overbound."""
    tables = []
    for fit, plant in _plants(artefact):
        for row, output in enumerate(plant.outputs):
            for column, input_name in enumerate(plant.inputs):
                values = plant.nominal[:, row, column]
                head = {"fit": fit.name, "test": fit.test, "output": output, "input": input_name}
                columns = {"unit": plant.unit, "frequency_hz": plant.frequency, "re": values.real}
                columns |= {"im": values.imag, "radius": plant.radius[:, row, column]}
                columns |= {"weight": plant.weight[:, row, column], "overbound": plant.bound(row, column)}
                tables.append(pd.DataFrame({**head, **columns, "confidence": plant.confidence}))
    write_table_csv(pd.concat(tables, ignore_index=True), target)


@with_endings(".mat")
def write_plant_mat(artefact: Path, target: Path) -> None:
    """State space A, B, C, D of the only fit with a plant, its response, radius and weight, and the
    overbound's k, zero and pole [Hz]. DataError for several such fits.
    """
    plants = _plants(artefact)
    if len(plants) > 1:
        named = ", ".join(f"{fit.name} {fit.test}".strip() for fit, _ in plants)
        what = f"holds {len(plants)} plants ({named}), a MATLAB file holds one"
        raise DataError(what, artefact, "--to band writes all")
    plant = plants[0][1]
    same = ("nominal", "radius", "weight", "overbound", "confidence")
    content = {letter: getattr(plant, letter.lower()) for letter in "ABCD"}
    content |= {"frequency_hz": plant.frequency} | {name: getattr(plant, name) for name in same}
    content |= {name: np.array(getattr(plant, name), object) for name in ("outputs", "inputs")}
    scipy.io.savemat(target, content)


def _plants(artefact: Path) -> tuple[tuple[Fit, RobustPlant], ...]:
    hint = "of fits of the model magnet, with one run per axis at least"
    return _fits_with(RobustPlant, artefact, "holds no plant", hint)


def write_signal(path: Path, samples: FloatArray, sample_rate: float, column: str = "u [V]") -> None:
    """Write *samples* (n_sample,) [V], or as the title of the *column* says, in the format of the suffix;
    ConfigError for other suffixes. A WAV file is scaled to full range.
    """
    suffix = path.suffix.lower()
    device = path.exists() and not path.is_file() and not path.is_dir()
    if suffix not in (".csv", ".parquet", ".wav") and not device:
        raise ConfigError(f"no signal format for the ending '{suffix}'", path, "known: .csv, .parquet, .wav")
    with output_file(path) as target:
        if suffix == ".wav":
            # 32-bit floats with peak 1; the file's rate is a whole number of hertz.
            if sample_rate != round(sample_rate):
                what = f"a WAV file cannot hold the sampling rate {sample_rate:g} Hz"
                raise ConfigError(what, hint="choose a whole number of hertz")
            full = (samples / np.max(np.abs(samples))).astype(np.float32)
            scipy.io.wavfile.write(target, round(sample_rate), full)
            return
        times = np.arange(samples.size) / sample_rate
        table = pa.table({"t [s]": arrow_array(times), column: arrow_array(samples)})
        if suffix == ".parquet":
            pq.write_table(table, target)
        else:
            pc.write_csv(table, target, pc.WriteOptions(quoting_style="none"))


# A result as XML after the Digital Calibration Certificate (DCC), for programs that read certificates. It is
# like a DCC and is none: labpipe knows no laboratory, customer or responsible person. What the schema asks
# for and nobody stated is said to be not stated; days stand in it only where a test states its date.

SCHEMA = "3.3.0"
NOT_STATED = "not stated"
# ISO 3166-1 keeps it for users: no country.
NO_COUNTRY = "ZZ"
# Outcomes of decisions as the schema writes them.
_CONFORMITY = {"conditional-pass": "conditionalPass", "conditional-fail": "conditionalFail"}


@with_endings(".xml")
def write_dcc(artefact: Path, target: Path) -> None:
    """The parameters of a result with their expanded uncertainties, and the outcomes of its rules; the same
    bytes for the same result. DataError for an artefact that is not a result.
    """
    identification = result_of(artefact, "cannot be written as a certificate")
    ET.register_namespace("dcc", DCC[1:-1])
    ET.register_namespace("si", SI[1:-1])
    root = ET.Element(f"{DCC}digitalCalibrationCertificate", schemaVersion=SCHEMA)
    owner = _child(root, "administrativeData")
    software = _name(_child(owner, "dccSoftware"), "software", "labpipe")
    _child(software, "release", identification.version or __version__)
    core = _child(owner, "coreData")
    _child(core, "countryCodeISO3166_1", NO_COUNTRY)
    _child(core, "usedLangCodeISO639_1", "en")
    _child(core, "mandatoryLangCodeISO639_1", "en")
    _child(core, "uniqueIdentifier", f"labpipe:{identification.digest or NOT_STATED}")
    days = sorted(filter(None, map(stated_day, identification.test_conditions.values())))
    if days:
        _child(core, "beginPerformanceDate", days[0])
        _child(core, "endPerformanceDate", days[-1])
    _child(core, "performanceLocation", "other")
    item = _name(_child(owner, "items"), "item", identification.rig.get("name") or NOT_STATED)
    identity = _child(_child(item, "identifications"), "identification")
    _child(identity, "issuer", "other")
    _child(identity, "value", identification.title or NOT_STATED)
    _locate(_name(_child(owner, "calibrationLaboratory"), "contact", NOT_STATED))
    _name(_child(_child(owner, "respPersons"), "respPerson"), "person", NOT_STATED)
    _locate(_name(owner, "customer", NOT_STATED))
    if identification.outcomes:
        statements = _child(owner, "statements")
        for outcome in identification.outcomes:
            _statement(_child(statements, "statement"), outcome)
    results = _child(root, "measurementResults")
    for number, fit in enumerate(identification.fits):
        _fit(_child(results, "measurementResult", id=f"fit{number + 1}"), fit, f"fit{number + 1}")
    ET.indent(root)
    target.write_bytes(ET.tostring(root, encoding="utf-8", xml_declaration=True) + b"\n")


def _child(owner: ET.Element, name: str, text: str = "", space: str = DCC, **attributes: str) -> ET.Element:
    child = ET.SubElement(owner, f"{space}{name}", attributes)
    # Without the characters that XML cannot hold.
    child.text = re.sub(r"[^\t\n\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]", "?", text) or None
    return child


def _name(owner: ET.Element, name: str, text: str) -> ET.Element:
    child = _child(owner, name)
    _child(_child(child, "name"), "content", text)
    return child


def _locate(contact: ET.Element) -> None:
    _child(_child(contact, "location"), "countryCode", NO_COUNTRY)


def _statement(owner: ET.Element, outcome: RuleOutcome) -> None:
    declared = f"{outcome.section}: {outcome.rule}; {outcome.found}"
    _child(_child(owner, "declaration"), "content", declared)
    word = "pass" if outcome.passed else "fail"
    word = word if outcome.decision is None else outcome.decision.outcome
    _child(owner, "conformity", _CONFORMITY.get(word, word))


def _fit(owner: ET.Element, fit: Fit, key: str) -> None:
    title = " ".join(filter(None, (fit.name, fit.term, f"[{fit.test}]" if fit.test else "")))
    _child(_child(owner, "name"), "content", title)
    band = f"{fit.band_hz[0]:g} Hz to {fit.band_hz[1]:g} Hz"
    _name(_child(owner, "usedMethods"), "usedMethod", f"{fit.model}, {fit.estimator}, {band}")
    listed = _child(_child(_name(_child(owner, "results"), "result", title), "data"), "list")
    for parameter in fit.parameters:
        _quantity(listed, parameter, key)


def _quantity(owner: ET.Element, parameter: Parameter, key: str) -> None:
    name = re.sub(r"[^A-Za-z0-9_.-]", "-", parameter.name)
    quantity = _name(owner, "quantity", parameter.name)
    quantity.set("id", f"{key}_{name}")
    real = _child(quantity, "real", space=SI)
    _child(real, "value", repr(parameter.value), SI)
    _child(real, "unit", dsi_unit(parameter.unit), SI)
    error = stated_error(parameter)
    if parameter.ci95 is None or not error:
        return
    half = (parameter.ci95[1] - parameter.ci95[0]) / 2
    univariate = _child(real, "measurementUncertaintyUnivariate", space=SI)
    expanded = _child(univariate, "expandedMU", space=SI)
    _child(expanded, "valueExpandedMU", repr(half), SI)
    _child(expanded, "coverageFactor", repr(half / error), SI)
    _child(expanded, "coverageProbability", "0.95", SI)
