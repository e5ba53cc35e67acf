"""Commands on a result of many tests: report, list, trend, compare and verify read the dataset."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import duckdb
import pandas as pd
import pyarrow as pa
import pytest

from labpipe.artefacts.dataset_file import first_tests
from labpipe.errors import ConfigError
from labpipe.project.catalogue import VALUE_COLUMNS
from labpipe.project.catalogue_search import condition_holds, value_row
from labpipe.project.executors import Execute, Work, serially
from labpipe.project.one_test import Done, Job
from tests.project.laboratory import PIPELINE, contents, laboratory, recording

ROOT = Path(__file__).parent.parent.parent
TESTS = 12
MANY = PIPELINE.replace("report: {formats: []}", "report: {formats: [html, md]}")


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twelve tests of one rig that gets stiffer with the preload, run once as a dataset and once in one
    file.
    """
    from labpipe.cli.main import run_command

    folder = tmp_path_factory.mktemp("lab")
    laboratory(folder)
    for number in range(TESTS):
        (folder / f"{number}.csv").write_text(recording(18e3 + 400 * number, seed=number))
    tests = "\n".join(
        f"  - {{name: t{n:02d}, recordings: {n}.csv, conditions: {{preload: {100 * (n // 2)} N}}}}"
        for n in range(TESTS)
    )
    text = MANY[: MANY.index("tests:")] + f"tests:\n{tests}\n" + MANY[MANY.index("frf:") :]
    (folder / "pipeline.yaml").write_text(text)
    for way in ("dataset", "whole"):
        formats = "[html, md]" if way == "dataset" else "[]"
        (folder / f"{way}.yaml").write_text(f"results: {way}\n{text.replace('[html, md]', formats)}")
        assert run_command(["run", str(folder / f"{way}.yaml"), "-o", str(folder / "out" / way), "-q"]) == 0
    return folder


def test_the_report_sums_up(lab: Path) -> None:
    text = (lab / "out/dataset/report.md").read_text()
    assert "ACCEPTED: the one rule holds for all 12 tests" in text
    row = next(line for line in text.splitlines() if line.startswith("| k of direct"))
    # k runs from 18 to 22.4 kN/m in steps of .4, its median is 20.2 kN/m.
    assert re.search(r"\| 12 +\| 20\.\d* +\|", row) and "t00" in row and "t11" in row
    assert "k of direct over preload" in text
    assert (lab / "out/dataset/report.html").stat().st_size < 1e6


def test_a_report_of_nothing_new_is_not_drawn_again(lab: Path, labpipe) -> None:
    before = (lab / "out/dataset/report.html").stat().st_mtime_ns
    ended = labpipe("run", lab / "dataset.yaml", "-o", lab / "out/dataset")
    n_row = duckdb.sql(f"from '{lab}/out/dataset/dataset/**/*.parquet'").shape[0]
    assert ended.code == 0 and ended.out.startswith(
        f"12 tests evaluated; fits: 12 of direct, 12 of plain; {n_row} rows in dataset/\n"
    )
    assert (lab / "out/dataset/report.html").stat().st_mtime_ns == before


def test_pages_of_one_test_are_drawn_on_demand(lab: Path, labpipe, tmp_path: Path) -> None:
    assert labpipe("report", lab / "out/dataset", "--test", "t03", "-o", tmp_path / "one.md").code == 0
    assert labpipe("report", lab / "out/whole", "--test", "t03", "-o", tmp_path / "two.md").code == 0
    # The same pages but for the stamp of the file that they come from.
    one, two = ((tmp_path / name).read_text().splitlines() for name in ("one.md", "two.md"))
    assert [line for line in one if "t03" in line] == [line for line in two if "t03" in line] and len(
        one
    ) > 20
    ended = labpipe("report", lab / "out/dataset", "--test", "t3", "-o", tmp_path / "no.md")
    assert ended.code == 2 and "the result has no test 't3'; did you mean" in ended.err


def test_a_dataset_is_not_exported_as_a_table_of_nothing(lab: Path, labpipe, tmp_path: Path) -> None:
    for kind in ("csv", "covariance", "shapes"):
        ended = labpipe("export", lab / "out/dataset/identification.json", "--to", kind, "-o", tmp_path / "t")
        assert ended.code == 2 and "in a dataset beside it" in ended.err and not (tmp_path / "t").exists()


