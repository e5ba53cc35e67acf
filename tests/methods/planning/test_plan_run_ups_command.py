"""labpipe plan for run-ups: files, words, refusals, and tables recorded as planned that end within the
predicted errors.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

from labpipe.errors import ConfigError
from labpipe.methods.planning import run_ups
from labpipe.methods.planning.plan_file import load_plan, read_plan
from labpipe.methods.planning.records import RunPlan
from labpipe.methods.planning.report import run_names
from labpipe.methods.planning.run_ups import (
    EXPONENTS,
    RunCandidate,
    RunUpChoice,
    RunUpPlanSettings,
    TrialSettings,
    expected_rig,
    expected_run,
    limit_speeds,
)
from labpipe.methods.rotor.posterior import rank_of
from labpipe.methods.run_ups.joint import family_about, fit_jointly
from labpipe.methods.run_ups.records import HELD_OUT, TRAINED, MeasuredRun, RunUp, RunUpMethod, RunUpResult
from labpipe.methods.run_ups.rotor import PARAMETERS, PRIOR
from labpipe.methods.run_ups.rotor_file import load_run_up_rotor
from labpipe.methods.run_ups.run_up_csv import read_run_up_csv, write_run_up_csv
from labpipe.records.finding import Parameter
from labpipe.records.uncertain import Uncertain
from tests.conftest import Command

ROTOR = Path(__file__).parents[3] / "configs/rotors/falah.yaml"
PLAN = {
    "model": "run-ups",
    "rotor": str(ROTOR),
    "loads": ["5.88 N", "10.3 N"],
    "speeds": "600-3000 rpm",
    "step": "200 rpm",
    "stretches": 2,
    "dwell": "10 s",
    "duration": "5 min",
    "trials": {
        "both": {"unbalance": {"disc 1": "50 g.mm", "disc 2": "30 g.mm at 60 deg"}},
        "one": {"unbalance": {"disc 2": "50 g.mm"}},
    },
    "noise": {"amplitude": "1 %", "displacement": "0.5 um", "phase": "1 deg", "threshold": "0.2 %"},
    "to_threshold": True,
    "known": ["clearance"],
    "at_load": "8 N",
    "at_speed": "1800 rpm",
    "goal": {"k_xy": "10 %", "threshold": "1 %"},
}


def _write(folder: Path, **changes: object) -> Path:
    path = folder / "plan.yaml"
    entries = {name: value for name, value in {**PLAN, **changes}.items() if value is not None}
    path.write_text(yaml.safe_dump({"title": "Film", "plan": entries}), encoding="utf-8")
    return path


def test_a_plan_takes_no_table_for_the_film() -> None:
    """The rotor file goes into the plan's folder, where a relative path of it leads nowhere."""
    rig = replace(load_run_up_rotor(ROTOR), tabulated=object())  # type: ignore[arg-type]
    trials = (("a", TrialSettings(unbalance=(("disc 1", 1e-5 + 0j),))),)
    times = {"step": 5.0, "dwell": 10.0, "duration": 600.0}
    with pytest.raises(ConfigError, match="made of the film, not of `coefficients`"):
        RunUpPlanSettings("run-ups", "r", loads=(5.0,), speeds=(10.0, 50.0), trials=trials, rig=rig, **times)


def _read(run: RunUp, rng: np.random.Generator) -> RunUp:
    """A run as its noise leaves it."""
    shape = run.response.shape
    size = 1 + run.amplitude_error / np.abs(run.response) * rng.standard_normal(shape)
    noisy = run.response * size * np.exp(1j * run.phase_error * rng.standard_normal(shape))
    threshold = None
    if run.threshold is not None:
        threshold = Uncertain(
            run.threshold.value + run.threshold.std_error * rng.standard_normal(), run.threshold.std_error
        )
    return replace(run, response=noisy, threshold=threshold)


def test_names_of_trials_are_names_of_files() -> None:
    """No name leads out of the folder, and no two name one file."""
    rig, trial = load_run_up_rotor(ROTOR), TrialSettings(unbalance=(("disc 1", 1e-5 + 0j),))
    entries = {"loads": (5.0,), "speeds": (10.0, 50.0), "step": 5.0, "dwell": 10.0, "duration": 600.0}
    settings = RunUpPlanSettings("run-ups", "r", trials=(("../a/b", trial),), rig=rig, **entries)
    names = {candidate.name for candidate in RunUpChoice(settings, expected_rig(settings, {})).iterate_runs()}
    assert names == {f"load-1-..-a-b-{number}" for number in (1, 2, 3)}
    with pytest.raises(ConfigError, match="two trials would write the same files"):
        RunUpPlanSettings("run-ups", "r", trials=(("a/b", trial), ("a b", trial)), rig=rig, **entries)


