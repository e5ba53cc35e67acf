"""A run from its parts: jobs, executors, tests that fail, and what is told on the way."""

from __future__ import annotations

import pickle
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from labpipe.artefacts.writing import output_folder
from labpipe.errors import ConfigError, DataError, FitError
from labpipe.project.executors import Work, in_processes, on_cluster, serially
from labpipe.project.one_test import Done, Job, silent, work
from labpipe.project.pipeline_file import load_pipeline
from labpipe.project.run import Manner, independent_fits, measure_tests
from labpipe.project.tests import ReadyFrf, Test as Measured
from labpipe.records.identification import Failed
from tests.project.laboratory import (
    ALONE,
    DAMPING,
    MASS,
    PIPELINE,
    STIFFNESS,
    contents,
    done,
    laboratory,
    recording,
)

SHORT = "t [s],force [N],y [um]\n0,1,1\n0.01,2,2\n"


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    laboratory(tmp_path)
    return tmp_path


# the numbers


def test_the_springs_of_the_laboratory_are_found(lab: Path) -> None:
    """Truth of the recordings: 18 and 22 kN/m, 20 N s/m, .79 kg.

    Within four of the stated standard errors.
    """
    found = done(lab / "pipeline.yaml", lab / "out")
    for fit in (one for one in found.fits if one.name == "direct"):
        for name, truth in (("k", STIFFNESS[fit.test]), ("c", DAMPING)):
            parameter = fit.parameter(name)
            assert parameter.std_error is not None
            assert abs(parameter.value - truth) < 4 * parameter.std_error
    assert found.rig["mass"] == MASS and found.accepted


def test_fits_stand_in_the_order_of_the_pipeline_then_of_the_tests(lab: Path) -> None:
    found = done(lab / "pipeline.yaml", lab / "out")
    assert [(fit.name, fit.test) for fit in found.fits] == [
        ("direct", "soft"),
        ("direct", "hard"),
        ("plain", "soft"),
        ("plain", "hard"),
    ]
    assert [response.name for response in found.responses] == ["soft", "hard"]
    assert [source["path"] for source in found.sources] == ["soft.csv", "hard.csv"]
    assert found.test_conditions == {"soft": {"preload": "100 N"}, "hard": {"preload": "200 N"}}


def test_one_of_many_tests_is_what_it_is_alone(lab: Path) -> None:
    """A test knows nothing of the others."""
    many = done(lab / "pipeline.yaml", lab / "out")
    (lab / "alone.yaml").write_text(
        ALONE.replace("recordings: soft.csv", "recordings: soft.csv\nconditions: {preload: 100 N}")
    )
    alone = done(lab / "alone.yaml", lab / "alone")
    for name in ("direct", "plain"):
        ours, theirs = (next(fit for fit in side.fits if fit.name == name) for side in (many, alone))
        assert ours.parameters == theirs.parameters and ours.gof == theirs.gof


# executors


def backwards(work_of: Work, jobs: Sequence[Job]) -> Iterator[Done]:
    """The last job first: as uneven processes finish."""
    return map(work_of, reversed(jobs))


def through_bytes(work_of: Work, jobs: Sequence[Job]) -> Iterator[Done]:
    """Jobs and outcomes as other processes get them."""
    for job in jobs:
        yield pickle.loads(pickle.dumps(work_of(pickle.loads(pickle.dumps(job.absolute())))))


@pytest.mark.parametrize("execute", [backwards, through_bytes])
def test_how_the_jobs_are_done_does_not_change_a_byte(lab: Path, execute) -> None:
    done(lab / "pipeline.yaml", lab / "plain")
    done(lab / "pipeline.yaml", lab / "other", manner=Manner(execute=execute))
    assert contents(lab / "plain") == contents(lab / "other")


def test_serial_work_is_done_when_it_is_asked_for() -> None:
    """One after the other, and none before its turn."""
    order: list[str] = []

    def noted(job: Job) -> Done:
        order.append(job.test.name)
        return Done(job.test.name)

    jobs = [
        Job(
            Measured(name),
            (),
            frf=None,
            fits=(),
            pipeline_path=Path("p.yaml"),
            target=Path("out"),
            scratch=Path("scratch"),
        )
        for name in ("a", "b")
    ]
    outcomes = serially(noted, jobs)
    assert order == []
    assert next(outcomes).test == "a" and order == ["a"]
    assert [one.test for one in outcomes] == ["b"]


def test_no_jobs_start_no_processes() -> None:
    assert list(in_processes(4)(work, ())) == []


def test_a_cluster_needs_an_address_that_answers(lab: Path) -> None:
    pytest.importorskip("distributed")
    with pytest.raises(
        DataError, match=r"tcp//nowhere: no scheduler answers .*; start one with `dask scheduler`"
    ):
        list(on_cluster("tcp//nowhere")(work, ()))


# a test that fails


