"""Wear fits as a whole: values with their uncertainty, what they say of themselves, tuning and what it leaves
known.
"""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from labpipe.errors import ConfigError, FitError, LabpipeError
from labpipe.estimation.budget import with_sources
from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import FitSettings
from labpipe.methods.wear.fit import _fit_without_prior, _Solved, healthy_findings, rival_findings
from labpipe.methods.wear.search import WearMinimum
from labpipe.methods.wear.settings import UNITS, Gaussian, posterior, with_prior
from labpipe.project.work import _begin
from labpipe.records.finding import Parameter
from labpipe.records.fit_details import Region
from labpipe.records.identification import Fit, Goodness, random_part
from labpipe.records.uncertain import Uncertain
from labpipe.uncertainty.amounts import parameter_changes, with_error
from tests.methods.wear.worn_cases import (
    LINES,
    NUISANCES,
    RIG,
    fit_settings,
    measured,
    misfit_of,
    wear_settings,
    without_region,
    worn_rig,
)

BAND = np.concatenate([np.arange(12.0, 48.0, 2.0), np.arange(70.0, 95.0, 1.0)])
TRUE_BEARING = {"viscosity": 0.1044 * 1.03, "clearance": 90e-6 * 0.98}


def fitted(settings: FitSettings, response) -> Fit:  # type: ignore[no-untyped-def]
    (fit,) = identify(response, settings)
    return fit


@pytest.fixture(scope="module")
def joint() -> Fit:
    """Wear 1 with 2 % noise on a rig of 3 % more viscosity and 2 % less clearance, both estimated along."""
    response = measured(worn_rig(22.27, 11.0, **TRUE_BEARING), 0.02, np.random.default_rng(11), BAND)
    return fitted(fit_settings(response="dFRF", **NUISANCES), response)


@pytest.fixture(scope="module")
def healthy() -> Fit:
    response = measured(worn_rig(**TRUE_BEARING), 0.02, np.random.default_rng(12), BAND)
    return fitted(fit_settings(**NUISANCES), response)


@pytest.mark.long
def test_joint_fit_holds_the_truth_within_its_intervals(joint: Fit) -> None:
    truth = {"wear_depth": 22.27e-6, "wear_angle": np.deg2rad(11), **TRUE_BEARING}
    for name, value in truth.items():
        parameter = joint.parameter(name)
        assert parameter.std_error is not None and abs(parameter.value - value) < 3 * parameter.std_error
        assert parameter.ci95 is not None and parameter.ci95[0] < parameter.value < parameter.ci95[1]
    assert joint.parameter("wear_depth").std_error < 0.5e-6
    assert joint.parameter("healthy_probability").value < 1e-6


def test_joint_fit_is_complete(joint: Fit) -> None:
    """Names and units of the interface; equations, degrees of freedom and the residual test.

    A curve in forward and backward.
    """
    assert [p.name for p in joint.parameters][:2] == ["wear_depth", "wear_angle"]
    assert [p.unit for p in joint.parameters] == ["m", "rad", "Pa.s", "m", "1"]
    assert (joint.lines, joint.equations, joint.dof) == (BAND.size, 8 * BAND.size, 8 * BAND.size - 2)
    assert (
        joint.gof.chi2_reduced == pytest.approx(1.0, abs=4 * np.sqrt(2 / joint.dof))
        and joint.gof.chi2_p > 1e-4
    )
    assert (
        joint.gof.r2 > 0.99
        and joint.converged
        and joint.estimator == "ml"
        and joint.correlation.shape == (4, 4)
    )
    assert (
        joint.curve is not None
        and joint.curve.outputs == ("f", "b")
        and joint.curve.fitted.shape == (BAND.size, 2, 2)
    )
    between, drawn = joint.curve.drawn
    np.testing.assert_allclose(
        drawn[np.searchsorted(between, joint.curve.frequency)], joint.curve.fitted, rtol=1e-9
    )
    assert between.size >= 200
    assert [finding.code for finding in joint.findings] == []
    assert "of 4 starts lead to this minimum" in joint.notes[0] and "192 x 16 cells" in joint.notes[0]


