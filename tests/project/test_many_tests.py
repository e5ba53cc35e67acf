"""Many recordings in one run: side by side, one that fails alone, runs that are interrupted, workers that are
killed.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest

from labpipe.artefacts.writing import output_folder
from labpipe.cli.many import duration
from labpipe.errors import DataError
from labpipe.project.executors import Work, batch_size, in_processes, on_cluster, serially
from labpipe.project.one_test import Done, Job
from labpipe.project.pipeline_file import load_pipeline
from labpipe.project.run import Manner, run
from labpipe.project.settings_reader import conditions_in

RIG = """name: Test rig
time: "t [s]"
channels:
  f: {column: "force [N]", quantity: force, unit: N, role: input, dof: y}
  y: {column: "y [um]", quantity: displacement, unit: um, role: output, dof: y}
mass: 0.79 kg
"""
PIPELINE = """title: Many
rig: rig.yaml
tests:
  - {each: "runs/*.csv", pattern: "{preload}-{direction}", conditions: {speed: 0 rpm}}
frf: {excitation: periodic, period: 1 s, skip: 0}
identify:
  direct: {model: sdof, estimator: ml, input: f, output: y, band: 10-40 Hz}
  curve: {model: sdof, estimator: ls, input: f, output: y, sliding: {width: 10 Hz, step: 10 Hz}}
compare:
  rise: {kind: trend, fit: direct, parameter: k, over: preload}
