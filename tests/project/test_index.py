"""The index follows the files: what is new, changed, gone or damaged; and a deleted index is only slower."""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, strategies as st

from labpipe.artefacts.identification_file import read_identification, write_identification
from labpipe.errors import DataError
from labpipe.estimation.statistics import widen
from labpipe.project.catalogue import INDEX, MADE_BY, Filter, open_index
from labpipe.project.catalogue_search import found_results, found_values
from labpipe.project.run_record import RECORD, begin, record_run, runs_of
from labpipe.records.finding import Finding, Parameter, note
from labpipe.records.identification import Failed, Fit, Goodness, Identification, RuleOutcome, warning_codes

K = Parameter("k", 1000.0, "N/m", std_error=10.0, t_ratio=100.0, ci95=(980.0, 1020.0), significant=True)
FIT = Fit(
    "direct",
    "sdof",
    "ml",
    band_hz=(60.0, 70.0),
    lines=20,
    equations=40,
    dof=38,
    gof=Goodness(0.99, 0.99),
    parameters=(K,),
    condition_number=3.0,
    correlation=np.eye(1),
    test="a",
)


def store(folder: Path, stiffness: float = 1000.0, date: str = "2026-11-03", **changes: object) -> Path:
    """A result of one test."""
    folder.mkdir(parents=True, exist_ok=True)
    settings = {"tests": [{"name": "a", "conditions": {"date": date, "preload": "400 N", "way": "up"}}]}
    fit = replace(FIT, parameters=(replace(K, value=stiffness),))
    whole = Identification((fit,), folder.name, rig={"name": "Small rig"}, settings=settings)
    write_identification(folder / "identification.json", replace(whole, **changes))
    return folder / "identification.json"


def stiffnesses(folder: Path, **asked: object) -> list[float]:
    return [row.value for row in found_values(folder, Filter(**asked))]


def later(path: Path) -> None:
    """The time of a file moves on, as it does between two runs."""
    status = path.stat()
    os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns + 1_000_000_000))


def test_results_at_any_depth_are_in_it(tmp_path: Path) -> None:
    store(tmp_path / "a", 1.0), store(tmp_path / "b/c/d", 2.0), store(tmp_path, 3.0)
    assert sorted(stiffnesses(tmp_path)) == [1.0, 2.0, 3.0]


def test_a_new_result_is_found_and_a_deleted_one_forgotten(tmp_path: Path) -> None:
    store(tmp_path / "a", 1.0)
    assert stiffnesses(tmp_path) == [1.0]
    path = store(tmp_path / "b", 2.0)
    assert sorted(stiffnesses(tmp_path)) == [1.0, 2.0]
    path.unlink()
    assert stiffnesses(tmp_path) == [1.0]


def test_a_changed_result_is_read_again(tmp_path: Path) -> None:
    store(tmp_path / "a", 1.0)
    assert stiffnesses(tmp_path) == [1.0]
    later(store(tmp_path / "a", 2.0))
    assert stiffnesses(tmp_path) == [2.0]


def test_a_result_that_did_not_change_is_not_read_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store(tmp_path / "a", 1.0)
    stiffnesses(tmp_path)
    monkeypatch.setattr(
        "labpipe.project.catalogue.read_identification", lambda path: pytest.fail(f"{path} was read")
    )
    assert stiffnesses(tmp_path) == [1.0]


def test_a_deleted_index_is_made_again_with_the_same_answers(tmp_path: Path) -> None:
    store(tmp_path / "a", 1.0), store(tmp_path / "b", 2.0)
    before = stiffnesses(tmp_path)
    (tmp_path / INDEX).unlink()
    assert stiffnesses(tmp_path) == before


@pytest.mark.parametrize(
    "content", [b"", b"no index at all, but a text of some length", bytes(64) + b"\n" + bytes(200)]
)
def test_a_damaged_index_is_made_again(tmp_path: Path, content: bytes) -> None:
    store(tmp_path / "a", 1.0)
    (tmp_path / INDEX).write_bytes(content)
    assert stiffnesses(tmp_path) == [1.0]