def test_healthy_bearing_is_called_healthy(healthy: Fit) -> None:
    """Depth below .6 um, no angle, and the probability of no wear."""
    depth, angle = healthy.parameter("wear_depth"), healthy.parameter("wear_angle")
    assert depth.value < 0.6e-6 and depth.at_bound and depth.std_error is None
    assert depth.ci95 is not None and depth.ci95[0] == 0 and depth.ci95[1] < 4e-6
    assert angle.std_error is None and angle.ci95 is None and not angle.at_bound
    assert healthy.parameter("healthy_probability").value > 0.9
    codes = [finding.code for finding in healthy.findings]
    assert {"at-bound", "not-identifiable", "healthy"} == set(codes)
    texts = " ".join(finding.message for finding in healthy.findings)
    assert "angle not identifiable" in texts and "probably healthy" in texts


@pytest.mark.long
def test_frf_and_dfrf_hold_the_same_information() -> None:
    response = measured(worn_rig(40.19, 8.0), 0.02, np.random.default_rng(5))
    plain, forward = (fitted(fit_settings(response=frame), response) for frame in ("FRF", "dFRF"))
    for name in ("wear_depth", "wear_angle"):
        assert plain.parameter(name).value == pytest.approx(forward.parameter(name).value, rel=1e-3)
        assert plain.parameter(name).std_error == pytest.approx(forward.parameter(name).std_error, rel=1e-3)


def test_log_amplitudes_know_less() -> None:
    """Same response, same lines: no chi-square, and larger standard errors than with phases and weights."""
    response = measured(worn_rig(22.27, -11.0), 0.02, np.random.default_rng(6))
    log = fitted(fit_settings(objective="log", response="dFRF"), response)
    whole = fitted(fit_settings(response="dFRF"), response)
    assert (
        log.estimator == "log-amplitude" and log.gof.chi2_reduced is None and log.equations == 4 * LINES.size
    )
    assert log.parameter("wear_depth").std_error > 1.5 * whole.parameter("wear_depth").std_error
    assert abs(log.parameter("wear_depth").value - 22.27e-6) < 4 * log.parameter("wear_depth").std_error


def test_response_without_noise_is_found_again_with_and_without_its_covariance() -> None:
    for known in (True, False):
        fit = fitted(fit_settings(), measured(worn_rig(22.27, -11.0), known=known))
        assert fit.parameter("wear_depth").value == pytest.approx(22.27e-6, abs=0.01e-6)
        assert fit.parameter("wear_angle").value == pytest.approx(np.deg2rad(-11), abs=np.deg2rad(0.01))


def test_residual_gives_the_errors_where_the_noise_is_not_known() -> None:
    """White noise of one size: weights from the residual are the true ones, so the standard errors agree."""
    rng = np.random.default_rng(7)
    response = measured(worn_rig(22.27, 11.0), 0.02, rng, BAND)
    known, unknown = (fitted(fit_settings(), one) for one in (response, replace(response, covariance=None)))
    assert unknown.gof.chi2_reduced is None
    for name in ("wear_depth", "wear_angle"):
        assert unknown.parameter(name).std_error == pytest.approx(known.parameter(name).std_error, rel=0.15)


@pytest.mark.long
def test_wear_beyond_the_range_ends_at_the_bound() -> None:
    response = measured(worn_rig(30.0, 18.0), 0.01, np.random.default_rng(8))
    fit = fitted(fit_settings(angle_limit=np.deg2rad(10), start_angles=(0.0,)), response)
    angle = fit.parameter("wear_angle")
    assert (
        angle.at_bound and angle.std_error is None and angle.value == pytest.approx(np.deg2rad(10), rel=1e-3)
    )
    assert "at-bound" in [finding.code for finding in fit.findings]


def test_nothing_but_bounds_is_a_result_too() -> None:
    """Deeper and farther round than is looked for: both at their bounds, no standard errors, no failure."""
    limits = {
        "depth_limit": 20e-6,
        "angle_limit": np.deg2rad(5),
        "start_depths": (5e-6,),
        "start_angles": (0.0,),
    }
    fit = fitted(fit_settings(**limits), measured(worn_rig(25.0, 15.0), 0.01, np.random.default_rng(8)))
    assert [fit.parameter(name).at_bound for name in ("wear_depth", "wear_angle")] == [True, True]
    assert fit.condition_number == 1.0 and fit.parameter("wear_depth").std_error is None


def test_a_model_error_without_nuisances_is_seen_by_chi_square() -> None:
    response = measured(worn_rig(22.27, 11.0, viscosity=0.1044 * 1.1), 0.01, np.random.default_rng(9), BAND)
    fit = fitted(fit_settings(), response)
    assert "model-mismatch" in [finding.code for finding in fit.findings]


