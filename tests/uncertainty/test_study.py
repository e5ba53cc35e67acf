"""labpipe study and simulate on the three-dof rig: a small study, its files, its rules, its faults."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from labpipe.project.pipeline_file import load_pipeline
from labpipe.uncertainty import study
from labpipe.uncertainty.study import WORTH_SHARING


@pytest.fixture(scope="module")
def pipeline(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small study of the shipped rig, with rules of its own."""
    root = Path(__file__).parents[2]
    path = tmp_path_factory.mktemp("study") / "small.yaml"
    fits = "\n".join(
        f"  {name}: {{model: mdof, mass: [1 kg, 2 kg, 3 kg], symmetric: true, estimator: {name}}}"
        for name in ("ls", "iv", "ml")
    )
    rules = '  study.ml.rmse_over_bound: [">= 0.8", "<= 1.2"]\n  study.ls[4 %].coverage: <= 90 %\n'
    study = f"study:\n  rig: {root}/configs/three-dof.yaml\n  noise: [2 %, 4 %]\n  repeats: 16\n"
    path.write_text(f"title: small\n{study}identify:\n{fits}\nexpect:\n{rules}", encoding="utf-8")
    return path


@pytest.fixture
def labpipe(labpipe_without_report):
    """Reports are drawn only where a test looks at one."""
    return labpipe_without_report


def test_a_study_leaves_table_report_and_result(labpipe, pipeline: Path, tmp_path: Path) -> None:
    ended = labpipe("study", pipeline, "-o", tmp_path, "-j", 1)
    assert ended.code == 0, ended
    assert "RMSE/CRLB" in ended.out and "expect: study.ml.rmse_over_bound >= 0.8: passed" in ended.out
    entries = json.loads((tmp_path / "identification.json").read_text("utf-8"))
    cases = entries["studies"][0]["cases"]
    assert [(case["fit"], case["noise"]) for case in cases] == [
        (fit, noise) for noise in (0.02, 0.04) for fit in ("ls", "iv", "ml")
    ]
    by_fit = {case["fit"]: case for case in cases if case["noise"] == 0.04}
    assert by_fit["ml"]["median_error"] < by_fit["iv"]["median_error"] < by_fit["ls"]["median_error"]
    rows = list(csv.DictReader((tmp_path / "study.csv").read_text("utf-8").splitlines()))
    assert len(rows) == 6 * 12 and float(rows[0]["truth"]) == 2.0
    report = (tmp_path / "report.html").read_text("utf-8")
    assert "Study: Three-dof benchmark" in report and "Cramer-Rao" in report


@pytest.mark.long
def test_more_processes_give_the_same_figures(labpipe, pipeline: Path, tmp_path: Path) -> None:
    """As many repeats as are worth sharing; the quickest estimator alone."""
    fits = "{ls: {model: mdof, mass: [1 kg, 2 kg, 3 kg], symmetric: true, estimator: ls}}"
    override = (
        "--set",
        f"study.repeats={WORTH_SHARING}",
        "--set",
        "study.noise=3 %",
        "--set",
        f"identify={fits}",
    )
    for jobs in (1, 2):
        assert (
            labpipe(
                "study", pipeline, "-o", tmp_path / str(jobs), "-j", jobs, *override, "--set", "expect={}"
            ).code
            == 0
        )
    first, second = ((tmp_path / str(jobs) / "study.csv").read_text("utf-8") for jobs in (1, 2))
    assert first == second


@pytest.mark.long
def test_run_and_check_hold_the_study_against_its_rules(labpipe, pipeline: Path, tmp_path: Path) -> None:
    assert labpipe("run", pipeline, "-o", tmp_path).code == 0
    before = (tmp_path / "identification.json").stat().st_mtime_ns
    assert labpipe("run", pipeline, "-o", tmp_path).code == 0
    assert (tmp_path / "identification.json").stat().st_mtime_ns == before
    failing = labpipe("check", pipeline, "--set", "expect={study.ls.coverage: '>= 99 %'}")
    assert failing.code == 1 and "study.ls.coverage >= 99 % fails" in failing.out


@pytest.mark.long
def test_thresholds_are_ordered_as_the_estimators_are(labpipe, pipeline: Path, tmp_path: Path) -> None:
    override = (
        "--set",
        "study.repeats=10",
        "--set",
        "study.noise=2 %",
        "--set",
        "study.thresholds=true",
        "--set",
        "expect={}",
    )
    assert labpipe("study", pipeline, "-o", tmp_path, *override).code == 0
    entries = json.loads((tmp_path / "identification.json").read_text("utf-8"))
    levels = {entry["fit"]: entry["noise"] for entry in entries["studies"][0]["thresholds"]}
    assert 0.008 < levels["ls"] < levels["iv"] < levels["ml"] < 0.09


