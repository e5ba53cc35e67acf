"""plan.json: a plan comes back as it was written, another file is none."""

from __future__ import annotations

from pathlib import Path

import pytest

from labpipe.artefacts.json_file import write_digested
from labpipe.errors import ConfigErrors, DataError
from labpipe.methods.planning.plan_file import load_plan, read_plan, write_plan
from labpipe.methods.planning.records import Plan, PlannedCoefficient, PlannedTest, RunPlan

LINES = (60.0, 61.0, 64.0, 64.5)
ONE = PlannedTest(
    "one", 3, 2, ("x",), ("one.csv",), LINES, ((1.0,) * 4,), ((0.0,) * 4,), (1.5,), (1.0,), (1e-6,)
)
COEFFICIENTS = tuple(
    PlannedCoefficient(name, unit, 1.0, 1.0, 0.1, 0.1, 0.2) for name, unit in (("k", "N/m"), ("c", "N.s/m"))
)
PLAN = Plan(
    "Planned", "sdof", "d", "alone", "optimal", 0.0, period=2.0, sample_rate=256.0, duration=6.0,
    efficiency=1.0, factor=1.0,
    coefficients=COEFFICIENTS, tests=(ONE,), gains=(), mass=0.79,
)  # fmt: skip


def test_a_plan_comes_back(tmp_path: Path) -> None:
    write_plan(tmp_path / "plan.json", PLAN)
    assert read_plan(tmp_path / "plan.json") == PLAN


def test_planned_runs_are_no_planned_excitation(tmp_path: Path) -> None:
    runs = RunPlan("Planned", "run-ups", "D", 60.0, 1.0, 1.0, 3, (), ())
    write_plan(tmp_path / "plan.json", runs)
    assert read_plan(tmp_path / "plan.json") == runs


def test_what_is_no_plan_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no such file"):
        read_plan(tmp_path / "plan.json")
    write_digested(tmp_path / "plan.json", {"schema": "labpipe-sketch-1"})
    with pytest.raises(DataError, match="not a readable plan"):
        read_plan(tmp_path / "plan.json")


def test_an_unknown_key_gets_the_one_whose_meaning_begins_with_it(tmp_path: Path) -> None:
    path = tmp_path / "plan.yaml"
    for key, hint in (("directions", r"'shakers' \(directions of force"), ("duratoin", "'duration'")):
        path.write_text(f"plan:\n  model: sdof\n  {key}: 45 deg\n")
        with pytest.raises(ConfigErrors, match=rf"plan\.{key}: unknown key; did you mean {hint}"):
            load_plan(path)
