"""A folder of results: listed, filtered, compared with each other, exported; the index follows the files."""

from __future__ import annotations

import csv
import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from labpipe.artefacts.identification_file import write_identification
from labpipe.errors import ConfigError, DataError
from labpipe.project.catalogue import INDEX, Filter, open_index
from labpipe.project.catalogue_search import differences, found_results, found_values, trends
from labpipe.records.finding import Finding, Parameter
from labpipe.records.identification import (
    Failed,
    Fit,
    Goodness,
    Identification,
    ListedParameter,
    RuleOutcome,
    of_fit,
)
from labpipe.uncertainty import weighted


def parameter(name: str, value: float, error: float | None, unit: str = "N/m") -> Parameter:
    ci95 = None if error is None else (value - 1.96 * error, value + 1.96 * error)
    return Parameter(name, value, unit, std_error=error, t_ratio=None, ci95=ci95, significant=True)


def fit(
    test: str, stiffness: float, error: float | None = 10.0, name: str = "direct", codes: tuple[str, ...] = ()
) -> Fit:
    return Fit(
        name=name,
        model="sdof",
        estimator="ml",
        band_hz=(60.0, 70.0),
        lines=20,
        equations=40,
        dof=38,
        gof=Goodness(0.99, 0.99),
        parameters=(parameter("k", stiffness, error), parameter("c", 3.0, 0.1, "N.s/m")),
        condition_number=3.0,
        correlation=np.eye(2),
        findings=tuple(Finding(code, "words") for code in codes),
        test=test,
    )


def store(
    folder: Path,
    fits: list[Fit],
    conditions: dict[str, dict[str, str]],
    rig: str = "Ball-bearing rig",
    **more: object,
) -> None:
    folder.mkdir(parents=True)
    settings = {"tests": [{"name": name, "conditions": own} for name, own in conditions.items()]}
    result = Identification(tuple(fits), folder.name, rig={"name": rig}, settings=settings, **more)
    write_identification(folder / "identification.json", result)


@pytest.fixture
def campaign(tmp_path: Path) -> Path:
    """Three runs: two preloads in one, one of another day with a warning, one of another rig."""
    both = {
        "a": {"preload": "400 N", "direction": "up", "date": "2026-11-03"},
        "b": {"preload": "0.7 kN", "direction": "down"},
    }
    held = (RuleOutcome("accept", "direct.gof >= 0.9", 0.99, True),)
    store(tmp_path / "one", [fit("a", 1000.0), fit("b", 1500.0)], both, outcomes=held)
    store(
        tmp_path / "sub/two",
        [fit("c", 1040.0, codes=("model-mismatch",))],
        {"c": {"preload": "400 N", "date": "2026-11-10"}},
    )
    store(tmp_path / "three", [fit("", 50.0, name="axial")], {"": {"date": "2026-10-01"}}, rig="Magnetic rig")
    return tmp_path


def found(folder: Path, **asked: object) -> list[tuple[str, float]]:
    return [(row.test, row.value) for row in found_values(folder, Filter(parameter="k", **asked))]


def test_every_result_is_listed_by_date(campaign: Path) -> None:
    rows = found_results(campaign, Filter())
    assert [(row.path, row.date, row.tests, row.verdict, row.warnings) for row in rows] == [
        ("three/identification.json", "2026-10-01", 1, "no rules", ""),
        ("one/identification.json", "2026-11-03", 2, "accepted", ""),
        ("sub/two/identification.json", "2026-11-10", 1, "no rules", "model-mismatch"),
    ]


FILTERS = [
    ({}, ["", "a", "b", "c"]),
    ({"where": ("preload >= 500 N",)}, ["b"]),
    ({"where": ("preload = 700 N",)}, ["b"]),
    ({"where": ("preload != 700 N",)}, ["a", "c"]),
    ({"where": ("preload < 0.4 kN",)}, []),
    ({"where": ("preload <= 0.4 kN",)}, ["a", "c"]),
    ({"where": ("preload > 400 N",)}, ["b"]),
    ({"where": ("direction = up",)}, ["a"]),
    ({"where": ("direction != up",)}, ["b"]),
    ({"where": ("preload = 400 N", "direction = up")}, ["a"]),
    ({"since": "2026-11-04"}, ["c"]),
    ({"until": "2026-10-31"}, [""]),
    ({"rig": "ball"}, ["a", "b", "c"]),
    ({"fit": "ax*"}, [""]),
    ({"test": "*a*"}, ["a"]),
    ({"rig": "BALL"}, ["a", "b", "c"]),
]


