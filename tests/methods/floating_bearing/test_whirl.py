"""Whirl, crossover, effective and synchronous coefficients against their closed forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labpipe.errors import ConfigError
from labpipe.methods.floating_bearing.forms import FORMS, StiffnessModel
from labpipe.methods.floating_bearing.values import (
    LIMIT,
    FittedStiffness,
    Shaft,
    Valued,
    crossover,
    derived_values,
    effective,
    whirl,
)
from labpipe.records.finding import Parameter
from labpipe.records.uncertain import Uncertain
from tests.methods.floating_bearing.floating_rig import JOURNAL, SEAL, kcm
from tests.methods.floating_bearing.test_fit import EVEN, GIVEN, drawn, fitted

KC, KCM = (StiffnessModel(FORMS[name], "none") for name in ("kc", "kcm"))
OMEGA = 2 * np.pi * np.arange(20.0, 200.0, 2.0)


def numbers(matrices: dict[str, list[list[float]]], letters: str = "kcm") -> np.ndarray:
    return np.concatenate([np.ravel(matrices[letter]) for letter in letters])


def some_covariance(values: np.ndarray, share: float) -> np.ndarray:
    mixing = np.random.default_rng(1).normal(size=(values.size, values.size)) / np.sqrt(values.size)
    return (np.diag(np.abs(values)) * share) @ mixing @ mixing.T @ (np.diag(np.abs(values)) * share)


def test_a_seal_without_mass_whirls_at_cross_stiffness_over_damping() -> None:
    """K = k I + q J, C = c I: w = q / c, and the rotor then feels k."""
    model = StiffnessModel(FORMS["kc"], "seal")
    found = whirl(model, np.array([5e6, 2.4e6, 4.2e4, 0.0]), np.eye(4))
    assert np.sqrt(found.square) == pytest.approx(2.4e6 / 4.2e4) and found.stiffness == pytest.approx(5e6)


def test_without_mass_it_is_the_textbook_formula() -> None:
    """Lund 1987 in eight coefficients, by hand."""
    (kxx, kxy), (kyx, kyy) = JOURNAL["k"]
    (cxx, cxy), (cyx, cyy) = JOURNAL["c"]
    k = (kxx * cyy + kyy * cxx - kxy * cyx - kyx * cxy) / (cxx + cyy)
    square = ((k - kxx) * (k - kyy) - kxy * kyx) / (cxx * cyy - cxy * cyx)
    found = whirl(KC, numbers(JOURNAL, "kc"), np.eye(8))
    assert (found.square, found.stiffness) == pytest.approx((square, k), rel=1e-12)


@pytest.mark.parametrize("bearing", [SEAL, JOURNAL])
def test_with_mass_the_determinant_vanishes(bearing: dict[str, list[list[float]]]) -> None:
    """det(K - k I + jwC - w^2 M) = 0 for the real k and w found."""
    found = whirl(KCM, numbers(bearing), np.eye(12))
    w = np.array([np.sqrt(found.square)])
    at = kcm(**bearing)(w)[0] - found.stiffness * np.eye(2)
    assert abs(np.linalg.det(at)) < 1e-9 * np.max(np.abs(at)) ** 2


def test_slopes_are_those_of_differences() -> None:
    values, covariance = numbers(SEAL), some_covariance(numbers(SEAL), 0.01)
    found = whirl(KCM, values, covariance)
    for number in range(12):
        step = np.zeros(12)
        step[number] = 1e-6 * abs(values[number])
        up, down = (whirl(KCM, values + sign * step, covariance) for sign in (1, -1))
        size = abs(values[number])
        square, stiffness = (up.square - down.square) / 2e-6, (up.stiffness - down.stiffness) / 2e-6
        assert found.slopes[number] * size == pytest.approx(square, rel=1e-5, abs=1e-7 * found.square)
        assert found.stiffness_slopes[number] * size == pytest.approx(
            stiffness, rel=1e-5, abs=1e-7 * found.stiffness
        )


def test_the_interval_is_fiellers() -> None:
    """K = q J, C = c I: w^2 = (q / c)^2. phi = q^2 - c^2 x.

    Its ends solve phi^2 = 1.96^2 var phi, var by the slopes 2 q and -2 c x.
    """
    model = StiffnessModel(FORMS["kc"], "seal")
    q, c, sq, sc = 2.4e6, 4.2e4, 4e5, 4e3
    found = whirl(model, np.array([0.0, q, c, 0.0]), np.diag([0.0, sq**2, sc**2, 0.0]))
    for end in found.interval:
        # The quadratic is taken with the slopes at the estimates.
        assert (q**2 - c**2 * end) ** 2 == pytest.approx(
            LIMIT**2 * ((2 * q * sq) ** 2 + (2 * c * end * sc) ** 2), rel=1e-6
        )
    assert found.interval[1] - found.square > 1.2 * (found.square - found.interval[0])


def test_small_errors_give_the_interval_of_first_order() -> None:
    values, covariance = numbers(SEAL), some_covariance(numbers(SEAL), 1e-4)
    found = whirl(KCM, values, covariance)
    error = np.sqrt(found.slopes @ covariance @ found.slopes)
    assert np.subtract(found.interval, found.square) == pytest.approx(
        [-LIMIT * error, LIMIT * error], rel=5e-3
    )


def test_cross_stiffness_of_one_sign_does_not_whirl() -> None:
    """K_xy K_yx > 0 as of an orthotropic bearing under 45 deg: the square is negative, and no ratio is given
    but words.
    """
    still = kcm([[5e6, 1e6], [1e6, 5e6]], [[4.2e4, 0.0], [0.0, 4.2e4]], SEAL["m"])
    fit = fitted(drawn(replace(EVEN, bearing=still)), **GIVEN)
    assert "whirl_frequency_ratio" not in [p.name for p in fit.parameters]
    (finding,) = [f for f in fit.findings if f.code == "no-whirl"]
    assert finding.level == "note" and "there is no whirl: the square" in finding.message


def test_damping_of_a_forward_orbit_and_where_it_changes_sign() -> None:
    """C_eff = (C_xx + C_yy) / 2 - (K_xy - K_yx - w^2 (M_xy - M_yx)) / (2 w).

    Zero at the root of the quadratic.
    """
    values, covariance = numbers(SEAL), some_covariance(numbers(SEAL), 1e-3)
    course = effective(KCM, values, covariance, OMEGA)
    by_hand = 4.2e4 - (4.8e6 - OMEGA**2 * 4.0) / (2 * OMEGA)
    assert course.damping == pytest.approx(by_hand, rel=1e-9) and course.stiffness == pytest.approx(
        5e6 - 45 * OMEGA**2 + 8e3 * OMEGA
    )
    slopes = np.array(
        [0, -1, 1, 0, *(np.array([1, 0, 0, 1]) * OMEGA[3]), 0, OMEGA[3] ** 2, -(OMEGA[3] ** 2), 0]
    ) / (2 * OMEGA[3])
    assert course.damping_error[3] == pytest.approx(np.sqrt(slopes @ covariance @ slopes), rel=1e-9)
    found = crossover(KCM, values, covariance, OMEGA)
    assert found.omega == pytest.approx(max(np.roots([4.0, 2 * 4.2e4, -4.8e6])), rel=1e-5)
    error = np.sqrt(found.slopes @ covariance @ found.slopes)
    assert np.subtract(found.interval, found.omega) == pytest.approx(
        [-LIMIT * error, LIMIT * error], rel=0.02
    )


def test_a_shaft_that_turns_the_other_way_swaps_the_cross_terms() -> None:
    backward = {letter: np.transpose(matrix).tolist() for letter, matrix in SEAL.items()}
    forward_values, values = numbers(SEAL), numbers(backward)
    one, other = (
        effective(KCM, forward_values, np.eye(12), OMEGA),
        effective(KCM, values, np.eye(12), OMEGA, -1.0),
    )
    assert other.damping == pytest.approx(one.damping) and Shaft(-50.0).sense == -1
    assert crossover(KCM, values, np.eye(12), OMEGA) is None


def named(valued: tuple[Valued, ...]) -> dict[str, Parameter]:
    return {one.parameter.name: one.parameter for one in valued}


def test_coefficients_at_the_speed_and_the_onset_speed() -> None:
    """At w = W: K_xx - W^2 M_xx. A short bearing, k_xy = c W / 2 at every speed: a rotor m on it is unstable
    from W = 2 sqrt(k / m) on.
    """
    speed = 50.0
    values = numbers(SEAL)
    found = FittedStiffness(KCM, values, 1e-6 * np.diag(values**2), 2e-6 * np.diag(values**2), 700)
    shown = named(derived_values(found, OMEGA, Shaft(speed))[0])
    w = 2 * np.pi * speed
    assert shown["k_xx_synchronous"].value == pytest.approx(5e6 - 45 * w**2) and shown[
        "c_yx_synchronous"
    ].value == pytest.approx(-8e3)
    assert shown["k_xx_synchronous"].std_error == pytest.approx(1e-3 * np.hypot(5e6, 45 * w**2), rel=1e-9)
    assert "k_xx_synchronous" not in named(derived_values(found, OMEGA, Shaft(5.0))[0])
    k, c, m = 5e6, 4.2e4, 80.0
    short = FittedStiffness(
        KC, np.array([k, c * w / 2, -c * w / 2, k, c, 0, 0, c]), 1e-6 * np.eye(8), 1e-6 * np.eye(8), 700
    )
    onset = named(derived_values(short, OMEGA, Shaft(speed, Uncertain(m, 0.8)))[0])["onset_speed"]
    assert onset.value == pytest.approx(2 * np.sqrt(k / m) / (2 * np.pi), rel=1e-9)
    assert onset.std_error_inflated == pytest.approx(onset.value * 0.005, rel=1e-6)

    def growth(turns: float) -> float:
        """Largest real part of the eigenvalues of m x'' + C x' + K(W) x = 0."""
        cross = c * 2 * np.pi * turns / 2
        lower = np.hstack([-np.array([[k, cross], [-cross, k]]) / m, -c / m * np.eye(2)])
        return float(
            np.max(np.linalg.eigvals(np.vstack([np.hstack([np.zeros((2, 2)), np.eye(2)]), lower])).real)
        )

    assert growth(0.999 * onset.value) < 0 < growth(1.001 * onset.value)
    soft = named(derived_values(short, OMEGA, Shaft(speed, Uncertain(m), k))[0])["onset_speed"]
    assert soft.value == pytest.approx(onset.value / np.sqrt(2))


