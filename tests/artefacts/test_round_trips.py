"""Every record comes back from identification.json as it was written, and is written the same again."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st

from labpipe.artefacts.identification_file import read_identification, write_identification
from labpipe.methods.rotor.section import UnbalanceCase, UnbalanceRuns
from labpipe.methods.run_ups.records import RunUpMethod, RunUpResult
from labpipe.records.comparison import (
    ComparedBand,
    ComparedPoint,
    Comparison,
    Overlay,
    QuantityCurve,
    Study,
    StudyCase,
)
from labpipe.records.finding import WARNING, Finding, Parameter, note
from labpipe.records.identification import Candidate, Failed, Fit, Goodness, Identification, RuleOutcome
from labpipe.records.response import FrequencyResponse, Port
from tests.artefacts.any_record import any_of, fits, responses, same

CHECKS = [HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.function_scoped_fixture]
SLOW = settings(max_examples=15, suppress_health_check=CHECKS)
QUICK = settings(max_examples=40, suppress_health_check=CHECKS)


def through_file(folder: Path, identification: Identification) -> Identification:
    """Written, read, and written again to the same bytes."""
    path = folder / "identification.json"
    write_identification(path, identification)
    again = read_identification(path)
    write_identification(folder / "again.json", again)
    assert (folder / "again.json").read_bytes() == path.read_bytes()
    return again


def by_level(record: Any) -> Any:
    """The record with its warnings before its notes, the order in which files keep them."""
    return dataclasses.replace(
        record, findings=tuple(sorted(record.findings, key=lambda finding: finding.level != WARNING))
    )


# one record type after the other


@pytest.mark.long
@SLOW
@given(fits())
def test_a_fit(tmp_path: Path, fit: Fit) -> None:
    (again,) = through_file(tmp_path, Identification((fit,))).fits
    assert same(again, by_level(fit))


@SLOW
@given(responses())
def test_a_response(tmp_path: Path, response: FrequencyResponse) -> None:
    """But for the correlations between lines and elements, which stay in the FRF's own file."""
    (again,) = through_file(tmp_path, Identification((), responses=(response,))).responses
    assert same(again, by_level(response))


@SLOW
@given(any_of(Comparison))
def test_a_comparison(tmp_path: Path, comparison: Comparison) -> None:
    (again,) = through_file(tmp_path, Identification((), sections={"compare": (comparison,)})).sections[
        "compare"
    ]
    assert same(again, comparison)


@QUICK
@given(any_of(Study))
def test_a_study(tmp_path: Path, study: Study) -> None:
    (again,) = through_file(tmp_path, Identification((), sections={"study": (study,)})).sections["study"]
    assert same(again, study)


@QUICK
@given(any_of(UnbalanceRuns))
def test_a_response_to_unbalance(tmp_path: Path, runs: UnbalanceRuns) -> None:
    assert same(
        through_file(tmp_path, Identification((), sections={"unbalance": runs})).sections["unbalance"], runs
    )


@SLOW
@given(any_of(RunUpResult))
def test_run_ups(tmp_path: Path, result: RunUpResult) -> None:
    assert same(
        through_file(tmp_path, Identification((), sections={"run_ups": result})).sections["run_ups"], result
    )


@QUICK
@given(st.lists(any_of(Failed), max_size=3).map(tuple))
def test_tests_that_failed(tmp_path: Path, failed: tuple[Failed, ...]) -> None:
    assert through_file(tmp_path, Identification((), failed=failed)).failed == failed


OUTCOMES = st.builds(
    RuleOutcome,
    st.sampled_from(["accept", "expect"]),
    st.text(max_size=5),
    st.none() | st.floats(-1e9, 1e9) | st.text(max_size=5),
    st.booleans(),
)


@QUICK
@given(st.lists(OUTCOMES, max_size=4).map(tuple))
def test_outcomes_of_rules(tmp_path: Path, outcomes: tuple[RuleOutcome, ...]) -> None:
    """`accept` comes before `expect`; within each the order stays."""
    again = through_file(tmp_path, Identification((), outcomes=outcomes))
    assert again.outcomes == tuple(sorted(outcomes, key=lambda outcome: outcome.section))
    assert again.accepted == all(outcome.passed for outcome in outcomes)


SETTINGS = st.dictionaries(
    st.text(max_size=4), st.none() | st.booleans() | st.floats(-1e9, 1e9) | st.text(max_size=5), max_size=3
)
SOURCES = st.lists(
    st.fixed_dictionaries({"path": st.text(max_size=5), "sha256": st.text(max_size=5)}), max_size=3
).map(tuple)


