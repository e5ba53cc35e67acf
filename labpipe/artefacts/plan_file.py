"""plan.json: a planned test as it was predicted."""

from __future__ import annotations

import json
from pathlib import Path

from labpipe import __version__
from labpipe.artefacts.json_file import write_json
from labpipe.artefacts.typed_json import entry_of, record_of
from labpipe.errors import DataError
from labpipe.records.plan import Plan

NAME = "plan.json"
SCHEMA = "labpipe/plan/1"


def write_plan(path: Path, plan: Plan) -> None:
    """Write a plan."""
    write_json(path, {"schema": SCHEMA, "labpipe": __version__, **entry_of(plan)})


def read_plan(path: Path) -> Plan:
    """The plan of a plan.json; DataError when the file is none."""
    try:
        entries = json.loads(path.read_text(encoding="utf-8"))
        if entries["schema"] != SCHEMA:
            raise ValueError(f"schema {entries['schema']}")
        plan: Plan = record_of(entries, Plan)
    except FileNotFoundError:
        raise DataError("no such file", where=str(path), hint="run `labpipe plan` first") from None
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(f"is not a readable plan ({error})", where=str(path), hint="run `labpipe plan` again") from None
    return plan
