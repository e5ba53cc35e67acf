"""The pipeline that evaluates a planned excitation."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from labpipe.methods.planning.excitation import Evaluation, pipeline_entries
from labpipe.methods.planning.records import PlannedTest
from labpipe.methods.planning.settings import NoiseSettings, PlanSettings
from labpipe.quantities import parse_value

LINES = (60.0, 61.0, 64.0, 64.5)
ONE = PlannedTest(
    "one", 3, 2, ("x",), ("one.csv",), LINES, ((1.0,) * 4,), ((0.0,) * 4,), (1.5,), (1.0,), (1e-6,)
)
SETTINGS = PlanSettings(
    "sdof", band=(50.0, 70.0), period=2.0, sample_rate=256.0, duration=6.0, force_limit=1.0, mass=0.79,
    noise=NoiseSettings(force=0.02),
    expected=(("k", 1.0), ("c", 1.0)),
)  # fmt: skip
PLANNED = Evaluation(SETTINGS, "Planned", (ONE,), with_masses=False)


def ends(band: str) -> tuple[float, float]:
    low, high = band.removesuffix(" Hz").split("-")
    return float(low), float(high)


def test_the_band_holds_the_planned_lines_and_the_gaps_none() -> None:
    """Lines stand every half hertz; every edge lies nearer to an excited line than to any other."""
    entries = pipeline_entries(PLANNED, Path())
    frf = entries["frf"]
    low, high = ends(frf["band"])
    gaps = [ends(gap) for gap in frf["exclude"]]
    every = [60 + n / 2 for n in range(-4, 14)]
    assert [f for f in every if low <= f <= high and not any(a <= f <= b for a, b in gaps)] == list(LINES)
    assert all(
        min(abs(edge - f) for f in every) == pytest.approx(0.125)
        for edge in (low, high, *(e for gap in gaps for e in gap))
    )
    assert parse_value(frf["period"], "s") == 2.0 and frf["skip"] == 2 and "result" not in frf
    assert entries["recordings"] == ["recordings/one.csv"] and entries["identify"]["planned"] == {
        "model": "sdof",
        "mass": "0.79 kg",
    }


def test_tests_one_after_the_other_say_where_their_force_acts() -> None:
    plan = replace(
        PLANNED, tests=(ONE, replace(ONE, name="two", shakers=("y",), frequency=(59.0, 61.0), skip=1))
    )
    entries = pipeline_entries(plan, Path())
    assert [entry["channels"]["f"]["dof"] for entry in entries["recordings"]] == ["x", "y"]
    # All lines of both, and as much of a transient as every test can spare.
    assert ends(entries["frf"]["band"])[0] == 58.875 and entries["frf"]["skip"] == 1
