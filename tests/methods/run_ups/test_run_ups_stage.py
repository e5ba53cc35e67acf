"""Run-ups of a pipeline: read from tables and recordings, residuals subtracted, every method compared with
every run, rules on them.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from labpipe.artefacts.json_file import entry_of, record_of
from labpipe.artefacts.writing import output_folder
from labpipe.errors import ConfigError, DataError
from labpipe.methods.run_ups.methods import with_unbalance_of
from labpipe.methods.run_ups.records import RunUp, RunUpResult
from labpipe.methods.run_ups.rotor import RunUpRotor, largest_displacement
from labpipe.methods.run_ups.rotor_file import load_run_up_rotor
from labpipe.methods.run_ups.run_up_csv import read_run_up_csv, write_run_up_csv
from labpipe.methods.run_ups.section import identify_run_ups
from labpipe.project.judging import judge
from labpipe.project.marked_yaml import Marked
from labpipe.project.pipeline_file import load_pipeline
from labpipe.project.rules import Rule, read_rules
from labpipe.project.settings_reader import Faults

ROOT = Path(__file__).parents[3]
RIG: RunUpRotor = load_run_up_rotor(ROOT / "configs/rotors/falah.yaml")
SAMPLES = ROOT / "sample_data/falah"
RPM = np.pi / 30


def identified(folder: Path, runs: str, methods: str = "[points]", further: str = "") -> RunUpResult:
    """The result of a section with these runs."""
    path = folder / "p.yaml"
    section = (
        f"run_ups:\n  rotor: {ROOT}/configs/rotors/falah.yaml\n  methods: {methods}\n{further}  runs:\n{runs}"
    )
    path.write_text(section, encoding="utf-8")
    settings = load_pipeline(path).sections["run_ups"]
    assert settings is not None
    with output_folder(folder / "out") as output:
        found = identify_run_ups(settings, output, folder)
        output.write_path("done").write_text("", encoding="utf-8")
    return found


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> RunUpResult:
    runs = "".join(f"    - {{file: {SAMPLES}/load-{n}.csv}}\n" for n in (1, 2, 3, 4))
    runs += f"    - {{file: {SAMPLES}/held-out.csv, role: held-out}}\n"
    methods = "[amplitudes, points, joint]"
    further = "  starts: 2\n  metamodels: [response-surface, physical]\n"
    return identified(tmp_path_factory.mktemp("run-ups"), runs, methods, further)


@pytest.mark.long
def test_every_method_speaks_of_every_run(whole: RunUpResult) -> None:
    assert [method.name for method in whole.methods] == ["start", "amplitudes", "points", "joint"]
    for method in whole.methods:
        assert [one.run for one in method.predictions] == [run.name for run in whole.runs]
    points, joint = whole.method("points"), whole.method("joint")
    assert points is not None and joint is not None
    held = points.prediction("held-out")
    assert held is not None and held.critical_speed is None and "fitted loads only" in held.notes[0]
    assert (
        points.rank == 4
        and points.verdict == "not determined"
        and joint.verdict == "not rejected"
        and len(joint.parameters) == 12
    )
    told = joint.prediction("held-out")
    assert told is not None and told.critical_speed is not None and told.critical_speed.std_error is not None
    assert {finding.code for finding in whole.findings} == {"collinear", "extrapolated", "experiment"}


def test_predictions_of_the_start_are_the_rotor_files_own(whole: RunUpResult) -> None:
    start = whole.method("start")
    assert start is not None
    for run in whole.runs:
        told = start.prediction(run.name)
        assert told is not None and told.critical_speed is not None and told.threshold is not None
        assert told.critical_speed.value == pytest.approx(RIG.critical_speed(RIG.start(run.load)))
        assert told.threshold.value == pytest.approx(RIG.threshold(RIG.start(run.load)), rel=1e-6)
        # The curve is the response itself, and it ends at the threshold.
        speed = np.array(told.speed)
        expected = RIG.response(speed, RIG.start(run.load))
        np.testing.assert_allclose(told.motions[2].real, expected[:, 1, 0].real, rtol=1e-5, atol=1e-11)
        assert speed[-1] <= told.threshold.value


def test_the_search_shows_its_convergence_and_its_spread(whole: RunUpResult) -> None:
    amplitudes = whole.method("amplitudes")
    assert amplitudes is not None and amplitudes.rank == 2 and amplitudes.chi2_per_datum is None
    (search,) = amplitudes.convergence
    assert (
        np.all(np.diff(search.objective) <= 0)
        and len(search.mesh) == len(search.evaluations)
        and len(search.best) == 8
    )
    # Of the third of four loads, where the rotor moves most and at the last speed.
    run = read_run_up_csv(SAMPLES / "load-3.csv")
    largest = np.argmax(np.sum(largest_displacement(run.response) ** 2, axis=1))
    assert [spread.where for spread in amplitudes.spreads] == [
        f"{run.load:.3g} N, {speed / RPM:.0f} rpm" for speed in run.speed[[largest, -1]]
    ]
    for spread in amplitudes.spreads:
        factors = np.array(spread.factors)
        assert (
            factors.shape == (2, 8)
            and np.all(np.abs(factors - 1) <= 0.3 + 1e-9)
            and max(spread.objective) < 0.05
        )


def test_metamodels_of_the_joint_fit(whole: RunUpResult) -> None:
    surface, physical = whole.metamodels
    assert (
        surface.name == "response-surface"
        and len(surface.left_out) == 4
        and [one.outside for one in surface.left_out] == [1, 0, 0, 1]
    )
    joint = whole.method("joint")
    assert joint is not None
    for run in whole.runs:
        own, same = physical.prediction(run.name), joint.prediction(run.name)
        assert (
            own is not None
            and same is not None
            and own.critical_speed is not None
            and same.critical_speed is not None
        )
        assert own.critical_speed.value == pytest.approx(same.critical_speed.value, rel=1e-9)
    assert np.array(surface.surface.values).shape == (
        8,
        len(surface.surface.load),
        len(surface.surface.speed),
    )
    assert surface.model["kind"] == "surface" and "PRESS" in surface.remarks[0]


def test_the_record_comes_back_from_its_entry(whole: RunUpResult) -> None:
    again = record_of(entry_of(whole), RunUpResult)
    assert repr(again) == repr(whole)


def ruled(result: RunUpResult, address: str, text: str) -> tuple[object, bool]:
    faults = Faults()
    node = Marked({address: Marked(text, "here", text=text)}, "here")
    rules: tuple[Rule, ...] = read_rules("expect", node, faults, ("run_ups",), {})
    faults.raise_any()
    (outcome,) = judge(rules, (), {"run_ups": result})
    return outcome.value, outcome.passed


def test_a_speed_and_its_interval_are_shown_in_the_unit_of_the_rule(whole: RunUpResult) -> None:
    """The records hold angular speeds: Omega 30 / pi is in rpm."""
    amount = (
        next(method for method in whole.methods if method.name == "joint")
        .prediction("held-out")
        .critical_speed
    )
    rules = read_rules(
        "expect",
        Marked(
            {
                f"run_ups.joint[held-out].critical_speed{end}": Marked("1740 rpm", "here", text="1740 rpm")
                for end in ("", ".covers")
            },
            "here",
        ),
        Faults(),
        ("run_ups",),
        {},
    )
    speed, interval = (outcome.found for outcome in judge(rules, (), {"run_ups": whole}))
    rpm = 30 / np.pi
    assert speed == f"{rpm * amount.value:.6g} rpm"
    assert interval == f"{rpm * amount.ci95[0]:.6g} rpm to {rpm * amount.ci95[1]:.6g} rpm"


@pytest.mark.parametrize(
    ("address", "text", "passed"),
    [
        ("run_ups.joint[held-out].critical_speed", "1740.03 rpm +- .2 %", True),
        ("run_ups.joint[held-out].critical_speed", "1600 rpm +- 1 %", False),
        ("run_ups.joint.critical_speed.difference", "<= 0.3 %", True),
        ("run_ups.start.critical_speed.difference", "<= 0.3 %", False),
        ("run_ups.joint[load-1].threshold.std_error", "<= 10 rpm", True),
        ("run_ups.measured[held-out].critical_speed.covers", "1740.03 rpm", True),
        ("run_ups.joint[held-out].critical_speed.covers", "1700 rpm", False),
        ("run_ups.points[held-out].critical_speed.covers", "1700 rpm", False),
        ("run_ups.points[held-out].critical_speed", ">= 0 rpm", False),
        ("run_ups.physical[load-1].critical_speed", "1384.50 rpm +- .2 %", True),
        ("run_ups.response-surface.left_out", "<= 50 %", True),
        ("run_ups.points.rank", "4", True),
        ("run_ups.joint.chi2_reduced", "<= 1.3", True),
        ("run_ups.points.share_at_bound", "<= 50 %", True),
        ("run_ups.joint.verdict", "not rejected", True),
        ("run_ups.points.verdict", "determined", False),
        ("run_ups.warnings", "collinear", True),
        ("run_ups.warnings", "not model-mismatch", True),
        ("run_ups.warnings", "also collinear", True),
        ("run_ups.warnings", "none", False),
    ],
)
def test_rules(whole: RunUpResult, address: str, text: str, passed: bool) -> None:
    value, held = ruled(whole, address, text)
    assert held is passed, value


@pytest.mark.parametrize(
    ("address", "said"),
    [
        ("run_ups.jiont[held-out].critical_speed", "there is no method 'jiont'; did you mean 'joint'"),
        ("run_ups.joint[held-in].critical_speed", "there is no run 'held-in'"),
        ("run_ups.joint.rnak", "a method has no 'rnak'; did you mean 'rank'"),
        ("run_ups.physical.rank", "a metamodel has no 'rank'"),
        ("run_ups.joint[load-1].threshold.cover", "a speed has no 'cover'; did you mean 'covers'"),
        ("run_ups.nobody.rank", "there is no method 'nobody'"),
        ("run_ups.joint", "is not an address"),
    ],
)
def test_rules_on_what_there_is_not(whole: RunUpResult, address: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said.replace("[", r"\[")):
        ruled(whole, address, ">= 1")
    with pytest.raises(ConfigError, match=r"wrong dimension"):
        ruled(whole, "run_ups.joint[held-out].threshold.covers", "4 N")


def test_a_second_unbalance_adds_no_rank_and_a_residual_is_subtracted(tmp_path: Path) -> None:
    """Two runs with weights on either disc, of which one carries the other's as its residual: their
    difference is the first alone.
    """
    first, coefficients = read_run_up_csv(SAMPLES / "load-2.csv"), RIG.start(5.87610075)
    both = {"disc 1": 5e-5 + 0j, "disc 2": 3e-5j}
    residual = made(first, {"disc 2": 3e-5j}, coefficients)
    write_run_up_csv(tmp_path / "both.csv", made(first, both, coefficients))
    write_run_up_csv(tmp_path / "residual.csv", residual)
    alone = made(first, {"disc 1": 5e-5 + 0j}, coefficients)
    write_run_up_csv(tmp_path / "other.csv", residual)
    runs = "    - {file: both.csv, subtract: residual.csv}\n    - {file: other.csv}\n"
    result = identified(tmp_path, runs)
    net = result.runs[0]
    assert net.subtracted == "residual.csv" and "disc 1: 50 g mm at 0 deg" in net.excitation
    np.testing.assert_allclose(net.motions[0].real, alone.response[:, 0, 0].real, rtol=1e-4, atol=1e-10)
    assert (
        result.measured_rank is not None
        and result.measured_rank.rank == 4
        and "adds no rank" in result.measured_rank.advice
    )
    told = result.methods[0].prediction("both")
    own = with_unbalance_of(RIG, alone)
    assert told is not None and told.critical_speed is not None
    assert told.critical_speed.value == pytest.approx(own.critical_speed(coefficients))
    assert any("'residual.csv' is subtracted" in finding.message for finding in result.findings)


def made(like: RunUp, unbalance: dict[str, complex], coefficients: object) -> RunUp:
    """A run without noise, at the speeds of another."""
    bare = replace(like, unbalance=unbalance, threshold=None)
    response = RIG.excite(bare).response(*coefficients(like.speed)).reshape(like.response.shape)  # type: ignore[operator]
    return replace(
        bare,
        response=response,
        amplitude_error=0.01 * np.abs(response),
        phase_error=np.full(response.shape, 0.02),
    )


def test_a_table_without_unbalance_takes_the_pipelines(tmp_path: Path) -> None:
    lines = (SAMPLES / "load-1.csv").read_text("utf-8").splitlines(keepends=True)
    (tmp_path / "bare.csv").write_text(
        "".join(line for line in lines if "unbalance" not in line), encoding="utf-8"
    )
    with pytest.raises(DataError, match="either an unbalance or a shaker"):
        identified(tmp_path, "    - {file: bare.csv}\n")
    stated = "unbalance: {disc 1: 50 g.mm, disc 2: 30 g.mm at 60 deg}"
    result = identified(
        tmp_path, f"    - {{file: bare.csv, {stated}, load: 4 N, threshold: 2800 rpm +- 5 rpm}}\n"
    )
    run = result.runs[0]
    assert run.load == 4 and run.threshold is not None and run.threshold.value == pytest.approx(2800 * RPM)
    assert run.excitation == "disc 1: 50 g mm at 0 deg; disc 2: 30 g mm at 60 deg"


def test_faults_of_the_data_are_told_with_their_run(tmp_path: Path) -> None:
    text = (SAMPLES / "load-1.csv").read_text("utf-8").replace("disc 2", "disc two")
    (tmp_path / "planes.csv").write_text(text, encoding="utf-8")
    with pytest.raises(DataError, match="the rotor has disc 1, disc 2") as caught:
        identified(tmp_path, "    - {file: planes.csv}\n")
    assert "planes" in str(caught.value)
    assert not (tmp_path / "out").exists()


RECORDED = """name: Recorded run-up
sample_rate: 2 kHz
channels:
  a: {column: ax, quantity: displacement, unit: um, role: output, dof: disc 1.x}
  b: {column: ay, quantity: displacement, unit: um, role: output, dof: disc 1.y}
  c: {column: bx, quantity: displacement, unit: um, role: output, dof: disc 2.x}
  d: {column: by, quantity: displacement, unit: um, role: output, dof: disc 2.y}
  n: {column: n, quantity: tacho, unit: V, role: reference}
