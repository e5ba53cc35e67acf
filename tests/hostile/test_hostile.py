"""Hostile and impossible inputs: each once ended in a traceback, a hang, or acted on the terminal."""

from __future__ import annotations

import importlib
import itertools
import json
import os
import struct
import sys
import time
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from labpipe.artefacts.json_file import json_bytes
from labpipe.artefacts.writing import cell, text_of
from labpipe.cli.main import main
from labpipe.cli.output import LONGEST, message_line, printable
from labpipe.errors import DataError
from labpipe.raw_files import mat, table as probe
from labpipe.raw_files.table import open_table
from tests.conftest import Command
from tests.project.laboratory import ALONE, contents, done, laboratory, recording

SECONDS = 10.0


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    laboratory(tmp_path, ALONE)
    return tmp_path


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> dict:
    """The entries of a result, without the digest that would betray an edit."""
    folder = tmp_path_factory.mktemp("result")
    done(laboratory(folder, ALONE), folder / "out")
    entries = json.loads((folder / "out/identification.json").read_text("utf-8"))
    del entries["digest"]
    return entries


def refused(ended, *said: str) -> None:  # type: ignore[no-untyped-def]
    """One message of usual length, in which nothing acts."""
    assert ended.code == 2, ended
    assert (
        1 <= len(ended.err.splitlines()) <= 3
        and len(ended.err) <= 3 * LONGEST
        and "Traceback" not in ended.err
    )
    assert printable(ended.err, "\n") == ended.err
    for fragment in said:
        assert fragment in ended.err


# units and amounts


@pytest.mark.parametrize(
    ("mass", "said"),
    [
        ("1 kg^(1/0)", "no unit has the exponent '^(1/0)'"),
        ("1 km^999", "no unit has the exponent '^999'"),
        ("1e300 kg", "out of range"),
        ("1e-300 kg", "is too small for a mass"),
        ("1 " + "kg." * 50000 + "m", "unreadable unit"),
        ("1" * 100000 + " kg", "is not a finite value"),
    ],
)
def test_an_impossible_mass_is_refused_at_its_place(
    lab: Path, labpipe: Command, mass: str, said: str
) -> None:
    text = (lab / "rig.yaml").read_text().replace("0.79 kg", mass)
    (lab / "rig.yaml").write_text(text)
    refused(labpipe("run", lab / "pipeline.yaml", "-o", lab / "out"), f"{lab}/rig.yaml:6:1: mass: ", said)


def test_an_impossible_unit_in_a_condition_of_a_list_is_refused(
    lab: Path, labpipe: Command, result: dict
) -> None:
    result["responses"][0]["conditions"] = {"length": "3 km"}
    (lab / "identification.json").write_bytes(json_bytes(result))
    for unit in ("km^999", "kg^(1/0)"):
        refused(labpipe("list", lab, "--where", f"length > 3 {unit}"), "no unit has the exponent")


@pytest.mark.parametrize("unit", ["km^999", "kg^(1/0)"])
def test_an_impossible_unit_in_a_header_is_no_unit(lab: Path, labpipe: Command, unit: str) -> None:
    (lab / "soft.csv").write_text(recording(18e3).replace("[um]", f"[{unit}]"))
    assert labpipe("inspect", lab / "soft.csv").code == 0
    refused(labpipe("run", lab / "pipeline.yaml", "-o", lab / "out"), "no column 'y [um]'")


def test_no_recordings_and_no_title_is_one_message(lab: Path, labpipe: Command) -> None:
    """It once ended in a KeyError: the place of the fault was that of the title."""
    (lab / "pipeline.yaml").write_text(
        ALONE.replace("title: Small\n", "").replace("recordings: soft.csv", "recordings: []")
    )
    ended = labpipe("run", lab / "pipeline.yaml", "-o", lab / "out")
    assert ended.code == 2 and "neither recordings nor frfs" in ended.err


# numbers beyond all measure