@pytest.mark.parametrize("bad", ["soft", "hard"])
def test_one_bad_test_is_named_and_the_other_is_whole(lab: Path, bad: str) -> None:
    (lab / f"{bad}.csv").write_text(SHORT)
    good = "hard" if bad == "soft" else "soft"
    found = done(lab / "pipeline.yaml", lab / "out")
    assert [one.name for one in found.failed] == [bad] and f"{bad}.csv" in found.failed[0].message
    assert {fit.test for fit in found.fits} == {good} and not found.accepted
    assert [source["path"] for source in found.sources] == [f"{good}.csv"]
    assert not [name for name in contents(lab / "out") if bad in name and "recordings" not in name]


def test_put_right_only_the_bad_test_is_done(lab: Path) -> None:
    text = (lab / "hard.csv").read_text()
    (lab / "hard.csv").write_text(SHORT)
    done(lab / "pipeline.yaml", lab / "out")
    (lab / "hard.csv").write_text(text)
    asked: list[str] = []
    found = done(
        lab / "pipeline.yaml",
        lab / "out",
        manner=Manner(progress=lambda _done, _all, name: asked.append(name)),
    )
    assert asked == ["soft", "hard"] and found.accepted
    done(lab / "pipeline.yaml", lab / "new")
    assert contents(lab / "out") == contents(lab / "new")


def test_where_no_test_can_be_evaluated_nothing_is_written(lab: Path) -> None:
    for name in STIFFNESS:
        (lab / f"{name}.csv").write_text(SHORT)
    with pytest.raises(DataError, match=r"soft\.csv.*none of 2 tests could be evaluated"):
        done(lab / "pipeline.yaml", lab / "out")
    assert not [path for path in lab.iterdir() if path.name.startswith(".labpipe-")]


def test_a_fit_without_a_mode_costs_the_others_nothing(tmp_path: Path, labpipe) -> None:
    """One of two fits has 4 lines: the other stands in the report, a rule on the first fails, the code is 2.

    Run again, nothing is made anew and the same is said.
    """
    few = "  modes: {model: modal, input: f, output: y, band: 20-23 Hz}\n"
    text = ALONE.split("  plain:")[0] + few + "accept: {modes.f_n_1: '> 0 Hz'}\nreport: {formats: [md]}\n"
    pipeline, out = laboratory(tmp_path, text), tmp_path / "out"
    for _ in range(2):
        ended = labpipe("run", pipeline, "-o", out)
        assert ended.code == 2 and "too few for a stabilisation diagram" in ended.err
        before = contents(out)
    report = (out / "report.md").read_text()
    assert "INCOMPLETE: 1 test(s), fit(s)" in report and "identify.modes" in report and "| k " in report
    found = done(pipeline, out)
    assert [fit.name for fit in found.fits] == ["direct"] and not found.accepted
    assert contents(out) == before
    alone = laboratory(tmp_path, ALONE.split("  direct:")[0] + few + "report: {formats: []}\n")
    with pytest.raises(FitError, match="too few for a stabilisation diagram"):
        done(alone, tmp_path / "none")


