"""The JSON schema (draft 2020-12) of pipeline, rig and bearing files, from the settings that read them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from labpipe.bearings.kinds import BEARINGS
from labpipe.estimation.settings import MODELS, FitSettings, model_kind, models_text
from labpipe.project.calibrations import CertificateSettings
from labpipe.project.pipeline_file import RESULTS, ReportSettings, UncertaintySettings
from labpipe.project.rig_file import ChannelSettings, RigSettings
from labpipe.project.rules import DECISION_KEYS, DECISIONS
from labpipe.project.tests import BY, REPEATS
from labpipe.records.frf_layout import FrfLayout
from labpipe.records.rig import Span
from labpipe.records.sections import PipelineSection, sections
from labpipe.records.settings import Setting, settings_of
from labpipe.registry import Registry
from labpipe.spectra.settings import FrfSettings
from labpipe.uncertainty.settings import COMPARISONS, CompareSettings, comparison_kind, kinds_text

DRAFT = "https://json-schema.org/draft/2020-12/schema"


def _mapping_of(schema: Mapping[str, Any]) -> dict[str, Any]:
    return {"type": "object", "additionalProperties": schema}


def _list_of(schema: Mapping[str, Any]) -> dict[str, Any]:
    return {"type": "array", "items": schema}


_TEXT_OR_NUMBER: dict[str, Any] = {"type": ["string", "number"]}
_TEXTS_OR_NUMBERS: dict[str, Any] = {"anyOf": [_TEXT_OR_NUMBER, _list_of(_TEXT_OR_NUMBER)]}
_TEXTS: dict[str, Any] = {"anyOf": [{"type": "string"}, {"type": "array", "items": {"type": "string"}}]}


# Entries of a sum of channels.
SUM_KEYS = ("quantity", "role", "dof", "position")

# The kinds of files with a schema: functions to it.
SCHEMAS = Registry("schema")


def rig_schema() -> dict[str, Any]:
    schema = object_schema(RigSettings)
    channel = object_schema(ChannelSettings)
    typed = channel["properties"]["sensitivity"]
    certified = object_schema(CertificateSettings)
    channel["properties"]["sensitivity"] = {"anyOf": [typed, certified], "description": typed["description"]}
    schema["properties"]["channels"] = _mapping_of(channel)
    numbers = _mapping_of(_TEXT_OR_NUMBER)
    described = "numbers in sums of channels, with their uncertainty: m_s: 30 kg +- 0.1 kg"
    schema["properties"]["constants"] = {**numbers, "description": described}
    listed = object_schema(ChannelSettings)
    listed["properties"] = {name: listed["properties"][name] for name in SUM_KEYS}
    listed["properties"]["sum"] = numbers
    described = "sums of channels, listed: {e: {sum: {f: 1, a: -30 kg +- 0.1 kg}, quantity: force, dof: x}}"
    schema["properties"]["derived"] = {**_mapping_of(listed), "description": described}
    schema["required"] = ["channels"]
    return {"$schema": DRAFT, "title": "labpipe rig", **schema}


def _recordings() -> dict[str, Any]:
    entry = {
        "type": "object",
        "properties": {
            "file": {"type": "string", "description": "a file or a glob"},
            "each": {**_TEXTS, "description": "files, each of which is a recording"},
            "join": {**_TEXTS, "description": "files that hold channels of one run"},
            "by": {
                "enum": list(BY),
                "description": "how files are joined; default: on time where all have the rig's time column",
            },
            "pattern": {
                "type": "string",
                "description": "dofs in the files' names, by channel, input or "
                "output: point_{output}_{input}",
            },
            "rig": {"type": "string"},
            "channels": {"type": "object"},
            **object_schema(Span)["properties"],
        },
        "additionalProperties": False,
    }
    return {"anyOf": [{"type": "string"}, _list_of({"anyOf": [{"type": "string"}, entry]})]}


def _frfs() -> dict[str, Any]:
    simple = [{"type": "string"}, object_schema(FrfLayout)]
    return {"anyOf": [*simple, _list_of({"anyOf": simple})]}


# What the entries of a test mean.
OF_TEST = {
    "each": "files, each of which is a test of its own, under the file's name",
    "together": "parts of the pattern in which the recordings of one test differ",
    "pattern": "conditions in the file's name, for example {preload}-{direction}",
    "frf": "in place of the pipeline's, for this test",
    "repeats": "what fits make of several recordings of the same FRFs: in place of their own",
}


def pipeline_schema() -> dict[str, Any]:
    recordings, frfs = _recordings(), _frfs()
    conditions = _mapping_of(_TEXT_OR_NUMBER)
    test = {
        "name": {"type": "string"},
        "recordings": recordings,
        "frfs": frfs,
        "each": recordings,
        "together": _TEXTS,
        "pattern": {"type": "string"},
        "conditions": conditions,
        "frf": object_schema(FrfSettings),
        "repeats": {"enum": list(REPEATS)},
    }
    test |= {name: {**test[name], "description": meaning} for name, meaning in OF_TEST.items()}
    rule = {"anyOf": [_TEXT_OR_NUMBER, {"type": "boolean"}, {"type": "array"}, _decision()]}
    rules = _mapping_of(rule)
    properties = {
        "title": {"type": "string"},
        "rig": {"type": "string", "description": "rig file, relative to this file"},
        "recordings": recordings,
        "tests": _list_of({"type": "object", "properties": test, "additionalProperties": False}),
        "frfs": frfs,
        "conditions": conditions,
        "frf": object_schema(FrfSettings),
        "uncertainty": object_schema(UncertaintySettings),
        "results": {
            "enum": list(RESULTS),
            "description": "How results of many tests are kept: whole, or as a dataset.",
        },
        **{name: _section(entry) for name, entry in sections()},
        "report": object_schema(ReportSettings),
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


def _decision() -> dict[str, Any]:
    texts: dict[str, Any] = {key: {"description": meaning} for key, meaning in DECISION_KEYS.items()}
    texts["rule"]["enum"] = list(DECISIONS)
    return {"type": "object", "properties": texts, "additionalProperties": False}


def bearing_schema() -> dict[str, Any]:
    return kinds_schema("bearing", "kind", {name: BEARINGS.load(name).settings for name in BEARINGS})


def kinds_schema(title: str, key: str, kinds: Mapping[str, type]) -> dict[str, Any]:
    """A mapping whose entry *key* names its kind, and settings of all kinds."""
    options = []
    for name, owner in kinds.items():
        schema = object_schema(owner)
        schema["properties"] = {**schema["properties"], key: {"enum": [name]}}
        options.append({**schema, "required": list(dict.fromkeys([key, *schema["required"]]))})
    return {"$schema": DRAFT, "title": f"labpipe {title}", "anyOf": options}


def _section(entry: PipelineSection) -> dict[str, Any]:
    owner = entry.settings
    schema = object_schema(owner)
    if owner in OWN_SECTIONS:
        kinds, text = OWN_SECTIONS[owner]
        parts = {kind.section: object_schema(kind.settings) for kind in kinds() if kind.settings is not None}
        # Settings of a model that needs no section may stand in the fit itself.
        plain = [parts[kind.section]["properties"] for kind in kinds() if getattr(kind, "optional", False)]
        for name, described in schema["properties"].items():
            described["description"] += text(name)
        inner = {name: value for part in plain for name, value in part.items()}
        schema["properties"] = inner | schema["properties"] | parts
    return _mapping_of(schema) if entry.named else schema


# Settings whose kinds have sections of their own: the kinds, and the words which of them take a key.
OWN_SECTIONS: dict[type, tuple[Callable[[], list[Any]], Callable[[str], str]]] = {
    FitSettings: (lambda: [model_kind(name) for name in MODELS], models_text),
    CompareSettings: (lambda: [comparison_kind(name) for name in COMPARISONS], kinds_text),
}


def object_schema(owner: type) -> dict[str, Any]:
    """The schema of a mapping that is read into settings."""
    settings = settings_of(owner)
    properties = {
        name: {
            **_kind(setting),
            "description": f"{setting.help} [{setting.unit}]" if setting.unit else setting.help,
        }
        for name, (setting, _) in settings.items()
    }
    required = [name for name, (_, needed) in settings.items() if needed]
    return {"type": "object", "properties": properties, "required": required, "additionalProperties": False}


def _kind(setting: Setting) -> dict[str, Any]:
    if setting.section is not None:
        section = object_schema(setting.section)
        kinds = {"section": section, "sections": _mapping_of(section), "entries": _list_of(section)}
        return kinds[setting.kind]
    return {
        "value": _TEXT_OR_NUMBER,
        "uncertain": _TEXT_OR_NUMBER,
        "band": {"type": "string"},
        "bands": _TEXTS,
        "peaks": _mapping_of(_TEXTS),
        "integer": {"type": "integer", "minimum": 0},
        "span": _TEXT_OR_NUMBER,
        "flag": {"type": "boolean"},
        "text": _TEXT_OR_NUMBER,
        "file": {"type": "string"},
        "choice": {"enum": list(setting.choices)},
        "names": _TEXTS,
        "mass": {"type": ["string", "number", "array"]},
        "values": _TEXTS_OR_NUMBERS,
        "matrix": _list_of(_list_of(_TEXT_OR_NUMBER)),
        "coefficients": _mapping_of(_TEXT_OR_NUMBER),
        "groups": {"type": "array"},
        "series": {"type": "object"},
        "roots": _TEXTS_OR_NUMBERS,
        "phasors": _mapping_of(_TEXT_OR_NUMBER),
        "texts": _mapping_of(_TEXT_OR_NUMBER),
    }[setting.kind]