def test_rival_minima_are_named_with_their_place() -> None:
    """Only those whose chi-square is within 9.21 of the least (99 %, two parameters), and that were
    reached.
    """
    misfit = misfit_of(measured(worn_rig(22.27, 11.0)))
    places = [
        ([22.0, 11.0], 10.0, True),
        ([30.0, -5.0], 12.0, True),
        ([40.0, 0.0], 30.0, True),
        ([45.0, 0.0], 11.0, False),
    ]
    found = [WearMinimum(np.array(place), chi2, 5, converged, 9) for place, chi2, converged in places]
    (finding,) = rival_findings(found, misfit)
    assert finding.code == "multi-modal" and "30 um at -5 deg (chi-square +2)" in finding.message
    assert "40 um" not in finding.message and "45 um" not in finding.message
    assert rival_findings(found[:1], misfit) == []


def test_verdicts_by_probability() -> None:
    codes = [
        [finding.code for finding in healthy_findings(probability, False)] for probability in (0.9, 0.3, 0.01)
    ]
    assert codes == [["healthy"], ["perhaps-healthy"], []]
    (finding,) = healthy_findings(0.9, True)
    assert finding.code == "perhaps-healthy" and "chi-square rejects" in finding.message


def test_tuning_finds_the_healthy_rig_s_oil_clearance_and_damping() -> None:
    rig = worn_rig(**TRUE_BEARING)
    rig = replace(rig, rotor=replace(rig.rotor, beta=1.9e-4))
    response = measured(rig, 0.01, np.random.default_rng(10), BAND)
    tuning = fitted(fit_settings(healthy=True, beta=Uncertain(1.6e-4, 3e-5), **NUISANCES), response)
    assert [p.name for p in tuning.parameters] == ["viscosity", "clearance", "beta"]
    for name, value in {**TRUE_BEARING, "beta": 1.9e-4}.items():
        parameter = tuning.parameter(name)
        assert abs(parameter.value - value) < 3.5 * parameter.std_error
    assert tuning.parameter("beta").std_error < 0.5 * 3e-5 and tuning.gof.chi2_p > 1e-3
    known = posterior(tuning)
    assert known.names == ("viscosity", "clearance", "beta")
    np.testing.assert_allclose(known.std, [p.std_error for p in tuning.parameters])
    assert known.covariance[0][1] == pytest.approx(tuning.correlation[0, 1] * known.std[0] * known.std[1])


@pytest.mark.long
def test_what_a_tuning_found_sharpens_the_wear() -> None:
    """The posterior of the tuning takes the prior's place; standard errors shrink."""
    rng = np.random.default_rng(13)
    tuning = replace(
        fitted(fit_settings(healthy=True, **NUISANCES), measured(worn_rig(**TRUE_BEARING), 0.01, rng, BAND)),
        name="tuning",
        test="healthy",
    )
    response = measured(worn_rig(22.27, 11.0, **TRUE_BEARING), 0.02, rng, BAND)
    sharpened = with_prior(fit_settings(prior="tuning"), [tuning])
    alone, carried = fitted(fit_settings(**NUISANCES), response), fitted(sharpened, response)
    assert carried.parameter("wear_depth").std_error < alone.parameter("wear_depth").std_error
    assert (
        abs(carried.parameter("wear_depth").value - 22.27e-6) < 3 * carried.parameter("wear_depth").std_error
    )


@pytest.mark.parametrize("off", [0.0, 3.7])
def test_lines_that_contradict_what_was_stated_are_named(off: float) -> None:
    """Oil and clearance as stated, or each 3.7 stated standard errors off, which precise lines see and the
    fit can follow: two squares of 13.7 have a probability of 1e-6.
    """
    bearing = {"viscosity": 0.1044 + off * 0.003, "clearance": 90e-6 - off * 1.8e-6}
    response = measured(worn_rig(22.27, 11.0, **bearing), 0.005, np.random.default_rng(5), BAND)
    with without_region():
        fit = fitted(fit_settings(**NUISANCES), response)
    named = [finding.message for finding in fit.findings if finding.code == "stated-value"]
    assert len(named) == (off > 0) and fit.gof.chi2_p is not None and fit.gof.chi2_p > 0.01
    assert not off or "contradict what was stated (p = " in named[0]


def test_priors_that_are_not_there(joint: Fit) -> None:
    settings = fit_settings(prior="tunning")
    with pytest.raises(ConfigError, match="no earlier fit 'tunning'"):
        with_prior(settings, [replace(joint, name="tuning")])
    with pytest.raises(ConfigError, match="'tuning' has 2 results"):
        with_prior(fit_settings(prior="tuning"), [replace(joint, name="tuning", test=test) for test in "ab"])
    other = replace(joint, name="tunning", parameters=joint.parameters[:2])
    with pytest.raises(ConfigError, match="tuned none of viscosity"):
        with_prior(settings, [other])
    assert with_prior(fit_settings(), []) == fit_settings()


