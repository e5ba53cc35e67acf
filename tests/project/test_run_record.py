"""The record of runs: a line for each, chained, and what shows of lines and results that were changed or
removed.
"""

from __future__ import annotations

import json
import multiprocessing
import shutil
from pathlib import Path

import pytest

from labpipe.artefacts.identification_file import NAME, write_identification
from labpipe.cli.main import run_command
from labpipe.errors import ConfigError, DataError
from labpipe.project.run_record import (
    RECORD,
    begin,
    faults_of_record,
    head,
    record_of_runs,
    record_run,
    runs_of,
)
from labpipe.records.identification import Identification, RuleOutcome
from tests.uncertainty.conftest import a_fit

ROOT = Path(__file__).parents[2]
RESULT = Identification(
    (a_fit("", {"k": (1.0, 0.1)}),),
    title="T",
    sources=({"path": "raw.csv", "sha256": "ab" * 32},),
    outcomes=(RuleOutcome("accept", "axial.k >= 0 N/m", 1.0, True),),
)


def made(folder: Path, result: Identification = RESULT) -> None:
    """A run with that result."""
    folder.mkdir(exist_ok=True)
    with record_run(folder, Path("p.yaml")) as results:
        write_identification(folder / NAME, result)
        results.append(result)


def many(folder: Path) -> None:
    for _ in range(10):
        made(folder)


@pytest.fixture
def record(tmp_path: Path) -> Path:
    """A record of three runs with two results."""
    begin(tmp_path)
    made(tmp_path / "a")
    made(tmp_path / "b")
    made(tmp_path / "a", Identification(RESULT.fits, title="other"))
    return tmp_path / RECORD


def test_a_run_is_recorded_with_its_inputs_and_outcome(record: Path) -> None:
    begun, first, _, last = runs_of(record)
    assert begun.outcome == "begun" and begun.number == 1 and "@" in begun.who
    assert (first.outcome, first.result, first.pipeline) == ("accepted", f"a/{NAME}", "p.yaml")
    assert first.inputs == ({"path": "raw.csv", "sha256": "ab" * 32},) and first.version and first.code
    assert last.outcome == "no rules" and last.digest != first.digest
    assert faults_of_record(record) == []
    assert record_of_runs(record.parent / "a") == record


def test_a_run_that_fails_is_recorded_as_such(record: Path) -> None:
    with pytest.raises(DataError), record_run(record.parent / "a", Path("p.yaml")):
        raise DataError("the recording ends too early", where="raw.csv")
    assert runs_of(record)[-1].outcome == "failed: raw.csv: the recording ends too early"
    assert faults_of_record(record) == []


def test_without_a_record_nothing_is_written(tmp_path: Path) -> None:
    made(tmp_path / "a")
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == [NAME]


def test_results_that_were_there_before_stand_in_the_first_line(tmp_path: Path) -> None:
    made(tmp_path / "a")
    begin(tmp_path)
    assert faults_of_record(tmp_path / RECORD) == []
    with pytest.raises(ConfigError, match="was begun already"):
        begin(tmp_path / "a")
    with pytest.raises(DataError, match="no such folder"):
        begin(tmp_path / "none")


@pytest.mark.parametrize("gone", [0, 1, 2])
def test_a_removed_line_shows(record: Path, gone: int) -> None:
    lines = record.read_bytes().splitlines(keepends=True)
    record.write_bytes(b"".join(lines[:gone] + lines[gone + 1 :]))
    assert any("removed" in fault for fault in faults_of_record(record))


def test_a_line_removed_at_the_end_shows_by_its_result_and_by_the_digest(record: Path) -> None:
    before = head(record)
    record.write_bytes(b"".join(record.read_bytes().splitlines(keepends=True)[:-1]))
    assert faults_of_record(record) == [f"'a/{NAME}' is not what the last recorded run made"]
    assert head(record) != before


def test_a_changed_line_shows(record: Path) -> None:
    lines = record.read_bytes().splitlines(keepends=True)
    lines[1] = lines[1].replace(b'"accepted"', b'"no rules"')
    record.write_bytes(b"".join(lines))
    (fault,) = faults_of_record(record)
    assert "before run 3 of" in fault


@pytest.mark.parametrize("line", [b"{}\n", b"[1]\n", b"\xff\n", b'{"number": 5}\n'])
def test_a_line_that_is_no_run_is_refused(record: Path, line: bytes) -> None:
    record.write_bytes(record.read_bytes() + line)
    with pytest.raises(DataError, match="line 5 is not a run"):
        faults_of_record(record)


def test_results_of_no_run_and_changed_ones_show(record: Path) -> None:
    shutil.copytree(record.parent / "b", record.parent / "c")
    write_identification(record.parent / "b" / NAME, Identification(RESULT.fits, title="forged"))
    assert faults_of_record(record) == [
        f"'b/{NAME}' is not what the last recorded run made",
        f"'c/{NAME}' was made by no run that is recorded",
    ]


@pytest.mark.long
def test_runs_at_the_same_time_add_their_lines_one_by_one(tmp_path: Path) -> None:
    begin(tmp_path)
    context = multiprocessing.get_context("spawn")
    processes = [context.Process(target=many, args=(tmp_path / name,)) for name in "ab"]
    for process in processes:
        process.start()
    for process in processes:
        process.join(60)
    assert len(runs_of(tmp_path / RECORD)) == 21 and faults_of_record(tmp_path / RECORD) == []


def test_the_commands(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(["runs", str(tmp_path)]) == 2
    assert run_command(["runs", str(tmp_path), "--begin"]) == 0
    pipeline, out = str(ROOT / "pipelines/pedestal.yaml"), str(tmp_path / "out")
    assert run_command(["run", pipeline, "-o", out, "-q", "--set", "report.formats=[md]"]) == 0
    assert run_command(["run", pipeline, "-o", out, "--set", "frf.period=x"]) == 2
    capsys.readouterr()
    assert run_command(["runs", str(tmp_path), "--inputs"]) == 0
    said = capsys.readouterr().out
    assert f"pedestal.yaml -> out/{NAME} accepted" in said and "failed:" in said and "pedestal.csv" in said
    assert run_command(["verify", str(tmp_path / "out"), "-c", pipeline]) == 0
    assert "3 lines of the record of runs: 0 faults; last line" in capsys.readouterr().out
    entries = (tmp_path / RECORD).read_text().splitlines()
    (tmp_path / RECORD).write_text("\n".join([entries[0], *entries[2:]]) + "\n")
    assert run_command(["verify", str(tmp_path / "out"), "-c", pipeline]) == 1
    assert "a line was changed, removed or put in" in capsys.readouterr().out
    assert json.loads(entries[1])["outcome"] == "accepted"