def test_lists_are_those_of_the_whole_result(lab: Path, labpipe, tmp_path: Path) -> None:
    """The same filters on both give the same values, by two ways of finding them."""
    for filters in (
        ["-p", "k"],
        ["-p", "k", "--where", "preload >= 300 N"],
        ["-p", "*", "--fit", "pl*", "--test", "t0*"],
    ):
        printed = [
            labpipe("list", lab / "out" / way, *filters).out.splitlines() for way in ("dataset", "whole")
        ]
        rows = [sorted(re.split(r"\s{2,}", line)[1:] for line in lines[1:]) for lines in printed]
        assert rows[0] == rows[1] and rows[0]


def test_both_kinds_are_listed_together(lab: Path, labpipe) -> None:
    ended = labpipe("list", lab / "out")
    assert [line.split()[1:] for line in ended.out.splitlines()[1:]] == [
        ["dataset", "Small", "rig", "12", "accepted"],
        ["whole", "Small", "rig", "12", "accepted"],
    ]
    assert len(labpipe("list", lab / "out", "-p", "k").out.splitlines()) == 1 + 4 * TESTS
    assert len(labpipe("list", lab / "out", "--where", "preload = 500 N").out.splitlines()) == 3
    assert labpipe("list", lab / "out", "--where", "preload = 5 kN").out.startswith("nothing found")


@pytest.mark.parametrize(
    ("filters", "what"),
    [
        (["-p", "kk"], "no result has the parameter 'kk'; did you mean 'k'?"),
        (
            ["-p", "k", "--where", "prelod > 1 N"],
            "no test has the condition 'prelod'; did you mean 'preload'?",
        ),
        (["-p", "k", "--where", "preload > 1 mm"], "the condition 'preload' is in N, not in m"),
    ],
)
def test_what_no_test_has_is_said(lab: Path, labpipe, filters: list[str], what: str) -> None:
    ended = labpipe("list", lab / "out/dataset", *filters)
    assert ended.code == 2 and what in ended.err


def test_trends_are_those_of_the_whole_result(lab: Path, labpipe) -> None:
    printed = [
        labpipe("trend", lab / "out" / way, "-p", "k", "--over", "preload", "--fit", "direct").out
        for way in ("dataset", "whole")
    ]
    slopes = [re.findall(r"slope .*", text) for text in printed]
    assert slopes[0] == slopes[1] and "rising" in slopes[0][0]


def test_a_dataset_does_not_differ_from_the_same_numbers(lab: Path, labpipe) -> None:
    ended = labpipe("compare", lab / "out/dataset", lab / "out/whole")
    assert ended.code == 0 and re.search(r"^0 of \d+ parameters differ", ended.out, re.MULTILINE)


def test_the_query_of_the_docs_gives_the_same_numbers(
    lab: Path, labpipe, monkeypatch: pytest.MonkeyPatch
) -> None:
    """DuckDB, which knows nothing of labpipe, runs the query that the page prints.

    Numpy takes the medians of `labpipe list --csv`.
    """
    query = re.search(r"```sql\n(.*?)```", (ROOT / "docs/pages/how-to/many.md").read_text(), re.DOTALL)
    assert query is not None
    monkeypatch.chdir(lab / "out/dataset")
    shown = duckdb.sql(query[1].replace("out/dataset/", "dataset/")).fetchall()
    assert (
        labpipe("list", lab / "out/dataset", "-p", "k", "--fit", "direct", "--csv", lab / "k.csv").code == 0
    )
    frame = pd.read_csv(lab / "k.csv")
    expected = frame.groupby("condition:preload")["value"].median()
    assert {row[0]: row[2] for row in shown} == pytest.approx(expected.to_dict(), rel=1e-12)
    assert all(row[1] == 2 for row in shown) and len(shown) == TESTS // 2


def test_verify_checks_the_parts(lab: Path, labpipe) -> None:
    ended = labpipe("verify", lab / "out/dataset")
    assert ended.code == 0 and "0 do not hold" in ended.out


@pytest.mark.usefixtures("jobs")
def test_the_script_of_the_docs_runs(capsys: pytest.CaptureFixture[str]) -> None:
    """The script that the page prints, on twelve tests and in one process."""
    page = (ROOT / "docs/pages/how-to/many.md").read_text()
    script = next(
        block for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL) if "labpipe.run" in block
    )
    exec(script.replace("jobs=2", "jobs=1"), {"__name__": "__main__"})
    assert capsys.readouterr().out.startswith("12 tests, 0 not accepted")