def test_a_test_that_was_tuned_is_not_fitted_again_with_what_it_told(joint: Fit) -> None:
    """Its lines counted twice. Those of another band, or test, count."""
    rng = np.random.default_rng(4)
    response = replace(measured(worn_rig(22.27, 11.0), 0.02, rng, BAND), name="a")
    tuned = with_prior(fit_settings(prior="tuning"), [replace(joint, name="tuning", test="a")])
    with pytest.raises(ConfigError, match=r"wear.prior: 'tuning' is of this test: its lines count once"):
        identify(response, tuned)
    prior = tuned.model_settings.posterior
    assert prior.origin == ("a", joint.band_hz) and prior == replace(posterior(joint), origin=prior.origin)


def test_a_value_beside_the_prior_that_tuned_it_is_refused(joint: Fit) -> None:
    """The posterior outranked it; what the tuning left alone may be given."""
    tuned = [replace(joint, name="tuning")]
    with pytest.raises(ConfigError, match="viscosity: 'tuning' has tuned it"):
        with_prior(fit_settings(prior="tuning", viscosity=Uncertain(0.1)), tuned)
    beside = with_prior(fit_settings(prior="tuning", beta=Uncertain(1e-4)), tuned).model_settings
    assert beside.fixed_values == {"beta": 1e-4} and "viscosity" in beside.nuisance_prior.names


def linear_fit(name: str, parameters: list[Parameter]) -> Fit:
    """A fit of 9 real equations that has only its parameters."""
    return Fit(
        name,
        "worn-bearing",
        "ml",
        band_hz=(1.0, 2.0),
        lines=9,
        equations=9,
        dof=7,
        gof=Goodness(1.0, 1.0, 1.0, 0.5),
        parameters=tuple(parameters),
        condition_number=1.0,
        correlation=np.eye(len(parameters)),
        test=name,
    )


def test_tests_that_share_a_tuning_have_its_error_in_common() -> None:
    """Of two linear tests, estimates (J^T J + P^-1)^-1 (J^T y + P^-1 mu): by mu they have the covariance A P
    B^T, A and B their slopes by mu, and each its whole variance.
    """
    rng = np.random.default_rng(8)
    spread = np.array([[4.0, 1.5], [1.5, 2.0]])
    prior = Gaussian.of(("viscosity", "clearance"), (0.1, 9e-5), spread)
    rows = np.pad(np.linalg.inv(np.linalg.cholesky(spread)), [(0, 0), (1, 0)])
    names, fits, slopes, whole = ("wear_depth", *prior.names), [], [], []
    for _ in range(2):
        jacobian = np.vstack([rng.standard_normal((9, 3)), rows])
        covariance = np.linalg.inv(jacobian.T @ jacobian)
        errors = np.sqrt(np.diag(covariance))
        stated = [
            with_error(name, "1", 1.0, float(error), 1.96) for name, error in zip(names, errors, strict=True)
        ]
        plain = linear_fit("wear", stated)
        model = SimpleNamespace(names=names, scale=np.ones(3), prior=prior)
        misfit = SimpleNamespace(model=model, n_prior=2, jacobian=lambda _, rows=jacobian: rows)
        solved = _Solved(misfit, (SimpleNamespace(parameters=None),), covariance, 0 * covariance)
        fits.append(with_sources(*_fit_without_prior(plain, solved, wear_settings(prior="tuning"))))
        slopes.append(covariance @ np.vstack([np.zeros(2), np.linalg.inv(spread)]))
        whole.append(covariance[0, 0])
    changes = parameter_changes(fits, "wear_depth")
    common = slopes[0] @ spread @ slopes[1].T
    assert changes[:, 0] @ changes[:, 1] == pytest.approx(common[0, 0])
    assert [source.source for source in fits[0].budget.sources] == [
        "tuning.viscosity = 0.1 Pa.s",
        "tuning.clearance = 9e-05 m",
    ]
    depths = [fit.parameter("wear_depth") for fit in fits]
    np.testing.assert_allclose([np.hypot(p.std_error, p.systematic) ** 2 for p in depths], whole)
    np.testing.assert_allclose([random_part(fits[0], depths[0])], depths[0].std_error)


