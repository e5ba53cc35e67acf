"""``identification.json``, schema "labpipe/identification/1": all fits with their doubt, and the responses they came from."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from labpipe import __version__
from labpipe.artefacts.comparison_entry import comparison_entry, read_comparison
from labpipe.artefacts.study_entry import read_study
from labpipe.artefacts.unbalance_entry import read_unbalance
from labpipe.errors import DataError
from labpipe.records.finding import NOTE, WARNING, Finding, of_level
from labpipe.records.identification import Candidate, Fit, FittedCurve, Goodness, Identification, Parameter, Region, RuleOutcome
from labpipe.records.response import FrequencyResponse, Port, uncorrelated

SCHEMA = "labpipe/identification/1"
NAME = "identification.json"


def write_identification(path: Path, identification: Identification) -> None:
    """Write the result; not-a-number has no place in JSON, what cannot be given is null."""
    entries = {
        "schema": SCHEMA,
        "labpipe": __version__,
        "title": identification.title,
        "pipeline": identification.pipeline,
        "sources": list(identification.sources),
        "rig": identification.rig,
        "settings": identification.settings,
        "fits": [_fit_entry(fit) for fit in identification.fits],
        "accept": [_outcome_entry(outcome) for outcome in identification.outcomes if outcome.section == "accept"],
        "expect": [_outcome_entry(outcome) for outcome in identification.outcomes if outcome.section == "expect"],
        "comparisons": [comparison_entry(comparison) for comparison in identification.comparisons],
        "studies": [dataclasses.asdict(study) for study in identification.studies],
        "responses": [_response_entry(response) for response in identification.responses],
        **({} if identification.unbalance is None else {"unbalance": dataclasses.asdict(identification.unbalance)}),
    }
    path.write_text(json.dumps(_without_nan(entries), indent=1, allow_nan=False, ensure_ascii=False) + "\n", encoding="utf-8")


def read_identification(path: Path) -> Identification:
    """The result of an identification.json; DataError when the file is none."""
    try:
        entries = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise DataError("no such file", where=str(path), hint="run `labpipe identify` first") from None
    except (ValueError, IsADirectoryError) as error:
        raise DataError(f"is not a readable identification.json ({error})", where=str(path)) from None
    if not isinstance(entries, dict) or entries.get("schema") != SCHEMA:
        raise DataError(f"is not of schema {SCHEMA}", where=str(path))
    try:
        return _identification(entries)
    except (KeyError, TypeError, IndexError, ValueError) as error:
        # Same schema, other entries: written by another version, or edited by hand.
        written = f"was written by labpipe {entries.get('labpipe', '?')}, or edited ({type(error).__name__}: {error})"
        raise DataError(written, where=str(path), hint="run `labpipe identify` again") from None


def _identification(entries: dict[str, Any]) -> Identification:
    outcomes = [RuleOutcome(section, **entry) for section in ("accept", "expect") for entry in entries.get(section, [])]
    return Identification(
        fits=tuple(_fit(entry) for entry in entries["fits"]),
        title=entries["title"],
        pipeline=entries["pipeline"],
        sources=tuple(entries["sources"]),
        settings=entries.get("settings", {}),
        rig=entries.get("rig", {}),
        responses=tuple(_response(entry) for entry in entries.get("responses", [])),
        outcomes=tuple(outcomes),
        comparisons=tuple(read_comparison(entry) for entry in entries.get("comparisons", [])),
        studies=tuple(read_study(entry) for entry in entries.get("studies", [])),
        unbalance=read_unbalance(entries["unbalance"]) if "unbalance" in entries else None,
        version=entries["labpipe"],
    )


def _without_nan(entry: Any) -> Any:
    if isinstance(entry, dict):
        return {key: _without_nan(item) for key, item in entry.items()}
    if isinstance(entry, (list, tuple)):
        return [_without_nan(item) for item in entry]
    return None if isinstance(entry, float) and not math.isfinite(entry) else entry


def _outcome_entry(outcome: RuleOutcome) -> dict[str, Any]:
    return {"rule": outcome.rule, "value": outcome.value, "passed": outcome.passed}


def _fit_entry(fit: Fit) -> dict[str, Any]:
    return {
        **{name: getattr(fit, name) for name in ("name", "test", "term", "model", "estimator")},
        "band_hz": list(fit.band_hz),
        "centre_hz": fit.centre_hz,
        **{name: getattr(fit, name) for name in ("lines", "equations", "dof")},
        "gof": dataclasses.asdict(fit.gof),
        **{name: getattr(fit, name) for name in ("condition_number", "converged", "iterations")},
        "parameters": [dataclasses.asdict(parameter) for parameter in fit.parameters],
        "correlation": fit.correlation.tolist(),
        **_finding_entries(fit.findings),
        "notes": list(fit.notes),
        "candidates": [dataclasses.asdict(candidate) for candidate in fit.candidates],
        "curve": None if fit.curve is None else _curve_entry(fit.curve),
        **({} if fit.region is None else {"region": {**dataclasses.asdict(fit.region), "outline": fit.region.outline.tolist()}}),
    }


def _fit(entry: dict[str, Any]) -> Fit:
    plain = {name: entry[name] for name in ("name", "test", "model", "estimator", "lines", "equations", "dof", "converged", "iterations")}
    condition = entry["condition_number"]
    return Fit(
        **plain,
        term=entry.get("term", ""),
        band_hz=(entry["band_hz"][0], entry["band_hz"][1]),
        gof=Goodness(**entry["gof"]),
        condition_number=math.inf if condition is None else condition,
        parameters=tuple(_parameter(parameter) for parameter in entry["parameters"]),
        correlation=np.array(entry["correlation"], np.float64),
        findings=_findings(entry),
        notes=tuple(entry.get("notes", [])),
        candidates=tuple(Candidate(**candidate) for candidate in entry.get("candidates", [])),
        curve=None if entry.get("curve") is None else _curve(entry["curve"]),
        region=_region(entry["region"]) if "region" in entry else None,
    )


def _region(entry: dict[str, Any]) -> Region:
    return Region((entry["names"][0], entry["names"][1]), np.array(entry["outline"], np.float64), entry["level"])


_FINDING_LISTS = {"warnings": WARNING, "remarks": NOTE}


def _finding_entries(findings: tuple[Finding, ...]) -> dict[str, list[dict[str, str]]]:
    """Warnings, and apart from them what only informs."""
    return {
        name: [{"code": finding.code, "message": finding.message} for finding in of_level(level, findings)]
        for name, level in _FINDING_LISTS.items()
    }


def _findings(entry: dict[str, Any]) -> tuple[Finding, ...]:
    return tuple(Finding(**one, level=level) for name, level in _FINDING_LISTS.items() for one in entry.get(name, []))


def _parameter(entry: dict[str, Any]) -> Parameter:
    interval = entry["ci95"]
    return Parameter(**{**entry, "ci95": None if interval is None else (interval[0], interval[1])})


def _complex_entry(values: NDArray[np.complex128]) -> dict[str, Any]:
    return {"re": values.real.tolist(), "im": values.imag.tolist()}


def _complex(entry: dict[str, Any]) -> NDArray[np.complex128]:
    return np.array(entry["re"], np.float64) + 1j * np.array(entry["im"], np.float64)


def _curve_entry(curve: FittedCurve) -> dict[str, Any]:
    return {
        "frequency_hz": curve.frequency.tolist(),
        "measured": _complex_entry(curve.measured),
        "fitted": _complex_entry(curve.fitted),
        "variance": None if curve.variance is None else curve.variance.tolist(),
        "outputs": list(curve.outputs),
        "inputs": list(curve.inputs),
        "form": curve.form,
        **({} if curve.before is None else {"before": _complex_entry(curve.before)}),
    }


def _curve(entry: dict[str, Any]) -> FittedCurve:
    return FittedCurve(
        np.array(entry["frequency_hz"], np.float64),
        _complex(entry["measured"]),
        _complex(entry["fitted"]),
        None if entry["variance"] is None else np.array(entry["variance"], np.float64),
        tuple(entry["outputs"]),
        tuple(entry["inputs"]),
        entry["form"],
        _complex(entry["before"]) if "before" in entry else None,
    )


_OPTIONAL_ARRAYS = ("coherence", "multiple_coherence", "partial_coherence", "distortion", "snr")


def _response_entry(response: FrequencyResponse) -> dict[str, Any]:
    """The response for reading and plotting: its variance, not the whole covariance (that stays in the FRF file)."""
    variance = response.variance
    optional = {name: getattr(response, name) for name in _OPTIONAL_ARRAYS}
    return {
        "test": response.name,
        "form": response.form,
        "outputs": [dataclasses.asdict(port) for port in response.outputs],
        "inputs": [dataclasses.asdict(port) for port in response.inputs],
        "frequency_hz": response.frequency.tolist(),
        "matrix": _complex_entry(response.matrix),
        "variance": None if variance is None else variance.tolist(),
        **{name: None if values is None else values.tolist() for name, values in optional.items()},
        "snr_channels": list(response.snr_channels),
        "averages": response.averages,
        "covariance_dof": response.covariance_dof,
        "conditions": response.conditions,
        **_finding_entries(response.findings),
    }


def _response(entry: dict[str, Any]) -> FrequencyResponse:
    matrix = _complex(entry["matrix"])
    variance = entry["variance"]
    dof = entry["covariance_dof"]
    return FrequencyResponse(
        frequency=np.array(entry["frequency_hz"], np.float64),
        matrix=matrix,
        outputs=tuple(Port(**port) for port in entry["outputs"]),
        inputs=tuple(Port(**port) for port in entry["inputs"]),
        form=entry["form"],
        covariance=None if variance is None else uncorrelated(np.array(variance, np.float64)),
        **{name: None if entry.get(name) is None else np.array(entry[name], np.float64) for name in _OPTIONAL_ARRAYS},
        snr_channels=tuple(entry["snr_channels"]),
        averages=entry["averages"],
        covariance_dof=math.inf if dof is None else dof,
        name=entry["test"],
        findings=_findings(entry),
        conditions=entry["conditions"],
    )
