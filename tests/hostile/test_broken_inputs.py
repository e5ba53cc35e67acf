"""Trying to break it: every faulty input ends with exit code 2, at most three lines, no traceback, nothing
written.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from labpipe.artefacts.measured_files import read_response

RIG = """name: Test rig
time: "t [s]"
channels:
  f: {column: "force [N]", quantity: force, unit: N, role: input, dof: y}
  y: {column: "y [um]", quantity: displacement, unit: um, role: output, dof: y}
mass: 0.79 kg
"""
PIPELINE = """title: Test
rig: rig.yaml
recordings: run.csv
frf: {excitation: periodic, period: 1 s, skip: 0}
identify:
  direct: {model: sdof, estimator: ml, input: f, output: y, band: 10-40 Hz}
"""


def table(change: Callable[[np.ndarray], np.ndarray] | None = None) -> str:
    """Five periods of 1 s at 200 Hz: force lines 1-50 Hz, a soft spring, noise. Seed pinned."""
    rng = np.random.default_rng(1)
    t = np.arange(1000) / 200
    force = sum(np.cos(2 * np.pi * line * t - np.pi * line * (line - 1) / 50) for line in range(1, 51))
    y = sum(
        (
            10
            / (1 - (line / 25) ** 2 + 0.1j * line / 25)
            * np.exp(1j * (2 * np.pi * line * t - np.pi * line * (line - 1) / 50))
        ).real
        for line in range(1, 51)
    )
    columns = np.column_stack([t, force + 0.01 * rng.normal(size=t.size), y + 0.1 * rng.normal(size=t.size)])
    columns = columns if change is None else change(columns)
    return "t [s],force [N],y [um]\n" + "".join(
        f"{row[0]:.6g},{row[1]:.6g},{row[2]:.6g}\n" for row in columns
    )


def replaced(column: int, rows: slice, value: float) -> Callable[[np.ndarray], np.ndarray]:
    def change(columns: np.ndarray) -> np.ndarray:
        columns[rows, column] = value
        return columns

    return change


@pytest.fixture
def project(tmp_path: Path) -> Path:
    (tmp_path / "rig.yaml").write_text(RIG)
    (tmp_path / "pipeline.yaml").write_text(PIPELINE)
    (tmp_path / "run.csv").write_text(table())
    return tmp_path


@pytest.fixture
def labpipe(labpipe_without_report):
    """Reports are drawn only where a test looks at one."""
    return labpipe_without_report


def assert_refused(project: Path, ended, *fragments: str) -> None:  # type: ignore[no-untyped-def]
    assert ended.code == 2, ended
    lines = ended.err.strip().splitlines()
    assert 1 <= len(lines) <= 3 and "Traceback" not in ended.err, ended.err
    assert all(line.startswith("error: ") for line in lines), ended.err
    for fragment in fragments:
        assert fragment in ended.err, ended.err
    assert (
        sorted(
            p.name
            for p in project.iterdir()
            if p.name not in ("rig.yaml", "pipeline.yaml", "run.csv", "other")
        )
        == []
    )


def test_the_sound_project_runs(project: Path, labpipe) -> None:
    ended = labpipe("run", project / "pipeline.yaml", "-o", project / "out", "--set", "report.formats=[html]")
    assert ended.code == 0, ended.err
    assert sorted(p.name for p in (project / "out").iterdir()) == [
        "frf.frf.parquet",
        "identification.json",
        "recordings",
        "report.html",
    ]


CSV = table()
LINES = CSV.splitlines(keepends=True)


@pytest.mark.parametrize(
    ("text", "fragments"),
    [
        ("", ["run.csv", "the file is empty"]),
        (LINES[0], ["no row of numbers"]),
        (CSV.replace(LINES[7], "0.03,1\n"), ["run.csv:8", "2 fields, 3 are needed"]),
        (CSV.replace(LINES[7], "0.03,1,2,3\n"), ["run.csv:8", "4 fields, 3 are needed"]),
        (CSV.replace(LINES[7], "0.03,oops,2\n"), ["run.csv:8", "column 'force [N]': 'oops' is not a number"]),
        (table(replaced(1, slice(300, 320), np.nan)), ["channel 'f'", "no number at sample 300 (1.5 s)"]),
        (table(replaced(2, slice(300, 320), np.nan)), ["channel 'y'", "sample 300"]),
        (table(lambda c: np.delete(c, 77, axis=0)), ["time steps", "not equal", "sample 77"]),
        (table(lambda c: c[:150]), ["too short for one period"]),
        (table(replaced(1, slice(None), 2.5)), ["force channel 'f'", "does not vary"]),
        (CSV.replace("force [N]", "Force [N]"), ["no column 'force [N]'", "did you mean 'Force [N]'?"]),
        (CSV.replace("y [um]", "force [N]"), ["the column 'force [N]' appears 2 times"]),
        (CSV.replace("y [um]", "y [mm]"), ["no column 'y [um]'", "did you mean 'y [mm]'?"]),
        (
            CSV.replace("t [s],force [N],y [um]\n", "t [s],force [N],y [um]\ns,kN,um\n"),
            ["is in kN by the file's own header, in N by the rig file"],
        ),
    ],
)
def test_broken_recordings(project: Path, labpipe, text: str, fragments: list[str]) -> None:
    (project / "run.csv").write_text(text)
    assert_refused(project, labpipe("run", project / "pipeline.yaml", "-o", project / "out"), *fragments)


@pytest.mark.parametrize(
    "text",
    [
        pytest.param(CSV.replace(",", ";"), id="semicolons"),
        pytest.param(CSV.replace(",", ";").replace(".", ","), id="decimal commas"),
        pytest.param("\ufeff" + CSV, id="byte-order mark"),
        pytest.param("# logger 5\n# rate 200 Hz\n" + CSV, id="comment header"),
    ],
)
def test_other_dialects_give_the_same_result(project: Path, labpipe, text: str) -> None:
    plain = labpipe("frf", "-c", project / "pipeline.yaml", "-o", project / "out")
    (project / "run.csv").write_text(text, encoding="utf-8")
    other = labpipe("frf", "-c", project / "pipeline.yaml", "-o", project / "other")
    assert (plain.code, other.code) == (0, 0)
    ours, theirs = (read_response(project / name / "frf.frf.parquet") for name in ("other", "out"))
    np.testing.assert_array_equal(ours.matrix, theirs.matrix)


def test_a_clipped_channel_is_used_and_the_warning_travels_to_the_result(project: Path, labpipe) -> None:
    (project / "run.csv").write_text(
        table(lambda c: np.column_stack([c[:, :2], np.clip(c[:, 2], -200, 200)]))
    )
    assert (
        labpipe(
            "run", project / "pipeline.yaml", "-o", project / "out", "--set", "report.formats=[html]"
        ).code
        == 0
    )
    assert '"code": "clipped"' in (project / "out" / "identification.json").read_text()
    assert "peaks are cut off" in (project / "out" / "report.html").read_text()


@pytest.mark.parametrize(
    ("file", "old", "new", "fragments"),
    [
        (
            "rig.yaml",
            "unit: um",
            "unit: umm",
            ["rig.yaml:5:", "channels.y.unit: unknown unit 'umm'; did you mean 'um'?"],
        ),
        ("rig.yaml", "unit: um", "unit: N", ["channels.y.unit: 'N' has the wrong dimension, m is needed"]),
        (
            "rig.yaml",
            "role: input",
            "rolle: input",
            ["rig.yaml:4:", "channels.f.rolle: unknown key; did you mean 'role'?"],
        ),
        ("rig.yaml", "mass: 0.79 kg", "mass: 0.79", ["rig.yaml:6:1: mass: '0.79' has no unit"]),
        ("rig.yaml", 'time: "t [s]"\n', "", ["one of sample_rate and time is needed"]),
        (
            "rig.yaml",
            "quantity: force",
            "quantity: farce",
            ["channels.f.quantity: unknown choice 'farce'; did you mean 'force'?"],
        ),
        (
            "pipeline.yaml",
            "model: sdof",
            "model: sdoff",
            ["pipeline.yaml:6:", "identify.direct.model: unknown choice 'sdoff'"],
        ),
        (
            "pipeline.yaml",
            "band: 10-40 Hz",
            "band: 40-10 Hz",
            ["identify.direct.band: the band '40-10 Hz' is empty"],
        ),
        (
            "pipeline.yaml",
            "period: 1 s",
            "period: 1 Hz",
            ["frf.period: 'Hz' has the wrong dimension, s is needed"],
        ),
        ("pipeline.yaml", "period: 1 s, ", "", ["frf: 'period' is missing"]),
        ("pipeline.yaml", "period: 1 s", "period: 0.9999 s", ["not a whole number"]),
        (
            "pipeline.yaml",
            "rig: rig.yaml",
            "rig: rigg.yaml",
            ["pipeline.yaml:2:1: rig: no such file 'rigg.yaml'"],
        ),
        (
            "pipeline.yaml",
            "recordings: run.csv",
            "recordings: '*.dat'",
            ["recordings: no file matches '*.dat'"],
        ),
        ("pipeline.yaml", "recordings: run.csv", "recordings: .", ["is a folder"]),
        ("pipeline.yaml", "input: f", "input: q", ["no force 'q' in the FRF"]),
        ("pipeline.yaml", "band: 10-40 Hz", "band: 90-99 Hz", ["no frequency line lies in the band"]),
        (
            "pipeline.yaml",
            "title: Test",
            "title: Test\ntitle: Again",
            ["pipeline.yaml:2:1: title: the key appears twice"],
        ),
        ("pipeline.yaml", "title: Test", "title: [Test", ["pipeline.yaml:", "not valid YAML"]),
        (
            "pipeline.yaml",
            "title: Test",
            "accept: {direct.kk: '> 0 N/m'}",
            ["accept.direct.kk: the fit has no 'kk'; did you mean 'k'?"],
        ),
        (
            "pipeline.yaml",
            "title: Test",
            "accept: {dirct.k: '> 0 N/m'}",
            ["accept.dirct.k: there is no fit 'dirct'"],
        ),
        (
            "pipeline.yaml",
            "title: Test",
            "accept: {direct.k: '> 3 um'}",
            ["accept.direct.k: 'um' has the wrong dimension"],
        ),
    ],
)
def test_broken_configuration(
    project: Path, labpipe, file: str, old: str, new: str, fragments: list[str]
) -> None:
    path = project / file
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new, 1))
    assert_refused(project, labpipe("run", project / "pipeline.yaml", "-o", project / "out"), *fragments)


def test_all_faults_of_both_files_in_one_pass(project: Path, labpipe) -> None:
    (project / "rig.yaml").write_text(
        RIG.replace("unit: um", "unit: umm").replace("mass: 0.79 kg", "mas: 0.79 kg")
    )
    (project / "pipeline.yaml").write_text(PIPELINE.replace("model: sdof", "model: sdoff"))
    ended = labpipe("run", project / "pipeline.yaml", "-o", project / "out")
    assert_refused(project, ended, "unknown unit 'umm'", "mas: unknown key; did you mean 'mass'?", "'sdoff'")
    assert len(ended.err.strip().splitlines()) == 3


@pytest.mark.parametrize(
    ("arguments", "fragment"),
    [
        (["run", "none.yaml", "-o", "out"], "no such file"),
        (["run", ".", "-o", "out"], "is a directory"),
        (["run", "pipeline.yaml"], "Missing option '-o'"),
        (["run", "pipeline.yaml", "-o", "run.csv"], "is a file, a folder is needed"),
        (["rum", "pipeline.yaml"], "no command 'rum'; did you mean 'run'?"),
        (
            ["run", "pipeline.yaml", "-o", "out", "--set", "identify.direct.bnd=1-2 Hz"],
            "--set identify.direct.bnd=1-2 Hz",
        ),
        (["run", "pipeline.yaml", "-o", "out", "--set", "frf"], "not an assignment"),
        (["report", "none", "-o", "r.html"], "no such file"),
        (["report", "run.csv", "-o", "r.html"], "is not a readable identification.json"),
        (["identify", "-c", "pipeline.yaml", "-o", "out"], "run `labpipe frf` first"),
        (["identify", "-c", "pipeline.yaml", "-o", "out", "run.csv"], "no column 'frequency_hz'"),
        (["ingest", "run.csv", "-r", "rig.yaml"], "Missing option '-o'"),
        (["ingest", "none.csv", "-r", "rig.yaml", "-o", "out"], "no such file"),
        (["inspect", "none.csv"], "no such file"),
        (["inspect", "."], "is a folder"),
        (["excite", "-o", "s.mp3"], "no signal format for the ending '.mp3'"),
        (["excite", "-o", "s.csv", "--band", "10 Hz"], "--band: '10 Hz' is not a band"),
        (["excite", "-o", "s.csv", "--level", "1 N"], "--level: 'N' has the wrong dimension"),
        (["simulate", "rig.yaml", "-o", "out"], "kind: is missing; known: virtual-mdof-rig"),
        (["calibrate", "-c", "pipeline.yaml", "-o", "out"], "calibrate: is missing"),
        (["export", "run.csv", "--to", "csv", "-o", "x.csv"], "is not a readable Parquet file"),
        (["check", "none.yaml"], "no such file"),
    ],
)
def test_broken_command_lines(
    project: Path, labpipe, monkeypatch, arguments: list[str], fragment: str
) -> None:
    monkeypatch.chdir(project)
    ended = labpipe(*arguments)
    assert ended.code == 2 and fragment in ended.err and len(ended.err.splitlines()) <= 8, ended
    assert "Traceback" not in ended.err
    assert sorted(p.name for p in project.iterdir()) == ["pipeline.yaml", "rig.yaml", "run.csv"]


def test_an_existing_result_survives_a_failed_run(project: Path, labpipe) -> None:
    assert labpipe("run", project / "pipeline.yaml", "-o", project / "other").code == 0
    before = {
        p: (p.stat().st_mtime_ns, p.read_bytes()) for p in (project / "other").rglob("*") if p.is_file()
    }
    (project / "run.csv").write_text(table(replaced(1, slice(300, 320), np.nan)))
    assert_refused(project, labpipe("run", project / "pipeline.yaml", "-o", project / "other"), "sample 300")
    assert {
        p: (p.stat().st_mtime_ns, p.read_bytes()) for p in (project / "other").rglob("*") if p.is_file()
    } == before


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full on this system")
@pytest.mark.parametrize("command", ["excite", "report", "schema"])
def test_a_full_disk_is_said(project: Path, labpipe, command: str) -> None:
    if command == "report":
        labpipe("run", project / "pipeline.yaml", "-o", project / "other")
    arguments = {"excite": ["excite"], "report": ["report", project / "other"], "schema": ["schema"]}[command]
    ended = labpipe(*arguments, "-o", "/dev/full")
    assert_refused(project, ended, "no space left on device")
    assert Path("/dev/full").is_char_device()


@pytest.mark.skipif(os.geteuid() == 0, reason="the superuser may write everywhere")
def test_a_folder_without_permission(project: Path, labpipe) -> None:
    locked = project / "other"
    locked.mkdir(mode=0o500)
    assert_refused(
        project, labpipe("run", project / "pipeline.yaml", "-o", locked / "out"), "permission denied"
    )


def test_an_operating_system_error_becomes_one_line(project: Path, labpipe, monkeypatch) -> None:
    """As by a folder that may only be read: it is named, and not what would have been made in it."""

    def denied(path: Path, **_: object) -> str:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr("pathlib.Path.mkdir", denied)
    ended = labpipe("run", project / "pipeline.yaml", "-o", project / "out")
    assert_refused(project, ended, f"error: {project}: permission denied")
    assert "labpipe-" not in ended.err


def hears_ctrl_c() -> None:
    """Processes of a test run that works in the background would inherit deafness."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def test_ctrl_c_within_an_exec_of_text_ends_with_exit_code_2() -> None:
    """As where a module of dataclasses is imported: Python notes such an interrupt and would end by the
    signal, though it was caught.
    """
    script = (
        "import labpipe.cli.main as m\ndef broken(_): exec('raise KeyboardInterrupt')\nm._run = "
        "broken\nm.main()"
    )
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stderr.strip()) == (2, "error: interrupted; nothing was changed")


def test_ctrl_c_leaves_nothing_behind(project: Path) -> None:
    """A long run is interrupted as by Ctrl-C once it is at work."""
    (project / "run.csv").write_text(
        LINES[0] + "".join(f"{n / 200:.6g},{n % 7},{n % 11}\n" for n in range(400_000))
    )
    command = [sys.executable, "-m", "labpipe", "run", "pipeline.yaml", "-o", "out"]
    process = subprocess.Popen(
        command, cwd=project, stderr=subprocess.PIPE, text=True, preexec_fn=hears_ctrl_c
    )
    deadline = time.monotonic() + 30
    while not list(project.glob(".labpipe-*")) and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=30)
    assert process.returncode == 2 and err.strip() == "error: interrupted; nothing was changed"
    assert sorted(p.name for p in project.iterdir()) == ["pipeline.yaml", "rig.yaml", "run.csv"]