@QUICK
@given(st.text(max_size=8), st.text(max_size=8), SOURCES, SETTINGS, SETTINGS)
def test_what_it_was_made_from(
    tmp_path: Path, title: str, pipeline: str, sources: Any, work: dict, rig: dict
) -> None:
    again = through_file(
        tmp_path, Identification((), title, pipeline=pipeline, sources=sources, settings=work, rig=rig)
    )
    assert (again.title, again.pipeline, again.sources, again.settings, again.rig) == (
        title,
        pipeline,
        sources,
        work,
        rig,
    )


# numbers that JSON has not


def test_a_condition_number_without_limit_is_null_in_the_file(tmp_path: Path) -> None:
    fit = Fit(
        "a",
        "sdof",
        "ls",
        band_hz=(1.0, 2.0),
        lines=3,
        equations=6,
        dof=4,
        gof=Goodness(0.9, 0.8),
        parameters=(),
        condition_number=math.inf,
        correlation=np.eye(1),
    )
    assert through_file(tmp_path, Identification((fit,))).fits[0].condition_number == math.inf
    assert (
        json.loads((tmp_path / "identification.json").read_text("utf-8"))["fits"][0]["condition_number"]
        is None
    )


def test_a_known_covariance_has_no_end_of_degrees_of_freedom(tmp_path: Path) -> None:
    port = (Port("x", "x", "x"),)
    response = FrequencyResponse(np.array([1.0]), np.ones((1, 1, 1)), port, port, covariance_dof=math.inf)
    assert (
        through_file(tmp_path, Identification((), responses=(response,))).responses[0].covariance_dof
        == math.inf
    )
    assert (
        json.loads((tmp_path / "identification.json").read_text("utf-8"))["responses"][0]["covariance_dof"]
        is None
    )


CASE = StudyCase(
    fit="ls",
    estimator="ls",
    noise=0.02,
    lines=25,
    repeats=30,
    failed=30,
    mean_error=math.nan,
    median_error=math.nan,
    error_variance=math.nan,
    success=(0.0,),
    rmse_over_bound=None,
    coverage=None,
    parameters=(),
)


def test_a_study_of_nothing_but_failures_has_errors_that_are_no_number(tmp_path: Path) -> None:
    study = Study("three-dof", 1, (0.05,), 0.95, (CASE,))
    (again,) = through_file(tmp_path, Identification((), sections={"study": (study,)})).sections["study"]
    assert math.isnan(again.cases[0].mean_error) and same(again, study)


def test_an_amount_that_could_not_be_given_is_no_number(tmp_path: Path) -> None:
    amounts = (Parameter("ratio", math.nan, "1"),)
    comparison = Comparison(
        name="ratio",
        kind="ratio",
        subject="k",
        unit="N/m",
        points=(),
        amounts=amounts,
        verdict="not determined",
        statement="nothing can be said",
    )
    (again,) = through_file(tmp_path, Identification((), sections={"compare": (comparison,)})).sections[
        "compare"
    ]
    assert same(again, comparison)


def test_a_run_up_method_without_numbers(tmp_path: Path) -> None:
    result = RunUpResult(
        "rotor", "disc", "journal", runs=(), methods=(RunUpMethod("a", "A", "failed", predictions=()),)
    )
    assert same(
        through_file(tmp_path, Identification((), sections={"run_ups": result})).sections["run_ups"], result
    )


# what the file looks like


def test_warnings_and_notes_stand_apart(tmp_path: Path) -> None:
    fit = Fit(
        "a",
        "sdof",
        "ls",
        band_hz=(1.0, 2.0),
        lines=3,
        equations=6,
        dof=4,
        gof=Goodness(0.9, 0.8),
        parameters=(),
        condition_number=2.0,
        correlation=np.eye(1),
    )
    found = (note("masked", "49-51 Hz"), Finding("clipped", "y"))
    through_file(tmp_path, Identification((dataclasses.replace(fit, findings=found),)))
    (entry,) = json.loads((tmp_path / "identification.json").read_text("utf-8"))["fits"]
    assert entry["warnings"] == [{"code": "clipped", "message": "y"}]
    assert entry["remarks"] == [{"code": "masked", "message": "49-51 Hz"}]