def test_an_index_of_another_version_is_made_again(tmp_path: Path) -> None:
    store(tmp_path / "a", 1.0)
    stiffnesses(tmp_path)
    _, _, content = (tmp_path / INDEX).read_bytes().partition(b"\n")
    index = json.loads(content)
    index["a/identification.json"]["rows"][0]["value"] = -1.0
    content = json.dumps(index).encode()
    for version, value in ((MADE_BY, -1.0), ("0.0.0", 1.0)):
        digest = hashlib.sha256(version.encode() + content).hexdigest()
        (tmp_path / INDEX).write_bytes(digest.encode() + b"\n" + content)
        assert stiffnesses(tmp_path) == [value]


@pytest.mark.parametrize("content", [b"", b"{", b'{"schema": "labpipe/identification/1"}'])
def test_a_result_that_cannot_be_read_is_listed_as_such(tmp_path: Path, content: bytes) -> None:
    store(tmp_path / "good")
    (tmp_path / "bad").mkdir()
    (tmp_path / "bad/identification.json").write_bytes(content)
    rows = {row.path.split("/")[0]: row for row in found_results(tmp_path, Filter())}
    assert rows["bad"].verdict == "unreadable" and rows["bad"].fault and rows["good"].verdict == "no rules"


def test_a_folder_without_results_and_no_folder(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"holds no identification\.json"):
        open_index(tmp_path)
    with pytest.raises(DataError, match="no such folder"):
        open_index(tmp_path / "none")


PASSED, FAILED = (RuleOutcome("accept", "direct.k > 0", 1.0, passed) for passed in (True, False))


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({}, "no rules"),
        ({"outcomes": (PASSED,)}, "accepted"),
        ({"outcomes": (PASSED, FAILED)}, "not accepted"),
        ({"outcomes": (PASSED,), "failed": (Failed("b", "gap"),)}, "incomplete"),
        ({"failed": (Failed("b", "gap"),)}, "incomplete"),
    ],
)
def test_the_verdict_in_a_word(changes: dict, word: str) -> None:
    assert Identification((FIT,), **changes).verdict == word


def test_warnings_count_once_and_notes_not_at_all() -> None:
    fit = replace(
        FIT, findings=(Finding("gap", "1"), note("masked", "2"), Finding("gap", "3"), Finding("clipped", "4"))
    )
    assert warning_codes(fit) == ["gap", "clipped"]


@given(st.floats(-1e6, 1e6), st.floats(1e-3, 1e3), st.floats(1.0, 10.0))
def test_an_interval_is_widened_as_its_error_is(value: float, error: float, factor: float) -> None:
    """ci95 of +- 2 s becomes +- 2 f s where the residual exceeds the noise by f."""
    plain = Parameter(
        "k", value, "N/m", std_error=error, t_ratio=None, ci95=(value - 2 * error, value + 2 * error)
    )
    low, high = widen(plain, factor).ci95
    assert high - low == pytest.approx(4 * factor * error, rel=1e-6, abs=1e-6 * abs(value) * 1e-6)
    assert (low + high) / 2 == pytest.approx(value, abs=1e-6 * (abs(value) + factor * error))


# the date of a result


def test_a_stated_date_goes_before_that_of_the_file(tmp_path: Path) -> None:
    store(tmp_path / "a", 1.0, date="2026-11-03")
    store(tmp_path / "b", 2.0, date="2025-01-31")
    assert stiffnesses(tmp_path) == [2.0, 1.0]
    assert stiffnesses(tmp_path, since="2026-01-01") == [1.0]
    assert stiffnesses(tmp_path, until="2025-12-31") == [2.0]


def test_a_day_holds_the_tests_of_its_hours(tmp_path: Path) -> None:
    """`until` their day left them out, since a text is above what it begins with."""
    store(tmp_path / "a", 1.0, date="2026-11-03 14:00")
    store(tmp_path / "b", 2.0, date="2026-11-03T16:30:00")
    assert sorted(stiffnesses(tmp_path, since="2026-11-03", until="2026-11-03")) == [1.0, 2.0]


def test_without_a_stated_date_the_file_s_day_counts(tmp_path: Path) -> None:
    path = store(tmp_path / "a", 1.0, settings={})
    # Noon of 2024-02-29 (UTC): the same day in every zone but the outermost.
    os.utime(path, (1709208000, 1709208000))
    assert stiffnesses(tmp_path, since="2024-02-28", until="2024-03-01") == [1.0]
    assert stiffnesses(tmp_path, since="2024-03-02") == []


