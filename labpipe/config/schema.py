"""The JSON schema (draft 2020-12) of rig and pipeline files, made from the same settings that read them."""

from __future__ import annotations

from typing import Any

from labpipe.campaign.settings import CompareSettings
from labpipe.config.calibration import CalibrationSettings
from labpipe.config.pipeline import ReportSettings
from labpipe.config.rig import ChannelSettings, RigSettings
from labpipe.identify.settings import FitSettings
from labpipe.records.settings import Setting, settings_of
from labpipe.rigs.unbalance_runs import UnbalanceSettings, WearCase
from labpipe.run_ups.settings import RunSettings, RunUpSettings
from labpipe.spectra.settings import FrfSettings
from labpipe.study.settings import StudySettings

DRAFT = "https://json-schema.org/draft/2020-12/schema"
_TEXT_OR_NUMBER: dict[str, Any] = {"type": ["string", "number"]}
_TEXTS: dict[str, Any] = {"anyOf": [{"type": "string"}, {"type": "array", "items": {"type": "string"}}]}


def rig_schema() -> dict[str, Any]:
    """The schema of a rig file."""
    schema = _object(RigSettings)
    schema["properties"]["channels"] = {"type": "object", "additionalProperties": _object(ChannelSettings)}
    schema["required"] = ["channels"]
    return {"$schema": DRAFT, "title": "labpipe rig", **schema}


def pipeline_schema() -> dict[str, Any]:
    """The schema of a pipeline file."""
    entry = {
        "type": "object",
        "properties": {"file": {"type": "string"}, "rig": {"type": "string"}, "channels": {"type": "object"}},
        "required": ["file"],
        "additionalProperties": False,
    }
    recordings = {"anyOf": [{"type": "string"}, {"type": "array", "items": {"anyOf": [{"type": "string"}, entry]}}]}
    conditions = {"type": "object", "additionalProperties": _TEXT_OR_NUMBER}
    test = {
        "name": {"type": "string"},
        "recordings": recordings,
        "frfs": _TEXTS,
        "each": {**recordings, "description": "files of which each is a test of its own, under the file's name"},
        "pattern": {"type": "string", "description": "conditions in the file's name, for example {preload}-{direction}"},
        "conditions": conditions,
    }
    rules = {"type": "object", "additionalProperties": {"anyOf": [_TEXT_OR_NUMBER, {"type": "boolean"}, {"type": "array"}]}}
    properties = {
        "title": {"type": "string"},
        "rig": {"type": "string", "description": "rig file, relative to this file"},
        "recordings": recordings,
        "tests": {"type": "array", "items": {"type": "object", "properties": test, "additionalProperties": False}},
        "frfs": _TEXTS,
        "conditions": conditions,
        "frf": _object(FrfSettings),
        "identify": {"type": "object", "additionalProperties": _object(FitSettings)},
        "study": _object(StudySettings),
        "unbalance": _unbalance(),
        "run_ups": _run_ups(),
        "calibrate": {"type": "object", "additionalProperties": _object(CalibrationSettings)},
        "compare": {"type": "object", "additionalProperties": _object(CompareSettings)},
        "report": _object(ReportSettings),
        "accept": rules,
        "expect": rules,
    }
    return {
        "$schema": DRAFT,
        "title": "labpipe pipeline",
        "type": "object",
        "properties": properties,
        "additionalProperties": False,
    }


def _object(owner: type) -> dict[str, Any]:
    settings = settings_of(owner)
    properties = {name: {**_kind(setting), "description": _described(setting)} for name, (setting, _) in settings.items()}
    required = [name for name, (_, needed) in settings.items() if needed]
    return {"type": "object", "properties": properties, "required": required, "additionalProperties": False}


def _described(setting: Setting) -> str:
    return f"{setting.help} [{setting.unit}]" if setting.unit else setting.help


def _kind(setting: Setting) -> dict[str, Any]:
    if setting.kind == "section":
        assert setting.section is not None
        return _object(setting.section)
    return {
        "value": _TEXT_OR_NUMBER,
        "uncertain": _TEXT_OR_NUMBER,
        "band": {"type": "string"},
        "bands": _TEXTS,
        "peaks": {"type": "object", "additionalProperties": _TEXTS},
        "integer": {"type": "integer", "minimum": 0},
        "flag": {"type": "boolean"},
        "text": _TEXT_OR_NUMBER,
        "choice": {"enum": list(setting.choices)},
        "names": _TEXTS,
        "mass": {"type": ["string", "number", "array"]},
        "values": {"anyOf": [_TEXT_OR_NUMBER, {"type": "array", "items": _TEXT_OR_NUMBER}]},
        "matrix": {"type": "array", "items": {"type": "array", "items": _TEXT_OR_NUMBER}},
        "coefficients": {"type": "object", "additionalProperties": _TEXT_OR_NUMBER},
        "groups": {"type": "array"},
        "series": {"type": "object"},
    }[setting.kind]


def _unbalance() -> dict[str, Any]:
    """The section `unbalance:`; its cases have names of their own."""
    section = _object(UnbalanceSettings)
    section["properties"]["cases"] = {"type": "object", "additionalProperties": _object(WearCase)}
    return section


def _run_ups() -> dict[str, Any]:
    """The section `run_ups:`; its runs are a list, unbalances have the names of planes."""
    run = _object(RunSettings)
    unbalance = "known unbalance by plane, instead of the table's: {disc 1: 50 g.mm at 0 deg}"
    run["properties"]["unbalance"] = {"type": "object", "additionalProperties": _TEXT_OR_NUMBER, "description": unbalance}
    section = _object(RunUpSettings)
    section["properties"]["runs"] = {"type": "array", "items": run}
    section["required"].append("runs")
    return section
