"""Files of planned runs, of whatever kind: plan.json, a report, the runs as a table, the pipeline."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import yaml

from labpipe import __version__
from labpipe.artefacts.plan_file import NAME, write_plan
from labpipe.artefacts.writing import OutputFolder
from labpipe.document.render import DOCUMENTS
from labpipe.records.run_plan import RunPlan
from labpipe.report.document import Document, Section
from labpipe.report.run_plan import run_plan_document, runs_csv, runs_table

REPORT, PIPELINE, ROTOR = "report.html", "pipeline.yaml", "rotor.yaml"


def write_runs(plan: RunPlan, settings_files: Mapping[str, Any], output: OutputFolder) -> list[str]:
    """plan.json, report.html, runs.csv and runs.md, and files of settings by name; the names."""
    write_plan(output.write_path(NAME), plan)
    output.write_path(REPORT).write_bytes(DOCUMENTS.load("html")(run_plan_document(plan, __version__)))
    output.write_path("runs.csv").write_text(runs_csv(plan), encoding="utf-8")
    table = Document(plan.title, "Runs to make", (Section("Runs", (runs_table(plan),)),), to_sign=False)
    output.write_path("runs.md").write_bytes(DOCUMENTS.load("md")(table))
    for name, entries in settings_files.items():
        text = entries if isinstance(entries, str) else yaml.safe_dump(entries, sort_keys=False, allow_unicode=True, width=120)
        output.write_path(name).write_text(text, encoding="utf-8")
    return [NAME, REPORT, "runs.csv", "runs.md", *settings_files]
