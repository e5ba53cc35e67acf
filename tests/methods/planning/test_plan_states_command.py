"""labpipe plan for a floating bearing at several loads and speeds: files, words, refusals, and states tested
on the virtual rig.
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

from labpipe.methods.floating_bearing.virtual_rig import FilmCondition, FloatingRig, coefficients, motions
from labpipe.methods.journal_bearing.kind import JournalSettings
from labpipe.methods.planning.plan_file import load_plan, read_plan
from labpipe.methods.planning.records import RunPlan
from labpipe.methods.planning.report import run_names
from labpipe.methods.planning.states import COEFFICIENTS, common_number, plan_states, planned_states
from labpipe.project.bearing_file import open_bearing
from tests.conftest import Command

BEARINGS = Path(__file__).parents[3] / "configs/bearings"
NOISE = {"force": 30.0, "displacement": 1e-6, "acceleration": 1.0}
PLAN = {
    "model": "bearing-states",
    "bearing": str(BEARINGS / "floating-journal.yaml"),
    "loads": ["2 kN", "5 kN"],
    "speeds": ["3000 rpm"],
    "mass": "60 kg",
    "noise": {"force": "30 N", "displacement": "1 um", "acceleration": "1 m/s^2"},
    "sample_rate": "500 Hz",
    "band": "20-100 Hz",
    "period": "0.5 s",
    "run": "10 s",
    "changeover": "30 s",
    "duration": "250 s",
    "force_limit": "1 kN",
}


def write(folder: Path, **changes: object) -> Path:
    path = folder / "plan.yaml"
    entries = {name: value for name, value in {**PLAN, **changes}.items() if value is not None}
    path.write_text(yaml.safe_dump({"title": "States", "plan": entries}), encoding="utf-8")
    return path


def test_files_and_words(labpipe: Command, tmp_path: Path) -> None:
    folder = tmp_path / "planned"
    common = {
        "estimate": ["clearance", "viscosity"],
        "goal": {"clearance": "1 %", "viscosity": "2 %"},
        "duration": "90 s",
    }
    ended = labpipe("plan", write(tmp_path, **common), "-o", folder)
    assert ended.code == 0, ended.err
    assert "runs of the floating bearing under" in ended.out and "The goals are met" in ended.out
    plan = read_plan(folder / "plan.json")
    assert isinstance(plan, RunPlan) and plan.candidates == 2 and plan.efficiency > 0.5
    names = [number.name for number in plan.numbers]
    assert names[:3] == ["clearance", "viscosity", "k_xx[2000N-3000rpm]"] and len(names) == 18
    pipeline = yaml.safe_load((folder / "pipeline.yaml").read_text("utf-8"))
    assert [test["name"] for test in pipeline["tests"]] == [run.name for run in plan.runs]
    assert pipeline["tests"][0]["conditions"]["speed"] == "50.0 Hz"
    # The shaft's own 50 Hz and its neighbours are left out.
    assert pipeline["tests"][0]["frf"]["exclude"] == ["46.5-53.5 Hz"]
    signal = pc.read_csv(folder / "signals" / f"{plan.runs[0].name}-x.csv")["f [N]"].to_numpy()
    assert signal.size == 21 * 250 and np.abs(signal).max() <= 1e3 * (1 + 1e-6)
    assert labpipe("verify", folder).code == 0


def test_viscosity_and_clearance_change_what_the_speed_changes(tmp_path: Path) -> None:
    """K c / W and C c w / W are functions of mu w / (W c^2) alone (Reynolds): by logarithms
    dK/dmu = dK/dw, dC/dmu = dC/dw + C, dK/dc = -K - 2 dK/dw, dC/dc = -3 C - 2 dC/dw; dw by other speeds.
    """
    speeds = ["2990 rpm", "3000 rpm", "3010 rpm"]
    settings = load_plan(write(tmp_path, loads=["2 kN"], speeds=speeds)).settings
    bearing = open_bearing(BEARINGS / "floating-journal.yaml")
    common = [common_number(bearing, name) for name in ("viscosity", "clearance")]
    three = planned_states(settings, bearing, common)
    below, here, above = (np.array(list(state.model.expected)) for state in three)
    by_speed, damping = (above - below) / (20 / 3000), np.repeat([0, 1], 4)
    expected = np.stack([by_speed + damping * here, -(1 + 2 * damping) * here - 2 * by_speed], axis=1)
    size = np.repeat([np.abs(here[:4]).max(), here[4:].max()], 4)[:, None]
    np.testing.assert_allclose(three[1].slopes * [0.03, 1e-4] / size, expected / size, atol=3e-3)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"bearing": str(BEARINGS / "nsk-6208.yaml")}, "a file of a ball-bearing has no 'load'"),
        ({"estimate": ["colour"]}, "'colour' is not a number of a journal-bearing"),
        ({"duration": "60 s"}, "2 kinds of runs"),
        ({"goal": {"m_xx": "1 %"}}, "no m_xx is predicted"),
        ({"noise": None}, "one of 'noise' and 'noise_density' is needed"),
    ],
)
def test_refusals_name_place_and_remedy(
    labpipe: Command, tmp_path: Path, changes: dict[str, object], message: str
) -> None:
    ended = labpipe("plan", write(tmp_path, **changes), "-o", tmp_path / "out")
    assert ended.code == 2
    assert message in ended.err and "plan.yaml" in ended.err and "Traceback" not in ended.err
    assert not (tmp_path / "out").exists()


@pytest.mark.long
def test_states_tested_as_planned_end_within_the_predicted_errors(labpipe: Command, tmp_path: Path) -> None:
    """The written signals on the virtual rig, whose shaft moves along, and the pipeline of the plan over all
    states.
    """
    conditions = {
        f"{load:g}N-3000rpm": FilmCondition(film="journal", load=load, speed=50.0) for load in (2e3, 5e3)
    }
    rig = FloatingRig(
        "virtual-floating-rig",
        stator_mass=60.0,
        shaft_mass=50.0,
        conditions=tuple(conditions.items()),
        journal=JournalSettings(
            kind="journal-bearing", diameter=0.1, length=0.05, clearance=1e-4, viscosity=0.03
        ),
    )
    folder = tmp_path / "planned"
    ended = labpipe("plan", write(tmp_path, goal={"k_xy": "3 %", "k_yx": "3 %"}), "-o", folder)
    assert ended.code == 0, ended.err
    plan = _plan_of(tmp_path)
    assert len(plan.runs) == 2
    rng = np.random.default_rng(11)
    (folder / "recordings").mkdir()
    for run in plan.runs:
        forces = np.stack(
            [pc.read_csv(folder / "signals" / f"{run.name}-{axis}.csv")["f [N]"].to_numpy() for axis in "xy"],
            axis=1,
        )
        frequency = np.fft.rfftfreq(len(forces), 1 / 500)[1:]
        applied = np.fft.rfft(forces, axis=0)[1:]
        stator, shaft = motions(
            rig, conditions[run.name], frequency, np.hstack([applied, np.zeros_like(applied)])
        )
        seen = np.hstack([applied, stator - shaft, -((2 * np.pi * frequency[:, None]) ** 2) * stator])
        clean = np.fft.irfft(np.vstack([np.zeros(6), seen]), len(forces), axis=0)
        names = ["f_1 [N]", "f_2 [N]", "x [m]", "y [m]", "a_x [m/s^2]", "a_y [m/s^2]"]
        for name in run_names(run):
            noisy = clean + rng.normal(size=clean.shape) * np.repeat(list(NOISE.values()), 2)
            pc.write_csv(
                pa.table(dict(zip(names, noisy.T, strict=True))), folder / "recordings" / f"{name}.csv"
            )
    for stage in ("frf", "identify"):
        ended = labpipe(stage, "-c", folder / "pipeline.yaml", "-o", tmp_path / "out")
        assert ended.code == 0, ended.err
    fits = {
        fit["test"]: fit
        for fit in json.loads((tmp_path / "out/identification.json").read_text("utf-8"))["fits"]
    }
    errors = {number.name: number for number in plan.numbers}
    for run in plan.runs:
        true = dict(zip(COEFFICIENTS, np.ravel(coefficients(rig, conditions[run.name])[:2]), strict=True))
        found = {p["name"]: p for p in fits[run.name]["parameters"]}
        for name in COEFFICIENTS:
            number = errors[f"{name}[{run.name}]"]
            assert number.error is not None and number.scale is not None
            # Theory on its usual mesh and the rig's converged film differ by tenths of a per cent.
            assert abs(number.expected - true[name]) < 0.02 * number.scale
            assert abs(found[name]["value"] - true[name]) < 4 * number.error
            assert found[name]["std_error"] == pytest.approx(number.error, rel=0.3)
    _check_what_states_have_in_common(tmp_path, fits)


def _check_what_states_have_in_common(folder: Path, fits: dict[str, Any]) -> None:
    """Clearance and viscosity by one step of least squares from the coefficients of both states, weighted by
    their information.
    """
    settings = load_plan(write(folder, estimate=["clearance", "viscosity"])).settings
    tests = plan_states(settings, "", folder)[1]
    told, pulled = np.zeros((2, 2)), np.zeros(2)
    for name, test in tests.items():
        runs = next(run for run in _plan_of(folder).runs if run.name == name).count
        found = {p["name"]: p["value"] for p in fits[name]["parameters"]}
        change = np.array([found[coefficient] for coefficient in COEFFICIENTS]) - test.state.model.expected
        told += runs * test.state.slopes.T @ test.information @ test.state.slopes
        pulled += runs * test.state.slopes.T @ test.information @ change
    off, errors = np.linalg.solve(told, pulled), np.sqrt(np.diagonal(np.linalg.inv(told)))
    # The truth is what the bearing file says, but for the mesh of the theory.
    assert np.all(np.abs(off) < 4 * errors + 5e-3 * np.array([1e-4, 0.03]))
    assert np.all(errors < 0.01 * np.array([1e-4, 0.03]))


def _plan_of(folder: Path) -> RunPlan:
    plan = read_plan(folder / "planned" / "plan.json")
    assert isinstance(plan, RunPlan)
    return plan
