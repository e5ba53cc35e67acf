"""What a fit says about itself."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from labpipe.estimation.diagnostics import collinear_group, estimate_findings
from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import FitSettings
from labpipe.estimation.statistics import Estimate, condition_number, inflation_factors
from labpipe.records.identification import Goodness

EIGHT = FitSettings("rotor-2dof", mass=0.92, name="eight")


def codes(response, settings: FitSettings) -> list[str]:
    (fit,) = identify(response, settings)
    return [finding.code for finding in fit.findings]


@pytest.mark.parametrize("estimator", ["ls", "ml"])
@pytest.mark.parametrize("noise", [3e-9, 3e-8, 2e-7])
def test_one_direction_on_a_symmetric_rig_is_collinear_however_good_the_fit(
    symmetric_response, estimator: str, noise: float
) -> None:
    """|H| is near 8e-6 m/N: the noise is 0.04 %, 0.4 % and 2.5 %."""
    response = symmetric_response(noise, np.random.default_rng(1))
    (fit,) = identify(response, replace(EIGHT, estimator=estimator, band=(65.0, 80.0)))
    assert fit.gof.r2_adjusted > 0.99
    (message,) = [finding.message for finding in fit.findings if finding.code == "collinear"]
    assert all(
        name in message for name in ("k_xx", "k_xy", "k_yx", "k_yy", "second, independent force direction")
    )


@pytest.mark.parametrize("estimator", ["ls", "ml"])
@pytest.mark.parametrize("noise", [3e-9, 2e-7])
def test_two_directions_are_not(coupled_response, estimator: str, noise: float) -> None:
    assert "collinear" not in codes(
        coupled_response(noise, np.random.default_rng(1)), replace(EIGHT, estimator=estimator)
    )


@pytest.mark.long
def test_intervals_of_all_eight_coefficients_hold_the_truth(coupled_response) -> None:
    """60 repeats x 8 coefficients: a 95 % interval holds the truth in 95 % +- 2 % of 480 cases (two sigma,
    binomial).
    """
    rng = np.random.default_rng(2)
    truth = {
        "k_xx": 180e3,
        "k_xy": 25e3,
        "k_yx": -18e3,
        "k_yy": 210e3,
        "c_xx": 120,
        "c_xy": 15,
        "c_yx": -10,
        "c_yy": 150,
    }
    fits = [identify(coupled_response(2e-8, rng), EIGHT)[0] for _ in range(60)]
    inside = [f.parameter(n).ci95[0] <= v <= f.parameter(n).ci95[1] for f in fits for n, v in truth.items()]
    assert 0.93 <= np.mean(inside) <= 0.97
    assert sum(finding.code == "collinear" for fit in fits for finding in fit.findings) == 0


def test_a_model_that_lacks_something_is_said(coupled_response) -> None:
    # The cross-coupled support fitted with direct coefficients only.
    response = coupled_response(2e-8, np.random.default_rng(2))
    assert "model-mismatch" in codes(response, FitSettings("rotor-2dof-direct", mass=0.92))


def test_few_lines_and_low_coherence(sdof_response) -> None:
    response = sdof_response(1e-6, np.random.default_rng(2))
    settings = FitSettings("sdof", mass=0.79)
    assert "few-lines" in codes(response, replace(settings, band=(65.0, 65.6)))
    poor = replace(response, coherence=np.full(response.matrix.shape, 0.5))
    assert "low-coherence" in codes(poor, settings)
    assert "low-coherence" in codes(sdof_response(1e-4, np.random.default_rng(2)), settings)


def test_low_coherence_counts_by_power_not_by_lines(sdof_response) -> None:
    """Half of the lines incoherent, but weak ones: at 60-70 Hz the resonance at 65.67 Hz has nearly all
    power. At the peak it counts.
    """
    response = sdof_response(1e-6, np.random.default_rng(2))
    settings = FitSettings("sdof", mass=0.79)
    power = np.abs(response.matrix[:, 0, 0]) ** 2
    weak = np.argsort(power)[: power.size // 2]
    peak = np.argsort(power)[-1:]
    for lines, said in ((weak, False), (peak, True)):
        coherence = np.full(response.matrix.shape, 0.999)
        coherence[lines] = 0.5
        # A line of coherence 1/2 holds as much noise as motion: its power counts once in the noise and twice
        # in the whole.
        noise, motion = float(power[lines].sum()), float(power.sum())
        assert (noise / (noise + motion) > 0.1) is said
        for quality in ({"coherence": coherence}, {"multiple_coherence": coherence[:, :, 0]}):
            assert ("low-coherence" in codes(replace(response, **quality), settings)) is said


def test_a_negative_stiffness_is_called_unphysical(sdof_response) -> None:
    response = sdof_response(1e-9, np.random.default_rng(2))
    assert "unphysical" in codes(
        replace(response, matrix=-response.matrix), FitSettings("sdof", mass="estimate")
    )


def test_an_overdamped_fit_is_called_unphysical(sdof_response) -> None:
    assert "unphysical" in codes(
        sdof_response(1e-10, np.random.default_rng(2), c=2000.0), FitSettings("sdof", mass=0.79)
    )


def test_condition_and_inflation_closed_forms() -> None:
    # Two columns of length 1 at an angle with cosine r: singular values sqrt(1 +- r), inflation 1 / (1 -
    # r^2).
    r = 0.8
    design = np.array([[1.0, r], [0.0, np.sqrt(1 - r**2)]])
    assert condition_number(design) == pytest.approx(np.sqrt((1 + r) / (1 - r)))
    np.testing.assert_allclose(inflation_factors(design), 1 / (1 - r**2))


def test_only_the_entangled_parameters_are_named() -> None:
    design = np.array([[1.0, 1.0, 0.0], [0.0, 1e-4, 0.0], [0.0, 0.0, 1.0]])
    assert collinear_group(design / np.linalg.norm(design, axis=0), ["a", "b", "c"]) == ["a", "b"]


@pytest.mark.long
def test_correlated_columns_that_do_no_harm_are_no_warning(three_dof_response, sdof_response) -> None:
    """k and m of a resonance, and the entries of K, stand on columns alike (condition above 100) but are
    known well.
    """
    directions = 10
    (resonance,) = identify(sdof_response(1e-7, np.random.default_rng(1)), FitSettings("sdof"))
    (three,) = identify(
        three_dof_response(0.05, np.random.default_rng(1)),
        FitSettings("mdof", mass=(1.0, 2.0, 3.0), symmetric=True),
    )
    for fit in (resonance, three):
        assert fit.condition_number > 100
        assert "collinear" not in [finding.code for finding in fit.findings]
    # A systematic error of 1 % of the FRF, the worst of many directions, moves k by less than 2 %: the
    # amplification is below 2.
    rng = np.random.default_rng(2)
    plain = sdof_response(1e-9)
    shifts = []
    for _ in range(directions):
        error = rng.normal(size=(2, 21)) * np.abs(plain.matrix[:, 0, 0])
        error = 0.01 * error / np.linalg.norm(error) * np.linalg.norm(plain.matrix)
        (fit,) = identify(
            replace(plain, matrix=plain.matrix + (error[0] + 1j * error[1])[:, None, None]),
            FitSettings("sdof"),
        )
        shifts.append(abs(fit.parameter("k").as_fitted.value / 134.5e3 - 1))
    assert max(shifts) < 0.02


def stated(message: str, pattern: str) -> float:
    """The number that a message states, about or in digits."""
    (number,) = re.findall(pattern + r" (?:about )?([0-9.e+]+)", message)
    return float(number)


@pytest.mark.parametrize("estimator", ["ls", "iv", "ml"])
def test_growth_of_errors_does_not_depend_on_units(symmetric_response, estimator: str) -> None:
    """In other units the condition number is the same up to rounding, some hundred operations of 2e-16 each,
    grown by its square.

    For iv that is some per cent of 1.4e6; a unit that is not taken out would show as a factor of 1000.
    """
    response = symmetric_response(1e-9, np.random.default_rng(3))
    conditions, growths = [], []
    for scale in (1.0, 1e3):
        scaled = replace(response, matrix=scale * response.matrix, covariance=scale**2 * response.covariance)
        (fit,) = identify(scaled, FitSettings("rotor-2dof", mass=0.92 / scale, estimator=estimator))
        (finding,) = [finding for finding in fit.findings if finding.code == "collinear"]
        conditions.append(fit.condition_number)
        growths.append(stated(finding.message, "systematic error of 1 % in what was measured can become"))
    assert conditions[1] == pytest.approx(conditions[0], rel=100 * np.finfo(float).eps * conditions[0] ** 2)
    # Powers of ten: two numbers that differ by rounding may stand on both sides of one edge.
    assert growths[0] > 1e3 and 0.1 <= growths[1] / growths[0] <= 10


def nearly_parallel(angle: float) -> Estimate:
    """Two unit columns at a small *angle*: condition number cot(angle / 2).

    Both values may change by the same amplification.
    """
    triangle = np.array([[1.0, np.cos(angle)], [0.0, np.sin(angle)]])
    gof = Goodness(1.0, 1.0)
    return Estimate(
        values=np.ones(2),
        covariance=np.eye(2),
        scaled_design=triangle,
        gof=gof,
        dof=100,
        amplification=np.full(2, 2 / angle),
    )


@pytest.mark.parametrize(
    ("angle", "condition", "growth"),
    [
        (0.01, "200", "200"),
        (1e-3, "2e+03", "2e+03"),
        (1e-5, "about 1e5", "about 1e5"),
        (2e-7, "about 1e7", "about 1e7"),
    ],
)
def test_numbers_beyond_rounding_are_written_as_powers_of_ten(
    angle: float, condition: str, growth: str
) -> None:
    """cot(angle / 2) is 2 / angle for small angles: 200, 2000, 2e5 (10^5.3) and 1e7."""
    (finding,) = estimate_findings(nearly_parallel(angle), ["k", "c"], 100, ["N/m", "N.s/m"])
    assert f"(condition number {condition}, limit 30)" in finding.message
    assert f"can become {growth} % in them" in finding.message


def test_columns_that_are_one_have_an_infinite_condition() -> None:
    estimate = replace(
        nearly_parallel(0.01), scaled_design=np.ones((2, 2)) / np.sqrt(2), amplification=np.full(2, np.inf)
    )
    (finding,) = estimate_findings(estimate, ["k", "c"], 100, ["N/m", "N.s/m"])
    assert "can become inf % in them" in finding.message