accept: {direct.gof: ">= 0.9"}
report: {formats: []}
"""
PRELOADS = (100, 200, 300, 400)


def recording(preload: int) -> str:
    """Five periods of 1 s at 200 Hz of a mass of .79 kg on a spring that grows with the preload.

    Seed pinned.
    """
    rng = np.random.default_rng(preload)
    t = np.arange(1000) / 200
    lines = np.arange(1, 51)
    phasors = np.exp(1j * (2 * np.pi * np.outer(t, lines) - np.pi * lines * (lines - 1) / 50))
    omega = 2 * np.pi * lines
    receptance = 1e6 / ((18e3 + 10 * preload) - 0.79 * omega**2 + 20j * omega)
    force, y = phasors.real.sum(1), (phasors * receptance).real.sum(1)
    columns = np.column_stack([t, force + 0.01 * rng.normal(size=t.size), y + 0.1 * rng.normal(size=t.size)])
    return "t [s],force [N],y [um]\n" + "".join(
        f"{row[0]:.6g},{row[1]:.7g},{row[2]:.7g}\n" for row in columns
    )


@pytest.fixture
def project(tmp_path: Path) -> Path:
    (tmp_path / "runs").mkdir()
    (tmp_path / "rig.yaml").write_text(RIG)
    (tmp_path / "pipeline.yaml").write_text(PIPELINE)
    for preload in PRELOADS:
        (tmp_path / f"runs/{preload}N-up.csv").write_text(recording(preload))
    return tmp_path


def contents(folder: Path) -> dict[str, bytes]:
    return {
        p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()
    }


def stamps(folder: Path) -> dict[str, int]:
    return {p.relative_to(folder).as_posix(): p.stat().st_mtime_ns for p in folder.rglob("*") if p.is_file()}


def identification(folder: Path) -> dict:
    return json.loads((folder / "identification.json").read_text())


@pytest.mark.long
def test_side_by_side_is_byte_for_byte_what_one_after_the_other_gives(project: Path, labpipe) -> None:
    assert labpipe("run", project / "pipeline.yaml", "-o", project / "one").code == 0
    assert labpipe("run", project / "pipeline.yaml", "-o", project / "two", "-j", 2).code == 0
    assert contents(project / "one") == contents(project / "two")
    result = identification(project / "two")
    assert [fit["test"] for fit in result["fits"] if fit["name"] == "direct"] == [
        f"{preload}N-up" for preload in PRELOADS
    ]
    assert result["responses"][0]["conditions"] == {"speed": "0 rpm", "preload": "100N", "direction": "up"}
    # The truth is 18 kN/m + 10 N/m for each newton of preload.
    stiffness = [fit["parameters"][0] for fit in result["fits"] if fit["name"] == "direct"]
    for preload, k in zip(PRELOADS, stiffness, strict=True):
        assert k["value"] == pytest.approx(18e3 + 10 * preload, abs=4 * k["std_error"])
    assert not list(project.glob(".labpipe-*"))


@pytest.mark.long
def test_the_stages_take_many_tests_as_well(project: Path, labpipe) -> None:
    assert labpipe("run", project / "pipeline.yaml", "-o", project / "whole").code == 0
    assert labpipe("frf", "-c", project / "pipeline.yaml", "-o", project / "staged").code == 0
    assert labpipe("identify", "-c", project / "pipeline.yaml", "-o", project / "staged").code == 0
    assert identification(project / "staged")["fits"] == identification(project / "whole")["fits"]


def test_one_bad_recording_fails_alone(project: Path, labpipe) -> None:
    good = (project / "runs/300N-up.csv").read_text()
    (project / "runs/300N-up.csv").write_text(good.replace("\n0.5,", "\n0.5,oops", 1))
    ended = labpipe("run", project / "pipeline.yaml", "-o", project / "out", "--set", "report.formats=[md]")
    assert ended.code == 2
    assert "error: 300N-up:" in ended.err and "300N-up.csv" in ended.err and "Traceback" not in ended.err
    result = identification(project / "out")
    assert [failed["name"] for failed in result["failed"]] == ["300N-up"]
    assert {fit["test"] for fit in result["fits"]} == {"100N-up", "200N-up", "400N-up"}
    assert [comparison["name"] for comparison in result["comparisons"]] == ["rise"]
    report = (project / "out/report.md").read_text()
    assert "INCOMPLETE" in report and "300N-up" in report
    # Put right, only the bad one is done; the others are left as they are.
    before = stamps(project / "out")
    (project / "runs/300N-up.csv").write_text(good)
    assert labpipe("run", project / "pipeline.yaml", "-o", project / "out").code == 0
    kept = {
        name: stamp
        for name, stamp in before.items()
        if "recordings" in name or name.endswith("frf.parquet") or "fits/" in name
    }
    assert len(kept) == 9 and {name: stamps(project / "out")[name] for name in kept} == kept
    assert "failed" not in identification(project / "out")


def test_a_rule_on_a_test_that_failed_fails(project: Path, labpipe) -> None:
    (project / "runs/300N-up.csv").write_text("t [s],force [N],y [um]\n0,1,1\n")
    ended = labpipe(
        "run", project / "pipeline.yaml", "-o", project / "out", "--set", "accept.direct[300N-up].gof=>= 0.5"
    )
    assert ended.code == 2 and "direct[300N-up].gof >= 0.5: FAILED (found nothing)" in ended.out


def test_a_comparison_without_the_tests_it_needs_is_named_too(project: Path, labpipe) -> None:
    for preload in PRELOADS[1:]:
        (project / f"runs/{preload}N-up.csv").write_text("t [s],force [N],y [um]\n0,1,1\n")
    ended = labpipe("run", project / "pipeline.yaml", "-o", project / "out")
    assert ended.code == 2 and "error: compare.rise:" in ended.err
    assert len(identification(project / "out")["failed"]) == 4


def test_nothing_is_reported_when_all_fail(project: Path, labpipe) -> None:
    for preload in PRELOADS:
        (project / f"runs/{preload}N-up.csv").write_text("t [s],force [N],y [um]\n0,1,1\n")
    ended = labpipe("run", project / "pipeline.yaml", "-o", project / "out")
    assert ended.code == 2 and "100N-up.csv" in ended.err and "none of 4 tests" in ended.err
    assert not (project / "out").exists()


def test_an_interrupted_run_goes_on_where_it_stopped(project: Path) -> None:
    pipeline = load_pipeline(project / "pipeline.yaml")

    def interrupted(work: Work, jobs: Sequence[Job]) -> Iterator[Done]:
        yield from map(work, jobs[:2])
        raise KeyboardInterrupt

    with (
        pytest.raises(DataError, match="2 of 4 tests are finished and kept"),
        output_folder(project / "out") as folder,
    ):
        run(pipeline, folder, Manner(execute=interrupted))
    before = stamps(project / "out")
    assert sorted(name for name in before if name.startswith("fits/")) == [
        "fits/100N-up.json",
        "fits/200N-up.json",
    ]
    with output_folder(project / "out") as folder:
        run(pipeline, folder, Manner())
    assert {name: stamps(project / "out")[name] for name in before} == before
    with output_folder(project / "fresh") as folder:
        run(pipeline, folder, Manner())
    assert contents(project / "out") == contents(project / "fresh")


def hears_ctrl_c() -> None:
    """Processes of a test run that works in the background would inherit deafness."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


