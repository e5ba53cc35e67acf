"""Normal equations from products of small matrices line by line against those of the derivatives written
out.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labpipe.errors import FitError
from labpipe.estimation.damping import damp
from labpipe.estimation.descent import linearise_problem
from labpipe.estimation.likelihood import starts
from labpipe.estimation.linear_models import mdof
from labpipe.estimation.measured import Measured
from labpipe.estimation.model import ResponseModel, Setup
from labpipe.estimation.output_error import OutputError, has_line_products
from labpipe.estimation.regression import equation_solution, regression, solve_scaled
from labpipe.estimation.settings import FitSettings
from labpipe.estimation.weights import (
    ProductWeights,
    correlation_factors,
    fit_weights,
    whiten_values,
    whitened_columns,
    whitener,
)
from labpipe.records.response import Port

DOFS = tuple(Port(f"x{n}", f"x{n}", f"x{n}") for n in range(3))
FORCES = tuple(Port(f"f{n}", f"f{n}", f"x{n}") for n in range(3))
STIFFNESS = np.array([[3.0, -1.0, 0.2], [-1.2, 2.5, -0.7], [0.1, -0.9, 2.0]])
DAMPING = np.array([[0.05, -0.01, 0.0], [-0.02, 0.06, -0.01], [0.0, -0.01, 0.04]])


def problem_of(
    settings: FitSettings, n_input: int, rng: np.random.Generator, noise: str = "independent"
) -> OutputError[ResponseModel]:
    """Forty lines with 2 % noise of another size at every line and FRF.

    *noise* with a part in "common", or a "product" as that of H1.
    """
    model = damp(mdof(Setup(DOFS, FORCES[:n_input], settings)), settings)
    omega = np.linspace(0.2, 2.5, 40)
    w = omega[:, None, None]
    h = np.linalg.inv(STIFFNESS + 1j * w * DAMPING - w**2 * np.eye(3))[:, :, :n_input]
    std = 0.02 * np.median(np.abs(h)) * rng.uniform(0.5, 2, h.shape)
    h = h + std * (rng.standard_normal(h.shape) + 1j * rng.standard_normal(h.shape)) / np.sqrt(2)
    covariance = np.eye(3 * n_input) * std.reshape(40, -1, 1) ** 2 + 0j
    if noise == "product":
        covariance = std[:, :1, 0, None] ** 2 * product_of(correlations(rng, 3), correlations(rng, n_input))
    elif noise == "common":
        covariance = covariance + 0.5 * std.reshape(40, -1, 1) * std.reshape(40, 1, -1)
    data = Measured(
        omega=omega,
        matrix=h,
        covariance=covariance,
        noise_dof=np.inf,
        noise_lines=1.0,
        outputs=DOFS,
        inputs=FORCES[:n_input],
    )
    return OutputError(data, model, fit_weights(data))


def correlations(rng: np.random.Generator, n: int) -> np.ndarray:
    """Hermitian positive definite matrices (40, n, n), none of them diagonal."""
    root = rng.standard_normal((40, n, 2 * n)) + 1j * rng.standard_normal((40, n, 2 * n))
    return np.asarray(root @ root.conj().swapaxes(1, 2))


def product_of(outputs: np.ndarray, inputs: np.ndarray) -> np.ndarray:
    """The Kronecker products line by line, (n_line, n, n)."""
    return np.stack([np.kron(left, right) for left, right in zip(outputs, inputs, strict=True)])


CASES = {
    "every entry": (FitSettings("mdof", symmetric=False, mass=(1.0, 1.0, 1.0)), 3),
    "symmetric": (FitSettings("mdof", symmetric=True, mass=(1.0, 1.0, 1.0)), 3),
    "with masses": (FitSettings("mdof", symmetric=False, mass="estimate"), 3),
    "a mass factor": (FitSettings("mdof", symmetric=True, mass=(1.0, 1.0, 1.0), scale_mass=True), 3),
    "proportional damping": (
        FitSettings("mdof", symmetric=True, mass=(1.0, 1.0, 1.0), damping="proportional"),
        3,
    ),
    "two forces": (FitSettings("mdof", symmetric=True, mass=(1.0, 1.0, 1.0)), 2),
}


@pytest.mark.parametrize("noise", ["independent", "product"])
@pytest.mark.parametrize("case", CASES)
def test_products_are_those_of_the_derivatives(case: str, noise: str, rng: np.random.Generator) -> None:
    problem = problem_of(*CASES[case], rng, noise)
    here = starts(problem)[0].values * 1.02
    ours, plain = problem.linearise(here), linearise_problem(problem, here)
    assert has_line_products(problem.model.linear, problem.weights)
    np.testing.assert_allclose(ours.scale, plain.scale, rtol=1e-12)
    np.testing.assert_allclose(ours.triangle.T @ ours.triangle, plain.triangle.T @ plain.triangle, atol=1e-11)
    by_jacobian = problem.jacobian(here).T @ problem.residual(here)
    np.testing.assert_allclose(
        ours.triangle.T @ ours.projected * ours.scale, by_jacobian, atol=1e-11 * np.abs(by_jacobian).max()
    )
    assert ours.chi2 == pytest.approx(float(problem.residual(here) @ problem.residual(here)), rel=1e-13)
    assert (
        ours.chi2 == pytest.approx(problem.chi2(here), rel=1e-13)
        and ours.n_equation == problem.residual(here).size
    )


@pytest.mark.parametrize("noise", ["independent", "product"])
def test_starts_are_those_of_the_written_out_regressions(noise: str, rng: np.random.Generator) -> None:
    problem = problem_of(*CASES["two forces"], rng, noise)
    measured, model = problem.measured, problem.model.linear
    found = {start.name: start.values for start in starts(problem)}
    first = equation_solution(regression(measured, model, "none"), model)[0]
    np.testing.assert_allclose(found["least squares"], first, rtol=1e-10)
    terms = model.filter(first, model.equation_terms(measured.matrix, measured.omega), measured.omega)
    side = model.filter(
        first, model.equation_constant(measured.matrix, measured.omega)[None], measured.omega
    )[0]
    second = solve_scaled(problem.whiten(terms).T, problem.whiten(side))[0]
    np.testing.assert_allclose(found["reweighted least squares (pass 1)"], second, rtol=1e-10)


def test_noise_that_frfs_share_has_no_such_products(rng: np.random.Generator) -> None:
    problem = problem_of(*CASES["symmetric"], rng, "common")
    assert not has_line_products(problem.model, problem.weights)
    here = starts(problem)[0].values
    np.testing.assert_array_equal(problem.linearise(here).triangle, linearise_problem(problem, here).triangle)
    np.testing.assert_array_equal(problem.weights, whitener(problem.measured))


def test_weights_in_short_are_the_diagonals_of_the_whitener(rng: np.random.Generator) -> None:
    problem = problem_of(*CASES["symmetric"], rng)
    np.testing.assert_allclose(problem.weights, np.einsum("lnn->ln", whitener(problem.measured)), rtol=1e-15)
    assert np.count_nonzero(whitener(problem.measured)) == problem.weights.size


def test_factors_of_the_weights_whiten_as_the_whole_whitener(rng: np.random.Generator) -> None:
    # The whole whitener is the Cholesky factor of the 6 x 6 covariance of every line, by numpy.
    problem = problem_of(*CASES["two forces"], rng, "product")
    assert isinstance(problem.weights, ProductWeights)
    whole, here = whitener(problem.measured), starts(problem)[0].values
    values = rng.standard_normal((4, 40, 3, 2)) + 1j * rng.standard_normal((4, 40, 3, 2))
    np.testing.assert_allclose(
        whiten_values(problem.weights, values), whiten_values(whole, values), rtol=1e-9, atol=1e-9
    )
    np.testing.assert_allclose(
        whiten_values(problem.weights, values[0]), whiten_values(whole, values[0]), rtol=1e-9, atol=1e-9
    )
    np.testing.assert_allclose(
        whitened_columns(problem.weights, values), whitened_columns(whole, values), rtol=1e-9, atol=1e-9
    )
    plain = OutputError(problem.measured, problem.model, whole)
    np.testing.assert_allclose(problem.jacobian(here), plain.jacobian(here), rtol=1e-8, atol=1e-8)
    assert problem.chi2(here) == pytest.approx(plain.chi2(here), rel=1e-10)


def test_a_covariance_that_is_no_product_to_ten_digits_is_taken_whole(rng: np.random.Generator) -> None:
    product = product_of(correlations(rng, 3), correlations(rng, 2))
    deviations = np.sqrt(np.einsum("lii->li", product).real).reshape(40, 3, 2)
    assert correlation_factors(product, deviations) is not None
    product[7, 4, 1] += 1e-10 * deviations[7, 2, 0] * deviations[7, 0, 1]
    assert correlation_factors(product, deviations) is None


def test_forces_whose_noise_has_levels_of_its_own_at_each_response_are_weighed_by_them(
    rng: np.random.Generator,
) -> None:
    """Correlations are a product, standard deviations are none, as of hits and sweeps with one force each:
    the weighted squares of any values are those by the inverse covariance, by numpy.
    """
    problem = problem_of(*CASES["two forces"], rng)
    product = product_of(correlations(rng, 3), np.broadcast_to(np.eye(2), (40, 2, 2)))
    levels = np.exp(rng.standard_normal((40, 6)))
    covariance = product * levels[:, :, None] * levels[:, None]
    weights = fit_weights(replace(problem.measured, covariance=covariance))
    values = rng.standard_normal((40, 3, 2)) + 1j * rng.standard_normal((40, 3, 2))
    flat = values.reshape(40, 6)
    square = 2 * np.einsum("la,lab,lb->", flat.conj(), np.linalg.inv(covariance), flat).real
    assert np.sum(whiten_values(weights, values) ** 2) == pytest.approx(square, rel=1e-9)


def test_a_singular_factor_is_refused_with_its_line(rng: np.random.Generator) -> None:
    outputs, inputs = correlations(rng, 3), correlations(rng, 2)
    outputs[5] = np.ones((3, 3))
    measured = replace(problem_of(*CASES["two forces"], rng).measured, covariance=product_of(outputs, inputs))
    with pytest.raises(
        FitError, match=f"the covariance of the 6 FRFs is singular at {measured.omega[5] / (2 * np.pi):g} Hz"
    ):
        fit_weights(measured)
