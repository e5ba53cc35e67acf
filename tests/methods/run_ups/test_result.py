"""A result of run-ups as a whole: a rejected fit has no interval, a rotor file without unbalances takes those
of the run-ups.
"""

from __future__ import annotations

from dataclasses import replace

import pytest

from labpipe.methods.run_ups.joint import JointFit, fit_jointly
from labpipe.methods.run_ups.measured import ReadRun
from labpipe.methods.run_ups.methods import joint_at, joint_method, predict, with_unbalance_of_runs
from labpipe.methods.run_ups.process import fit_with_process
from labpipe.methods.run_ups.records import HELD_OUT, MeasuredRun, RunPrediction, RunUp, RunUpMethod
from labpipe.methods.run_ups.report import speed_blocks
from labpipe.methods.run_ups.result import fit_findings, run_up_result
from labpipe.methods.run_ups.section import run_up_lines
from labpipe.methods.run_ups.settings import RunSettings, RunUpSettings
from labpipe.records.finding import Parameter
from labpipe.report.document import Table
from tests.methods.run_ups.run_up_cases import RIG, trained


@pytest.fixture(scope="module")
def runs() -> list[RunUp]:
    return list(trained("inside")[:2])


@pytest.fixture(scope="module")
def joint(runs: list[RunUp]) -> JointFit:
    return fit_jointly(RIG, runs)


def test_a_fit_that_is_not_rejected_has_intervals(joint: JointFit, runs: list[RunUp]) -> None:
    assert not joint.rejected
    method = joint_method(joint)
    assert all(parameter.std_error is not None for parameter in method.parameters if not parameter.at_bound)
    prediction = predict(RIG, runs[0], joint_at(joint)(RIG, runs[0]), "", curves=False)
    assert prediction.critical_speed is not None and prediction.critical_speed.ci95 is not None


def test_a_rejected_fit_has_values_and_no_interval(joint: JointFit, runs: list[RunUp]) -> None:
    """Six of its own standard errors away from the truth were seen: no such number is given."""
    rejected = replace(joint)
    # What a property keeps once it is computed.
    rejected.__dict__["chi2"] = 100 * joint.chi2
    assert rejected.rejected
    method = joint_method(rejected)
    assert method.verdict == "rejected"
    assert all(parameter.std_error is None and parameter.ci95 is None for parameter in method.parameters)
    prediction = predict(RIG, runs[0], joint_at(rejected)(RIG, runs[0]), "", curves=False)
    speeds = (prediction.critical_speed, prediction.threshold)
    assert all(speed is not None and speed.std_error is None and speed.ci95 is None for speed in speeds)
    assert any("no interval is given" in note for note in prediction.notes)
    assert (
        "chi-square rejects the fit: critical speed, threshold and coefficients are values without an "
        "interval"
    ) in prediction.notes
    trusted = predict(RIG, runs[0], joint_at(joint)(RIG, runs[0]), "", curves=False)
    assert prediction.critical_speed.value == pytest.approx(trusted.critical_speed.value, rel=1e-9)


def test_every_speed_of_a_rejected_method_says_so(runs: list[RunUp]) -> None:
    """Run-ups with three hundredths of their errors: the joint fit, its metamodels, and the tables."""
    sharp = [
        replace(run, amplitude_error=0.03 * run.amplitude_error, phase_error=0.03 * run.phase_error)
        for run in runs
    ]
    entries = tuple(RunSettings(file=f"{run.name}.csv") for run in sharp)
    settings = RunUpSettings(rotor="falah.yaml", runs=entries, methods=("joint",), metamodels=("physical",))
    result = run_up_result(
        settings, RIG, [ReadRun(entry, run) for entry, run in zip(entries, sharp, strict=True)]
    )
    start, joint = result.methods
    assert joint.verdict == "rejected"
    for prediction in joint.predictions:
        assert any("chi-square rejects the fit" in note for note in prediction.notes)
        assert (
            prediction.critical_speed is not None
            and prediction.critical_speed.ci95 is None
            and not prediction.std_errors
        )
    for prediction in result.metamodels[0].predictions:
        assert (
            "of a fit that chi-square rejects, (c) joint physical fit" in prediction.notes
            and not prediction.std_errors
        )
    assert not any("rejects" in note for prediction in start.predictions for note in prediction.notes)
    assert "joint rejected" in next(line for line in run_up_lines(result) if "load [N]" in line)
    headings = [block.header for block in speed_blocks(result) if isinstance(block, Table)]
    assert all("(c) joint, rejected" in header for header in headings[::2])