def test_a_single_test_that_fails_is_an_error(tmp_path: Path) -> None:
    laboratory(tmp_path, ALONE)
    (tmp_path / "soft.csv").write_text(SHORT)
    with pytest.raises(DataError, match=r"soft\.csv"):
        done(tmp_path / "pipeline.yaml", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_an_error_of_the_operating_system_is_the_outcome_of_its_test(
    lab: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device", "disk")

    monkeypatch.setattr("labpipe.project.one_test.measure", full)
    job = Job(
        Measured("soft"),
        (),
        frf=None,
        fits=(),
        pipeline_path=lab / "pipeline.yaml",
        target=lab / "out",
        scratch=lab,
    )
    assert work(job) == Done("soft", failed=Failed("soft", "disk: no space left on device"), halts=True)


def test_a_fault_of_ours_is_no_outcome(lab: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is not a fault of the input keeps its traceback, and says which test it comes from."""

    def broken(*_: object, **__: object) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr("labpipe.project.one_test.measure", broken)
    with pytest.raises(ZeroDivisionError) as fault:
        done(lab / "pipeline.yaml", lab / "out")
    assert fault.value.__notes__ == [f"in test 'soft' of {lab}/pipeline.yaml"]
    assert not list(lab.rglob(".labpipe-*"))


@pytest.mark.parametrize("after", [0, 1])
def test_what_was_finished_before_an_interruption_is_kept(lab: Path, after: int) -> None:
    def interrupted(work_of: Work, jobs: Sequence[Job]) -> Iterator[Done]:
        yield from map(work_of, jobs[:after])
        raise KeyboardInterrupt

    with pytest.raises(
        DataError,
        match=f"interrupted; {after} of 2 tests are finished and kept; the same command goes on from there",
    ):
        done(lab / "pipeline.yaml", lab / "out", manner=Manner(execute=interrupted))
    kept = set(contents(lab / "out")) if (lab / "out").exists() else set()
    assert kept == (
        {"recordings/soft.recording.parquet", "soft.frf.parquet", "fits/soft.json"} if after else set()
    )
    assert not list(lab.rglob(".labpipe-*"))


# jobs


def test_a_job_says_where_its_fits_stand() -> None:
    job = Job(
        Measured("427 N, up/down"),
        (),
        frf=None,
        fits=(),
        pipeline_path=Path("lab/p.yaml"),
        target=Path("out"),
        scratch=Path("scratch"),
    )
    assert job.fits_name == "fits/427-N-up-down.json" and job.folder == Path("lab")


def test_a_job_for_another_place_has_no_relative_path(lab: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(lab)
    test = load_pipeline(Path("pipeline.yaml")).tests[0]
    job = Job(
        replace(test, frfs=(ReadyFrf((Path("h.csv"),)),)),
        ("soft",),
        frf=None,
        fits=(),
        pipeline_path=Path("pipeline.yaml"),
        target=Path("out"),
        scratch=Path("scratch"),
    ).absolute()
    paths = [
        job.pipeline_path,
        job.target,
        job.scratch,
        *job.test.frfs[0].paths,
        *(source.path for source in job.test.recordings),
    ]
    assert all(path.is_absolute() for path in paths) and job.test.recordings[0].rig == test.recordings[0].rig


@pytest.mark.parametrize(("first", "second"), [("a b", "a/b"), ("a-b", "a b"), ("x?", "x!")])
def test_two_tests_that_would_write_one_file_are_refused(lab: Path, first: str, second: str) -> None:
    text = PIPELINE.replace("name: soft", f"name: '{first}'").replace("name: hard", f"name: '{second}'")
    (lab / "pipeline.yaml").write_text(text)
    with pytest.raises(ConfigError, match="would write the same file"):
        done(lab / "pipeline.yaml", lab / "out")
    assert not (lab / "out").exists()


def test_recordings_of_one_name_in_two_folders_are_kept_apart(lab: Path) -> None:
    (lab / "other").mkdir()
    (lab / "other/soft.csv").write_text(recording(22e3))
    (lab / "pipeline.yaml").write_text(PIPELINE.replace("recordings: hard.csv", "recordings: other/soft.csv"))
    found = done(lab / "pipeline.yaml", lab / "out")
    assert {"recordings/soft.recording.parquet", "recordings/soft-2.recording.parquet"} <= set(
        contents(lab / "out")
    )
    assert [fit.parameter("k").value > 20e3 for fit in found.fits if fit.name == "direct"] == [False, True]


def test_all_fits_of_a_plain_pipeline_are_independent(lab: Path) -> None:
    assert independent_fits(load_pipeline(lab / "pipeline.yaml")) == ["direct", "plain"]


# what is told


def test_progress_counts_to_the_number_of_tests(lab: Path) -> None:
    steps: list[tuple[int, int, str]] = []
    done(lab / "pipeline.yaml", lab / "out", manner=Manner(progress=lambda *step: steps.append(step)))
    assert steps == [(1, 2, "soft"), (2, 2, "hard")]


def test_the_stages_of_a_single_test_are_told_in_their_order(tmp_path: Path) -> None:
    told: list[str] = []
    done(laboratory(tmp_path, ALONE), tmp_path / "out", manner=Manner(tell=told.append))
    assert [line.split()[0] for line in told[:3]] == ["ingest", "frf", "identify"]


def test_nobody_is_told_by_default(lab: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert silent("ingest") is None
    done(lab / "pipeline.yaml", lab / "out")
    assert capsys.readouterr() == ("", "")


def test_measuring_alone_makes_no_fits(lab: Path) -> None:
    with output_folder(lab / "out") as output:
        measured = measure_tests(load_pipeline(lab / "pipeline.yaml"), output, Manner())
    assert measured.fits == {} and [response.name for response in measured.tests] == ["soft", "hard"]
    assert not (lab / "out/fits").exists()


def test_a_cluster_by_tls_takes_the_certificates_of_its_own_configuration(tmp_path: Path) -> None:
    """Without them nothing is sent to anyone; a plain address has none."""
    import dask

    from labpipe.project import executors as cluster

    assert cluster.security_of("tcp://127.0.0.1:8786") is None
    with pytest.raises(ConfigError, match="no certificates are configured"):
        cluster.security_of("tls://127.0.0.1:8786")
    names = {"ca-file": "ca.pem", "client.cert": "cert.pem", "client.key": "key.pem"}
    with dask.config.set(
        {f"distributed.comm.tls.{name}": str(tmp_path / file) for name, file in names.items()}
    ):
        security = cluster.security_of("tls://127.0.0.1:8786")
    assert security.tls_ca_file == str(tmp_path / "ca.pem") and security.tls_client_key == str(
        tmp_path / "key.pem"
    )
