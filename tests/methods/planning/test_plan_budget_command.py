"""Predicted uncertainty budgets: against closed forms, and against the result of the test carried out on a
simulated rig.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv as pc
import pytest
import yaml

from labpipe.methods.planning.campaigns import INTERLEAVED, ONE_BY_ONE, PlannedRig, RigLimits
from labpipe.methods.planning.excitation import rehearsal
from labpipe.methods.planning.model import UNITS, SensorDensities, planned_model
from labpipe.methods.planning.plan_file import load_plan, read_plan
from labpipe.methods.planning.records import Plan
from labpipe.methods.planning.search import LEAST_CREST, SCHROEDER, flat
from labpipe.records.uncertain import Budget
from tests.conftest import Command, Ended
from tests.methods.planning.rigs import SEAL, seal

PROBE = {"quantity": "displacement", "unit": "V", "sensitivity": "8 V/mm +- 1 %"}
SHAKER = {"column": "f [V]", "quantity": "force", "unit": "V", "sensitivity": "50 mV/N +- 0.5 %"}
PEDESTAL_RIG = {
    "sample_rate": "500 Hz",
    "channels": {"shaker": {**SHAKER, "dof": "y"}, "probe": {**PROBE, "column": "x [V]", "dof": "y"}},
}
PEDESTAL = {
    "model": "sdof",
    "rig": "rig.yaml",
    "mass": "0.79 kg +- 5 g (rectangular, source=scale)",
    "expected": {"k": "134.5 kN/m", "c": "3.682 N.s/m"},
    "noise": {"force": "20 mN", "displacement": "0.3 um"},
    "sample_rate": "500 Hz",
    "band": "62-70 Hz",
    "period": "2 s",
    "force_limit": "1 N",
    "duration": "40 s",
}
# One load cell, moved from shaker to shaker, and probes of one calibrator.
ROTOR_RIG = {
    "sample_rate": "1 kHz",
    "channels": {
        "cell": {**SHAKER, "dof": "x +- 0.5 deg"},
        "u": {
            **PROBE,
            "column": "x [V]",
            "dof": "x",
            "sensitivity": "8 V/mm +- 1 % (source=calibrator)",
            "delay": "0 s +- 2 us",
        },
        "v": {
            **PROBE,
            "column": "y [V]",
            "dof": "y +- 0.3 deg",
            "sensitivity": "8 V/mm +- 1 % (source=calibrator)",
        },
    },
}
TWO_CELLS = {
    **ROTOR_RIG["channels"],
    "cell": {**SHAKER, "column": "f_1 [V]", "dof": "x"},
    "other": {**SHAKER, "column": "f_2 [V]", "dof": "y"},
}
EIGHT = {
    **{"k_xx": "180 kN/m", "k_xy": "25 kN/m", "k_yx": "-18 kN/m", "k_yy": "210 kN/m"},
    **{"c_xx": "120 N.s/m", "c_xy": "15 N.s/m", "c_yx": "-10 N.s/m", "c_yy": "150 N.s/m"},
}
ROTOR = {
    "model": "rotor-2dof",
    "rig": "rig.yaml",
    "mass": "0.92 kg +- 0.2 %",
    "expected": EIGHT,
    "noise": {"force": "20 mN", "displacement": "0.3 um"},
    "sample_rate": "1 kHz",
    "band": "40-100 Hz",
    "period": "0.5 s",
    "force_limit": "1 N",
    "duration": "20 s",
    "floor": "40 %",
}


def write(folder: Path, entries: dict[str, Any], rig: dict[str, Any]) -> Path:
    (folder / "rig.yaml").write_text(yaml.safe_dump(rig), encoding="utf-8")
    path = folder / "plan.yaml"
    path.write_text(yaml.safe_dump({"title": "Planned", "plan": entries}), encoding="utf-8")
    return path


def budget_of(folder: Path, entries: dict[str, Any], rig: dict[str, Any], lines: np.ndarray) -> Budget:
    """The budget of a flat test of the pedestal on lines [multiples of 0.5 Hz]."""
    file = load_plan(write(folder, entries, rig))
    rehearse = rehearsal(file)
    assert rehearse is not None
    model = planned_model("sdof", dict(file.settings.expected), file.settings.mass)
    bench = PlannedRig(
        model,
        SensorDensities.of_samples(0.02, 0.3e-6, 0.0, 500.0),
        RigLimits(1.0),
        np.ones((1, 1), complex),
        ("x",),
        0.5,
    )
    budget = rehearse(bench, flat(bench, lines, ONE_BY_ONE, LEAST_CREST).tests, [20])
    assert budget is not None
    return budget


def test_with_the_mass_estimated_every_coefficient_goes_as_force_over_displacement(tmp_path: Path) -> None:
    # F = (k + jwc - w^2 m) X is linear in k, c, m: a gain of X that is 1 % off makes all of them 1 % wrong,
    # one of F 0.5 %.
    free = {key: value for key, value in PEDESTAL.items() if key != "mass"}
    found = budget_of(
        tmp_path,
        {**free, "expected": {**PEDESTAL["expected"], "m": "0.79 kg"}},
        PEDESTAL_RIG,
        np.arange(120, 144),
    )  # type: ignore[dict-item]
    assert [source.source for source in found.sources] == [
        "probe.sensitivity 8 V/mm",
        "shaker.sensitivity 50 mV/N",
    ]
    values = np.array([134.5e3, 3.682, 0.79])
    np.testing.assert_allclose(np.abs(found.changes) / values, [[0.01] * 3, [0.005] * 3], rtol=1e-3)
    np.testing.assert_allclose(found.systematic / values, np.hypot(0.01, 0.005), rtol=1e-3)


def test_near_a_resonance_the_known_mass_is_the_stiffness(tmp_path: Path) -> None:
    # The curve knows k / m = w_n^2: u(k) / k = u(m) / m = 5 g / sqrt(3) / 0.79 kg; c goes as force over
    # displacement.
    found = budget_of(tmp_path, PEDESTAL, PEDESTAL_RIG, np.arange(120, 144))
    k, c = found.systematic / np.array([134.5e3, 3.682])
    assert k == pytest.approx(0.005 / np.sqrt(3) / 0.79, rel=2e-3)
    assert c == pytest.approx(np.hypot(0.01, 0.005), rel=0.06)


def test_a_common_gain_of_all_probes_is_that_of_every_coefficient_of_a_floating_bearing(
    tmp_path: Path,
) -> None:
    # F - M_s A = D X: displacements that are all 1 % off make K, C and M 1 % wrong, whatever the test.
    probe = {"quantity": "displacement", "uncertainty": {"gain": "1 % (source=calibrator)"}}
    channels = {
        **{f"f{axis}": {"quantity": "force", "dof": axis} for axis in "xy"},
        **{axis: {**probe, "dof": axis} for axis in "xy"},
        **{f"a{axis}": {"quantity": "acceleration", "dof": axis} for axis in "xy"},
    }
    entries = {
        "model": "dynamic-stiffness",
        "rig": "rig.yaml",
        "mass": "60 kg",
        "expected": {name: f"{value} {UNITS[name[0]]}" for name, value in SEAL.items()},
        "noise": {"force": "2 N", "displacement": "0.2 um", "acceleration": "0.05 m/s^2"},
        **{
            "sample_rate": "1 kHz",
            "band": "10-100 Hz",
            "period": "1 s",
            "force_limit": "2 kN",
            "duration": "20 s",
        },
    }
    rehearse = rehearsal(load_plan(write(tmp_path, entries, {"sample_rate": "1 kHz", "channels": channels})))
    assert rehearse is not None
    model, noise, _ = seal()
    bench = PlannedRig(model, noise, RigLimits(2e3), np.eye(2, dtype=complex), ("x", "y"), 1.0)
    budget = rehearse(bench, flat(bench, np.arange(10, 100, 3), INTERLEAVED, SCHROEDER).tests, [20])
    assert budget is not None and [source.source for source in budget.sources] == ["calibrator"]
    np.testing.assert_allclose(np.abs(budget.changes[0] / model.expected), 0.01, rtol=2e-3)


def carry_out(plan: Plan, folder: Path, seed: int) -> None:
    """Recordings in volts of the plan's signal files on the expected rig, with the noise that the plan
    assumes.
    """
    model = planned_model(plan.model, {c.name: c.expected for c in plan.coefficients}, plan.mass)
    rng = np.random.default_rng(seed)
    (folder / "recordings").mkdir()
    for test in plan.tests:
        applied = [pc.read_csv(folder / name)["f [N]"].to_numpy() for name in test.files]
        forces = np.zeros((model.n_dof, applied[0].size))
        for shaker, signal in zip(test.shakers, applied, strict=True):
            forces[("x", "y").index(shaker)] = signal
        frequency = np.fft.rfftfreq(forces.shape[1], 1 / plan.sample_rate)
        spectrum = np.einsum("lij,jl->il", model.receptance(2 * np.pi * frequency), np.fft.rfft(forces))
        moved = np.fft.irfft(spectrum, forces.shape[1])
        names = ["f"] if len(test.shakers) == 1 else ["f_1", "f_2"]
        columns = {
            f"{name} [V]": 0.05 * (one + 0.02 * rng.normal(size=one.size))
            for name, one in zip(names, applied, strict=True)
        }
        columns |= {
            f"{axis} [V]": 8e3 * (row + 0.3e-6 * rng.normal(size=row.size))
            for axis, row in zip("xy"[: model.n_dof], moved, strict=True)
        }
        pc.write_csv(pa.table(columns), folder / "recordings" / f"{test.name}.csv")


@pytest.mark.long
@pytest.mark.parametrize(
    ("entries", "rig"),
    [
        pytest.param(PEDESTAL, PEDESTAL_RIG, id="pedestal"),
        pytest.param({**ROTOR, "scheme": "one by one"}, ROTOR_RIG, id="one cell", marks=pytest.mark.long),
        pytest.param(
            {**ROTOR, "scheme": "together"},
            {**ROTOR_RIG, "channels": TWO_CELLS},
            id="two cells",
            marks=pytest.mark.long,
        ),
    ],
)
def test_the_result_has_the_predicted_budget(
    labpipe: Command, tmp_path: Path, entries: dict[str, Any], rig: dict[str, Any]
) -> None:
    folder = tmp_path / "planned"
    goals = {"k.expanded": "1 %", "c.expanded": "2 %"} if entries["model"] == "sdof" else {"k_xx": "1 %"}
    ended = labpipe("plan", write(tmp_path, {**entries, "goal": goals}, rig), "-o", folder)
    assert ended.code == 0, ended.err
    assert not (folder / "rig.yaml").exists()
    plan = read_plan(folder / "plan.json")
    carry_out(plan, folder, 3)
    for stage in ("frf", "identify"):
        made = labpipe(stage, "-c", folder / "pipeline.yaml", "-o", tmp_path / "out")
        assert made.code == 0, made.err
    (fit,) = json.loads((tmp_path / "out" / "identification.json").read_text("utf-8"))["fits"]
    found = {p["name"]: p for p in fit["parameters"]}
    for c in plan.coefficients:
        assert c.systematic is not None and c.combined is not None and c.expanded is not None
        assert c.systematic * c.scale == pytest.approx(found[c.name]["systematic"], rel=0.1)
        assert c.combined * c.scale == pytest.approx(found[c.name]["combined"], rel=0.1)
        assert c.expanded * c.scale == pytest.approx(found[c.name]["expanded"], rel=0.1)
        stated = {part["source"]: part["contribution"] for part in found[c.name]["budget"]}
        assert {part.source: part.contribution * c.scale for part in c.budget} == pytest.approx(
            stated, abs=0.1 * c.combined * c.scale
        )
    if plan.model == "sdof":
        check_words(ended, plan, folder)


def check_words(ended: Ended, plan: Plan, folder: Path) -> None:
    """The goal of c is beyond what the probe leaves, and the plan says so."""
    assert "no time meets them, that of c because of what sensors and mass leave" in ended.out
    assert "Longer measuring hardly helps k (100 %)" in ended.out
    assert plan.unreachable == ("c",) and plan.needed is None
    # u_c(c) = 1 % is allowed (k about 2): of it 0.5 % are the shaker's, the rest sqrt(1 / 1.96^2 * 4 - 0.25)
    # % the probe's.
    assert "probe.sensitivity 8 V/mm is known to 1 % and must be known to 0.88 %" in ended.out
    assert "Predicted uncertainty" in (folder / "report.html").read_text("utf-8")


@pytest.mark.parametrize(
    ("changes", "rig", "message"),
    [
        ({"goal": {"k.expanded": "1 %"}, "mass": "0.79 kg"}, {}, "nothing but noise is uncertain"),
        ({"goal": {"z.expanded": "1 %"}}, PEDESTAL_RIG, "the model has no coefficient z"),
        ({"period": "2 s +- 1 %"}, PEDESTAL_RIG, "an uncertainty of 'period' is not planned with"),
        ({}, {"channels": {"shaker": {**SHAKER, "dof": "y"}}}, "the rig has no displacement in x"),
        (
            {},
            {"channels": {**PEDESTAL_RIG["channels"], "a": {"quantity": "acceleration", "dof": "y"}}},
            "a is not a response that this model",
        ),  # type: ignore[dict-item]
        ({**ROTOR, "scheme": "together"}, ROTOR_RIG, "the rig has one force"),
        (
            {**ROTOR},
            {"channels": {**TWO_CELLS, "cell": {**SHAKER, "dof": "z"}}},
            "are not those of the shakers (x, y)",
        ),
    ],
)
def test_refusals(
    labpipe: Command, tmp_path: Path, changes: dict[str, Any], rig: dict[str, Any], message: str
) -> None:
    entries = {**PEDESTAL, **changes}
    if not rig:
        del entries["rig"]
    ended = labpipe("plan", write(tmp_path, entries, rig or PEDESTAL_RIG), "-o", tmp_path / "out")
    assert ended.code == 2
    assert message in ended.err and "plan.yaml" in ended.err and "Traceback" not in ended.err
    assert not (tmp_path / "out").exists()