@pytest.fixture
def jobs(lab: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The laboratory without results, its pipeline named as on the page."""
    for path in lab.glob("*.*"):
        shutil.copy(path, tmp_path / path.name.replace("dataset.yaml", "fleet.yaml"))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_tests_are_run_one_by_one_and_collected(lab: Path, jobs: Path, labpipe) -> None:
    """The collecting run finds the fits of two tests and makes the others: the same bytes as of one run."""
    names = labpipe("tests", "fleet.yaml").out.split()
    assert names == [f"t{number:02d}" for number in range(TESTS)]
    for name in names[3:5]:
        assert labpipe("run", "fleet.yaml", "-o", "out", "--only", name, "-q").code == 0
    assert (
        sorted(path.name for path in (jobs / "out/fits").iterdir()) == ["t03.json", "t04.json"]
        and not (jobs / "out/dataset").exists()
    )
    before = (jobs / "out/fits/t03.json").stat().st_mtime_ns
    assert labpipe("run", "fleet.yaml", "-o", "out", "-q").code == 0
    assert (jobs / "out/fits/t03.json").stat().st_mtime_ns == before
    here, there = (
        next((folder / "dataset").rglob("*.parquet")).read_bytes()
        for folder in (jobs / "out", lab / "out/dataset")
    )
    assert here == there


def test_fits_by_themselves_give_the_same_dataset(lab: Path, jobs: Path, labpipe) -> None:
    """`labpipe frf`, then `labpipe identify`: the rows of one run.

    One whose response is missing is named, the others are done.
    """
    assert labpipe("frf", "-c", "fleet.yaml", "-o", "out", "-q").code == 0
    assert labpipe("identify", "-c", "fleet.yaml", "-o", "out", "-q").code == 0
    here, there = (
        next((folder / "dataset").rglob("*.parquet")).read_bytes()
        for folder in (jobs / "out", lab / "out/dataset")
    )
    assert here == there
    ended = labpipe("identify", "-c", "fleet.yaml", "-o", "out", "-q", "--set", "frf.band=12-38 Hz")
    assert ended.code == 2 and "was made with another `frf:` than there is now (band)" in ended.err
    (jobs / "out/t03.frf.parquet").unlink()
    ended = labpipe("identify", "-c", "fleet.yaml", "-o", "out", "-q")
    assert ended.code == 2 and "t03.frf.parquet: no such file; run `labpipe frf` first" in ended.err
    assert "11 tests evaluated" in labpipe("identify", "-c", "fleet.yaml", "-o", "out").out


def test_a_test_that_fails_or_is_not_there_ends_with_2(jobs: Path, labpipe) -> None:
    (jobs / "3.csv").write_text("t [s],force [N],y [um]\n0,1,x\n")
    ended = labpipe("run", "fleet.yaml", "-o", "out", "--only", "t03")
    assert ended.code == 2 and "3.csv" in ended.err
    ended = labpipe("run", "fleet.yaml", "-o", "out", "--only", "t3")
    assert ended.code == 2 and "no test 't3' among several; did you mean" in ended.err


def test_one_test_alone_is_worked_on_where_the_options_say(jobs: Path, labpipe, monkeypatch) -> None:
    """`-j` and `--cluster` choose how jobs are done, one as well as many."""
    asked: list[tuple[int, str | None]] = []

    def executor(processes: int, cluster: str | None) -> Execute:
        def execute(work: Work, given: Sequence[Job]) -> Iterator[Done]:
            asked.append((processes, cluster))
            return serially(work, given)

        return execute

    monkeypatch.setattr("labpipe.cli.many.executor", executor)
    alone = ("run", "fleet.yaml", "-o", "out", "-q", "--only")
    assert labpipe(*alone, "t03", "-j", "2").code == 0
    assert labpipe(*alone, "t04", "--cluster", "tcp://10.0.0.1:8786").code == 0
    assert asked == [(2, None), (1, "tcp://10.0.0.1:8786")]


@pytest.mark.long
def test_the_snakefile_of_the_docs_runs(jobs: Path, labpipe) -> None:
    """As Snakemake runs it, two jobs at a time, of three tests: the bytes of one run.

    Snakemake is not installed with the tests, since it brings more than fifty packages; the recipe ran with
    version 9.27.
    """
    pytest.importorskip("snakemake")
    text = (jobs / "fleet.yaml").read_text()
    (jobs / "fleet.yaml").write_text(re.sub(r"  - \{name: t(0[3-9]|1).*\n", "", text))
    page = (ROOT / "docs/pages/how-to/many.md").read_text()
    (jobs / "Snakefile").write_text(
        next(block for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL) if "Snakefile" in block)
    )
    environment = {**os.environ, "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"}
    subprocess.run(
        [sys.executable, "-m", "snakemake", "-c", "2", "-q"], check=True, env=environment, cwd=jobs
    )
    assert sorted(path.name for path in (jobs / "done").iterdir()) == ["t00", "t01", "t02"]
    assert labpipe("run", "fleet.yaml", "-o", "again", "-q").code == 0
    assert contents(jobs / "out") == contents(jobs / "again")


def test_a_date_that_is_no_day_is_not_that_of_the_file() -> None:
    """As of single results: the catalogue shows what stands there."""
    row = {**dict.fromkeys(VALUE_COLUMNS), "full_error": 1.0, "changes": [], "date": "2026-11-29"}
    row |= {"path": "p", "dated": "the file"}
    stated = value_row({**row, "condition.date": "03/11/2026"}, {"date": {"03/11/2026": (None, "")}})
    assert (stated.date, stated.dated) == ("03/11/2026", "")
    dated = value_row({**row, "condition.date": None}, {"date": {}})
    assert (dated.date, dated.dated) == ("2026-11-29", "the file")


def test_tests_that_failed_are_named_once_with_their_conditions() -> None:
    """Each row of a test says it; the report names the first hundred."""
    names = [f"t{number:03d}" for number in range(120) for _ in range(2)]
    loads = [f"{number} N" if number % 2 else None for number in range(120) for _ in range(2)]
    table = pa.table(
        {
            "test": names,
            "failed": ["no peak", "no peak", *([None] * 238)],
            "condition.load": loads,
            "condition.oil": ["VG 32"] * 240,
        }
    )
    named = list(first_tests(table, "failed"))
    assert len(named) == 100 and named[-1][0] == "t099"
    assert named[:2] == [("t000", "oil VG 32", "no peak"), ("t001", "load 1 N, oil VG 32", "")]


@pytest.mark.parametrize(
    ("condition", "kept"),
    [
        ("load = 2 kN", [2]),
        ("load != 2000 N", [0, 1, 3]),
        ("load >= 2 kN", [2, 3]),
        ("load > 2 kN", [3]),
        ("load <= 2 kN", [0, 1, 2]),
        ("load < 2 kN", [0, 1]),
        ("oil = VG 32", [0, 2]),
        ("oil != VG 32", [1]),
    ],
)
def test_conditions_choose_rows_by_amounts_or_words(condition: str, kept: list[int]) -> None:
    """What rounds to a bound is the bound; a test without the condition is neither it nor another."""
    loads = [1000.0, 1999.0, 2000.0 * (1 - 1e-15), 3000.0]
    table = pa.table(
        {
            "row": [0, 1, 2, 3],
            "condition.load": [f"{load!r} N" for load in loads],
            "amount.load": loads,
            "condition.oil": ["VG 32", "VG 46", "VG 32", None],
            "amount.oil": pa.array([None] * 4, pa.float64()),
        }
    )
    assert table.filter(condition_holds(table, condition))["row"].to_pylist() == kept
    with pytest.raises(ConfigError, match="no test has the condition 'lod'"):
        condition_holds(table, "lod = 1 N")
    with pytest.raises(ConfigError, match="is in N, not in m"):
        condition_holds(table, "load = 1 m")
    with pytest.raises(ConfigError, match="oil > VG 32"):
        condition_holds(table, "oil > VG 32")
    mixed = pa.table({"row": [0, 1, 2], "condition.load": ["1 N", "2 mm", "high"]})
    assert mixed.filter(condition_holds(mixed, "load >= 0.5 N"))["row"].to_pylist() == [0]
    assert mixed.filter(condition_holds(mixed, "load != 2 mm"))["row"].to_pylist() == [0, 2]