def scaled(column: int, factor: float) -> str:
    head, *lines = recording(18e3).splitlines()
    rows = [[float(number) for number in line.split(",")] for line in lines]
    for row in rows:
        row[column] *= factor
    return "\n".join([head, *(",".join(map(repr, row)) for row in rows)]) + "\n"


@pytest.mark.parametrize(
    ("column", "factor", "said"),
    [
        (2, 1e160, "is not a measured number"),
        (1, 1e300, "is not a measured number"),
        (2, 1e-160, "which nothing measures"),
        (0, 1e-300, "check the unit of the time"),
        (0, 1e-9, "a period of 1 s is longer than the recording"),
    ],
)
def test_numbers_that_nothing_measures_are_refused(
    lab: Path, labpipe: Command, column: int, factor: float, said: str
) -> None:
    (lab / "soft.csv").write_text(scaled(column, factor))
    refused(labpipe("run", lab / "pipeline.yaml", "-o", lab / "out"), "soft.csv", said)


@pytest.mark.parametrize(("column", "factor"), [(2, 1e12), (1, 1e-30)])
def test_unusual_numbers_give_a_result_or_a_message(
    lab: Path, labpipe: Command, column: int, factor: float
) -> None:
    """A numpy bool once reached the JSON writer."""
    (lab / "soft.csv").write_text(scaled(column, factor))
    ended = labpipe("run", lab / "pipeline.yaml", "-o", lab / "out")
    assert ended.code in (0, 1, 2) and "Traceback" not in ended.err


def test_numbers_of_numpy_are_written_as_numbers() -> None:
    entries = {"a": np.bool_(True), "b": [np.float64(2.5), np.int64(3)], "c": {"d": np.float32(np.nan)}}
    assert json.loads(json_bytes(entries)) == {"a": True, "b": [2.5, 3], "c": {"d": None}}
    with pytest.raises(TypeError, match="a set has no place in JSON"):
        json_bytes({"a": {1}})


def test_a_long_block_is_held_against_the_recording_first(lab: Path, labpipe: Command) -> None:
    """1e7 s once asked for 37 GB."""
    overrides = ("--set", "frf.excitation=random", "--set", "frf.block=1e7 s", "--set", "frf.period=~")
    ended = labpipe("run", lab / "pipeline.yaml", "-o", lab / "out", *overrides)
    assert ended.code == 2 and "Traceback" not in ended.err


# results of other hands