@pytest.mark.parametrize("name", ["viscosity", "beta"])
def test_a_tuning_of_another_oil_or_shaft_is_refused(name: str) -> None:
    """It passed, and the file's own number was passed over."""
    other = replace(RIG, rotor=replace(RIG.rotor, beta=1e-3))
    other = other if name == "beta" else RIG.with_bearings(viscosity=0.05)
    tuned = linear_fit("tuning", [Parameter(name, 0.104, UNITS[name], std_error=1e-3)])
    earlier = replace(fit_settings(healthy=True, **{name: Uncertain(0.1, 0.005)}), name="tuning")
    work = SimpleNamespace(pipeline=SimpleNamespace(path="p.yaml", fits=[earlier]), failed=[])
    assert _begin(fit_settings(prior="tuning"), [tuned], work).model_settings.posterior.names == (name,)
    with pytest.raises(
        ConfigError, match=rf"p.yaml: identify.*'tuning' tuned {name}, .* of this fit"
    ) as caught:
        _begin(fit_settings(prior="tuning", rig=other), [tuned], work)
    assert caught.value.hint.startswith(f"give {name} with its uncertainty")


def test_a_tuned_parameter_at_its_bound_keeps_some_uncertainty(joint: Fit) -> None:
    parameters = tuple(replace(p, std_error=None) if p.name == "viscosity" else p for p in joint.parameters)
    known = posterior(replace(joint, parameters=parameters))
    assert known.std[0] == pytest.approx(1e-3 * joint.parameter("viscosity").value)
    inflated = tuple(
        replace(p, std_error_inflated=9e-7) if p.name == "clearance" else p for p in joint.parameters
    )
    assert posterior(replace(joint, parameters=inflated)).std[1] == pytest.approx(9e-7)


def test_a_test_at_another_speed_than_its_rotor_is_refused() -> None:
    """The rotor file turns at 50 Hz; films at 40 Hz have other coefficients. Nothing peaks at 1 Hz."""
    response = measured(worn_rig(22.27, 11.0), lines=LINES[:1])
    nowhere = fit_settings(half_power=((1.0, 2.0),))
    speeds = {
        "2400 rpm": True,
        "40 Hz +- 1 Hz": True,
        "251.327412 rad/s": True,
        "49.8 Hz": False,
        "full": False,
    }
    for stated, refused in speeds.items():
        with pytest.raises(LabpipeError) as caught:
            fitted(nowhere, response.rename("t", {"speed": stated}))
        assert ("the test ran at 40 Hz" in str(caught.value)) is refused


def test_too_few_equations_are_refused() -> None:
    response = measured(worn_rig(22.27, 11.0))
    with pytest.raises(FitError, match="cannot determine 2 parameters"):
        fitted(fit_settings(objective="log", terms="cross", lines=(81.3,)), response)


def test_joint_region_holds_the_estimate_and_reaches_beyond_its_intervals(joint: Fit) -> None:
    """Along each axis the region of two parameters reaches sqrt(5.99 / 3.84) = 1.25 times as far as the
    interval of one.
    """
    assert (
        joint.detail(Region) is not None
        and joint.detail(Region).names == ("wear_depth", "wear_angle")
        and joint.detail(Region).level == 0.95
    )
    for name, column in zip(joint.detail(Region).names, joint.detail(Region).outline.T, strict=True):
        one = joint.parameter(name)
        assert one.ci95 is not None
        reach = np.ptp(column) / (one.ci95[1] - one.ci95[0])
        assert reach == pytest.approx(np.sqrt(5.991 / 3.841), rel=0.05)
        assert column.min() < one.value < column.max()


def test_an_angle_that_is_not_identifiable_has_no_region(healthy: Fit) -> None:
    assert healthy.detail(Region) is None and healthy.curve is not None and healthy.curve.before is None


def test_a_tuning_keeps_the_model_before_it() -> None:
    """At the mean of what was known beforehand, it is the rig as its file says: 3 % and 2 % from the
    truth.
    """
    response = measured(worn_rig(**TRUE_BEARING), 0.0, np.random.default_rng(13), BAND)
    curve = fitted(fit_settings(healthy=True, **NUISANCES), response).curve
    assert curve is not None and curve.before is not None
    untuned = measured(worn_rig(), 0.0, np.random.default_rng(13), BAND).matrix
    size = np.abs(untuned).max()
    assert np.abs(curve.before - untuned).max() < 2e-3 * size
    assert np.abs(curve.fitted - curve.measured).max() < 0.1 * np.abs(curve.before - curve.measured).max()