@pytest.mark.long
def test_ctrl_c_on_several_processes_leaves_only_whole_tests(project: Path) -> None:
    for preload in range(500, 560):
        (project / f"runs/{preload}N-up.csv").write_text(recording(preload))
    command = [sys.executable, "-m", "labpipe", "run", "pipeline.yaml", "-o", "out", "-j", "2"]
    process = subprocess.Popen(
        command,
        cwd=project,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=hears_ctrl_c,
    )
    deadline = time.monotonic() + 60
    while (
        len(list(project.glob("out/fits/*.json"))) < 2
        and process.poll() is None
        and time.monotonic() < deadline
    ):
        time.sleep(0.02)
    os.killpg(process.pid, signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 2 and err.startswith("error: interrupted; ") and "Traceback" not in err
    assert "the same command goes on from there" in err
    assert not list(project.glob(".labpipe-*")) and not list(project.glob("out/**/.labpipe-*"))
    assert not (project / "out/identification.json").exists()


def work_or_die(job: Job) -> Done:
    """The work of a test.

    The process of the second one is ended from outside the first time, that of the third one always.
    """
    from labpipe.project.one_test import work

    marker = job.pipeline_path.parent / "killed-once"
    if job.test.name == "300N-up" or (job.test.name == "200N-up" and not marker.exists()):
        marker.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return work(job)


@pytest.mark.long
def test_a_killed_process_loses_no_test_but_its_own(project: Path) -> None:
    pipeline = load_pipeline(project / "pipeline.yaml")

    def deadly(_work: Work, jobs: Sequence[Job]) -> Iterator[Done]:
        return in_processes(2)(work_or_die, jobs)

    with output_folder(project / "out") as folder:
        found = run(pipeline, folder, Manner(execute=deadly))
    assert [failed.name for failed in found.failed] == ["300N-up"]
    assert "was killed" in found.failed[0].message
    assert {fit.test for fit in found.fits} == {"100N-up", "200N-up", "400N-up"}
    assert not list(project.glob("**/.labpipe-*"))


def test_progress_counts_every_test_once(project: Path) -> None:
    steps: list[tuple[int, int, str]] = []
    with output_folder(project / "out") as folder:
        run(
            load_pipeline(project / "pipeline.yaml"),
            folder,
            Manner(progress=lambda *step: steps.append(step), execute=serially),
        )
    assert steps == [(n, 4, f"{preload}N-up") for n, preload in enumerate(PRELOADS, 1)]


def test_progress_on_the_terminal_names_the_time_left(project: Path, labpipe) -> None:
    ended = labpipe("run", project / "pipeline.yaml", "-o", project / "out", "-v")
    assert "test 1 of 4  100N-up, " in ended.err and " left" in ended.err
    assert "test 4 of 4  400N-up in " in ended.err
    assert labpipe("run", project / "pipeline.yaml", "-o", project / "quiet", "-q").err == ""


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.4, "0 s"),
        (59.4, "59 s"),
        (59.6, "1 min 0 s"),
        (200, "3 min 20 s"),
        (3600, "1 h 0 min"),
        (7500, "2 h 5 min"),
    ],
)
def test_durations_read_as_people_say_them(seconds: float, text: str) -> None:
    assert duration(seconds) == text