DEEP = 100_000
EDITS: dict[str, Callable[[dict], object]] = {
    "null": lambda entries: entries["fits"][0]["parameters"][0].update(value=None),
    "text": lambda entries: entries["fits"][0]["parameters"][0].update(value="many"),
    "large": lambda entries: entries["fits"][0].update(lines=10**30),
    "larger": lambda entries: entries["fits"][0]["parameters"][0].update(value=10**400),
    "list": lambda entries: entries.update(rig=[1]),
    "fits": lambda entries: entries.update(fits=None),
    "settings": lambda entries: entries.update(settings="none"),
    "title": lambda entries: entries.update(title={}),
    "sources": lambda entries: entries.update(sources=["a"]),
    "condition": lambda entries: entries["settings"]["tests"][0].update(conditions={"a": [1]}),
    "date": lambda entries: entries["responses"][0].update(conditions={"date": "yesterday"}),
    "conditions": lambda entries: entries["responses"][0].update(conditions={"date": None}),
    "surrogate": lambda entries: entries.update(title="\ud800"),
}


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory, result: dict) -> Path:
    """Good results among bad ones."""
    tmp_path = tmp_path_factory.mktemp("archive")
    for name, edit in {"good": lambda _: None, "other": lambda _: None, **EDITS}.items():
        entries = json.loads(json.dumps(result))
        edit(entries)
        (tmp_path / name).mkdir()
        (tmp_path / name / "identification.json").write_text(json.dumps(entries))
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep/identification.json").write_text('{"schema": ' + "[" * DEEP)
    (tmp_path / "pipe").mkdir()
    os.mkfifo(tmp_path / "pipe/identification.json")
    return tmp_path


@pytest.mark.parametrize(
    "command",
    [
        ("list",),
        ("list", "-p", "k"),
        ("trend", "-p", "k", "--over", "date"),
        ("verify",),
        ("report", "-o", "r.md"),
    ],
    ids=["list", "values", "trend", "verify", "report"],
)
def test_one_bad_result_does_not_stop_a_folder(
    archive: Path, labpipe: Command, command: tuple[str, ...]
) -> None:
    began = time.monotonic()
    arguments = [str(archive / "r.md") if argument == "r.md" else argument for argument in command[1:]]
    ended = labpipe(command[0], archive, *arguments)
    assert ended.code == (1 if command[0] == "verify" else 0), ended.err
    assert time.monotonic() - began < SECONDS
    assert printable(ended.out + ended.err, "\n") == ended.out + ended.err
    if command == ("list",):
        assert sum("unreadable" in line for line in ended.out.splitlines()) == 13
    if command[0] == "trend":
        assert "'yesterday' is not a date" in ended.err
    if command == ("list", "-p", "k"):
        assert "not determined" in ended.out


@pytest.mark.parametrize("name", [*EDITS, "deep", "pipe"])
def test_a_bad_result_is_refused_or_shown(archive: Path, labpipe: Command, name: str) -> None:
    ended = labpipe("report", archive / name, "-o", archive / "r.md")
    if ended.code:
        refused(ended, "identification.json: ")
    else:
        assert name in ("null", "date")


# what hangs or hoards


@pytest.mark.long
def test_aliases_of_aliases_are_counted(tmp_path: Path, labpipe: Command) -> None:
    """500 bytes that stand for 9^11 entries."""
    letters = "abcdefghijkl"
    lines = ["a: &a [x, x, x, x, x, x, x, x, x]"]
    lines += [f"{new}: &{new} [{', '.join([f'*{old}'] * 9)}]" for old, new in itertools.pairwise(letters)]
    (tmp_path / "bomb.yaml").write_text("\n".join(lines))
    refused(labpipe("run", tmp_path / "bomb.yaml", "-o", tmp_path / "out"), "aliases expand the file")
    (tmp_path / "deep.yaml").write_text("a: " + "[" * DEEP)
    refused(labpipe("run", tmp_path / "deep.yaml", "-o", tmp_path / "out"), "nested too deeply")


@pytest.mark.parametrize(
    "header", ["[" * DEEP, "(" * DEEP + "m", "#" * DEEP, "/" * DEEP, " " * DEEP + "x", "'" * DEEP]
)
def test_a_long_header_takes_no_long_time(tmp_path: Path, labpipe: Command, header: str) -> None:
    (tmp_path / "a.csv").write_text(
        f"t [s],force [N],{header}\n" + "".join(f"{n / 100},{n % 7},{n % 5}\n" for n in range(50))
    )
    began = time.monotonic()
    assert labpipe("inspect", tmp_path / "a.csv").code in (0, 2)
    assert time.monotonic() - began < SECONDS


def test_a_sound_file_that_claims_4_gigabytes_is_refused_before_memory_is_asked_for(tmp_path: Path) -> None:
    content = (
        b"RIFF"
        + struct.pack("<I", 0xFFFFFFF0)
        + b"WAVEfmt "
        + struct.pack("<IHHIIHH", 16, 1, 1, 48000, 144000, 3, 24)
    )
    (tmp_path / "a.wav").write_bytes(content + b"data" + struct.pack("<I", 0xFFFFFFD0) + bytes(3000))
    with pytest.raises(DataError, match="ends before its last sample"):
        open_table(tmp_path / "a.wav")


def test_a_file_that_loops_inside_the_library_is_ended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the child process only: a loop in place of the library's."""
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        file["x"] = np.arange(10.0)
    assert open_table(path).columns == ("x",)

    def loops(_: Path) -> None:
        while True:
            pass

    monkeypatch.setattr(mat, "touch", loops)
    monkeypatch.setattr(probe, "SECONDS", 0.2)
    os.utime(path, ns=(1, 1))
    with pytest.raises(DataError, match="takes too long"):
        open_table(path)


@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".wav", ".h5", ".uff", ".frf.parquet"])
def test_a_pipe_is_no_file(tmp_path: Path, labpipe: Command, suffix: str) -> None:
    os.mkfifo(tmp_path / f"a{suffix}")
    refused(labpipe("inspect", tmp_path / f"a{suffix}"))


