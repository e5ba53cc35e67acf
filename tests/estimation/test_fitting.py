"""identify: noise-free recovery, scale, bands, corrections, elimination. Truth: the closed-form receptances
of conftest.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from labpipe.errors import ConfigError, FitError
from labpipe.estimation.fitting import identify, sliding_bands
from labpipe.estimation.model import DynamicModel, Setup
from labpipe.estimation.settings import ESTIMATORS, MODELS, FitSettings, Sliding, Support, model_kind
from labpipe.records.finding import NOTE
from labpipe.records.response import FrequencyResponse
from labpipe.records.uncertain import Uncertain

SDOF = FitSettings("sdof", mass=0.79, name="pedestal")


def values(response: FrequencyResponse, settings: FitSettings) -> dict[str, float]:
    (fit,) = identify(response, settings)
    return {parameter.name: parameter.value for parameter in fit.parameters}


@pytest.mark.parametrize("estimator", list(ESTIMATORS))
@pytest.mark.parametrize("form", ["receptance", "mobility", "accelerance"])
def test_sdof_without_noise(sdof_response, estimator: str, form: str) -> None:
    plain = sdof_response()
    factor = (2j * np.pi * plain.frequency) ** {"receptance": 0, "mobility": 1, "accelerance": 2}[form]
    response = replace(plain, matrix=plain.matrix * factor[:, None, None], form=form)
    found = values(response, replace(SDOF, estimator=estimator, mass="estimate"))
    assert found["k"] == pytest.approx(134.5e3, rel=1e-9)
    assert found["c"] == pytest.approx(3.682, rel=1e-7)
    assert found["m"] == pytest.approx(0.79, rel=1e-9)
    # Closed forms: f_n = sqrt(k/m) / 2 pi, zeta = c / (2 sqrt(k m)).
    assert found["f_n"] == pytest.approx(np.sqrt(134.5e3 / 0.79) / (2 * np.pi), rel=1e-9)
    assert found["zeta"] == pytest.approx(3.682 / (2 * np.sqrt(134.5e3 * 0.79)), rel=1e-7)


@pytest.mark.parametrize("estimator", [name for name in ESTIMATORS if name != "amplitude"])
def test_eight_coefficients_from_two_directions_without_noise(coupled_response, estimator: str) -> None:
    found = values(coupled_response(), FitSettings("rotor-2dof", mass=0.92, estimator=estimator))
    expected = {
        "k_xx": 180e3,
        "k_xy": 25e3,
        "k_yx": -18e3,
        "k_yy": 210e3,
        "c_xx": 120,
        "c_xy": 15,
        "c_yx": -10,
        "c_yy": 150,
    }
    assert found == {name: pytest.approx(value, rel=1e-7) for name, value in expected.items()}


def test_one_force_gives_its_factors_and_angle(coupled_response) -> None:
    # A force of 1 N at 30 deg on the coupled support: b = (cos, sin).
    two = coupled_response()
    angle = np.radians(30)
    matrix = two.matrix @ np.array([[np.cos(angle)], [np.sin(angle)]])
    one = FrequencyResponse(
        two.frequency, matrix, two.outputs, (replace(two.inputs[0], angle=None, dof="shaker"),)
    )
    found = values(one, FitSettings("rotor-2dof", mass=0.92, estimator="ls"))
    assert found["b_x"] == pytest.approx(np.cos(angle), rel=1e-7)
    assert found["forcing_angle"] == pytest.approx(angle, rel=1e-7)
    assert found["k_xy"] == pytest.approx(25e3, rel=1e-6)


def test_direct_coefficients_share_the_force(symmetric_response) -> None:
    found = values(symmetric_response(), FitSettings("rotor-2dof-direct", mass=0.92, band=(65.0, 80.0)))
    assert [found[name] for name in ("k_xx", "c_xx", "k_yy", "c_yy")] == pytest.approx(
        [180e3, 190, 180e3, 190], rel=1e-8
    )
    only_y = values(
        symmetric_response(), FitSettings("rotor-2dof-direct", mass=0.92, output=("y",), band=(65.0, 80.0))
    )
    assert set(only_y) == {"k_yy", "c_yy"}


@pytest.mark.parametrize("estimator", list(ESTIMATORS))
@pytest.mark.parametrize("scale", [1e-7, 1e3])
def test_the_scale_of_the_receptance_changes_no_relative_result(
    sdof_response, estimator: str, scale: float
) -> None:
    settings = replace(SDOF, estimator=estimator, mass="estimate")
    (plain,) = identify(sdof_response(1e-6, np.random.default_rng(1)), settings)
    (scaled,) = identify(sdof_response(1e-6, np.random.default_rng(1), scale=scale), settings)
    for one, other in zip(plain.parameters, scaled.parameters, strict=True):
        factor = scale if one.name in ("k", "c", "m") else 1.0
        assert other.value * factor == pytest.approx(one.value, rel=1e-6)
        assert other.std_error * factor == pytest.approx(one.std_error, rel=1e-5)
    assert scaled.gof.r2 == pytest.approx(plain.gof.r2, rel=1e-8)


def test_sliding_bands_of_the_source() -> None:
    # Lim et al. 2009, section 5.1: 15 Hz every 3 Hz up to 250 Hz gives 79 sets.
    bands = sliding_bands((1.0, 250.0), 15.0, 3.0)
    assert (len(bands), bands[0], bands[-1]) == (79, (1.0, 16.0), (235.0, 250.0))
    with pytest.raises(ConfigError, match="no band of 15 Hz fits"):
        sliding_bands((1.0, 10.0), 15.0, 3.0)


def test_every_sliding_band_has_its_fifteen_lines_and_warns_of_nothing(symmetric_response) -> None:
    settings = FitSettings(
        "rotor-2dof-direct", mass=0.92, output=("y",), sliding=Sliding(15.0, 3.0), name="sliding"
    )
    fits = identify(symmetric_response(1e-9, np.random.default_rng(3)), settings)
    assert len(fits) == 79 and {fit.lines for fit in fits} == {15} and fits[0].centre_hz == 8.5
    codes = [finding.code for fit in fits for finding in fit.findings]
    # 5 % of the bands miss their 95 % intervals by definition; nothing but chance may warn.
    assert codes.count("collinear") == 0 and codes.count("model-mismatch") <= 4


def test_edges_of_a_single_band_belong_to_it(sdof_response) -> None:
    (fit,) = identify(sdof_response(), replace(SDOF, band=(62.0, 66.0), estimator="ls"))
    assert (fit.lines, fit.equations, fit.dof) == (9, 18, 16)


@pytest.mark.parametrize(
    ("band", "said"), [((59.5, 71.0), False), ((58.0, 70.0), True), ((60.0, 5000.0), True), (None, False)]
)
def test_a_band_far_beyond_the_lines_is_said(sdof_response, band, said: bool) -> None:
    """Lines from 60 to 70 Hz: of 11.5 Hz 1 lies beyond them, of 12 Hz 2, of 4940 Hz nearly all."""
    (fit,) = identify(sdof_response(), replace(SDOF, band=band, estimator="ls"))
    messages = [finding.message for finding in fit.findings if finding.code == "band-beyond"]
    assert len(messages) == said and all("from 60 to 70 Hz" in message for message in messages)


def test_support_is_subtracted_and_the_rest_shared_with_its_uncertainty(sdof_response) -> None:
    response = sdof_response(1e-6, np.random.default_rng(2))
    (total,) = identify(response, SDOF)
    support = Support(Uncertain(34.5e3, 200.0), Uncertain(1.0, 0.2))
    (fit,) = identify(response, replace(SDOF, subtract=support, share=2))
    k, k_total = fit.parameter("k"), total.parameter("k")
    assert k.value == pytest.approx((k_total.value - 34.5e3) / 2, rel=1e-12)
    assert k.std_error == pytest.approx(k_total.std_error / 2, rel=1e-9)
    assert k.combined == pytest.approx(np.hypot(k_total.std_error, 200.0) / 2, rel=1e-6)
    assert fit.budget is not None and [source.unit for source in fit.budget.sources] == ["N/m", "N.s/m"]
    assert fit.parameter("c").value == pytest.approx((total.parameter("c").value - 1.0) / 2)
    assert fit.parameter("k_total").value == k_total.value
    assert fit.parameter("f_n").value == total.parameter("f_n").value


@pytest.mark.long
def test_elimination_drops_what_is_not_there(coupled_response) -> None:
    response = coupled_response(1e-8, np.random.default_rng(5))
    diagonal = np.linalg.inv(response.matrix)
    diagonal[:, 0, 1] = diagonal[:, 1, 0] = 0
    noise = response.matrix - coupled_response().matrix
    response = replace(response, matrix=np.linalg.inv(diagonal) + noise)
    (full,) = identify(response, FitSettings("rotor-2dof", mass=0.92))
    (fit,) = identify(response, FitSettings("rotor-2dof", mass=0.92, eliminate=True))
    left = {parameter.name for parameter in fit.parameters}
    assert {"k_xx", "k_yy", "c_xx", "c_yy"} <= left and len(left) < len(full.parameters)
    assert all(parameter.significant for parameter in fit.parameters)
    assert any("was dropped as insignificant" in note for note in fit.notes)


def test_insignificant_damping_is_reported_as_such(sdof_response) -> None:
    # Noise for which the true t-ratio of c lies far below the limit: var(k) = s^2 / (2 sum |H|^4), s.e.(c) =
    # s.e.(k) / w.
    response = sdof_response(2e-6, np.random.default_rng(8), c=0.001)
    (fit,) = identify(response, SDOF)
    assert fit.parameter("c").significant is False and fit.parameter("k").significant is True
    assert [finding.code for finding in fit.findings] == ["insignificant"]


def test_standard_error_of_k_is_its_closed_form(sdof_response) -> None:
    # dH/dk = -H^2, dH/dc = -j w H^2: k and c are orthogonal, so var(k) = s^2 / (2 sum |H|^4).
    response = sdof_response(1e-6)
    (fit,) = identify(response, SDOF)
    expected = 1e-6 / np.sqrt(2 * np.sum(np.abs(response.matrix) ** 4))
    assert fit.parameter("k").std_error == pytest.approx(expected, rel=1e-6)


def test_ls_equals_the_literal_regression_line_by_line(coupled_response, rng: np.random.Generator) -> None:
    """Twin: the x row of the equation of motion under two known forces, one pair of equations after the
    other.
    """
    response = coupled_response(1e-7, rng)
    rows, side = [], []
    for line, frequency in enumerate(response.frequency):
        w = 2 * np.pi * frequency
        for force in range(2):
            gx, gy = response.matrix[line, :, force]
            equation = [gx, gy, 1j * w * gx, 1j * w * gy]
            known = 0.92 * w**2 * gx + (1.0 if force == 0 else 0.0)
            rows += [[v.real for v in equation], [v.imag for v in equation]]
            side += [known.real, known.imag]
    rows, side = np.array(rows), np.array(side)
    solution, residual, *_ = np.linalg.lstsq(rows, side)
    covariance = residual[0] / (len(side) - 4) * np.linalg.inv(rows.T @ rows)
    (fit,) = identify(response, FitSettings("rotor-2dof", mass=0.92, estimator="ls"))
    for number, name in enumerate(("k_xx", "k_xy", "c_xx", "c_xy")):
        assert fit.parameter(name).value == pytest.approx(solution[number], rel=1e-8)
        assert fit.parameter(name).std_error == pytest.approx(np.sqrt(covariance[number, number]), rel=1e-6)


def test_interval_and_significance_follow_student(sdof_response) -> None:
    (fit,) = identify(sdof_response(1e-6, np.random.default_rng(4)), SDOF)
    k = fit.parameter("k")
    quantile = stats.t.ppf(0.975, fit.dof)
    assert k.ci95 == pytest.approx((k.value - quantile * k.std_error, k.value + quantile * k.std_error))
    assert k.t_ratio == pytest.approx(k.value / k.std_error)


def model_of(name: str, response: FrequencyResponse) -> DynamicModel:
    return MODELS[name].model(Setup(response.outputs, response.inputs, FitSettings(name, mass=0.92)))


@pytest.mark.parametrize("name", [name for name in MODELS if not model_kind(name).section])
def test_jacobian_equals_central_differences(
    name: str, sdof_response, coupled_response, symmetric_response
) -> None:
    responses = {
        "sdof": sdof_response,
        "base": sdof_response,
        "rotor-2dof": coupled_response,
        "rotor-2dof-direct": symmetric_response,
        "mdof": coupled_response,
    }
    response = responses[name]()
    model = model_of(name, response)
    start = np.array(
        [
            {"N/m": 2e5, "N.s/m": 100.0, "1": 0.7, "kg": 1.0, "1/s^2": 1e5, "1/s": 50.0}[unit]
            for unit in model.units
        ]
    ) * (1 + 0.1 * np.arange(len(model.terms)))
    omega = 2 * np.pi * np.array([30.0, 65.0, 110.0])
    jacobian = model.jacobian(start, omega)
    for number in range(start.size):
        step = np.zeros_like(start)
        step[number] = 1e-5 * start[number]
        difference = (model.receptance(start + step, omega) - model.receptance(start - step, omega)) / (
            2 * step[number]
        )
        np.testing.assert_allclose(
            jacobian[number], difference, rtol=1e-6, atol=1e-9 * np.max(np.abs(difference))
        )


def test_ports_answer_to_label_channel_or_dof_and_a_miss_names_the_nearest(coupled_response) -> None:
    response = coupled_response()
    assert "k" in values(response, FitSettings("sdof", mass=0.92, input=("fx",), output=("x",)))
    with pytest.raises(ConfigError, match="no force 'fxx' in the FRF") as caught:
        identify(response, FitSettings("sdof", mass=0.92, input=("fxx",)))
    assert caught.value.hint == "did you mean 'fx'?"
    with pytest.raises(ConfigError, match=r"sdof takes 1 response\(s\), found x, y"):
        identify(response, FitSettings("sdof", mass=0.92))


@pytest.mark.parametrize("averages", [3, 20, np.inf])
def test_one_line_determines_k_and_c_with_errors_by_its_noise(sdof_response, rng, averages: float) -> None:
    """k - m w^2 + j c w = 1 / H: errors |Z|^2 s / sqrt(2), of c over w, and Student's t with two degrees of
    freedom for each complex one of the noise.
    """
    response = sdof_response(2e-8, rng)
    if np.isfinite(averages):
        response = replace(response, covariance_dof=averages - 1)
    (fit,) = identify(response, replace(SDOF, band=(64.9, 65.1), estimator="ml"))
    omega = 2 * np.pi * 65.0
    z = 1 / response.matrix[10, 0, 0]
    error = abs(z) ** 2 * np.sqrt(response.covariance[10, 0, 0].real / 2)
    quantile = stats.t.ppf(0.975, 2 * (averages - 1)) if np.isfinite(averages) else stats.norm.ppf(0.975)
    expected = {"k": (z.real + 0.79 * omega**2, error), "c": (z.imag / omega, error / omega)}
    for name, (value, of_noise) in expected.items():
        parameter = fit.parameter(name)
        assert (parameter.value, parameter.std_error) == pytest.approx((value, of_noise), rel=1e-6)
        assert parameter.ci95[1] - parameter.value == pytest.approx(quantile * of_noise, rel=1e-5)
    assert (fit.dof, fit.gof.chi2_reduced, fit.gof.chi2_p) == (0, None, None)
    assert "exactly determined" in str(fit) and "G.o.F" not in str(fit)
    (finding,) = (finding for finding in fit.findings if finding.code == "few-lines")
    assert finding.level == NOTE and "nothing is left to test the model by" in finding.message


def test_one_line_of_two_directions_determines_eight_coefficients(coupled_response) -> None:
    response = coupled_response(1e-9)
    settings = FitSettings("rotor-2dof", mass=0.92, band=(79.9, 80.1), estimator="ml")
    (fit,) = identify(response, settings)
    found = [fit.parameter(f"k_{place}").value for place in ("xx", "xy", "yx", "yy")]
    assert found == pytest.approx([180e3, 25e3, -18e3, 210e3], rel=1e-6)
    assert fit.dof == 0 and all(parameter.std_error > 0 for parameter in fit.parameters[:8])


def test_what_a_fit_cannot_do_is_said(sdof_response, symmetric_response, coupled_response) -> None:
    with pytest.raises(FitError, match="no frequency line lies in the band"):
        identify(sdof_response(), replace(SDOF, band=(1.0, 2.0)))
    with pytest.raises(FitError, match="2 real equations cannot determine 2 parameters"):
        identify(sdof_response(), replace(SDOF, band=(65.0, 65.2)))
    with pytest.raises(FitError, match="2 real equations cannot determine 2 parameters"):
        identify(sdof_response(1e-8), replace(SDOF, band=(65.0, 65.2), estimator="ls"))
    with pytest.raises(ConfigError, match="needs the known mass"):
        identify(coupled_response(), FitSettings("rotor-2dof"))
    unknown = replace(
        symmetric_response(), inputs=(replace(symmetric_response().inputs[0], angle=None, dof="shaker"),)
    )
    with pytest.raises(ConfigError, match="direction of the force f is unknown"):
        identify(unknown, FitSettings("rotor-2dof-direct", mass=0.92))
    axis = replace(
        symmetric_response(), inputs=(replace(symmetric_response().inputs[0], angle=0.0, dof="x"),)
    )
    with pytest.raises(ConfigError, match="no force acts in direction y"):
        identify(axis, FitSettings("rotor-2dof-direct", mass=0.92))
    silent = sdof_response(1e-6)
    one_line = np.where(np.arange(silent.n_frequency)[:, None, None] == 3, 0, silent.covariance)
    with pytest.raises(FitError, match=r"variance of the FRF is zero at 61\.5 Hz"):
        identify(replace(silent, covariance=one_line), SDOF)
    lines = np.where(np.arange(silent.n_frequency)[:, None, None] >= 3, 0, silent.covariance)
    n = silent.n_frequency
    with pytest.raises(
        FitError, match=rf"zero at 61\.5 Hz and {n - 4} more of {n} lines; a coherence rounded to 1"
    ):
        identify(replace(silent, covariance=lines), SDOF)
    with pytest.raises(FitError, match="linearly dependent"):
        identify(symmetric_response(), FitSettings("rotor-2dof", mass=0.92, estimator="ls"))


@pytest.mark.parametrize("variance", [0.0, 1e-40])
def test_a_response_without_noise_is_fitted_with_equal_weights(sdof_response, variance: float) -> None:
    silent = replace(sdof_response(), covariance=np.full((21, 1, 1), variance))
    (fit,) = identify(silent, SDOF)
    assert fit.parameter("k").value == pytest.approx(134.5e3, rel=1e-9)
    assert fit.gof.chi2_reduced is None
    assert any("all lines have equal weight" in note for note in fit.notes)
