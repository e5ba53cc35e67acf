"""One fit as it stands in JSON: in identification.json, and on its own while other tests are still at work."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from labpipe.records.finding import NOTE, WARNING, Finding, of_level
from labpipe.records.identification import Candidate, Fit, FittedCurve, Goodness, Parameter, Region


def fit_entry(fit: Fit) -> dict[str, Any]:
    return {
        **{name: getattr(fit, name) for name in ("name", "test", "term", "model", "estimator")},
        "band_hz": list(fit.band_hz),
        "centre_hz": fit.centre_hz,
        **{name: getattr(fit, name) for name in ("lines", "equations", "dof")},
        "gof": dataclasses.asdict(fit.gof),
        **{name: getattr(fit, name) for name in ("condition_number", "converged", "iterations")},
        "parameters": [dataclasses.asdict(parameter) for parameter in fit.parameters],
        "correlation": fit.correlation.tolist(),
        **finding_entries(fit.findings),
        "notes": list(fit.notes),
        "candidates": [dataclasses.asdict(candidate) for candidate in fit.candidates],
        "curve": None if fit.curve is None else _curve_entry(fit.curve),
        **({} if fit.region is None else {"region": {**dataclasses.asdict(fit.region), "outline": fit.region.outline.tolist()}}),
    }


def read_fit(entry: dict[str, Any]) -> Fit:
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
        findings=read_findings(entry),
        notes=tuple(entry.get("notes", [])),
        candidates=tuple(Candidate(**candidate) for candidate in entry.get("candidates", [])),
        curve=None if entry.get("curve") is None else _curve(entry["curve"]),
        region=_region(entry["region"]) if "region" in entry else None,
    )


def _region(entry: dict[str, Any]) -> Region:
    return Region((entry["names"][0], entry["names"][1]), np.array(entry["outline"], np.float64), entry["level"])


_FINDING_LISTS = {"warnings": WARNING, "remarks": NOTE}


def finding_entries(findings: tuple[Finding, ...]) -> dict[str, list[dict[str, str]]]:
    """Warnings, and apart from them what only informs."""
    return {
        name: [{"code": finding.code, "message": finding.message} for finding in of_level(level, findings)]
        for name, level in _FINDING_LISTS.items()
    }


def read_findings(entry: dict[str, Any]) -> tuple[Finding, ...]:
    return tuple(Finding(**one, level=level) for name, level in _FINDING_LISTS.items() for one in entry.get(name, []))


def _parameter(entry: dict[str, Any]) -> Parameter:
    interval = entry["ci95"]
    return Parameter(**{**entry, "ci95": None if interval is None else (interval[0], interval[1])})


def complex_entry(values: NDArray[np.complex128]) -> dict[str, Any]:
    return {"re": values.real.tolist(), "im": values.imag.tolist()}


def read_complex(entry: dict[str, Any]) -> NDArray[np.complex128]:
    return np.array(entry["re"], np.float64) + 1j * np.array(entry["im"], np.float64)


def _curve_entry(curve: FittedCurve) -> dict[str, Any]:
    return {
        "frequency_hz": curve.frequency.tolist(),
        "measured": complex_entry(curve.measured),
        "fitted": complex_entry(curve.fitted),
        "variance": None if curve.variance is None else curve.variance.tolist(),
        "outputs": list(curve.outputs),
        "inputs": list(curve.inputs),
        "form": curve.form,
        **({} if curve.before is None else {"before": complex_entry(curve.before)}),
        **_dense_entry(curve),
    }


def _dense_entry(curve: FittedCurve) -> dict[str, Any]:
    """The model between the lines, where it was computed."""
    if curve.dense_frequency is None or curve.dense is None:
        return {}
    return {"dense_frequency_hz": curve.dense_frequency.tolist(), "dense": complex_entry(curve.dense)}


def _curve(entry: dict[str, Any]) -> FittedCurve:
    return FittedCurve(
        np.array(entry["frequency_hz"], np.float64),
        read_complex(entry["measured"]),
        read_complex(entry["fitted"]),
        None if entry["variance"] is None else np.array(entry["variance"], np.float64),
        tuple(entry["outputs"]),
        tuple(entry["inputs"]),
        entry["form"],
        read_complex(entry["before"]) if "before" in entry else None,
        np.array(entry["dense_frequency_hz"], np.float64) if "dense_frequency_hz" in entry else None,
        read_complex(entry["dense"]) if "dense" in entry else None,
    )
