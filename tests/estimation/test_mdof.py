"""mdof on the three-dof benchmark of Knaapen (1997), whose matrices are the expected values."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import linalg

from labpipe.errors import ConfigError
from labpipe.estimation.derived import Estimated, correct, is_direct
from labpipe.estimation.fitting import identify
from labpipe.estimation.linear_models import axes_of, force_direction
from labpipe.estimation.settings import FitSettings, Support
from labpipe.records.identification import Fit
from labpipe.records.response import Port
from labpipe.records.uncertain import Uncertain
from tests.estimation.conftest import DAMPING, MASS, STIFFNESS

KNOWN = FitSettings("mdof", mass=(1.0, 2.0, 3.0), symmetric=True, name="three")
# k and c of a support that is not symmetric, as of a journal bearing; arbitrary.
CROSS_COUPLED = STIFFNESS + np.array([[0.0, 0.3, 0.0], [-0.3, 0.0, 0.1], [0.0, -0.1, 0.0]])


def one(response, settings: FitSettings) -> Fit:  # type: ignore[no-untyped-def]
    (fit,) = identify(response, settings)
    return fit


def matrix(fit: Fit, letter: str) -> np.ndarray:
    """The 3 x 3 matrix of a fit; of a symmetric one the half below the diagonal is filled."""
    values = {parameter.name: parameter.value for parameter in fit.parameters}
    found = np.zeros((3, 3))
    for row in range(3):
        for column in range(3):
            name = f"{letter}_{row + 1}_{column + 1}"
            found[row, column] = values.get(name, values.get(f"{letter}_{column + 1}_{row + 1}", np.nan))
    return found


@pytest.mark.parametrize("estimator", ["ls", "iv", "ml"])
@pytest.mark.parametrize("symmetric", [True, False])
def test_known_mass_without_noise(three_dof_response, estimator: str, symmetric: bool) -> None:
    fit = one(three_dof_response(), replace(KNOWN, estimator=estimator, symmetric=symmetric))
    np.testing.assert_allclose(matrix(fit, "k"), STIFFNESS, atol=1e-9)
    np.testing.assert_allclose(matrix(fit, "c"), DAMPING, atol=1e-9)
    assert len([p for p in fit.parameters if not p.derived]) == (12 if symmetric else 18)


@pytest.mark.parametrize("estimator", ["ls", "iv", "ml"])
@pytest.mark.parametrize("lumped", [True, False])
def test_estimated_mass_without_noise(three_dof_response, estimator: str, lumped: bool) -> None:
    fit = one(three_dof_response(), replace(KNOWN, estimator=estimator, mass="estimate", lumped_mass=lumped))
    np.testing.assert_allclose(matrix(fit, "k"), STIFFNESS, atol=1e-8)
    found = matrix(fit, "m")
    np.testing.assert_allclose(
        np.diag(found) if lumped else found, np.diag(MASS) if lumped else MASS, atol=1e-8
    )


def test_a_mass_known_but_for_a_factor(three_dof_response) -> None:
    fit = one(three_dof_response(), replace(KNOWN, mass=(0.5, 1.0, 1.5), scale_mass=True))
    assert fit.parameter("mass_scale").value == pytest.approx(2.0, rel=1e-9)
    assert fit.parameter("mass_scale").unit == "1"


def test_a_full_mass_matrix(three_dof_response) -> None:
    fit = one(three_dof_response(), replace(KNOWN, mass=tuple(tuple(row) for row in MASS.tolist())))
    np.testing.assert_allclose(matrix(fit, "k"), STIFFNESS, atol=1e-9)


@pytest.mark.parametrize("estimator", ["ls", "iv", "ml"])
def test_one_force_and_all_responses_give_every_coefficient(three_dof_response, estimator: str) -> None:
    response = three_dof_response(stiffness=CROSS_COUPLED, columns=(0,))
    fit = one(response, replace(KNOWN, estimator=estimator, symmetric=False))
    np.testing.assert_allclose(matrix(fit, "k"), CROSS_COUPLED, atol=1e-7)
    np.testing.assert_allclose(matrix(fit, "c"), DAMPING, atol=1e-7)


@pytest.mark.parametrize("form", ["receptance", "mobility", "accelerance"])
def test_every_form_gives_the_same(three_dof_response, form: str) -> None:
    plain = three_dof_response(1e-3, np.random.default_rng(1))
    factor = (2j * np.pi * plain.frequency) ** {"receptance": 0, "mobility": 1, "accelerance": 2}[form]
    covariance = plain.covariance * (np.abs(factor) ** 2)[:, None, None]
    turned = replace(plain, matrix=plain.matrix * factor[:, None, None], covariance=covariance, form=form)
    for own, other in zip(one(plain, KNOWN).parameters, one(turned, KNOWN).parameters, strict=True):
        assert own.value == pytest.approx(other.value, rel=1e-6)
        assert own.std_error == pytest.approx(other.std_error, rel=1e-6)


@pytest.mark.parametrize("scale", [1e-9, 1e3])
@pytest.mark.parametrize("estimator", ["ls", "iv", "ml"])
def test_the_size_of_the_receptance_does_not_matter(three_dof_response, scale: float, estimator: str) -> None:
    # H -> s H is K, C, M -> / s: every coefficient and its standard error is divided by s, chi-square stays.
    mass = tuple(np.array([1.0, 2.0, 3.0]) / scale)
    plain = one(three_dof_response(0.05, np.random.default_rng(7)), replace(KNOWN, estimator=estimator))
    scaled = one(
        three_dof_response(0.05, np.random.default_rng(7), scale=scale),
        replace(KNOWN, estimator=estimator, mass=mass),
    )
    assert plain.converged and scaled.converged
    for own, other in zip(plain.parameters[:12], scaled.parameters[:12], strict=True):
        assert other.value * scale == pytest.approx(own.value, rel=1e-5, abs=1e-7)
        assert other.std_error * scale == pytest.approx(own.std_error, rel=1e-4)
    assert scaled.gof.chi2_reduced == pytest.approx(plain.gof.chi2_reduced, rel=1e-6)
    assert [finding.code for finding in scaled.findings] == [finding.code for finding in plain.findings]


def test_modes_are_those_of_the_matrices(three_dof_response) -> None:
    fit = one(three_dof_response(1e-3, np.random.default_rng(2)), KNOWN)
    # Closed form: undamped eigenvalues of (K, M); B = 0.1 K gives zeta = 0.05 w.
    squares, shapes = linalg.eigh(STIFFNESS, MASS)
    for number, (square, shape) in enumerate(zip(squares, shapes.T, strict=True), 1):
        frequency, ratio = fit.parameter(f"f_n_{number}"), fit.parameter(f"zeta_{number}")
        assert abs(frequency.value - np.sqrt(square) / (2 * np.pi)) < 4 * frequency.std_error
        assert abs(ratio.value - 0.05 * np.sqrt(square)) < 4 * ratio.std_error
        leading = shape[np.argmax(np.abs(shape) >= 0.8 * np.max(np.abs(shape)))]
        scaled = shape / leading
        for dof in (1, 2, 3):
            entry = fit.parameter(f"shape_{number}_{dof}")
            assert abs(entry.value - scaled[dof - 1]) <= 4 * entry.std_error + 1e-12
            share = fit.parameter(f"participation_{number}_f{dof}")
            # eigh's vectors have unit modal mass, so the factor to a leading entry of 1 enters squared.
            expected = shape[dof - 1] * leading
            assert abs(share.value - expected) < 4 * share.std_error + 1e-12


@pytest.mark.long
def test_standard_errors_of_modes_are_the_scatter(three_dof_response) -> None:
    fits = [one(three_dof_response(0.02, np.random.default_rng(seed)), KNOWN) for seed in range(60)]
    for name in ("f_n_1", "zeta_2", "shape_2_1", "participation_1_f2"):
        values = [fit.parameter(name).value for fit in fits]
        # A standard deviation from 60 values is known to 9 %; three of those.
        assert np.mean([fit.parameter(name).std_error for fit in fits]) == pytest.approx(
            np.std(values, ddof=1), rel=0.27
        )


def test_forces_are_found_by_their_dof_not_by_their_order(three_dof_response) -> None:
    response = three_dof_response()
    turned = replace(
        response, matrix=response.matrix[:, :, [2, 0, 1]], inputs=tuple(response.inputs[n] for n in (2, 0, 1))
    )
    np.testing.assert_allclose(matrix(one(turned, KNOWN), "k"), STIFFNESS, atol=1e-9)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mass": (1.0, 2.0)}, "does not fit 3 responses"),
        ({"mass": ((1.0, 0.5, 0.0), (0.0, 2.0, 0.0), (0.0, 0.0, 3.0))}, "not symmetric"),
        ({"mass": ((1.0, 0.5), (0.0, 2.0, 0.0), (0.0, 0.0, 3.0))}, "does not fit"),
        ({"fixed": (("k_1_4", 0.0),)}, "no coefficient 'k_1_4'"),
        ({"tied": (("k_1_1", "c_1_1"),)}, "cannot have one value"),
        ({"output": ("1", "2"), "input": ("f1",)}, "does not fit 2 responses"),
        ({"output": ("1", "2"), "mass": (1.0, 2.0)}, "acts on dof '3', which has no response"),
        ({"mass": "estimate", "symmetric": False, "input": ("f1",)}, "a force on 2, 3, .* no scale"),
    ],
)
def test_what_does_not_fit_is_said(three_dof_response, change: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        identify(three_dof_response(), replace(KNOWN, **change))


def test_one_force_without_a_mass_tells_matrices_that_are_symmetric(three_dof_response) -> None:
    settings = replace(KNOWN, mass="estimate", input=("f1",), estimator="ls")
    np.testing.assert_allclose(matrix(one(three_dof_response(), settings), "k"), STIFFNESS, atol=1e-6)


def test_a_negative_direct_coefficient_is_called_unphysical(three_dof_response) -> None:
    response = three_dof_response(1e-3, np.random.default_rng(3))
    fit = one(replace(response, matrix=-response.matrix), replace(KNOWN, mass="estimate"))
    assert any(finding.code == "unphysical" and "k_1_1" in finding.message for finding in fit.findings)


def test_responses_are_x_and_y_by_name_and_else_by_their_order() -> None:
    def ports(*names: str) -> tuple[Port, ...]:
        return tuple(Port(name, name, name) for name in names)

    assert [axes_of(ports(*names)) for names in ("xy", "yx", "ab", "yb", "ax", "x")] == [
        [0, 1],
        [1, 0],
        [0, 1],
        [1, 0],
        [1, 0],
        [0],
    ]
    with pytest.raises(ConfigError, match="response 'a' is neither x nor y"):
        axes_of(ports("a"))


def test_a_force_at_an_angle_acts_on_x_and_y_by_its_cosines() -> None:
    """30 deg from x: cos 30 deg and cos 60 deg; a force at right angles to a response does not act on it."""
    x, y = Port("x", "x", "x", 0.0), Port("y", "y", "y", np.pi / 2)
    setup = SimpleNamespace(outputs=(x, y))
    for degrees, shares in ((30.0, [0.75**0.5, 0.5]), (90.0, [0.0, 1.0]), (180.0, [-1.0, 0.0])):
        force = Port("f", "f", f"{degrees:g} deg", np.deg2rad(degrees))
        direction = force_direction(force, ["x", "y"], setup)
        np.testing.assert_allclose(direction, shares, atol=1e-15)
        assert (direction == 0).tolist() == [share == 0 for share in shares]
    np.testing.assert_array_equal(force_direction(Port("f", "f", "y"), ["x", "y"], setup), [0, 1])
    with pytest.raises(ConfigError, match="acts on dof 'z', which has no response"):
        force_direction(Port("f", "f", "z"), ["x", "y"], setup)


def test_a_force_at_another_point_in_the_same_direction_has_no_response() -> None:
    """Points 1 and 2 along x as a universal file names them, the force at 3 along x: it acts on neither.

    One along x of the whole rig acts on x by the cosine of the angle between them.
    """

    def setup(*dofs: str) -> SimpleNamespace:
        return SimpleNamespace(outputs=tuple(Port(dof, dof, dof, 0.0) for dof in dofs))

    with pytest.raises(ConfigError, match="which has no response"):
        force_direction(Port("f", "f", "3.x", 0.0), ["1.x", "2.x"], setup("1.x", "2.x"))
    inclined = Port("f", "f", "60 deg", np.pi / 3)
    np.testing.assert_allclose(force_direction(inclined, ["x"], setup("x")), [0.5])


def test_points_of_several_digits_are_told_apart() -> None:
    """The support's 5 kN/m come off k_1_1 and k_11_11 alone: k_1_11 joins two points."""
    direct = ("k", "c_xx", "k_1_1", "m_11_11", "k_b.x_b.x")
    assert all(map(is_direct, direct))
    assert not any(map(is_direct, ("k_xy", "k_1_11", "k_11_1", "c_x_1x", "f_n_1", "mass_scale")))
    support = FitSettings("mdof", subtract=Support(Uncertain(5e3)))
    names = ("k_1_1", "k_1_11", "k_11_11")
    total = Estimated(names, ("N/m",) * 3, np.full(3, 2e4), np.eye(3))
    assert correct(total, support).values.tolist() == [15e3, 20e3, 15e3]