# damaged files of other programs


@pytest.mark.parametrize("seed", range(4))
def test_damaged_pages_of_a_foreign_parquet_file(tmp_path: Path, labpipe: Command, seed: int) -> None:
    rng = np.random.default_rng(seed)
    pq.write_table(
        pa.table({"t [s]": np.arange(500) / 100, "force [N]": rng.normal(size=500)}),
        tmp_path / "whole.parquet",
    )
    content = (tmp_path / "whole.parquet").read_bytes()
    for place in rng.integers(0, len(content), 40):
        (tmp_path / "a.parquet").write_bytes(
            content[:place] + bytes([255 - content[place]]) + content[place + 1 :]
        )
        ended = labpipe("inspect", tmp_path / "a.parquet")
        if ended.code:
            refused(ended, "a.parquet")


def test_text_whose_encoding_is_damaged(lab: Path, labpipe: Command) -> None:
    text = recording(18e3)
    for content in (
        text.encode("utf-16") + b"\x41",
        text[:900].encode("utf-16") + b"\x00\xd8\x41\x00" + text[900:].encode("utf-16-le"),
    ):
        (lab / "soft.csv").write_bytes(content)
        refused(labpipe("run", lab / "pipeline.yaml", "-o", lab / "out"), "soft.csv: is not UTF-16 text")


# what acts


NAMES = ["\x1b]0;title\x07", "\x1b[31mred", "\u202etfel", "\x9b2J", "\r\x1b[K", "a\u2028b"]


@pytest.mark.parametrize("name", NAMES)
def test_no_name_acts_on_the_terminal(lab: Path, labpipe: Command, name: str) -> None:
    (lab / "soft.csv").write_text(recording(18e3).replace("y [um]", f"y{name} [um]"))
    ended = labpipe("inspect", lab / "soft.csv")
    assert printable(ended.out, "\n") == ended.out and (ended.code or name not in ended.out)
    refused(labpipe("run", lab / "pipeline.yaml", "-o", lab / "out"))
    ended = labpipe("run", lab / f"{name}.yaml", "-o", lab / "out")
    refused(ended)
    ended = labpipe(name)
    refused(ended)


def test_echoes_of_what_stood_in_a_file_are_cut(lab: Path, labpipe: Command) -> None:
    """A message of 100 kB was seen."""
    (lab / "pipeline.yaml").write_text(ALONE.replace("model: sdof", "model: " + "x" * 100_000))
    ended = labpipe("run", lab / "pipeline.yaml", "-o", lab / "out")
    refused(ended)
    assert max(map(len, ended.err.splitlines())) <= LONGEST


def test_a_message_keeps_its_place_and_its_cure() -> None:
    line = message_line("error: a.yaml:1:1: " + "x" * 2000 + "; write it as 1 N")
    assert (
        len(line) <= LONGEST
        and line.startswith("error: a.yaml:1:1: x")
        and line.endswith("; write it as 1 N")
    )
    assert message_line(f"a: '{'y' * 200}' is not a number") == f"a: '{'y' * 77}...' is not a number"
    assert message_line("µm ± 振動 \x1b") == "µm ± 振動 \\x1b"


@pytest.mark.parametrize(
    "text",
    ["=cmd|' /C calc'!A0", "+1+2", "-2+3+cmd|' /C calc'!A0", "@SUM(A1)", "\t=1", "'quoted", "'=1", "''"],
)
def test_no_cell_is_a_formula_and_every_cell_reads_back(text: str) -> None:
    written = cell(text)
    assert isinstance(written, str) and written.startswith("'") and text_of(written) == text