def test_a_rejected_fit_with_factors_says_so_at_every_load(joint: JointFit, runs: list[RunUp]) -> None:
    """Whatever its loads: its own caution is on extrapolation only."""
    process = fit_with_process(RIG, runs, joint)
    rejected = replace(process)
    rejected.__dict__["chi2"] = 1e3 * process.n_datum
    for fit, said in ((rejected, True), (process, False)):
        prediction = predict(RIG, runs[0], joint_at(fit)(RIG, runs[0]), "", curves=False)
        assert any("values without an interval" in note for note in prediction.notes) is said
        assert prediction.threshold is not None and (prediction.threshold.ci95 is None) is said


def test_a_rotor_file_without_unbalances_takes_those_of_the_run_ups(runs: list[RunUp]) -> None:
    """The shipped rotor's own unbalances stand in the tables: the same result either way."""
    bare = replace(RIG, unbalances=())
    assert with_unbalance_of_runs(bare, runs).known_unbalance == pytest.approx(RIG.known_unbalance)
    assert with_unbalance_of_runs(RIG, runs) is RIG and with_unbalance_of_runs(bare, []) is bare
    entries = tuple(RunSettings(file=f"{run.name}.csv") for run in runs)
    settings = RunUpSettings(rotor="falah.yaml", runs=entries, methods=("points",))
    read = [ReadRun(entry, run) for entry, run in zip(entries, runs, strict=True)]
    results = [run_up_result(settings, rig, read) for rig in (RIG, bare)]
    first, second = (result.methods[0].predictions[0].critical_speed for result in results)
    assert first is not None and second is not None and second.value == pytest.approx(first.value, rel=1e-9)
    assert [row.rank for row in results[1].ranks] == [row.rank for row in results[0].ranks]


@pytest.mark.parametrize(
    ("change", "codes"),
    [
        ({}, []),
        ({"verdict": "not determined", "rank": 4}, ["collinear"]),
        ({"verdict": "rejected"}, ["model-mismatch"]),
        ({"verdict": "determined", "chi2_p": 1e-9, "share_at_bound": 0.25}, ["model-mismatch"]),
        ({"verdict": "determined", "chi2_p": 0.5}, []),
        ({"parameters": (Parameter("k", 1.0, "N/m", at_bound=True),)}, ["at-bound"]),
    ],
)
def test_what_a_method_cannot_state_is_a_finding(change: dict[str, object], codes: list[str]) -> None:
    plain = RunUpMethod("points", "Point by point", "not rejected", predictions=(), chi2_per_datum=3.456)
    findings = fit_findings(replace(plain, **change), ())
    assert [finding.code for finding in findings] == codes
    said = {
        "rejected": "chi² per datum is 3.46: the bearing is not of the fitted family, and no interval is",
        "not determined": "the data determine 4 of 8 coefficients at a point; the values are not determined",
        "determined": "3.46: the residual exceeds the noise; 25 % of the coefficients lie on their bounds",
        "": "k at the bound: the rotor file describes another bearing.",
    }
    for finding in findings:
        assert said[change.get("verdict", "")] in finding.message
        assert finding.message.startswith("Point by point: ")


def test_only_a_load_beyond_the_fit_is_extrapolated() -> None:
    """A held-out run within the loads, whose note is on its threshold."""
    run = MeasuredRun("held", 5.0, HELD_OUT, excitation="", speed=(), motions=())
    for note, codes in (("no threshold below 6 Hz", []), ("9 N lies outside the loads", ["extrapolated"])):
        prediction = RunPrediction("held", None, None, notes=(note,))
        method = RunUpMethod("joint", "(c)", "not rejected", predictions=(prediction,))
        assert [finding.code for finding in fit_findings(method, [run])] == codes
