"""JSON entry of one fit: in identification.json, and in a separate file until all tests are done."""

from __future__ import annotations

from typing import Any

from labpipe.artefacts.typed_json import entry_of, record_of
from labpipe.records.finding import NOTE, WARNING, Finding, of_level
from labpipe.records.identification import Fit

_FINDING_LISTS = {"warnings": WARNING, "remarks": NOTE}


def fit_entry(fit: Fit) -> dict[str, Any]:
    """The entry of a fit, its findings as warnings and remarks."""
    entry: dict[str, Any] = entry_of(fit)
    del entry["findings"]
    return {**entry, "centre_hz": fit.centre_hz, **finding_entries(fit.findings)}


def read_fit(entry: dict[str, Any]) -> Fit:
    """The fit of its entry."""
    fit: Fit = record_of({**entry, "findings": findings_of(entry)}, Fit)
    return fit


def finding_entries(findings: tuple[Finding, ...]) -> dict[str, list[dict[str, str]]]:
    """Warnings and notes, separately."""
    return {
        name: [{"code": finding.code, "message": finding.message} for finding in of_level(level, findings)]
        for name, level in _FINDING_LISTS.items()
    }


def findings_of(entry: dict[str, Any]) -> list[dict[str, Any]]:
    """The findings of an entry that lists them as warnings and remarks, each with its level."""
    return [{**finding, "level": level} for name, level in _FINDING_LISTS.items() for finding in entry.get(name, [])]