@pytest.mark.parametrize("text", ["-5 N", "+1.5e3", "-", "k_xx", "3-4 Hz", "-12 um", "", "it's", 3.5, None])
def test_amounts_and_names_stay_as_they_are(text: object) -> None:
    assert cell(text) == text and (not isinstance(text, str) or text_of(text) == text)


def test_formulas_in_names_do_not_reach_an_exported_table(lab: Path, labpipe: Command) -> None:
    (lab / "pipeline.yaml").write_text(
        ALONE.replace("  direct:", "  '=cmd|calc':").replace("direct.gof", "'=cmd|calc.gof'")
    )
    assert labpipe("run", lab / "pipeline.yaml", "-o", lab / "out").code == 0
    assert labpipe("export", lab / "out/identification.json", "--to", "csv", "-o", lab / "a.csv").code == 0
    assert labpipe("list", lab, "-p", "k", "--csv", lab / "b.csv").code == 0
    for name in ("a.csv", "b.csv"):
        text = (lab / name).read_text()
        assert "'=cmd|calc" in text and not any(
            field.startswith("=") for line in text.splitlines() for field in line.split(",")
        )


def test_nothing_is_left_of_what_was_refused(lab: Path, labpipe: Command) -> None:
    before = contents(lab)
    (lab / "soft.csv").write_text(scaled(2, 1e160))
    refused(labpipe("run", lab / "pipeline.yaml", "-o", lab / "out"))
    assert set(contents(lab)) == set(before)


# data that leave a fit nothing to work with