def test_the_day_of_a_run_goes_before_that_of_a_copied_file(tmp_path: Path, labpipe) -> None:
    """The record of runs says when a result was made; of one that no run made its file alone does."""
    begin(tmp_path)
    for name in ("a", "b"):
        store(tmp_path / name, 1.0, settings={})
    with record_run(tmp_path / "a", Path("p.yaml")) as made:
        made.append(read_identification(tmp_path / "a/identification.json"))
    for name in ("a", "b"):
        os.utime(tmp_path / name / "identification.json", (1709208000, 1709208000))
    days = {row.path[0]: row.date for row in found_values(tmp_path, Filter())}
    assert days == {"a": runs_of(tmp_path / RECORD)[-1].time[:10], "b": "2024-02-29"}
    ended = labpipe("trend", tmp_path, "-p", "k", "--over", "date")
    assert "note: a: without a condition `date`, dated by the record of runs" in ended.err
    assert "note: b: without a condition `date`, dated by the last change of its file" in ended.err


# conditions


@pytest.mark.parametrize(
    ("where", "found"),
    [
        ("preload = 400 N", True),
        ("preload = 0.4 kN", True),
        ("preload = 400.001 N", False),
        ("preload >= 400 N", True),
        ("preload > 400 N", False),
        ("preload <= 0.4 kN", True),
        ("preload < 0.4 kN", False),
        ("preload != 400 N", False),
        ("preload != 401 N", True),
        ("way = up", True),
        ("way = down", False),
        ("way != down", True),
        ("date = 2026-11-03", True),
    ],
)
def test_conditions_are_compared_as_amounts_or_as_words(tmp_path: Path, where: str, found: bool) -> None:
    store(tmp_path / "a", 1.0)
    assert stiffnesses(tmp_path, where=(where,)) == ([1.0] if found else [])


@pytest.mark.parametrize(
    ("asked", "found"),
    [
        ({"test": "run [1]"}, [1.0]),
        ({"test": "run ?"}, [3.0]),
        ({"test": "run *"}, [1.0, 2.0, 3.0]),
        ({"rig": "rig_a"}, [1.0]),
        ({"rig": "PRÜF"}, [3.0]),
        ({"where": ("batch != 12",)}, [2.0, 3.0]),
        ({"where": ("load >= 1 mm",)}, [3.0]),
        ({"since": "2026-01-01"}, [1.0, 3.0]),
    ],
)
def test_names_are_taken_as_they_stand(tmp_path: Path, asked: dict[str, object], found: list[float]) -> None:
    """A pattern's one sign is '*'; what is not equal to an amount may be a word; a date is one."""
    tests = (
        ("run [1]", "rig_a", {"batch": "12", "load": "1 N", "date": "2026-11-03"}),
        ("run 1", "rig-a", {"batch": "A12", "load": "2 N", "date": "3 Nov 2026"}),
        ("run ?", "Prüfstand", {"batch": "13", "load": "3 mm", "date": "2026-11-04"}),
    )
    for number, (test, rig, conditions) in enumerate(tests, 1):
        fit = replace(FIT, test=test, parameters=(replace(K, value=float(number)),))
        settings = {"tests": [{"name": test, "conditions": conditions}]}
        store(tmp_path / str(number), fits=(fit,), rig={"name": rig}, settings=settings)
    assert sorted(stiffnesses(tmp_path, **asked)) == found


def test_rows_carry_what_is_known_of_their_test(tmp_path: Path) -> None:
    store(tmp_path / "a")
    (row,) = found_values(tmp_path, Filter())
    assert row.conditions == {"date": "2026-11-03", "preload": "400 N", "way": "up"}
    assert row.amounts["preload"] == (400.0, "N") and "way" not in row.amounts
    assert (row.fit, row.test, row.parameter, row.unit, row.std_error, row.label) == (
        "direct",
        "a",
        "k",
        "N/m",
        10.0,
        "a",
    )
    assert (row.ci_low, row.ci_high, row.low_hz, row.high_hz) == (980.0, 1020.0, 60.0, 70.0)