"""
LOAD = 8.0


def recorded(path: Path, unbalance: dict[str, complex]) -> None:
    """A slow sweep from 900 to 2100 rpm: at every instant the steady motion of that speed, the rotor file's
    bearing under LOAD.
    """
    time = np.arange(0, 100, 1 / 2000)
    speed = np.linspace(900, 2100, time.size) * RPM
    revolutions = np.cumsum(speed) / 2000 / (2 * np.pi)
    grid = np.arange(880.0, 2121.0, 10.0) * RPM
    phasors = RIG.condense(grid, unbalance).response(*RIG.start_coefficients(LOAD, grid))
    there = np.stack(
        [np.interp(speed, grid, one.real) + 1j * np.interp(speed, grid, one.imag) for one in phasors.T]
    )
    motion = 1e6 * np.real(there * np.exp(2j * np.pi * revolutions))
    noise = 0.05 * np.random.default_rng(3).standard_normal(motion.shape)
    columns = dict(zip(("ax", "ay", "bx", "by"), motion + noise, strict=True))
    pd.DataFrame({**columns, "n": np.where(revolutions % 1 < 0.5, 5.0, 0.0)}).to_parquet(path)


@pytest.mark.long
def test_a_recording_with_its_residual_gives_the_run_and_its_cascade(tmp_path: Path) -> None:
    known = RIG.known_unbalance
    left = {"disc 2": 2e-5j}
    recorded(
        tmp_path / "sweep.run.parquet",
        {"disc 1": known["disc 1"], "disc 2": known["disc 2"] + left["disc 2"]},
    )
    recorded(tmp_path / "sweep.left.parquet", left)
    (tmp_path / "rig.yaml").write_text(RECORDED, encoding="utf-8")
    what = (
        "rig: rig.yaml, tacho: n, load: 8 N, unbalance: {disc 1: 50 g.mm, disc 2: 30 g.mm at 60 deg}, "
        "revolutions: 15"
    )
    result = identified(
        tmp_path,
        f"    - {{name: ../../8 N, recording: sweep.run.parquet, {what}, subtract: sweep.left.parquet}}\n",
    )
    (run,) = result.runs
    assert run.critical_speed is not None and run.critical_speed.value == pytest.approx(
        RIG.critical_speed(RIG.start(LOAD)), rel=3e-3
    )
    # The tracked motion, less the residual's, is that of the known unbalance; pulses are known to half a
    # sample of 2000 a second, some 3 deg each.
    exact = RIG.response(np.array(run.speed), RIG.start(LOAD)).reshape(len(run.speed), 4)
    for number, motion in enumerate(run.motions):
        found = np.array(motion.real) + 1j * np.array(motion.imag)
        assert np.max(np.abs(found - exact[:, number])) < 0.06 * np.max(np.abs(exact[:, number]))
    assert [cascade.label for cascade in run.cascades] == ["a", "b", "c", "d"]
    cascade = run.cascades[0]
    peaks = np.array(cascade.frequency)[np.argmax(np.array(cascade.amplitude), axis=1)]
    np.testing.assert_allclose(peaks, cascade.speed, atol=1.1)
    # A name is not a path: the files stand where results stand, and nowhere else.
    assert {path.name for path in (tmp_path / "out/recordings").iterdir()} == {
        "..-..-8-N.recording.parquet",
        "..-..-8-N-residual.recording.parquet",
    }


@pytest.mark.parametrize("names", [("5 N", "5-N"), ("5 N", "5-N-residual")])
def test_two_recordings_of_one_file_are_refused(tmp_path: Path, names: tuple[str, str]) -> None:
    """Runs whose names differ in what no file name has shared one recording, that of the last."""
    what = "tacho: n, load: 8 N, unbalance: {disc 1: 50 g.mm}, subtract: b.parquet"
    pairs = zip(names, "ac", strict=True)
    runs = "".join(f"    - {{name: {name}, recording: {file}.parquet, {what}}}\n" for name, file in pairs)
    for name in "abc":
        (tmp_path / f"{name}.parquet").touch()
    with pytest.raises(ConfigError, match=r"'5.N.*' and '5.N.*' would write the same file"):
        identified(tmp_path, runs)


def test_a_raw_recording_needs_its_rig(tmp_path: Path) -> None:
    pd.DataFrame({"ax": [1.0, 2.0]}).to_parquet(tmp_path / "raw.parquet")
    with pytest.raises(DataError, match="a raw file needs its rig file"):
        identified(
            tmp_path, "    - {recording: raw.parquet, tacho: n, load: 8 N, unbalance: {disc 1: 50 g.mm}}\n"
        )