def bench(folder: Path, noise: float) -> Path:
    """A mass on a spring, 77 Hz, under six periods of an odd multisine with lines 4 Hz apart.

    *noise* [1] over the motion.
    """
    rng, n_sample = np.random.default_rng(3), 512
    lines = np.arange(11, 100, 2)
    force = np.zeros(n_sample // 2 + 1, complex)
    force[lines] = np.exp(2j * np.pi * rng.random(lines.size)) * n_sample
    omega = 2 * np.pi * 2.0 * np.arange(force.size)
    motion = np.fft.irfft(force / ((2 * np.pi * 77) ** 2 * (1 + 0.02j) - omega**2), n_sample)
    whole = np.tile(motion, 6)
    whole = whole + noise * np.std(motion) * rng.normal(size=whole.size)
    pq.write_table(
        pa.table({"f [N]": np.tile(np.fft.irfft(force, n_sample), 6), "y [m]": whole}), folder / "odd.parquet"
    )
    channels = "".join(
        f"  {name}: {{column: '{name} [{unit}]', quantity: {quantity}, unit: {unit}, role: {role}, dof: y}}\n"
        for name, unit, quantity, role in (("f", "N", "force", "input"), ("y", "m", "displacement", "output"))
    )
    (folder / "odd-rig.yaml").write_text(f"name: bench\nsample_rate: 1024 Hz\nchannels:\n{channels}")
    (folder / "odd.yaml").write_text(
        "title: odd\nrig: odd-rig.yaml\nrecordings: odd.parquet\nfrf: {excitation: periodic, period: 500 "
        "ms, band: 20-200 Hz}\n"
        "identify: {modes: {model: modal, modal: {poles: [77 Hz]}}}\nreport: {formats: []}\n"
    )
    return folder / "odd.yaml"


def test_a_pole_by_hand_in_data_without_one(labpipe: Command, tmp_path: Path) -> None:
    # The highest order has no pole in what is mostly noise: lower ones are asked, and where none has any,
    # that is said.
    ended = labpipe("run", bench(tmp_path, 0.01), "-o", tmp_path / "out")
    assert ended.code == 0, ended.err
    (fit,) = json.loads((tmp_path / "out/identification.json").read_text("utf-8"))["fits"]
    (frequency,) = (p for p in fit["parameters"] if p["name"] == "f_n_1")
    assert abs(frequency["value"] - 77.0) < 4 * frequency["std_error"] + 0.01
    refused(
        labpipe("run", bench(tmp_path, 30.0), "-o", tmp_path / "other"),
        "odd.yaml: identify.modes: no order up to ",
        "choose another band",
    )


def test_two_periods_of_all_channels(labpipe: Command, tmp_path: Path, root: Path) -> None:
    # One degree of freedom: a line that exceeds its neighbours' noise had a covariance without an inverse,
    # which no descent survives.
    recording = pq.read_table(root / "sample_data/floating/dry-zipper.parquet").slice(0, 1500)
    pq.write_table(recording, tmp_path / "dry.parquet")
    fit = "{model: dynamic-stiffness, motion: absolute, form: kcm, stator_mass: 60 kg}"
    (tmp_path / "pipeline.yaml").write_text(
        f"title: dry\nrig: {root}/configs/floating.yaml\nrecordings: dry.parquet\nidentify: {{hoses: "
        f"{fit}}}\nreport: {{formats: []}}\n"
        "frf: {excitation: periodic, period: 500 ms, result: spectra, band: 20-200 Hz}\n"
    )
    ended = labpipe("run", tmp_path / "pipeline.yaml", "-o", tmp_path / "out")
    assert ended.code == 0, ended.err
    (fit,) = json.loads((tmp_path / "out/identification.json").read_text("utf-8"))["fits"]
    # Truth of the virtual rig: 1 MN/m and 500 N.s/m.
    for p in fit["parameters"]:
        truth = {"k_xx": 1e6, "k_yy": 1e6, "c_xx": 500.0, "c_yy": 500.0}.get(p["name"])
        assert truth is None or abs(p["value"] - truth) < 4 * p["std_error"], p


@pytest.mark.parametrize(
    ("place", "said"),
    [
        ("estimation.fitting.identify", "pipeline.yaml: identify.direct"),
        ("spectra.measurement.measure", ".csv: "),
    ],
)
def test_a_matrix_without_a_solution_is_a_refusal(
    lab: Path, labpipe: Command, monkeypatch: pytest.MonkeyPatch, place: str, said: str
) -> None:
    def singular(*_: object, **__: object) -> None:
        np.linalg.inv(np.zeros((2, 2)))

    module, _, name = place.rpartition(".")
    monkeypatch.setattr(importlib.import_module(f"labpipe.{module}"), name, singular)
    refused(labpipe("run", lab / "pipeline.yaml", "-o", lab / "out"), said, "(Singular matrix)")
    assert not (lab / "out").exists()


# faults of labpipe itself


@pytest.mark.parametrize("debug", [False, True])
@pytest.mark.parametrize(
    ("command", "place"), [("run", "estimation.fitting.identify"), ("check", "cli.run.run_pipeline")]
)
def test_a_fault_of_ours_says_so(
    lab: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    command: str,
    place: str,
    debug: bool,
) -> None:
    def broken(*_: object, **__: object) -> None:
        raise ZeroDivisionError("by nothing")

    module, _, name = place.rpartition(".")
    importlib.import_module(f"labpipe.{module}")
    monkeypatch.setattr(sys.modules[f"labpipe.{module}"], name, broken)
    monkeypatch.setattr("tempfile.tempdir", str(lab))
    output = ["-o", str(lab / "out")] if command == "run" else []
    arguments = [command, str(lab / "pipeline.yaml"), *output, *(["--debug"] if debug else [])]
    monkeypatch.setattr("sys.argv", ["labpipe", *arguments])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 3 and not (lab / "out").exists()
    *before, line = capsys.readouterr().err.splitlines()
    assert line.startswith(
        "error: this is a fault of labpipe, not of your files (ZeroDivisionError: by nothing"
    )
    written = list(lab.glob("labpipe-fault-*.txt"))
    if debug:
        assert any(row.startswith("Traceback") for row in before) and line.endswith(
            "please report it with the traceback above"
        )
        assert not written
    else:
        assert before == [] and line.endswith(f"please report it with {written[0]}")
        assert (
            "Traceback" in (text := written[0].read_text("utf-8"))
            and "broken" in text
            and str(arguments[1]) in text
        )