def test_the_ratio_of_a_fit_is_over_the_speed_of_its_test() -> None:
    by_condition, by_setting = fitted(drawn(), **GIVEN), fitted(drawn(), speed="1500 rpm", **GIVEN)
    ratios = [fit.parameter("whirl_frequency_ratio") for fit in (by_condition, by_setting)]
    assert ratios[1].value == pytest.approx(2 * ratios[0].value, rel=1e-12)
    truth = np.sqrt(whirl(KCM, numbers(SEAL), np.eye(12)).square) / (2 * np.pi * 50)
    assert ratios[0].ci95[0] < truth < ratios[0].ci95[1] and ratios[0].derived


def test_intervals_of_few_lines_are_as_wide_as_those_of_the_coefficients() -> None:
    """Three lines of one run: t with 4 degrees of freedom, 2.78, where 1.96 stood."""
    fit = fitted(
        drawn(replace(EVEN, excitation="zipper")), **GIVEN, form="kc", speed="50 Hz", band=(20.0, 25.0)
    )
    damping, ratio = fit.parameter("c_xx"), fit.parameter("whirl_frequency_ratio")
    assert fit.dof == 4
    limit = (damping.ci95[1] - damping.ci95[0]) / damping.full_error
    assert (ratio.ci95[1] - ratio.ci95[0]) / ratio.full_error == pytest.approx(limit, rel=0.1)


