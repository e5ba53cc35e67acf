"""``identification.json`` and ``fits/TEST.json``: fits with their uncertainty, the records of all other
sections.

Schema "labpipe/identification/2", or 3 for many tests, whose fits stand in a dataset; results of schema 1 are
read as well.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from labpipe import __version__
from labpipe.arrays import FloatArray
from labpipe.artefacts.digest import AGAIN, DamagedError
from labpipe.artefacts.header import SourceRef, code_digest
from labpipe.artefacts.json_file import (
    BAD_ENTRY,
    DIGEST,
    entry_of,
    named_entries,
    read_digested,
    record_of,
    values_of,
    write_digested,
)
from labpipe.errors import DataError, shorten
from labpipe.records.finding import NOTE, WARNING, Finding, of_level
from labpipe.records.fit_details import DETAILS
from labpipe.records.identification import Fit, Identification, RuleDecision, RuleOutcome
from labpipe.records.response import BlockCovariance, FrequencyResponse
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
        name: [named_entries(finding, "code", "message") for finding in of_level(level, findings)]
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
    made_by = {"schema": SCHEMA, "labpipe": __version__, "code": code_digest()}
    return {**made_by, "settings": entry_of(list(settings)), "responses": entry_of(list(responses))}


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
# Fields of every result that its file holds as they are.
_ALWAYS = ("code", "title", "pipeline", "sources", "inputs", "rig", "settings")


def write_identification(path: Path, identification: Identification) -> None:
    some = (name for name in ("failed", "dataset") if getattr(identification, name))
    spectra = [_spectra_entry(spectra) for spectra in identification.spectra]
    of_rules: dict[str, list[dict[str, Any]]] = {"accept": [], "expect": []}
    for outcome in identification.outcomes:
        decided = entry_of(outcome.decision) or {}
        of_rules[outcome.section].append(named_entries(outcome, "rule", "value", "passed") | decided)
    entries = {
        "schema": IDENTIFICATION_SCHEMA if identification.dataset is None else SCHEMA_OF_MANY,
        "labpipe": __version__,
        **named_entries(identification, *_ALWAYS, *some),
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


def _check_plain(entries: dict[str, Any]) -> None:
    """TypeError for files and tests that are none."""
    for reference in (*entries.get("sources", ()), *entries.get("inputs", ())):
        record_of(reference, SourceRef)
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
    there = (name for name in (*_ALWAYS, "failed", "dataset", DIGEST) if name in entries)
    return Identification(
        fits=tuple(read_fit(entry) for entry in entries["fits"]),
        **values_of({name: entries[name] for name in there}, Identification),
        responses=tuple(_response(entry) for entry in entries.get("responses", [])),
        spectra=tuple(_spectra(entry) for entry in entries.get("spectra", [])),
        outcomes=tuple(outcomes),
        version=record_of(entries["labpipe"], str),
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
    return {
        "test": response.name,
        **named_entries(response, "form", "outputs", "inputs"),
        "frequency_hz": entry_of(response.frequency),
        **named_entries(response, "matrix", "variance", *_OPTIONAL_ARRAYS),
        **({} if response.open_loop is None else named_entries(response, "open_loop")),
        **named_entries(response, "snr_channels", "averages", "covariance_dof", "conditions"),
        **finding_entries(response.findings),
    }


def _response(entry: dict[str, Any]) -> FrequencyResponse:
    names = ("form", "outputs", "inputs", "matrix", "snr_channels", "averages", *_COMMON)
    given = _choose(entry, *names) | {name: entry.get(name) for name in (*_OPTIONAL_ARRAYS, "open_loop")}
    covariance = None
    if entry["variance"] is not None:
        covariance = BlockCovariance.from_variance(record_of(entry["variance"], FloatArray))
    return FrequencyResponse(**values_of(given, FrequencyResponse), covariance=covariance)


_COMMON = ("covariance_dof", "conditions")


def _choose(entry: dict[str, Any], *names: str) -> dict[str, Any]:
    """Entries under the *names* of their fields, with those that are called otherwise in the file."""
    called = {"name": entry["test"], "frequency": entry["frequency_hz"], "findings": findings_of(entry)}
    return {**{name: entry[name] for name in names}, **called}


def _spectra_entry(spectra: ChannelSpectra) -> dict[str, Any]:
    """The spectra for reading and plotting: the variance of every channel, not the covariances (these stay in
    the spectra's file).
    """
    return {
        "test": spectra.name,
        **named_entries(spectra, "channels", "runs"),
        "frequency_hz": entry_of(spectra.frequency),
        "vectors": entry_of(spectra.vectors),
        "variance": np.einsum("lrcc->lrc", spectra.covariance).real.tolist(),
        **named_entries(spectra, *_COMMON),
        **finding_entries(spectra.findings),
    }


def _spectra(entry: dict[str, Any]) -> ChannelSpectra:
    variance = np.array(entry["variance"], np.float64)
    covariance = np.asarray(variance[..., None] * np.eye(variance.shape[-1]), np.complex128)
    given = values_of(_choose(entry, "channels", "runs", "vectors", *_COMMON), ChannelSpectra)
    return ChannelSpectra(**given, covariance=covariance)
