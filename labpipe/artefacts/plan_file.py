"""plan.json: a planned test, or planned runs, as they were predicted."""

from __future__ import annotations

from pathlib import Path

from labpipe import __version__
from labpipe.artefacts.json_file import read_digested, write_digested
from labpipe.artefacts.typed_json import RECORD_FAULTS, entry_of, record_of
from labpipe.errors import DataError, cut
from labpipe.records.plan import Plan
from labpipe.records.run_plan import RunPlan

NAME = "plan.json"
# Of an excitation, and of runs.
SCHEMAS: dict[type, str] = {Plan: "labpipe/plan/1", RunPlan: "labpipe/run-plan/1"}


def write_plan(path: Path, plan: Plan | RunPlan) -> None:
    """Write a plan."""
    write_digested(path, {"schema": SCHEMAS[type(plan)], "labpipe": __version__, **entry_of(plan)})


def read_plan(path: Path) -> Plan:
    """The plan of an excitation from its plan.json; DataError when the file is none."""
    plan = read_any_plan(path)
    if not isinstance(plan, Plan):
        raise DataError("plans runs, not an excitation", where=str(path))
    return plan


def read_any_plan(path: Path) -> Plan | RunPlan:
    """The plan of a plan.json, of whatever kind; DataError when the file is none."""
    try:
        entries = read_digested(path, "plan")
        kinds = {schema: kind for kind, schema in SCHEMAS.items()}
        if entries["schema"] not in kinds:
            raise ValueError(f"schema {cut(repr(entries['schema']))}")
        plan: Plan | RunPlan = record_of(entries, kinds[entries["schema"]])
    except FileNotFoundError:
        raise DataError("no such file", where=str(path), hint="run `labpipe plan` first") from None
    except RECORD_FAULTS as error:
        raise DataError(f"is not a readable plan ({cut(str(error))})", where=str(path), hint="run `labpipe plan` again") from None
    return plan
