"""Records of results: their uncertainty, their names, and what they say when a name is not there."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from labpipe.methods.rotor.section import UnbalanceCase, UnbalanceRuns
from labpipe.methods.run_ups.records import (
    MeasuredRun,
    MetamodelResult,
    RunPrediction,
    RunUpMethod,
    RunUpResult,
    Surface,
    UncertainAmount,
)
from labpipe.records.comparison import ComparedBand, Comparison, StudiedParameter
from labpipe.records.finding import NOTE, WARNING, Finding, Parameter, note, of_level
from labpipe.records.identification import Failed, Fit, Goodness, Identification, RuleOutcome
from labpipe.records.recording import ChannelOverview, Envelope, Overview, Spectrum
from labpipe.records.response import FrequencyResponse, Port
from labpipe.records.rig import AXIS_ANGLES

K, C = Parameter("k", 45.2e3, "N/m", std_error=31.0), Parameter("c", 3.7, "N.s/m")
FIT = Fit(
    "direct",
    "sdof",
    "ml",
    band_hz=(65.0, 80.0),
    lines=15,
    equations=30,
    dof=28,
    gof=Goodness(0.99, 0.98),
    parameters=(K, C),
    condition_number=12.0,
    correlation=np.eye(2),
)


# parameters and fits


@pytest.mark.parametrize(("band", "centre"), [((65.0, 80.0), 72.5), ((0.0, 1.0), 0.5), ((10.0, 10.0), 10.0)])
def test_the_centre_of_a_band_lies_halfway(band: tuple[float, float], centre: float) -> None:
    assert dataclasses.replace(FIT, band_hz=band).centre_hz == centre
    assert (
        ComparedBand("t", "k", "N/m", band_hz=band, value=1.0, ci95=(0.0, 2.0), other=1.0).centre_hz == centre
    )


def test_a_parameter_goes_by_its_name() -> None:
    assert FIT.parameter("c") is C
    with pytest.raises(KeyError, match="no parameter 'm'; known: k, c"):
        FIT.parameter("m")


def test_a_parameter_without_uncertainty_says_none_rather_than_nought() -> None:
    assert (C.std_error, C.t_ratio, C.ci95, C.significant, C.vif, C.std_error_inflated) == (None,) * 6
    assert not C.derived and not C.at_bound


# findings


def test_findings_of_one_level_stay_in_their_order() -> None:
    mixed = [Finding("a", "1"), note("b", "2"), Finding("c", "3"), note("d", "4")]
    assert [finding.code for finding in of_level(WARNING, mixed)] == ["a", "c"]
    assert [finding.code for finding in of_level(NOTE, mixed)] == ["b", "d"]


@settings(derandomize=True, max_examples=30)
@given(st.lists(st.booleans()))
def test_every_finding_is_a_note_or_a_warning(levels: list[bool]) -> None:
    findings = [note("n", "") if low else Finding("w", "") for low in levels]
    assert len(of_level(NOTE, findings)) + len(of_level(WARNING, findings)) == len(levels)


# an identification as a whole


def outcome(passed: bool) -> RuleOutcome:
    return RuleOutcome("accept", "direct.k > 0", 1.0, passed)


@pytest.mark.parametrize(
    ("outcomes", "failed", "accepted"),
    [
        ((), (), True),
        ((True,), (), True),
        ((True, False), (), False),
        ((True,), ("b",), False),
        ((), ("b",), False),
    ],
)
def test_accepted_needs_every_rule_and_every_test(
    outcomes: tuple[bool, ...], failed: tuple[str, ...], accepted: bool
) -> None:
    whole = Identification(
        (FIT,), outcomes=tuple(map(outcome, outcomes)), failed=tuple(Failed(name, "gap") for name in failed)
    )
    assert whole.accepted is accepted
    verdict = "INCOMPLETE" if failed else "no rules" if accepted and not outcomes else "accepted"
    verdict = verdict if accepted or failed else "NOT ACCEPTED"
    assert repr(whole) == f"<Identification : 1 fits; {verdict}>"
    of_sections = dataclasses.replace(whole, title="Rig", sections={"matrix": (), "run_ups": ()})
    assert repr(of_sections) == f"<Identification Rig: 1 fits, matrix, run_ups; {verdict}>"


def response(name: str, **conditions: str) -> FrequencyResponse:
    port = (Port("x", "x", "x"),)
    return FrequencyResponse(
        np.array([1.0]), np.ones((1, 1, 1)), port, port, name=name, conditions=conditions
    )


def test_conditions_are_those_listed_and_those_the_responses_had() -> None:
    listed = {
        "tests": [
            {"name": "a", "conditions": {"preload": "1 N"}},
            {"name": "b", "conditions": {"preload": "2 N"}},
        ]
    }
    whole = Identification((), settings=listed, responses=(response("b", preload="2.1 N"), response("c")))
    assert whole.test_conditions == {"a": {"preload": "1 N"}, "b": {"preload": "2.1 N"}, "c": {}}


def test_without_tests_there_are_no_conditions() -> None:
    assert Identification(()).test_conditions == {}


# comparisons


COMPARISON = Comparison(
    name="pair",
    kind="difference",
    subject="k",
    unit="N/m",
    points=(),
    amounts=(Parameter("difference", 3.0, "N/m"),),
    verdict="different",
    statement="k differs",
)


def test_an_amount_goes_by_its_name() -> None:
    assert COMPARISON.amount("difference").value == 3.0
    with pytest.raises(KeyError, match="no amount 'slope'; known: difference"):
        COMPARISON.amount("slope")


@pytest.mark.parametrize(
    ("other", "holds"), [(0.9, True), (1.1, True), (1.0, True), (0.89, False), (1.11, False)]
)
def test_an_interval_holds_its_ends(other: float, holds: bool) -> None:
    assert (
        ComparedBand("t", "k", "N/m", band_hz=(1.0, 2.0), value=1.0, ci95=(0.9, 1.1), other=other).holds
        is holds
    )


# run-ups


@settings(derandomize=True, max_examples=40)
@given(st.floats(-1e6, 1e6), st.floats(1e-3, 1e3))
def test_an_interval_of_two_sided_95_per_cent(value: float, error: float) -> None:
    low, high = UncertainAmount(value, error).ci95
    assert (low + high) / 2 == pytest.approx(value, abs=1e-6 * error + 1e-9 * abs(value))
    assert (high - low) / 2 == pytest.approx(1.959964 * error, rel=1e-6, abs=1e-9 * abs(value))


def test_the_half_width_is_the_normal_quantile() -> None:
    """P(|z| < 1.959964) = erf(1.959964 / sqrt 2) = 0.95."""
    _, high = UncertainAmount(0.0, 1.0).ci95
    assert math.erf(high / math.sqrt(2)) == pytest.approx(0.95, abs=1e-7)


def test_an_amount_without_error_has_no_interval() -> None:
    assert UncertainAmount(3.0).ci95 is None


RUN = MeasuredRun("5 N", 5.0, "trained", excitation="unbalance", speed=(60.0,), motions=())
PREDICTION = RunPrediction("5 N", UncertainAmount(300.0), None)
METHOD = RunUpMethod("joint", "Joint fit", "determined", predictions=(PREDICTION,))
METAMODEL = MetamodelResult("gp", "Gaussian process", Surface((), (), ()), (), (PREDICTION,))
RUN_UPS = RunUpResult("rotor", "disc", "journal", runs=(RUN,), methods=(METHOD,), metamodels=(METAMODEL,))


@pytest.mark.parametrize("owner", [METHOD, METAMODEL])
def test_a_prediction_goes_by_its_run(owner: RunUpMethod | MetamodelResult) -> None:
    assert owner.prediction("5 N") is PREDICTION
    assert owner.prediction("6 N") is None


def test_methods_go_by_their_names() -> None:
    assert RUN_UPS.method("joint") is METHOD and RUN_UPS.method("points") is None


# study, unbalance, rig


@settings(derandomize=True, max_examples=30)
@given(st.floats(-1e9, 1e9), st.floats(-1e9, 1e9))
def test_bias_is_mean_less_truth(truth: float, mean: float) -> None:
    studied = StudiedParameter(
        "k", "N/m", truth=truth, mean=mean, rmse=1.0, bound=None, std_error=None, coverage=None
    )
    assert studied.bias == mean - truth
    # A root mean square error holds the bias: rmse^2 = bias^2 + variance.
    assert truth + studied.bias == pytest.approx(mean, abs=1e-6)


SPEEDS = (10.0, 20.0, 30.0, 40.0)


@settings(derandomize=True, max_examples=40)
@given(st.lists(st.floats(0, 1), min_size=4, max_size=4), st.lists(st.floats(0, 1), min_size=4, max_size=4))
def test_peaks_are_the_largest_radii_and_their_speeds(forward: list[float], backward: list[float]) -> None:
    case = UnbalanceCase("worn", 1e-5, 0.0, tuple(forward), tuple(backward))
    values = UnbalanceRuns("rotor", "a", 3, SPEEDS, (case,)).values(case)
    for name, radii in (("forward", forward), ("backward", backward)):
        peak, unit = values[f"{name}_peak"]
        speed, hertz = values[f"{name}_speed"]
        assert (unit, hertz) == ("m", "Hz")
        assert peak == max(radii) and radii[SPEEDS.index(speed)] == peak


def test_of_two_equal_peaks_the_slower_one_counts() -> None:
    case = UnbalanceCase("healthy", 0.0, 0.0, (1.0, 3.0, 3.0, 1.0), (0.0, 0.0, 0.0, 0.0))
    values = UnbalanceRuns("rotor", "a", 3, SPEEDS, (case,)).values(case)
    assert values["forward_speed"] == (20.0, "Hz") and values["backward_speed"] == (10.0, "Hz")


def test_axes_stand_at_a_right_angle() -> None:
    assert AXIS_ANGLES["y"] - AXIS_ANGLES["x"] == math.pi / 2


# the first look at a file


def channel(name: str, unit: str = "") -> ChannelOverview:
    envelope = Envelope(10, np.zeros(2), np.ones(2))
    return ChannelOverview(
        name,
        unit,
        "",
        minimum=0.0,
        maximum=1.0,
        mean=0.5,
        rms=0.6,
        envelope=envelope,
        spectrum=Spectrum(np.array([0.0, 1.0]), np.array([0.1, 0.2]), 3),
    )


@pytest.mark.parametrize(
    ("name", "unit", "label"),
    [("x", "um", "x [um]"), ("x [um]", "um", "x [um]"), ("x", "", "x"), ("t [s]", "s", "t [s]")],
)
def test_a_label_states_the_unit_once(name: str, unit: str, label: str) -> None:
    assert channel(name, unit).label == label


def test_time_is_not_plotted() -> None:
    whole = Overview(
        "a.csv",
        "csv",
        n_sample=20,
        sample_rate=100.0,
        rate="100 Hz",
        channels=(channel("t"), channel("x"), channel("y")),
        findings=(),
        time="t",
    )
    assert [one.name for one in whole.plotted] == ["x", "y"]
    assert len(dataclasses.replace(whole, time="").plotted) == 3


@pytest.mark.parametrize(
    ("frequency", "density"), [([0.0, 1.0], [0.1]), ([0.0], [0.1, 0.2]), ([0.0, 1.0], [0.1, np.nan])]
)
def test_a_spectrum_has_a_density_for_each_frequency(frequency: list[float], density: list[float]) -> None:
    with pytest.raises(Exception, match=r"density (has the shape|is not finite)"):
        Spectrum(np.array(frequency), np.array(density), 1)
