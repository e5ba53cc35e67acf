"""The section run_ups: of a pipeline: what is read, and every fault at its place in one pass."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from labpipe.artefacts.json_file import entry_of
from labpipe.errors import ConfigError
from labpipe.project.pipeline_file import Pipeline, load_pipeline
from labpipe.quantities import UnitError
from labpipe.records.settings import parse_phasor

ROOT = Path(__file__).parents[3]
HEAD = "title: t\nrun_ups:\n  rotor: {root}/configs/rotors/falah.yaml\n"
RUNS = "  runs:\n    - {{file: {root}/sample_data/falah/load-1.csv}}\n"


def read(tmp_path: Path, text: str) -> Pipeline:
    path = tmp_path / "p.yaml"
    path.write_text(text.format(root=ROOT), encoding="utf-8")
    return load_pipeline(path)


def refused(tmp_path: Path, text: str) -> str:
    with pytest.raises(ConfigError) as caught:
        read(tmp_path, text)
    return str(caught.value)


def test_defaults_and_files(tmp_path: Path) -> None:
    run = (
        "    - {{file: {root}/sample_data/falah/held-out.csv, role: held-out, load: 17 N, threshold: 4000 "
        "rpm +- 8 rpm}}\n"
    )
    pipeline = read(tmp_path, HEAD + RUNS + run)
    section = pipeline.sections["run_ups"]
    assert section.methods == ("points", "joint") and section.metamodels == () and section.bound == 0.3
    assert [(one.name, one.role) for one in section.runs] == [("load-1", "trained"), ("held-out", "held-out")]
    held = section.runs[1]
    assert held.load == 17 and held.threshold is not None and held.threshold.value == pytest.approx(4000 / 60)
    assert [path.name for path in pipeline.side_files] == ["falah.yaml", "load-1.csv", "held-out.csv"]


def test_an_unbalance_is_a_size_at_an_angle(tmp_path: Path) -> None:
    text = HEAD + RUNS.replace("}}", ", unbalance: {{disc 1: 50 g.mm at 60 deg, disc 2: 30 g.mm}}}}")
    section = read(tmp_path, text).sections["run_ups"]
    known = dict(section.runs[0].unbalance)
    assert known["disc 1"] == pytest.approx(5e-5 * np.exp(1j * np.pi / 3)) and known[
        "disc 2"
    ] == pytest.approx(3e-5)
    entry = entry_of(section)
    assert entry["runs"][0]["unbalance"][1] == ["disc 2", {"re": pytest.approx(3e-5), "im": 0.0}]
    assert "path" not in entry["runs"][0]
    with pytest.raises(UnitError, match="wrong dimension"):
        parse_phasor("50 g at 0 deg", "kg.m")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (HEAD, "run_ups.runs: is missing"),
        (HEAD + "  runs: []\n", "run_ups.runs: is empty"),
        (HEAD + "  runs:\n    - {{file: none.csv}}\n", "run_ups.runs.1.file: no such file 'none.csv'"),
        (HEAD + "  runs:\n    - {{load: 3 N}}\n", "one of 'file' and 'recording' is needed"),
        (HEAD + RUNS + RUNS.partition("\n")[2], "a second run named 'load-1'"),
        (
            HEAD + RUNS + RUNS.partition("\n")[2].replace("}}", ", name: again}}"),
            "several runs are of 'load-1",
        ),
        (HEAD + RUNS.replace("}}", ", role: held-out}}"), "every run is held out"),
        (HEAD + RUNS.replace("}}", ", role: test}}"), "unknown choice 'test'"),
        (HEAD + RUNS.replace("}}", ", load: -1 N}}"), "load must be positive"),
        (HEAD + RUNS.replace("}}", ", threshold: 2772 rpm}}"), "'threshold' needs its uncertainty"),
        (HEAD + RUNS.replace("}}", ", printed_threshold: [2838 rpm, 2475 rpm]}}"), "has three values"),
        (HEAD + RUNS.replace("}}", ", printed_threshold: [0 Hz, 1 Hz, 1 Hz]}}"), "three values above zero"),
        (HEAD + RUNS.replace("}}", ", tacho: n}}"), "run_ups.runs.1.tacho: 'tacho' belongs to a recording"),
        (HEAD + RUNS.replace("}}", ", pulses: 3}}"), "'pulses' belongs to a recording"),
        (HEAD + "  methods: [joint, joint]\n" + RUNS, "run_ups.methods: 'joint' is named twice"),
        (HEAD + "  methods: []\n" + RUNS, "run_ups.methods: is empty"),
        (HEAD + RUNS.replace("}}", ", unbalance: {{disc 1: 50 mm}}}}"), "run_ups.runs.1.unbalance: disc 1: "),
        (HEAD + RUNS.replace("}}", ", unbalence: 3}}"), "unbalence: unknown key"),
        (HEAD + "  methods: [jiont]\n" + RUNS, "unknown name 'jiont'; did you mean 'joint'"),
        (
            HEAD + "  metamodels: [physical]\n  methods: [points]\n" + RUNS,
            "metamodels need the method 'joint'",
        ),
        (HEAD + "  plane: disc 3\n" + RUNS, "no plane 'disc 3'"),
        (HEAD + "  bound: 120 %\n" + RUNS, "'bound' lies between 0 and 100 %"),
        (HEAD.replace("falah.yaml", "none.yaml") + RUNS, "run_ups.rotor: no such file"),
        (
            HEAD
            + "  runs:\n    - {{recording: {root}/sample_data/hmb-loop/run-up.parquet, tacho: n, load: 3 "
            "N}}\n",
            "unbalance: is missing",
        ),
        (
            HEAD + "  runs:\n    - {{recording: {root}/sample_data/hmb-loop/run-up.parquet, load: 3 N}}\n",
            "'tacho' is missing",
        ),
        (
            HEAD + "  runs:\n    - {{recording: {root}/sample_data/hmb-loop/run-up.parquet, tacho: n}}\n",
            "'load' is missing",
        ),
        (
            # Another first pulse turns all phasors by a quarter turn.
            HEAD
            + "  runs:\n    - {{recording: {root}/sample_data/hmb-loop/run-up.parquet, tacho: n, load: 3 "
            "N, pulses: 4, unbalance: {{disc 1: 50 g.mm at 0 deg}}}}\n",
            "run_ups.runs.1.pulses: of several pulses a revolution none marks the angle",
        ),
        (HEAD + RUNS + "expect: {{run_up.joint.rank: 4}}\n", "there is no fit 'run_up'"),
    ],
)
def test_faults_are_said_at_their_place(tmp_path: Path, text: str, said: str) -> None:
    message = refused(tmp_path, text)
    assert said in message and "p.yaml:" in message, message


def test_all_faults_in_one_pass(tmp_path: Path) -> None:
    message = refused(
        tmp_path, HEAD + "  bound: 3\n  runs:\n    - {{file: none.csv}}\n    - {{file: no.csv, role: x}}\n"
    )
    assert all(part in message for part in ("'bound'", "none.csv", "unknown choice 'x'")), message