def test_coefficients_without_dimension() -> None:
    """By hand: k c / W, c c w / W, m c w^2 / W.

    S = mu N L D / W (R / c)^2 = 0.01 50 0.05 0.1 / 1000 (0.05 / 1e-4)^2 = 0.625.
    """
    bearing = {
        "load": "1 kN",
        "clearance": "100 um",
        "viscosity": "10 mPa.s",
        "diameter": "100 mm",
        "length": "50 mm",
    }
    fit = fitted(drawn(), **GIVEN, **bearing)
    for letter, factor in zip("kcm", 1e-7 * (100 * np.pi) ** np.arange(3), strict=True):
        plain, scaled = fit.parameter(f"{letter}_xy"), fit.parameter(f"{letter}_xy_dimensionless")
        assert (scaled.value, scaled.std_error) == pytest.approx(
            (factor * plain.value, factor * plain.std_error)
        )
        assert scaled.ci95 == pytest.approx(tuple(factor * end for end in plain.ci95)) and scaled.derived
    assert fit.parameter("sommerfeld").value == pytest.approx(0.625)
    rig = replace(EVEN, conditions={"speed": "3000 rpm", "load": "1 kN"})
    by_condition = fitted(drawn(rig), clearance="100 um", **GIVEN)
    assert by_condition.parameter("k_xx_dimensionless").value == pytest.approx(
        fit.parameter("k_xx_dimensionless").value
    )
    against = fitted(
        drawn(replace(rig, conditions={"speed": "3000 rpm", "load": "-1 kN"})), **GIVEN, clearance=1e-4
    )
    one, other = (each.parameter("k_xx_dimensionless") for each in (against, by_condition))
    assert one.value == pytest.approx(other.value) and one.ci95 == pytest.approx(other.ci95)
    assert not any("without dimension" in note for note in by_condition.notes)
    vague = fitted(
        drawn(replace(rig, conditions={"speed": "3000 rpm", "load": "1 kN +- 10 %"})), **GIVEN, clearance=1e-4
    )
    assert any("without the uncertainty of the condition load: 1 kN +- 10 %." in n for n in vague.notes)
    idle = fitted(drawn(), **GIVEN, clearance=1e-4, rotor_mass="90 kg", symmetry="direct")
    assert sum("no coefficients without dimension" in n or "no onset speed" in n for n in idle.notes) == 2
    with pytest.raises(ConfigError, match=r"conditions\.speed"):
        fitted(drawn(replace(EVEN, conditions={"speed": "fast"})), **GIVEN)