def test_the_agreed_names_of_a_fit_are_in_the_file(tmp_path: Path) -> None:
    """Names that outside checks read: INTERFACE of the file."""
    parameter = Parameter(
        "k",
        45200.0,
        "N/m",
        std_error=31.0,
        t_ratio=1458.0,
        ci95=(45137.0, 45263.0),
        significant=True,
        vif=1.2,
    )
    candidates = (Candidate("this model", 2, 3.0, 4, 7.0, 0.5),)
    fit = Fit(
        "a",
        "sdof",
        "ml",
        band_hz=(65.0, 80.0),
        lines=15,
        equations=30,
        dof=28,
        gof=Goodness(1.0, 1.0),
        parameters=(parameter,),
        condition_number=12.3,
        correlation=np.eye(1),
        candidates=candidates,
    )
    through_file(tmp_path, Identification((fit,), "T", pipeline="p.yaml"))
    whole = json.loads((tmp_path / "identification.json").read_text("utf-8"))
    assert whole["schema"] == "labpipe/identification/2" and (whole["title"], whole["pipeline"]) == (
        "T",
        "p.yaml",
    )
    (entry,) = whole["fits"]
    assert entry["band_hz"] == [65.0, 80.0] and entry["centre_hz"] == 72.5 and entry["correlation"] == [[1.0]]
    assert entry["parameters"][0]["ci95"] == [45137.0, 45263.0] and entry["gof"]["chi2_p"] is None
    assert (entry["lines"], entry["equations"], entry["dof"]) == (15, 30, 28)


@pytest.mark.parametrize("section", ["failed", "comparisons", "studies", "unbalance", "run_ups"])
def test_what_a_result_does_not_have_is_not_in_its_file(tmp_path: Path, section: str) -> None:
    through_file(tmp_path, Identification(()))
    assert section not in json.loads((tmp_path / "identification.json").read_text("utf-8"))


def test_a_file_from_before_newer_entries_is_read(tmp_path: Path) -> None:
    """Entries that later versions added are empty where a file has none."""
    path = tmp_path / "identification.json"
    write_identification(path, Identification((), "T", pipeline="p.yaml"))
    entries = json.loads(path.read_text("utf-8"))
    for name in ("responses", "settings", "rig", "accept", "expect", "digest"):
        del entries[name]
    path.write_text(json.dumps(entries), "utf-8")
    old = read_identification(path)
    assert (old.responses, old.sections, old.settings, old.rig, old.outcomes) == ((), {}, {}, {}, ())


# the same record however it was made


POINT = ComparedPoint(
    "427N",
    1.1,
    ci95=(1.0, 1.2),
    condition=427.0,
    group="up",
    theory=1.0,
    ratio=1.1,
    ratio_ci95=(1.0, 1.2),
    p_value=0.5,
)
BAND = ComparedBand(
    "427N",
    "k",
    "N/m",
    band_hz=(10.0, 20.0),
    value=1.0,
    ci95=(0.9, 1.1),
    other=1.05,
    other_ci95=None,
    ratio=0.95,
    ratio_ci95=(0.9, 1.0),
    p_value=0.04,
)
CURVE = QuantityCurve(
    "427N", "k", "N/m", frequency=(1.0, 2.0), theory=(3.0, 4.0), matched=(), measured=(5.0, 6.0)
)
OVERLAY = Overlay("427N", "receptance", (1.0,), (2.0,), (3.0,), (4.0,))


def test_a_comparison_with_all_its_parts(tmp_path: Path) -> None:
    parts = {
        "line": ((1.0, 2.0),),
        "overlays": (OVERLAY,),
        "bands": (BAND,),
        "curves": (CURVE,),
        "correlations": (("a", "b", 0.3),),
    }
    whole = Comparison(
        name="r",
        kind="ratio",
        subject="k",
        unit="N/m",
        points=(POINT,),
        amounts=(),
        verdict="stiffer",
        statement="stiffer than theory",
        condition="preload",
        condition_unit="N",
        **parts,
    )
    (again,) = through_file(tmp_path, Identification((), sections={"compare": (whole,)})).sections["compare"]
    assert again == whole and again.bands[0].holds and again.bands[0].centre_hz == 15.0


def test_peaks_of_unbalance_are_the_same_after_the_file(tmp_path: Path) -> None:
    case = UnbalanceCase("worn", 2e-5, 0.1, (1e-6, 3e-6, 2e-6), (0.0, 1e-7, 2e-7))
    runs = UnbalanceRuns("mendes", "bearing 2", 4, (10.0, 20.0, 30.0), (case,))
    again = through_file(tmp_path, Identification((), sections={"unbalance": runs})).sections["unbalance"]
    assert again is not None
    assert again.values(again.cases[0]) == {
        "forward_peak": (3e-6, "m"),
        "forward_speed": (20.0, "Hz"),
        "backward_peak": (2e-7, "m"),
        "backward_speed": (30.0, "Hz"),
    }