@pytest.mark.long
def test_a_threshold_leaves_a_level_as_soon_as_too_many_are_lost(
    monkeypatch: pytest.MonkeyPatch, pipeline: Path
) -> None:
    """Bisection over all repeats of every level gives the same, by more fits; levels at or below a
    case that is held are not drawn. From a twentieth to twenty times its noise two ends and seven middles
    lead to 5 %; the lower end and the first middle are among those.
    """
    loaded = load_pipeline(pipeline)
    settings = replace(loaded.sections["study"], noise=(0.005,), repeats=12, thresholds=True)
    fits, drawn = [fit for fit in loaded.fits if fit.name == "ls"], []
    outcomes = study.Workers.outcomes

    def counted(self: study.Workers, *arguments: Any) -> Any:
        drawn.append(len(arguments[2]))
        return outcomes(self, *arguments)

    monkeypatch.setattr(study.Workers, "outcomes", counted)
    results = []
    for step in (2, settings.repeats):
        monkeypatch.setattr(study, "SEARCH_STEP", step)
        drawn.clear()
        threshold = study.run_study(settings.virtual_rig, settings, fits, None, lambda _: None).thresholds[0]
        results.append((threshold.noise, sum(drawn)))
    (early, fewer), (late, more) = results
    assert early == late and early is not None and 1.2 * fewer < more
    assert more == (1 + 9 - 2) * settings.repeats


def test_a_study_through_recordings_and_spectra(labpipe, root: Path, tmp_path: Path) -> None:
    path = tmp_path / "pedestal.yaml"
    path.write_text(
        f"""title: pedestal study
study: {{rig: {root}/configs/virtual-hmb.yaml, runs: pedestal, noise: 100 %, repeats: 20}}
frf: {{excitation: periodic, period: 2 s, skip: 3, band: 50-80 Hz}}
identify:
  pedestal: {{model: sdof, mass: 0.79 kg, band: 60-70 Hz}}
expect:
  study.pedestal.rmse_over_bound: [">= 0.6", "<= 1.5"]
  study.pedestal.failed: <= 0
""",
        encoding="utf-8",
    )
    ended = labpipe("study", path, "-o", tmp_path / "out", "-j", 1)
    assert ended.code == 0, ended


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("study.rig=nowhere.yaml", "study.rig: no such file 'nowhere.yaml'"),
        ("study.repeats=3", "'repeats' must be at least 10"),
        ("study.noise=0", "noise must be positive"),
        ("study.runs=pedestal", "'runs': this rig has none"),
        ("study.lines=2.5", "whole numbers"),
        ("study.printed={ls: [1, 2, 3]}", "one value for each noise level"),
        ("expect={study.ml.covrage: '>= 1'}", "the study has no 'covrage'"),
        ("expect={study.m1.coverage: '>= 1'}", "no such case in the study"),
        ("study.sede=1", "study.sede: unknown key; did you mean 'seed'?"),
        ("identify={}", "there is nothing to study"),
        ("identify={ml: {model: modal}}", "the rig states no parameter of fit 'ml'; it states k_1_1"),
        ("identify.ml.bands=[0.05-0.2 Hz, 0.2-0.4 Hz]", "fit 'ml' has 2 results; a study repeats a fit of"),
        ("identify.ml.sliding={width: 0.2 Hz, step: 0.1 Hz}", "results; a study repeats a fit of one band"),
    ],
)
def test_faults_of_a_study_are_said(
    labpipe, pipeline: Path, tmp_path: Path, override: str, message: str
) -> None:
    ended = labpipe(
        "study", pipeline, "-o", tmp_path / "out", "-j", 1, "--set", "study.repeats=10", "--set", override
    )
    assert ended.code == 2 and message in ended.err, ended
    assert not (tmp_path / "out").exists()


def test_a_pipeline_without_study_is_refused(labpipe, root: Path, tmp_path: Path) -> None:
    ended = labpipe("study", root / "pipelines/pedestal.yaml", "-o", tmp_path / "out")
    assert ended.code == 2 and "study: is missing" in ended.err


def test_simulate_writes_the_frf_of_an_mdof_rig(labpipe, root: Path, tmp_path: Path) -> None:
    assert labpipe("simulate", root / "configs/three-dof.yaml", "-o", tmp_path, "--seed", 3).code == 0
    truth = json.loads((tmp_path / "truth.json").read_text("utf-8"))["truth"]
    assert truth["k_1_2"] == -1.0 and truth["m_3_3"] == 3.0
    path = tmp_path / "fit.yaml"
    fit = "{model: mdof, mass: [1 kg, 2 kg, 3 kg], symmetric: true, compare: true}"
    path.write_text(
        f"title: t\nfrfs: frf.csv\nidentify:\n  ml: {fit}\nexpect: {{ml.k_3_3: 2 N/m +- 5 %}}\n",
        encoding="utf-8",
    )
    ended = labpipe("run", path, "-o", tmp_path / "out")
    assert ended.code == 0, ended
    assert (
        labpipe("simulate", root / "configs/three-dof.yaml", "-o", tmp_path / "other", "--run", "x").code == 2
    )


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        (
            "kind: virtual-mdof-rigs",
            "unknown virtual rig 'virtual-mdof-rigs'; did you mean 'virtual-mdof-rig'?",
        ),
        ("name: nothing", "kind: is missing"),
        (
            "kind: virtual-mdof-rig\nstiffness: [[1 N/m, 2 N/m], [3 N/m]]",
            "the rows of the matrix are not equally long",
        ),
        ("kind: virtual-mdof-rig\nstiffness: 3", "is not a matrix"),
    ],
)
def test_broken_virtual_rigs(labpipe, tmp_path: Path, entry: str, message: str) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text(entry + "\n", encoding="utf-8")
    ended = labpipe("simulate", path, "-o", tmp_path / "out")
    assert ended.code == 2 and message in ended.err and "rig.yaml:" in ended.err, ended