def test_an_earlier_viscosity_is_referred_to_the_loads_and_speeds_of_the_plan(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The film of the earlier result, at its own references, is the one that is expected."""
    parameters = {"viscosity": 0.8, "viscosity_speed": -0.4, "viscosity_load": 0.2, "clearance": 1.1}
    listed = tuple(Parameter(name, value, "1") for name, value in parameters.items())
    runs = tuple(
        MeasuredRun(f"{load:g}", load, role, excitation="", speed=(60.0, 600.0), motions=())
        for load, role in ((4.0, TRAINED), (9.0, TRAINED), (40.0, HELD_OUT))
    )
    method = RunUpMethod("joint", "(c)", "not rejected", predictions=(), parameters=listed)
    result = RunUpResult("rotor", "disc 1", "film", runs=runs, methods=(method,))
    found = SimpleNamespace(sections={"run_ups": result})
    monkeypatch.setattr(run_ups, "read_identification", lambda _path: found)
    (tmp_path / "identification.json").touch()
    lines = ROTOR.read_text("utf-8").splitlines(keepends=True)
    bare = "".join(line for line in lines if not line.startswith("speeds:"))
    (tmp_path / "bare.yaml").write_text(bare, encoding="utf-8")
    file = load_plan(_write(tmp_path, rotor="bare.yaml", earlier="identification.json", known=None))
    expected = run_ups.expected_rig(file.settings, run_ups.earlier_parameters(file))
    rig = replace(file.settings.rig, speeds=(60.0, 600.0))
    old = np.zeros(12)
    old[:4] = np.log(0.8), -0.4, 0.2, np.log(1.1)
    load, speed = np.array([5.0, 10.0]), np.array([100.0, 250.0])
    np.testing.assert_allclose(
        expected.family.coefficients(expected.values, load, speed),
        family_about(rig, [4.0, 9.0]).coefficients(old, load, speed),
    )


def test_files_and_words(labpipe: Command, tmp_path: Path) -> None:
    folder = tmp_path / "planned"
    ended = labpipe("plan", _write(tmp_path), "-o", folder)
    assert ended.code == 0, ended.err
    assert "The goals are" in ended.out and "times better by the largest error" in ended.out
    plan = read_plan(folder / "plan.json")
    assert isinstance(plan, RunPlan) and plan.efficiency > 0.9 and plan.gain > 1 and plan.duration <= 300
    page = (folder / "report.html").read_text("utf-8")
    assert "Runs to make" in page
    # Rounded down, and never to more than there is.
    sure = float(page.partition("an efficiency (by variances) of at least ")[2].partition(" %")[0])
    assert 100 * plan.efficiency - 0.01 < sure <= 100 * plan.efficiency
    assert len((folder / "runs.csv").read_text("utf-8").splitlines()) == len(plan.runs) + 1
    assert labpipe("verify", folder).code == 0


@pytest.mark.long
def test_runs_read_as_planned_end_within_the_predicted_errors(labpipe: Command, tmp_path: Path) -> None:
    folder = tmp_path / "planned"
    assert labpipe("plan", _write(tmp_path), "-o", folder).code == 0
    plan = read_plan(folder / "plan.json")
    assert isinstance(plan, RunPlan)
    rng = np.random.default_rng(5)
    (folder / "recordings").mkdir()
    for run in plan.runs:
        expected = read_run_up_csv(folder / f"expected/{run.name}.csv")
        for name in run_names(run):
            write_run_up_csv(folder / f"recordings/{name}.csv", _read(expected, rng))
    ended = labpipe("run", folder / "pipeline.yaml", "-o", tmp_path / "out")
    assert ended.code == 0, ended.err
    (method,) = [
        m
        for m in json.loads((tmp_path / "out/identification.json").read_text("utf-8"))["run_ups"]["methods"]
        if m["name"] == "joint"
    ]
    found = {p["name"]: p for p in method["parameters"]}
    assert "clearance" not in found and method["unknowns"] == 11
    for number in plan.numbers:
        if number.name in found and number.error is not None:
            assert abs(found[number.name]["value"] - number.expected) < 4 * number.error
            factor = 1.0 if number.name in EXPONENTS else found[number.name]["value"]
            assert found[number.name]["std_error"] == pytest.approx(number.error * factor, rel=0.35)
    # What was found is what is expected of the next runs.
    ended = labpipe("plan", _write(tmp_path, earlier="out/identification.json"), "-o", tmp_path / "second")
    assert ended.code == 0, ended.err
    again = {number.name: number.expected for number in read_plan(tmp_path / "second/plan.json").numbers}
    assert again["viscosity"] == pytest.approx(found["viscosity"]["value"])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        # Without a measured clearance no run-up separates it from viscosity and all factors: rank 11 of 12.
        (
            {"known": [], "goal": {"clearance": "1 %"}},
            "however many runs there are, they do not determine clearance",
        ),
        (
            {"known": [], "goal": {"clearance": "1 %"}},
            "a measured clearance (known: clearance) would determine all",
        ),
        ({"goal": {"k_zz": "2 %"}}, "no k_zz is predicted"),
        ({"goal": {"clearance": "2 %"}}, "clearance is known"),
        ({"known": ["oil"]}, "the film has no parameter oil"),
        ({"trials": {}}, "trials: is empty"),
        ({"trials": {"a": {}}}, "a trial has an unbalance or a shaker"),
        ({"trials": {"a": {"unbalance": {"disc 1": "0 g.mm"}}}}, "the trial unbalance is zero"),
        (
            {"trials": {name: {"unbalance": {"disc 1": "1 g.mm"}} for name in ("a b", "a-b")}},
            "two trials would write the same files",
        ),
        ({"loads": ["6 N", "6 N"]}, "loads: one appears twice"),
        ({"trials": {"a": {"unbalance": {"disc 3": "1 g.mm"}}}}, "no plane 'disc 3'"),
        ({"displacement_limit": "1 nm"}, "no run keeps within the limits"),
        ({"expected": {"viscosity": 50}}, "beyond what a joint fit looks for"),
        ({"duration": "3 s"}, "no run fits into 3 s"),
        ({"stretches": 20}, "make no 20 stretches"),
        ({"model": "run-upss"}, "did you mean 'run-ups'"),
        ({"dwel": "3 s"}, "did you mean 'dwell'"),
        ({"step": "130 rpm"}, "steps from end to end; a whole number of them"),
    ],
)
def test_refusals_name_place_and_remedy(
    labpipe: Command, tmp_path: Path, changes: dict[str, object], message: str
) -> None:
    quick = {"to_threshold": False, "stretches": 1, "step": "400 rpm"}
    ended = labpipe("plan", _write(tmp_path, **{**quick, **changes}), "-o", tmp_path / "out")
    assert ended.code == 2
    assert message in ended.err and "plan.yaml" in ended.err and "Traceback" not in ended.err
    assert not (tmp_path / "out").exists()


def choice_of(settings: RunUpPlanSettings) -> RunUpChoice:
    return RunUpChoice(settings, expected_rig(settings, {}))


@pytest.fixture(scope="module")
def one_load(tmp_path_factory: pytest.TempPathFactory) -> RunUpChoice:
    folder = tmp_path_factory.mktemp("one-load")
    file = load_plan(_write(folder, loads=["8 N"], goal=None, to_threshold=False, stretches=1))
    return choice_of(file.settings)


def test_a_run_keeps_the_speeds_within_its_limits_if_they_are_two(one_load: RunUpChoice) -> None:
    """The largest displacement of every speed by its orbit, point by point over a turn; limits between the
    two smallest, and above the second.
    """
    expected, run = one_load.expected, RunCandidate("a", 8.0, np.array([120.0, 130, 140]), {"disc 1": 5e-5})
    turn = np.exp(2j * np.pi * np.linspace(0, 1, 3601))
    orbit = np.real(expected_run(expected, run).response[..., None] * turn)
    largest = np.max(np.hypot(orbit[:, :, 0], orbit[:, :, 1]), axis=(1, 2))
    low, middle, high = np.argsort(largest)
    kept = limit_speeds(expected, run, np.sqrt(largest[middle] * largest[high]))
    assert kept is not None and set(kept.speed) == set(run.speed[[low, middle]])
    assert limit_speeds(expected, run, np.sqrt(largest[low] * largest[middle])) is None


def test_one_load_leaves_the_load_s_exponent_open(one_load: RunUpChoice) -> None:
    plan = one_load.plan("").plan
    assert "viscosity_load +1.00" in plan.undetermined
    assert plan.remedies == ("a second load",)


@pytest.mark.long
def test_the_remedy_works_and_predicted_errors_are_those_of_draws(tmp_path: Path) -> None:
    """Where the plan names a measured clearance as the change, fits with it tell all, and scatter as
    predicted.
    """
    file = load_plan(_write(tmp_path, known=[], goal=None, at_load=None, at_speed=None))
    plan = choice_of(file.settings).plan("").plan
    assert plan.remedies == ("a measured clearance (known: clearance)",)
    file = load_plan(_write(tmp_path, goal=None, duration="20 min", to_threshold=False))
    choice = choice_of(file.settings)
    answered = choice.plan("")
    assert answered.plan.undetermined == ()
    runs = [choice.run(run.name) for run in answered.plan.runs for _ in range(run.count)]
    free = np.array([name != "clearance" for name in PARAMETERS])
    prior = np.diag(PRIOR[free] ** -2.0)
    covariance = answered.covariance[np.ix_(free, free)]
    information = np.linalg.inv(covariance) - prior
    assert rank_of(np.linalg.cholesky(information).T)[0] == 11
    # At one truth the estimates scatter by C I C, less than C, which holds for truths drawn from the prior.
    scatter = covariance @ information @ covariance
    rng = np.random.default_rng(8)
    draws = np.array(
        [
            fit_jointly(choice.expected.rig, [_read(run, rng) for run in runs], known=("clearance",)).values
            for _ in range(80)
        ]
    )
    away = draws[:, free] - draws[:, free].mean(axis=0)
    square = np.einsum("di,ij,dj->d", away, np.linalg.inv(scatter), away).sum() / (79 * 11)
    # The mean square of 79 x 11 normal numbers wanders by sqrt(2 / 869) = 4.8 %.
    assert square == pytest.approx(1.0, abs=0.15)