NAMES = [
    ("427N-up", "{preload}-{direction}", {"preload": "427N", "direction": "up"}),
    ("6208-427N-up-x", "6208-{preload}-{direction}-{}", {"preload": "427N", "direction": "up"}),
    ("run_12_3000rpm", "run_{}_{speed}", {"speed": "3000rpm"}),
    ("427N", "{preload}-{direction}", None),
    ("a.b", "a.b", {}),
    ("axb", "a.b", None),
]


@pytest.mark.parametrize(("name", "pattern", "found"), NAMES)
def test_conditions_in_a_file_name(name: str, pattern: str, found: dict[str, str] | None) -> None:
    assert conditions_in(name, pattern) == found


FAULTS = [
    ('{each: "runs/*.csv", pattern: "{preload}_{direction}"}', "tests.1.pattern: does not match '100N-up'"),
    ('{each: "nothing/*.csv"}', "tests.1.each: no file matches 'nothing/*.csv'"),
    ('{each: "runs/*.csv", name: all}', "tests.1.name: unknown key"),
    ('{each: "runs/100N-up.csv"}\n  - {each: "runs/100N-up.csv"}', "a second test named '100N-up'"),
    (
        '{name: "a b", recordings: runs/100N-up.csv}\n  - {name: "a/b", recordings: runs/200N-up.csv}',
        "would write the same file",
    ),
]


@pytest.mark.parametrize(("entry", "message"), FAULTS)
def test_faults_of_many_tests_are_named(project: Path, labpipe, entry: str, message: str) -> None:
    old = PIPELINE.splitlines()[3]
    (project / "pipeline.yaml").write_text(PIPELINE.replace(old, f"  - {entry}"))
    ended = labpipe("run", project / "pipeline.yaml", "-o", project / "out")
    assert ended.code == 2 and message in ended.err and not (project / "out").exists()


def test_a_fit_of_an_unknown_test_is_refused_before_any_work(project: Path, labpipe) -> None:
    ended = labpipe(
        "run", project / "pipeline.yaml", "-o", project / "out", "--set", "identify.direct.test=100N-pu"
    )
    assert ended.code == 2 and "no test '100N-pu'; did you mean '100N-up'?" in ended.err
    assert not (project / "out").exists()


@pytest.fixture(scope="module")
def scheduler() -> Iterator[str]:
    """A scheduler with two workers on loopback."""
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, host="127.0.0.1", dashboard_address="127.0.0.1:0"
    ) as cluster:
        yield cluster.scheduler_address


