"""Given, tied and proportional coefficients: truth from the matrices, tests of structure from their own
distribution.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labpipe.errors import ConfigError
from labpipe.estimation.damping import HYSTERETIC, PROPORTIONAL, FactorModel, damp
from labpipe.estimation.fitting import identify
from labpipe.estimation.model import Setup
from labpipe.estimation.settings import MODELS, FitSettings, Support
from labpipe.records.identification import Fit
from labpipe.records.uncertain import Uncertain
from tests.estimation.conftest import DAMPING, MASS

KNOWN = FitSettings("mdof", mass=(1.0, 2.0, 3.0), symmetric=True, name="three")
PEDESTAL = FitSettings("sdof", band=(67.0, 70.0))
RAYLEIGH = replace(KNOWN, damping="proportional")
OMEGA = np.array([0.3, 1.1, 2.2])


def test_a_given_coefficient_is_kept_and_the_rest_gains(three_dof_response) -> None:
    response = three_dof_response(0.05, np.random.default_rng(1))
    (free,), (given,) = (
        identify(response, settings)
        for settings in (KNOWN, replace(KNOWN, fixed=(("k_1_3", 0.0), ("c_1_3", 0.0))))
    )
    assert given.parameter("k_1_3").value == 0.0 and given.parameter("k_1_3").std_error is None
    assert given.dof == free.dof + 2
    assert given.parameter("k_1_1").std_error <= free.parameter("k_1_1").std_error
    assert abs(given.parameter("k_1_1").value - 2.0) < 4 * given.parameter("k_1_1").std_error


@pytest.mark.parametrize("estimator", ["ls", "iv", "ml"])
def test_tied_coefficients_have_one_value(three_dof_response, estimator: str) -> None:
    settings = replace(KNOWN, estimator=estimator, tied=(("k_1_1", "k_2_2", "k_3_3"), ("k_1_2", "k_2_3")))
    (fit,) = identify(three_dof_response(), settings)
    assert [fit.parameter(f"k_{n}_{n}").value for n in (1, 2, 3)] == [pytest.approx(2.0, rel=1e-9)] * 3
    assert fit.parameter("k_2_3").value == pytest.approx(-1.0, rel=1e-9)
    assert fit.parameter("k_2_2").derived and not fit.parameter("k_1_1").derived
    assert len([p for p in fit.parameters if not p.derived]) == 9


def test_ties_work_for_the_rotor_as_well(coupled_response) -> None:
    response = coupled_response(1e-8, np.random.default_rng(2))
    (fit,) = identify(response, FitSettings("rotor-2dof", mass=0.92, tied=(("c_xy", "c_yx"),)))
    assert fit.parameter("c_xy").value == fit.parameter("c_yx").value


def test_proportional_damping_without_noise(three_dof_response) -> None:
    # C = 0.05 M + 0.1 K, with the mass known and with it estimated.
    response = three_dof_response(damping=0.05 * MASS + DAMPING)
    for mass in ((1.0, 2.0, 3.0), "estimate"):
        (fit,) = identify(response, replace(RAYLEIGH, mass=mass))
        assert fit.parameter("alpha").value == pytest.approx(0.05, rel=1e-7)
        assert fit.parameter("beta").value == pytest.approx(0.1, rel=1e-7)
        assert fit.parameter("c_2_3").value == pytest.approx(-0.1, rel=1e-6)


@pytest.fixture(scope="module")
def fits(three_dof_response) -> list[Fit]:
    """Of 60 noises."""
    return [
        identify(three_dof_response(0.05, np.random.default_rng(seed)), RAYLEIGH)[0] for seed in range(60)
    ]


@pytest.mark.long
def test_proportional_standard_errors_are_the_scatter(fits: list[Fit]) -> None:
    for name in ("alpha", "beta", "c_1_1"):
        values = [fit.parameter(name).value for fit in fits]
        assert np.mean([fit.parameter(name).std_error for fit in fits]) == pytest.approx(
            np.std(values, ddof=1), rel=0.27
        )
    assert np.mean([fit.gof.chi2_reduced for fit in fits]) == pytest.approx(1.0, abs=0.03)


@pytest.mark.parametrize("mass", [(1.0, 2.0, 3.0), "estimate"])
def test_slopes_of_proportional_models_are_central_differences(three_dof_response, mass) -> None:  # type: ignore[no-untyped-def]
    response = three_dof_response()
    setup = Setup(response.outputs, response.inputs, replace(RAYLEIGH, mass=mass, fixed=(("k_1_3", 0.1),)))
    model = damp(MODELS["mdof"].model(setup), setup.settings)
    assert isinstance(model, FactorModel)
    start = 1 + 0.1 * np.arange(len(model.names))
    own = dict(zip(model.names, start, strict=True))
    whole = model.whole(start)
    np.testing.assert_allclose(
        whole.damping, own["alpha"] * whole.mass + own["beta"] * whole.stiffness, rtol=1e-12
    )
    entries = {"k": whole.stiffness, "c": whole.damping, "m": whole.mass}
    linear = np.array([entries[name[0]][int(name[2]) - 1, int(name[4]) - 1] for name in model.linear.names])
    np.testing.assert_allclose(model.from_linear(linear), start, rtol=1e-10)
    jacobian = model.jacobian(start, OMEGA)
    for number in range(start.size):
        step = 1e-6 * np.eye(start.size)[number]
        difference = (model.receptance(start + step, OMEGA) - model.receptance(start - step, OMEGA)) / 2e-6
        np.testing.assert_allclose(jacobian[number], difference, rtol=1e-5, atol=1e-8)


def test_proportional_damping_is_refused_where_it_means_nothing(sdof_response) -> None:
    for model in ("sdof", "modal"):
        with pytest.raises(
            ConfigError,
            match=f"proportional damping is of several coefficients, every mode of model {model} has its own",
        ):
            FitSettings(model, damping="proportional")
    setup = Setup((), (), FitSettings("sdof"))
    ports = replace(setup, outputs=sdof_response().outputs, inputs=sdof_response().inputs)
    model = MODELS["sdof"].model(ports)
    with pytest.raises(ConfigError, match="several damping coefficients"):
        PROPORTIONAL(model)
    # A loss factor asks for one coefficient in whose place it stands.
    undamped = replace(model, terms=tuple(term for term in model.terms if term.name != "c"))
    with pytest.raises(ConfigError, match="needs a model with a damping coefficient"):
        HYSTERETIC(undamped)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"estimator": "ls", "damping": "proportional"},
            "'damping' is not for estimator ls; leave it out, or estimator: ml$",
        ),
        ({"eliminate": True, "damping": "proportional"}, "eliminate"),
        ({"weight": "noise"}, "not for estimator ml; leave it out, or estimator: ls or iv$"),
        ({"estimator": "amplitude"}, "amplitude does not estimate model mdof"),
        ({"mass": "estimate", "scale_mass": True}, "needs the mass"),
    ],
)
def test_settings_that_contradict_each_other(change: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        replace(KNOWN, **change)
    with pytest.raises(ConfigError, match=r"not for model sdof; leave it out; models that take it: mdof$"):
        FitSettings("sdof", symmetric=True)


def codes(fit) -> list[str]:  # type: ignore[no-untyped-def]
    return [finding.code for finding in fit.findings]


@pytest.mark.long
def test_comparison_finds_damping_that_is_not_proportional(three_dof_response) -> None:
    odd = np.diag([0.5, 0.05, 0.05])
    settings = replace(RAYLEIGH, compare=True)
    (wrong,) = identify(three_dof_response(0.02, np.random.default_rng(4), damping=odd), settings)
    (right,) = identify(three_dof_response(0.02, np.random.default_rng(4)), settings)
    assert "other-model" in codes(wrong) and "other-model" not in codes(right)
    own = next(c for c in wrong.candidates if c.name.startswith("this model"))
    assert own.p_value < 1e-6 and wrong.candidates[0].aic < own.aic
    names = {candidate.name for candidate in right.candidates}
    assert {"mdof, symmetric", "mdof, general, proportional damping"} <= names


@pytest.mark.long
def test_likelihood_ratio_of_a_true_restriction_is_uniform(fits: list[Fit]) -> None:
    """Proportional damping is compared with free damping coefficients without being asked to."""
    levels = [next(c for c in fit.candidates if c.name.startswith("this model")).p_value for fit in fits]
    # 60 values of a uniform variable: mean 0.5 +- 0.037, share below 0.1 is 0.1 +- 0.039; three sigma each.
    assert np.mean(levels) == pytest.approx(0.5, abs=0.12)
    assert np.mean(np.array(levels) < 0.1) < 0.22


def test_comparison_shows_whether_cross_terms_are_needed(coupled_response) -> None:
    response = coupled_response(1e-8, np.random.default_rng(5))
    (fit,) = identify(response, FitSettings("rotor-2dof-direct", mass=0.92, compare=True))
    assert fit.candidates[0].name == "rotor-2dof" and "other-model" in codes(fit)
    (full,) = identify(response, FitSettings("rotor-2dof", mass=0.92, compare=True))
    assert full.candidates[0].name == "this model: rotor-2dof" and "other-model" not in codes(full)


def test_without_noise_nothing_is_compared(coupled_response) -> None:
    (fit,) = identify(coupled_response(), FitSettings("rotor-2dof", mass=0.92, compare=True))
    assert fit.candidates == ()


def test_a_mass_among_the_given_coefficients_gives_the_resonance(sdof_response) -> None:
    """sqrt(k / m) / 2 pi and c / 2 sqrt(k m) of the pedestal; of two given numbers f_n is not a result."""
    f_n = np.sqrt(134.5e3 / 0.79) / (2 * np.pi)
    (fit,) = identify(sdof_response(), FitSettings("sdof", fixed=(("m", 0.79),)))
    assert fit.parameter("f_n").value == pytest.approx(f_n, rel=1e-9)
    (fit,) = identify(sdof_response(), FitSettings("sdof", mass=0.79, fixed=(("k", 134.5e3),)))
    assert fit.parameter("zeta").value == pytest.approx(3.682 / (2 * np.sqrt(134.5e3 * 0.79)), rel=1e-9)
    assert "f_n" not in {parameter.name for parameter in fit.parameters}


def test_a_fixed_mass_is_taken_for_granted_like_a_given_one(sdof_response) -> None:
    """Beside the resonance, at 65.7 Hz, the band need not hold it; and nothing is left to attach to."""
    given = replace(PEDESTAL, mass=0.79), replace(PEDESTAL, fixed=(("m", 0.79),))
    fits = [identify(sdof_response(1e-9, np.random.default_rng(1)), settings)[0] for settings in given]
    assert fits[0].not_stated == fits[1].not_stated
    assert [fit.findings for fit in fits] == [(), ()]


SUPPORTED = {"subtract": Support(Uncertain(10e3), Uncertain(4.0)), "share": 2}


def test_given_coefficients_are_those_of_one_bearing_like_all_others(coupled_response) -> None:
    """(180 - 10) / 2 and 25 / 2 kN/m of the coupled support, whether they are given or fitted."""
    given = (("k_xx", 180e3), ("k_xy", 25e3))
    (fit,) = identify(coupled_response(), FitSettings("rotor-2dof", mass=0.92, fixed=given, **SUPPORTED))
    found = {parameter.name: parameter for parameter in fit.parameters}
    assert (found["k_xx"].value, found["k_xx_total"].value) == (85e3, 180e3)
    assert (found["k_xy"].value, found["k_xy_total"].value) == (12.5e3, 25e3)
    assert found["k_xx"].std_error is None and found["k_yy"].value == pytest.approx(100e3, rel=1e-6)


def test_the_support_is_no_part_of_a_cross_term_tied_to_a_direct_one(coupled_response) -> None:
    tied = (("k_xx", "k_xy"), ("k_xx", "k_yy"))
    (fit,) = identify(coupled_response(), FitSettings("rotor-2dof", mass=0.92, tied=tied, **SUPPORTED))
    whole = fit.parameter("k_xx_total").value
    # Both groups have the one value, and all of their coefficients are in the result.
    assert [fit.parameter(f"k_{place}_total").value for place in ("xy", "yy")] == [whole, whole]
    assert fit.parameter("k_yy").value == fit.parameter("k_xx").value == (whole - 10e3) / 2
    assert fit.parameter("k_xy").value == whole / 2


def test_proportional_damping_is_that_of_one_bearing(three_dof_response) -> None:
    """C = 0.05 M + 0.1 K: (c_1_1 - 4) / 2 and c_1_2 / 2 of (0.05 * 1 + 0.1 * 2) and -0.1 N.s/m."""
    response = three_dof_response(damping=0.05 * MASS + DAMPING)
    (fit,) = identify(response, replace(RAYLEIGH, **SUPPORTED))
    assert fit.parameter("c_1_1").value == pytest.approx((0.25 - 4.0) / 2, rel=1e-6)
    assert fit.parameter("c_1_2").value == pytest.approx(-0.05, rel=1e-6)
    assert fit.parameter("c_1_1_total").value == pytest.approx(0.25, rel=1e-6)
