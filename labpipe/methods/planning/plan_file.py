"""Reading a plan file, and plan.json with the files that planned runs leave."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from labpipe import __version__
from labpipe.artefacts.json_file import BAD_ENTRY, entry_of, read_digested, record_of, write_digested
from labpipe.artefacts.writing import OutputFolder
from labpipe.document.render import DOCUMENTS
from labpipe.errors import ConfigError, DataError, LabpipeError, shorten
from labpipe.methods.planning.records import Plan, RunPlan
from labpipe.methods.planning.report import run_plan_document, runs_csv, runs_table
from labpipe.methods.planning.settings import PlanKind, plan_kinds
from labpipe.project.marked_yaml import Marked, load_marked
from labpipe.project.schema import kinds_schema
from labpipe.project.settings_reader import DECIDE, Faults, read_settings
from labpipe.registry import nearest
from labpipe.report.document import Document, Section

KEYS = ("title", "plan")


def plan_schema() -> dict[str, Any]:
    plan = kinds_schema("plan", "model", {name: kind.settings for name, kind in plan_kinds().items()})
    head = {name: plan.pop(name) for name in ("$schema", "title")}
    properties = {"title": {"type": "string"}, "plan": plan}
    entries = {"type": "object", "properties": properties, "required": ["plan"]}
    return {**head, **entries, "additionalProperties": False}


@dataclass(frozen=True)
class PlanFile:
    """A plan file: where it is, its title, what is planned, and the settings of that."""

    path: Path
    title: str
    kind: PlanKind
    settings: Any


def load_plan(path: Path, overrides: Iterable[str] = ()) -> PlanFile:
    """The content of a plan file; ConfigErrors with every fault at its place."""
    tree = load_marked(path, overrides)
    faults = Faults(path.parent)
    entries = faults.mapping(tree, "")
    if entries:
        faults.unknown_keys(tree, "", KEYS)
    kind, settings = None, None
    if "plan" not in entries:
        faults.add(tree, "plan", "is missing", "state model, expected values, noise, limits and duration")
    else:
        kind = _kind(entries["plan"], faults)
        _sort_theory(entries["plan"])
        settings = None if kind is None else read_settings(kind.settings, entries["plan"], "plan", faults)
    title = faults.text(entries, "", "title")
    faults.raise_any()
    assert kind is not None and settings is not None
    return PlanFile(path, title or path.stem, kind, settings)


def _sort_theory(node: Marked) -> None:
    entries = node.content if isinstance(node.content, dict) else {}
    content = entries["expected"].content if "expected" in entries and "theory" not in entries else None
    if isinstance(content, dict) and {"bearing", "rotor"} & set(content):
        entries["theory"] = entries.pop("expected")


def _kind(node: Marked, faults: Faults) -> PlanKind | None:
    entries = faults.mapping(node, "plan")
    kinds = plan_kinds()
    if "model" not in entries or entries["model"].text == DECIDE:
        faults.add(node, "plan.model", "is missing", f"known: {', '.join(kinds)}")
        return None
    name = entries["model"].text
    if name not in kinds:
        faults.add(entries["model"], "plan.model", f"unknown model '{name}'", nearest(name, kinds))
        return None
    return kinds[name]


NAME = "plan.json"
SCHEMAS: dict[type, str] = {Plan: "labpipe/plan/1", RunPlan: "labpipe/run-plan/1"}


def write_plan(path: Path, plan: Plan | RunPlan) -> None:
    write_digested(path, {"schema": SCHEMAS[type(plan)], "labpipe": __version__, **entry_of(plan)})


def read_plan(path: Path) -> Plan | RunPlan:
    """The plan of a plan.json, of whatever kind; DataError when the file is none."""
    try:
        entries = read_digested(path, "plan")
        kinds = {schema: kind for kind, schema in SCHEMAS.items()}
        if entries["schema"] not in kinds:
            raise ValueError(f"schema {shorten(repr(entries['schema']))}")
        plan: Plan | RunPlan = record_of(entries, kinds[entries["schema"]])
    except FileNotFoundError:
        raise DataError("no such file", path, "run `labpipe plan` first") from None
    except BAD_ENTRY as error:
        what = f"is not a readable plan ({shorten(str(error))})"
        raise DataError(what, path, "run `labpipe plan` again") from None
    return plan


REPORT, PIPELINE, ROTOR = "report.html", "pipeline.yaml", "rotor.yaml"


def write_runs(plan: RunPlan, settings_files: Mapping[str, Any], output: OutputFolder) -> list[str]:
    write_plan(output.write_path(NAME), plan)
    output.write_path(REPORT).write_bytes(DOCUMENTS.load("html")(run_plan_document(plan, __version__)))
    output.write_path("runs.csv").write_text(runs_csv(plan), encoding="utf-8")
    table = Document(plan.title, "Runs to make", (Section("Runs", (runs_table(plan),)),), to_sign=False)
    output.write_path("runs.md").write_bytes(DOCUMENTS.load("md")(table))
    write_settings(settings_files, output)
    return [NAME, REPORT, "runs.csv", "runs.md", *settings_files]


def write_settings(files: Mapping[str, Any], output: OutputFolder) -> None:
    for name, content in files.items():
        text = content
        if not isinstance(content, str):
            text = yaml.safe_dump(content, sort_keys=False, allow_unicode=True, width=120)
        output.write_path(name).write_text(text, encoding="utf-8")


def plan_files(file: PlanFile, output: OutputFolder) -> tuple[list[str], list[str]]:
    try:
        sentences, names = file.kind.files(file, output)
    except LabpipeError as error:
        if not error.where:
            field = f"plan.{error.field}: " if isinstance(error, ConfigError) and error.field else ""
            error.what, error.where = f"{field}{error.what}", str(file.path)
        raise
    return list(sentences), list(names)
