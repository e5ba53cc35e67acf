"""plan.json: a planned test as it was predicted."""

from __future__ import annotations

from pathlib import Path

from labpipe import __version__
from labpipe.artefacts.json_file import read_digested, write_digested
from labpipe.artefacts.typed_json import RECORD_FAULTS, entry_of, record_of
from labpipe.errors import DataError, cut
from labpipe.records.plan import Plan

NAME = "plan.json"
SCHEMA = "labpipe/plan/1"


def write_plan(path: Path, plan: Plan) -> None:
    """Write a plan."""
    write_digested(path, {"schema": SCHEMA, "labpipe": __version__, **entry_of(plan)})


def read_plan(path: Path) -> Plan:
    """The plan of a plan.json; DataError when the file is none."""
    try:
        entries = read_digested(path, "plan")
        if entries["schema"] != SCHEMA:
            raise ValueError(f"schema {cut(repr(entries['schema']))}")
        plan: Plan = record_of(entries, Plan)
    except FileNotFoundError:
        raise DataError("no such file", where=str(path), hint="run `labpipe plan` first") from None
    except RECORD_FAULTS as error:
        raise DataError(f"is not a readable plan ({cut(str(error))})", where=str(path), hint="run `labpipe plan` again") from None
    return plan