@pytest.mark.parametrize(("asked", "tests"), FILTERS)
def test_values_are_chosen_by_what_is_known_of_them(
    campaign: Path, asked: dict[str, object], tests: list[str]
) -> None:
    assert [test for test, _ in found(campaign, **asked)] == tests


def test_results_are_chosen_by_the_conditions_of_any_test(campaign: Path) -> None:
    assert [row.title for row in found_results(campaign, Filter(where=("direction = down",)))] == ["one"]


@pytest.mark.parametrize(
    ("asked", "what"),
    [
        ({"where": ("preload 400 N",)}, "is not a condition"),
        ({"where": ("preloat = 400 N",)}, "did you mean 'preload'?"),
        ({"where": ("preload = 400 mm",)}, "is in N, not in m"),
        ({"where": ("direction = 4 N",)}, "is in words, not in N"),
        ({"where": ("preload >= up",)}, "'up' is not an amount"),
        ({"since": "3.11.2026"}, "write it as 2026-11-03"),
        ({"fit": "axiel"}, "did you mean 'axial'?"),
        ({"test": "x*"}, "no result has the test 'x*'"),
    ],
)
def test_questions_that_cannot_be_meant_are_refused(
    campaign: Path, asked: dict[str, object], what: str
) -> None:
    with pytest.raises(ConfigError) as error:
        found(campaign, **asked)
    assert what in str(error.value)


def undigested(text: str) -> str:
    """A result as labpipe wrote it before it had a digest."""
    return "".join(line for line in text.splitlines(keepends=True) if not line.startswith('"digest"'))


def test_the_index_follows_the_files(campaign: Path) -> None:
    assert len(found(campaign)) == 4
    path = campaign / "sub/two/identification.json"
    path.write_text(undigested(path.read_text()).replace("1040.0", "1234.0"))
    os.utime(path, ns=(1, 1))
    assert ("c", 1234.0) in found(campaign)
    path.unlink()
    assert [test for test, _ in found(campaign)] == ["", "a", "b"]


def test_what_is_up_to_date_is_not_read_again(campaign: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found(campaign)
    monkeypatch.setattr(
        "labpipe.project.catalogue.read_identification", lambda path: pytest.fail(f"{path} was read again")
    )
    assert len(found(campaign)) == 4


def test_a_damaged_index_is_made_again(campaign: Path) -> None:
    found(campaign)
    (campaign / INDEX).write_bytes(b"no index at all, but long enough to be looked at " * 50)
    assert len(found(campaign)) == 4


def test_no_damaged_byte_of_the_index_reaches_a_value(campaign: Path) -> None:
    """Each of 40 single bytes, seed pinned: the index is made again."""
    expected = found(campaign)
    whole = (campaign / INDEX).read_bytes()
    for place in np.random.default_rng(3).integers(0, len(whole), 40):
        (campaign / INDEX).write_bytes(whole[:place] + bytes([255 - whole[place]]) + whole[place + 1 :])
        assert found(campaign) == expected
        assert (campaign / INDEX).read_bytes() == whole


@pytest.mark.parametrize("kind", ["folder", "pipe", "another file"])
def test_what_is_no_index_of_ours_does_not_stop_a_list(tmp_path: Path, campaign: Path, kind: str) -> None:
    path = campaign / INDEX
    path.unlink(missing_ok=True)
    if kind == "folder":
        path.mkdir()
    elif kind == "pipe":
        os.mkfifo(path)
    else:
        path.write_text('{"a": 1}')
    assert len(found(campaign)) == 4


@pytest.mark.long
def test_several_processes_build_the_index_at_once(campaign: Path) -> None:
    """Each writes it whole, so that none waits for another."""
    command = [sys.executable, "-m", "labpipe", "list", str(campaign), "-p", "k"]
    running = [subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) for _ in range(3)]
    ended = [process.communicate() for process in running]
    assert {out for out, _ in ended} == {ended[0][0]} and {err for _, err in ended} == {b""}


