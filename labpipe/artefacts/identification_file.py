"""``identification.json`` and ``fits/TEST.json``: fits with their uncertainty, the records of all other
sections.

Schema "labpipe/identification/2", or 3 for many tests, whose fits stand in a dataset; results of schema 1 are
read as well.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from labpipe import __version__
from labpipe.arrays import ComplexArray
from labpipe.artefacts.digest import AGAIN, DamagedError
from labpipe.artefacts.header import SourceRef, code_digest
from labpipe.artefacts.json_file import BAD_ENTRY, DIGEST, entry_of, read_digested, record_of, write_digested
from labpipe.errors import DataError, shorten
from labpipe.records.finding import NOTE, WARNING, Finding, of_level
from labpipe.records.fit_details import DETAILS
from labpipe.records.identification import (
    DatasetIndex,
    Failed,
    Fit,
    Identification,
    RuleDecision,
    RuleOutcome,
)
from labpipe.records.recording import Channel
from labpipe.records.response import BlockCovariance, FrequencyResponse, Port
from labpipe.records.sections import section, sections
from labpipe.records.spectra import ChannelSpectra

_FINDING_LISTS = {"warnings": WARNING, "remarks": NOTE}


def fit_entry(fit: Fit) -> dict[str, Any]:
    """The entry of a fit, its findings as warnings and remarks."""
    entry: dict[str, Any] = entry_of(fit)
    del entry["findings"]
    entry |= dict.fromkeys(DETAILS.names()) | {detail.key: entry_of(detail) for detail in fit.details}
    return {**entry, "centre_hz": fit.centre_hz, **finding_entries(fit.findings)}


def read_fit(entry: dict[str, Any]) -> Fit:
    """The fit of its entry."""
    fit: Fit = record_of({**entry, "findings": findings_of(entry)}, Fit)
    kinds = ((key, DETAILS.load(key)) for key in DETAILS.names() if entry.get(key) is not None)
    return replace(
        fit,
        # Of no estimate it is an empty list.
        correlation=fit.correlation.reshape(2 * (len(fit.correlation),)),
        details=tuple(record_of(entry[key], kind.record) for key, kind in kinds),
    )


def finding_entries(findings: tuple[Finding, ...]) -> dict[str, list[dict[str, str]]]:
    """Warnings and notes, separately."""
    return {
        name: [{"code": finding.code, "message": finding.message} for finding in of_level(level, findings)]
        for name, level in _FINDING_LISTS.items()
    }


def findings_of(entry: dict[str, Any]) -> list[dict[str, Any]]:
    """The findings of an entry that lists them as warnings and remarks, each with its level."""
    return [
        {**finding, "level": level}
        for name, level in _FINDING_LISTS.items()
        for finding in entry.get(name, [])
    ]


# ``fits/TEST.json``: the fits of one test among many, so that an interrupted run can be resumed.

SCHEMA = "labpipe/fits/1"
FOLDER = "fits"


def _work(settings: Sequence[Any], responses: Sequence[SourceRef]) -> dict[str, Any]:
    """What the fits depend on: equal work gives equal fits."""
    entry = {
        "schema": SCHEMA,
        "labpipe": __version__,
        "code": code_digest(),
        "settings": [entry_of(fit) for fit in settings],
        "responses": [asdict(response) for response in responses],
    }
    return json.loads(json.dumps(entry))


def write_fits(
    path: Path, fits: Sequence[Fit], settings: Sequence[Any], responses: Sequence[SourceRef]
) -> None:
    """Write the fits with the settings and the checksums of the responses they were made from."""
    write_digested(path, {**_work(settings, responses), "fits": [fit_entry(fit) for fit in fits]})


def has_fresh_fits(path: Path, settings: Sequence[Any], responses: Sequence[SourceRef]) -> bool:
    """True if the file holds the fits of these settings and responses; DamagedError for another file."""
    if not path.exists():
        return False
    entries = read_digested(path, "file of fits")
    work = _work(settings, responses)
    if {key: entries.get(key) for key in work} != work:
        return False
    if DIGEST not in entries:
        raise DamagedError("carries no digest", path)
    return True


def read_fits(path: Path) -> list[Fit]:
    """The fits of a file that `write_fits` wrote; DamagedError for another one."""
    return fits_with_digest(path)[0]


def fits_with_digest(path: Path) -> tuple[list[Fit], str]:
    """The fits of a file that `write_fits` wrote, and its digest; DamagedError for another one."""
    try:
        entries = read_digested(path, "file of fits")
        return [read_fit(entry) for entry in entries["fits"]], str(entries.get(DIGEST, ""))
    except BAD_ENTRY as error:
        raise DamagedError(f"is not readable as fits ({shorten(str(error))})", path, AGAIN) from None


IDENTIFICATION_SCHEMA = "labpipe/identification/2"
# Of a result of so many tests that their fits and responses stand elsewhere.
SCHEMA_OF_MANY = "labpipe/identification/3"
READ_SCHEMAS = ("labpipe/identification/1", IDENTIFICATION_SCHEMA, SCHEMA_OF_MANY)
NAME = "identification.json"


def write_identification(path: Path, identification: Identification) -> None:
    """Write the result."""
    failed = [asdict(failed) for failed in identification.failed]
    spectra = [_spectra_entry(spectra) for spectra in identification.spectra]
    of_rules: dict[str, list[dict[str, Any]]] = {"accept": [], "expect": []}
    for outcome in identification.outcomes:
        of_rules[outcome.section].append(_outcome_entry(outcome))
    entries = {
        "schema": IDENTIFICATION_SCHEMA if identification.dataset is None else SCHEMA_OF_MANY,
        "labpipe": __version__,
        "code": identification.code,
        "title": identification.title,
        "pipeline": identification.pipeline,
        "sources": list(identification.sources),
        "inputs": list(identification.inputs),
        "rig": identification.rig,
        "settings": identification.settings,
        **({"failed": failed} if failed else {}),
        **({} if identification.dataset is None else {"dataset": entry_of(identification.dataset)}),
        "fits": [fit_entry(fit) for fit in identification.fits],
        **of_rules,
        **_found_entries(identification.outcomes),
        "responses": [_response_entry(response) for response in identification.responses],
        **({"spectra": spectra} if spectra else {}),
        **{section(name).entry: entry_of(record) for name, record in identification.sections.items()},
    }
    write_digested(path, entries)


def read_identification(path: Path) -> Identification:
    """The result of an identification.json; DataError for another file, or one changed since."""
    try:
        entries = read_digested(path, NAME)
    except FileNotFoundError:
        raise DataError("no such file", path, "run `labpipe identify` first") from None
    if entries.get("schema") not in READ_SCHEMAS:
        raise DataError(f"is not of schema {IDENTIFICATION_SCHEMA}", path)
    try:
        return _identification(_upgrade(entries))
    except BAD_ENTRY as error:
        # Same schema, other entries: written by another version, or edited by hand.
        version = shorten(str(entries.get("labpipe", "?")))
        written = (
            f"was written by labpipe {version}, or edited ({type(error).__name__}: {shorten(str(error))})"
        )
        raise DataError(written, path, "run `labpipe identify` again") from None


def _upgrade(entries: dict[str, Any]) -> dict[str, Any]:
    """Schema 1 called the frequency of a fitted curve frequency_hz, and had empty lists for sections that a
    pipeline did not have.
    """
    if entries["schema"] in (IDENTIFICATION_SCHEMA, SCHEMA_OF_MANY):
        return entries
    fits = []
    for fit in entries["fits"]:
        curve = fit.get("curve")
        curve = None if curve is None else {**curve, "frequency": curve["frequency_hz"]}
        fits.append({**fit, "curve": curve})
    return {**{name: entry for name, entry in entries.items() if entry != []}, "fits": fits}


_REFERENCES = tuple[Mapping[str, str], ...]
# Entries that are kept as they are, by the type that readers rely on.
_PLAIN: dict[str, Any] = {
    "title": str, "pipeline": str, "labpipe": str, "code": str, "settings": Mapping[str, Any],
    "rig": Mapping[str, Any],
    "sources": _REFERENCES, "inputs": _REFERENCES, "found": Mapping[str, tuple[str, ...]],
}  # fmt: skip


def _check_plain(entries: dict[str, Any]) -> None:
    """TypeError for a plain entry of another type, and for tests that are no tests."""
    for name, kind in _PLAIN.items():
        if name in entries:
            record_of(entries[name], kind)
    for reference in (*entries.get("sources", ()), *entries.get("inputs", ())):
        record_of({"path": reference["path"], "sha256": reference["sha256"]}, Mapping[str, str])
    tests = record_of(entries.get("settings", {}).get("tests", []), tuple[Mapping[str, Any], ...])
    for test in tests:
        record_of(test["name"], str)
    for test in (*tests, *entries.get("responses", ()), *entries.get("spectra", ())):
        for condition in record_of(test["conditions"], Mapping[str, Any]).values():
            if not isinstance(condition, (str, int, float)):
                raise TypeError(f"{shorten(repr(condition))} is not a condition")


def _identification(entries: dict[str, Any]) -> Identification:
    _check_plain(entries)
    outcomes = [outcome for key in ("accept", "expect") for outcome in _outcomes(entries, key)]
    return Identification(
        fits=tuple(read_fit(entry) for entry in entries["fits"]),
        title=entries["title"],
        pipeline=entries["pipeline"],
        sources=tuple(entries["sources"]),
        settings=entries.get("settings", {}),
        rig=entries.get("rig", {}),
        responses=tuple(_response(entry) for entry in entries.get("responses", [])),
        spectra=tuple(_spectra(entry) for entry in entries.get("spectra", [])),
        outcomes=tuple(outcomes),
        version=entries["labpipe"],
        failed=tuple(Failed(**entry) for entry in entries.get("failed", [])),
        inputs=tuple(entries.get("inputs", [])),
        code=entries.get("code", ""),
        digest=entries.get(DIGEST, ""),
        dataset=record_of(entries["dataset"], DatasetIndex) if "dataset" in entries else None,
        sections=_records(entries),
    )


# What every result has; other keys are those of sections, which are loaded only then.
_WITHOUT_SECTIONS = {
    "schema", "labpipe", "title", "pipeline", "sources", "settings", "rig", "responses", "spectra", "fits",
    "accept", "expect", "found", "failed", "inputs", "code", "dataset", DIGEST,
}  # fmt: skip


def _records(entries: dict[str, Any]) -> dict[str, Any]:
    if set(entries) <= _WITHOUT_SECTIONS:
        return {}
    there = ((name, part) for name, part in sections() if part.entry in entries)
    return {name: record_of(entries[part.entry], part.record) for name, part in there}


def _outcome_entry(outcome: RuleOutcome) -> dict[str, Any]:
    entry = {"rule": outcome.rule, "value": outcome.value, "passed": outcome.passed}
    return entry if outcome.decision is None else {**entry, **entry_of(outcome.decision)}


def _found_entries(outcomes: Sequence[RuleOutcome]) -> dict[str, Any]:
    """The values in the rules' own units, beside the rules: readers of an earlier labpipe take no further key
    of a rule.
    """
    keys = ("accept", "expect")
    entries = {key: [outcome.shown for outcome in outcomes if outcome.section == key] for key in keys}
    return {"found": entries} if any(any(texts) for texts in entries.values()) else {}


def _outcomes(entries: dict[str, Any], key: str) -> list[RuleOutcome]:
    rules, outcomes = entries.get(key, []), []
    texts = entries.get("found", {}).get(key) or [""] * len(rules)
    for entry, shown in zip(rules, texts, strict=True):
        decision = record_of(entry, RuleDecision) if "outcome" in entry else None
        outcome = record_of({**entry, "section": key, "shown": shown}, RuleOutcome)
        outcomes.append(replace(outcome, decision=decision))
    return outcomes


_OPTIONAL_ARRAYS = ("coherence", "multiple_coherence", "partial_coherence", "distortion", "snr")


def _response_entry(response: FrequencyResponse) -> dict[str, Any]:
    """The response for reading and plotting: its variance, not the whole covariance (that stays in the FRF
    file).
    """
    variance = response.variance
    optional = {name: getattr(response, name) for name in _OPTIONAL_ARRAYS}
    return {
        "test": response.name,
        "form": response.form,
        "outputs": [asdict(port) for port in response.outputs],
        "inputs": [asdict(port) for port in response.inputs],
        "frequency_hz": response.frequency.tolist(),
        "matrix": entry_of(response.matrix),
        "variance": None if variance is None else variance.tolist(),
        **{name: None if values is None else values.tolist() for name, values in optional.items()},
        **({} if response.open_loop is None else {"open_loop": entry_of(response.open_loop)}),
        "snr_channels": list(response.snr_channels),
        "averages": response.averages,
        "covariance_dof": response.covariance_dof,
        "conditions": response.conditions,
        **finding_entries(response.findings),
    }


def _response(entry: dict[str, Any]) -> FrequencyResponse:
    matrix: ComplexArray = record_of(entry["matrix"], ComplexArray)
    variance = entry["variance"]
    dof = entry["covariance_dof"]
    optional: dict[str, Any] = {
        name: None if entry.get(name) is None else np.array(entry[name], np.float64)
        for name in _OPTIONAL_ARRAYS
    }
    return FrequencyResponse(
        frequency=np.array(entry["frequency_hz"], np.float64),
        matrix=matrix,
        outputs=tuple(Port(**port) for port in entry["outputs"]),
        inputs=tuple(Port(**port) for port in entry["inputs"]),
        form=entry["form"],
        covariance=None
        if variance is None
        else BlockCovariance.from_variance(np.array(variance, np.float64)),
        **optional,
        open_loop=record_of(entry["open_loop"], ComplexArray) if "open_loop" in entry else None,
        snr_channels=tuple(entry["snr_channels"]),
        averages=entry["averages"],
        covariance_dof=math.inf if dof is None else dof,
        name=entry["test"],
        findings=record_of(findings_of(entry), tuple[Finding, ...]),
        conditions=entry["conditions"],
    )


def _spectra_entry(spectra: ChannelSpectra) -> dict[str, Any]:
    """The spectra for reading and plotting: the variance of every channel, not the covariances (these stay in
    the spectra's file).
    """
    return {
        "test": spectra.name,
        "channels": [asdict(channel) for channel in spectra.channels],
        "runs": list(spectra.runs),
        "frequency_hz": spectra.frequency.tolist(),
        "vectors": entry_of(spectra.vectors),
        "variance": np.einsum("lrcc->lrc", spectra.covariance).real.tolist(),
        "covariance_dof": spectra.covariance_dof,
        "conditions": spectra.conditions,
        **finding_entries(spectra.findings),
    }


def _spectra(entry: dict[str, Any]) -> ChannelSpectra:
    variance = np.array(entry["variance"], np.float64)
    dof = entry["covariance_dof"]
    return ChannelSpectra(
        frequency=np.array(entry["frequency_hz"], np.float64),
        vectors=record_of(entry["vectors"], ComplexArray),
        covariance=np.asarray(variance[..., None] * np.eye(variance.shape[-1]), np.complex128),
        channels=tuple(Channel(**channel) for channel in entry["channels"]),
        runs=tuple(entry["runs"]),
        covariance_dof=math.inf if dof is None else dof,
        name=entry["test"],
        findings=record_of(findings_of(entry), tuple[Finding, ...]),
        conditions=entry["conditions"],
    )
