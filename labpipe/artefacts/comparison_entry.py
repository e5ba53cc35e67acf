"""A comparison as it stands in identification.json."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

from labpipe.records.comparison import ComparedBand, ComparedPoint, Comparison, Curve, Overlay
from labpipe.records.finding import Finding
from labpipe.records.identification import Parameter


def comparison_entry(comparison: Comparison) -> dict[str, Any]:
    return dataclasses.asdict(comparison)


def read_comparison(entry: dict[str, Any]) -> Comparison:
    """The comparison of its entry; a null value is not a number (JSON has none)."""
    return Comparison(
        **{
            **entry,
            "points": tuple(_point(point) for point in entry["points"]),
            "amounts": tuple(_amount(amount) for amount in entry["amounts"]),
            "line": tuple((x, y) for x, y in entry["line"]),
            "overlays": tuple(_overlay(overlay) for overlay in entry["overlays"]),
            "bands": tuple(_band(band) for band in entry.get("bands", [])),
            "curves": tuple(Curve(**{key: _sequence(value) for key, value in curve.items()}) for curve in entry.get("curves", [])),
            "correlations": tuple((one, other, value) for one, other, value in entry.get("correlations", [])),
            "findings": tuple(Finding(**finding) for finding in entry.get("findings", [])),
        }
    )


def _overlay(entry: dict[str, Any]) -> Overlay:
    curves = {name: tuple(entry[name]) for name in ("frequency", "measured", "theory", "matched")}
    return Overlay(entry["test"], entry["form"], **curves)


def _sequence(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


def _band(entry: dict[str, Any]) -> ComparedBand:
    return ComparedBand(**{key: _sequence(value) for key, value in entry.items()})


def _interval(entry: list[float] | None) -> tuple[float, float] | None:
    return None if entry is None else (entry[0], entry[1])


def _point(entry: dict[str, Any]) -> ComparedPoint:
    return ComparedPoint(**{**entry, "ci95": _interval(entry["ci95"]), "ratio_ci95": _interval(entry["ratio_ci95"])})


def _amount(entry: dict[str, Any]) -> Parameter:
    value = math.nan if entry["value"] is None else entry["value"]
    return Parameter(**{**entry, "value": value, "ci95": _interval(entry["ci95"])})