def test_what_another_run_is_making_is_not_listed(campaign: Path) -> None:
    (campaign / ".labpipe-x1").mkdir()
    (campaign / ".labpipe-x1/identification.json").write_bytes(
        (campaign / "one/identification.json").read_bytes()
    )
    assert len(found(campaign)) == 4


def test_a_folder_that_may_not_be_written_is_indexed_in_memory(
    campaign: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refusing(path: Path) -> Path:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr("labpipe.project.catalogue.output_file", refusing)
    assert len(found(campaign)) == 4
    assert not (campaign / INDEX).exists()


def test_a_result_that_cannot_be_read_is_listed_as_such(campaign: Path) -> None:
    (campaign / "three/identification.json").write_text('{"schema": "other"}')
    rows = {row.path: row for row in found_results(campaign, Filter())}
    assert rows["three/identification.json"].verdict == "unreadable"
    assert "is not of schema" in rows["three/identification.json"].fault


def test_an_incomplete_result_says_so(tmp_path: Path) -> None:
    store(tmp_path / "x", [fit("a", 1.0)], {"a": {}}, failed=(Failed("b", "was cut off"),))
    assert found_results(tmp_path, Filter())[0].verdict == "incomplete"


def test_no_folder_and_no_results_are_named(tmp_path: Path) -> None:
    for folder, what in ((tmp_path / "none", "no such folder"), (tmp_path, "holds no identification.json")):
        with pytest.raises(DataError, match=what):
            open_index(folder)


def test_lists_on_the_terminal_and_as_csv(campaign: Path, labpipe) -> None:
    ended = labpipe("list", campaign)
    assert ended.code == 0 and "sub/two" in ended.out and "model-mismatch" in ended.out
    ended = labpipe("list", campaign, "-p", "k", "--where", "preload = 400 N", "--csv", campaign / "k.csv")
    assert [line.split()[0] for line in ended.out.splitlines()] == ["result", "one", "sub/two"]
    rows = list(csv.DictReader((campaign / "k.csv").read_text().splitlines()))
    assert [(row["test"], float(row["value"]), row["unit"], row["condition:preload"]) for row in rows] == [
        ("a", 1000.0, "N/m", "400 N"),
        ("c", 1040.0, "N/m", "400 N"),
    ]
    assert labpipe("list", campaign, "-p", "k", "--where", "preload > 9 kN").out == "nothing found\n"
    assert labpipe("list", campaign / "nowhere").code == 2


@pytest.fixture
def line(tmp_path: Path) -> Path:
    """k = 1000 N/m + 2 N/m for each newton of preload exactly, errors 10 N/m, one test a day."""
    for day, preload in enumerate((100, 200, 400, 300), 1):
        fits = [fit(f"t{preload}", 1000.0 + 2 * preload)]
        store(
            tmp_path / f"r{day}",
            fits,
            {f"t{preload}": {"preload": f"{preload} N", "date": f"2026-11-0{day}"}},
        )
    return tmp_path


def test_a_trend_over_a_condition(line: Path) -> None:
    """Weighted line through exact values: slope 2, standard error 10 / sqrt(sum (x - 250)^2) = 10 /
    sqrt(50,000).
    """
    (series,) = trends(found_values(line, Filter(parameter="k")), "preload")
    assert list(series.condition) == [100.0, 200.0, 300.0, 400.0] and series.condition_unit == "N"
    drawn = series.line_over("preload")
    assert drawn is not None and drawn.values[1] == pytest.approx(2.0)
    assert drawn.std_error(1) == pytest.approx(10 / 50_000**0.5)


def test_limits_over_time_are_those_of_values_without_their_trend(line: Path) -> None:
    """By date 1200, 1400, 1800, 1600, exactly 1000 + 2 x preload: 1500 each at the mean preload. Without
    preload the mean moving range is 800 / 3, sigma that over 2 / sqrt(pi).
    """
    found = found_values(line, Filter(parameter="k"))
    for rows, sigma, conditions in (
        (found, 0.0, ("preload",)),
        ([replace(row, amounts={}) for row in found], 800 / 3 * np.pi**0.5 / 2, ()),
    ):
        series = trends(rows, "date")
        (adjusted,) = weighted.adjust(series, weighted.trends_of(series))
        assert list(series[0].condition) == [0.0, 1.0, 2.0, 3.0] and adjusted.conditions == conditions
        assert adjusted.limits is not None and adjusted.limits.centre == pytest.approx(1500.0)
        assert adjusted.limits.sigma == pytest.approx(sigma, abs=1e-9)


def test_a_value_out_of_control_is_named(tmp_path: Path, labpipe) -> None:
    for day in range(1, 10):
        value = 1000.0 + (day % 2) + (500.0 if day == 9 else 0.0)
        store(tmp_path / f"r{day}", [fit("", value)], {"": {"date": f"2026-11-0{day}"}})
    ended = labpipe("trend", tmp_path, "-p", "k", "--over", "date")
    assert "beyond r9" in ended.out and ended.out.count("out of control") == 1
    assert "test" not in ended.out.splitlines()[2]


def test_a_curved_trend_is_not_none(tmp_path: Path, labpipe) -> None:
    """1 % above the middle at either end, with standard errors of 1e-4."""
    for day in range(1, 7):
        value = 1e5 * (1 + 0.01 * ((day - 3.5) / 2.5) ** 2) + 10 * (-1) ** day
        store(tmp_path / f"r{day}", [fit("", value)], {"": {"date": f"2026-11-0{day}"}})
    ended = labpipe("trend", tmp_path, "-p", "k", "--over", "date")
    assert "no trend" not in ended.out and "(95 %): curved" in ended.out
    assert re.search(r"in the middle (0\.9\d?|1) % below the chord \(p = ", ended.out)


def test_trends_on_the_terminal_as_csv_and_as_report(line: Path, labpipe) -> None:
    ended = labpipe(
        "trend", line, "-p", "k", "--over", "preload", "--csv", line / "t.csv", "-o", line / "t.html"
    )
    assert ended.code == 0, ended.err
    # 1.96 standard errors of 10 / sqrt(50,000) N/m for a newton.
    assert "slope 0.002000 ± 0.000088 kN/m per N (95 %): rising" in ended.out
    assert "control limits" not in ended.out
    assert len((line / "t.csv").read_text().splitlines()) == 5
    assert "Campaign" in (line / "t.html").read_text()
    ended = labpipe("trend", line, "-p", "k", "--over", "preload", "--where", "preload < 250 N")
    assert "no trend can be computed" in ended.out
    # 1500 N/m at the mean preload, all four.
    ended = labpipe("trend", line, "-p", "k", "--over", "date")
    low, high = re.search(
        r"limits ([\d.]+) to ([\d.]+) kN/m of k, less its trend over preload: beyond none", ended.out
    ).groups()
    assert [float(low), float(high)] == pytest.approx([1.5, 1.5], rel=1e-5)


@pytest.mark.parametrize(
    ("arguments", "what"),
    [
        (["--over", "speed"], "no test has the amount 'speed'"),
        (["--over", "preload", "--where", "preload > 9 kN"], "no test has the amount 'preload'"),
        (["--over", "date", "--since", "2030-01-01"], "no result matches these filters"),
        (["--over", "preload", "-o", "x.docx"], "no report format for the ending '.docx'"),
    ],
)
def test_trends_that_cannot_be_told_are_refused(line: Path, labpipe, arguments: list[str], what: str) -> None:
    ended = labpipe("trend", line, "-p", "k", *arguments)
    assert ended.code == 2 and what in ended.err


def two(first: list[Fit], second: list[Fit]) -> tuple[list[ListedParameter], list[ListedParameter]]:
    return listed(first), listed(second)


def listed(fits: list[Fit]) -> list[ListedParameter]:
    return [parameter for fit in fits for parameter in of_fit(fit)]


def test_differences_are_judged_by_both_errors_and_their_number() -> None:
    """z = 40 / sqrt(10^2 + 10^2) = 2.828, p = .004678 two-sided; twice that after Holm for two parameters."""
    k, c = differences(*two([fit("a", 1000.0)], [fit("b", 1040.0)]))
    assert (k.parameter, k.first, k.second, k.std_error) == ("k", 1000.0, 1040.0, pytest.approx(200**0.5))
    assert k.p_value == pytest.approx(2 * 0.004677735, rel=1e-6) and k.differs
    assert c.p_value == 1.0 and not c.differs


def test_without_an_error_nothing_is_claimed() -> None:
    k, c = differences(*two([fit("a", 1000.0, None)], [fit("a", 5000.0)]))
    assert k.std_error is None and k.p_value is None and not k.differs
    assert c.p_value == 1.0


def test_tests_are_matched_by_name_where_there_are_several() -> None:
    found = differences(*two([fit("a", 1.0), fit("b", 2.0)], [fit("b", 3.0), fit("x", 4.0)]))
    assert [(one.test, one.parameter, one.second) for one in found] == [("b", "k", 3.0), ("b", "c", 3.0)]


def test_other_sections_are_compared_as_fits_are() -> None:
    """5 mm/N and 7 of a comparison, errors 0.6 and 0.8: z = 2, p = 0.0455; of an untested one none."""
    lag, trial = parameter("lag", 5.0, 0.6, "1"), parameter("trial", float("nan"), 0.1, "1")
    mine, other = (
        [
            *listed([fit(test, 1000.0)]),
            *(ListedParameter(fit="loop", parameter=p, model="trend") for p in amounts),
        ]
        for test, amounts in (("a", (lag, trial)), ("b", (replace(lag, value=7.0, std_error=0.8), trial)))
    )
    k, c, of_loop, untested = differences(mine, other)
    assert (k.parameter, c.parameter, of_loop.fit, of_loop.std_error) == (
        "k",
        "c",
        "loop",
        pytest.approx(1.0),
    )
    # Three are tested.
    assert of_loop.p_value == pytest.approx(3 * 0.04550026, rel=1e-6) and untested.p_value is None


def test_comparing_on_the_terminal(campaign: Path, labpipe) -> None:
    ended = labpipe(
        "compare", campaign / "one", campaign / "one/identification.json", "--csv", campaign / "d.csv"
    )
    assert ended.code == 0 and "0 of 4 parameters differ" in ended.out
    rows = list(csv.DictReader((campaign / "d.csv").read_text().splitlines()))
    assert len(rows) == 4 and {row["p_value"] for row in rows} == {"1.0"}
    assert "of the same files" not in ended.out
    for name, digests in (("once", "a"), ("again", "ab")):
        sources = tuple({"path": f"{digest}.csv", "sha256": 64 * digest} for digest in digests)
        store(campaign / name, [fit("a", 1000.0)], {"a": {}}, sources=sources)
    assert "both come from the same files" in labpipe("compare", campaign / "once", campaign / "again").out
    ended = labpipe("compare", campaign / "one", campaign / "three")
    assert ended.code == 2 and "no fit in common (fits: direct; axial)" in ended.err
    path = campaign / "sub/two/identification.json"
    entries = json.loads(path.read_text())
    entries["fits"][0]["test"] = "a"
    del entries["digest"]
    path.write_text(json.dumps(entries))
    ended = labpipe("compare", campaign / "one", campaign / "sub/two", "-p", "k")
    assert "differs" in ended.out and "1 of 2 parameters differ" in ended.out
    # What has no partner, or one of another unit, is not passed over: it said 0 of 1, and nothing more.
    (entry,) = (p for p in entries["fits"][0]["parameters"] if p["name"] == "k")
    entry["unit"] = "N.m/rad"
    path.write_text(json.dumps(entries))
    ended = labpipe("compare", campaign / "one", campaign / "sub/two")
    assert ended.code == 0 and "0 of 1 parameters differ" in ended.out
    first, second = (line for line in ended.out.splitlines() if line.startswith("not compared"))
    assert "direct, test a: k [N/m]; direct, test b: k" in first and "test a: k [N.m/rad]" in second