def test_a_cluster_gives_the_same_bytes(
    project: Path, labpipe, scheduler: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(project)
    assert labpipe("run", "pipeline.yaml", "-o", "one").code == 0
    ended = labpipe("run", "pipeline.yaml", "-o", "two", "--cluster", scheduler)
    assert ended.code == 0, ended.err
    assert contents(project / "one") == contents(project / "two")


@pytest.mark.long
def test_a_killed_worker_loses_nothing(project: Path, scheduler: str) -> None:
    """The worker that begins the second test is killed; another one does the test, and the third is named."""
    pipeline = load_pipeline(project / "pipeline.yaml")

    def deadly(_work: Work, jobs: Sequence[Job]) -> Iterator[Done]:
        kept = [job for job in jobs if job.test.name != "300N-up"]
        return on_cluster(scheduler)(work_or_die, kept)

    with output_folder(project / "out") as folder:
        (project / "runs/300N-up.csv").unlink()
        found = run(load_pipeline(pipeline.path), folder, Manner(execute=deadly))
    assert (project / "killed-once").exists()
    assert not found.failed and {fit.test for fit in found.fits} == {"100N-up", "200N-up", "400N-up"}


CLUSTER = """class: distributed.LocalCluster
arguments: {n_workers: 1, threads_per_worker: 1, host: 127.0.0.1, dashboard_address: "127.0.0.1:0"}
adapt: {minimum: 1, maximum: 2}
"""


@pytest.mark.long
def test_a_described_cluster_is_started_and_takes_batches(
    project: Path, labpipe, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Batches of two and one at a time in the scheduler.

    A test of a batch that fails costs the other nothing.
    """
    monkeypatch.setattr("labpipe.project.executors.batch_size", lambda *_: 2)
    monkeypatch.setattr("labpipe.project.executors.MOST_BATCHES", 1)
    (project / "cluster.yaml").write_text(CLUSTER)
    (project / "runs/300N-up.csv").write_text("t [s],force [N],y [um]\n0,1,x\n")
    ended = labpipe(
        "run", project / "pipeline.yaml", "-o", project / "two", "--cluster", project / "cluster.yaml"
    )
    assert ended.code == 2 and "300N-up" in ended.err
    assert labpipe("run", project / "pipeline.yaml", "-o", project / "one").code == 2
    assert contents(project / "one") == contents(project / "two")


@pytest.mark.parametrize(("jobs", "workers", "size"), [(3, 2, 1), (80, 2, 10), (100_000, 10, 50), (5, 0, 1)])
def test_batches_grow_with_the_number_of_tests(jobs: int, workers: int, size: int) -> None:
    """Each worker has at least four batches, none is of more than fifty."""
    assert batch_size(jobs, workers) == size


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("arguments: {}", "is not the description of a cluster"),
        ("class: dask_jobqueue.NoCluster", "dask_jobqueue.NoCluster is not installed"),
        ("class: distributed.LocalCluster\nworkers: 2", "unknown entry 'workers'"),
        ("class: pathlib.PurePath\narguments: {cores: 2}", "does not take this"),
    ],
)
def test_descriptions_that_no_cluster_is_made_of_are_refused(
    project: Path, labpipe, text: str, what: str
) -> None:
    (project / "cluster.yaml").write_text(f"{text}\n")
    ended = labpipe(
        "run", project / "pipeline.yaml", "-o", project / "out", "--cluster", project / "cluster.yaml"
    )
    assert ended.code == 2 and what in ended.err and not (project / "out").exists()


def test_a_cluster_that_is_not_there_is_named(project: Path, labpipe) -> None:
    ended = labpipe("run", project / "pipeline.yaml", "-o", project / "out", "--cluster", "nonsense://x")
    assert ended.code == 2 and "nonsense://x: no scheduler answers" in ended.err
    ended = labpipe(
        "run", project / "pipeline.yaml", "-o", project / "out", "--cluster", "tcp://127.0.0.1:1", "-j", "2"
    )
    assert ended.code == 2 and "exclude each other" in ended.err


@pytest.mark.long
def test_several_pipelines_are_checked_at_the_same_time(project: Path, labpipe) -> None:
    strict = project / "strict.yaml"
    strict.write_text(PIPELINE.replace('">= 0.9"', '">= 0.99999999"'))
    ended = labpipe("check", "-j", 2, project / "pipeline.yaml", strict)
    assert ended.code == 1
    lines = [line for line in ended.out.splitlines() if line.startswith(str(project))]
    assert lines[0] == f"{project / 'pipeline.yaml'}: 1 of 1 rules hold"
    assert lines[1] == f"{strict}: 0 of 1 rules hold" and "direct.gof >= 0.99999999 fails" in lines[2]
    ended = labpipe("check", project / "missing.yaml", strict)
    assert ended.code == 2 and "missing.yaml: no such file" in ended.err


def test_a_pipeline_without_rules_is_not_said_to_hold(project: Path, labpipe) -> None:
    without = project / "open.yaml"
    without.write_text("".join(line for line in PIPELINE.splitlines(True) if not line.startswith("accept:")))
    ended = labpipe("check", without)
    assert (ended.code, ended.out.strip()) == (
        0,
        f"{without}: no rules under expect: or accept:, nothing was judged",
    )
