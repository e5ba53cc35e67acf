"""Normal equations from products of small matrices line by line against those of the derivatives written out."""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.identify.constraints import constrained
from labpipe.identify.line_products import has_line_products
from labpipe.identify.mdof import mdof
from labpipe.identify.measured import Measured
from labpipe.identify.model import ResponseModel
from labpipe.identify.output_error import OutputError
from labpipe.identify.regression import equation_solution, regression, solve_scaled
from labpipe.identify.settings import FitSettings
from labpipe.identify.setup import Setup
from labpipe.identify.starts import starts
from labpipe.identify.weights import fit_weights, whitener
from labpipe.optimise.levenberg import linearised
from labpipe.records.response import Port

DOFS = tuple(Port(f"x{n}", f"x{n}", f"x{n}") for n in range(3))
FORCES = tuple(Port(f"f{n}", f"f{n}", f"x{n}") for n in range(3))
STIFFNESS = np.array([[3.0, -1.0, 0.2], [-1.2, 2.5, -0.7], [0.1, -0.9, 2.0]])
DAMPING = np.array([[0.05, -0.01, 0.0], [-0.02, 0.06, -0.01], [0.0, -0.01, 0.04]])


def problem_of(settings: FitSettings, n_input: int, rng: np.random.Generator, correlated: bool = False) -> OutputError[ResponseModel]:
    """Forty lines with 2 % noise of another size at every line and FRF; *correlated*: with a common part."""
    model = constrained(mdof(Setup(DOFS, FORCES[:n_input], settings)), settings)
    omega = np.linspace(0.2, 2.5, 40)
    w = omega[:, None, None]
    h = np.linalg.inv(STIFFNESS + 1j * w * DAMPING - w**2 * np.eye(3))[:, :, :n_input]
    std = 0.02 * np.median(np.abs(h)) * rng.uniform(0.5, 2, h.shape)
    h = h + std * (rng.standard_normal(h.shape) + 1j * rng.standard_normal(h.shape)) / np.sqrt(2)
    covariance = np.eye(3 * n_input) * std.reshape(40, -1, 1) ** 2 + 0j
    if correlated:
        covariance = covariance + 0.5 * std.reshape(40, -1, 1) * std.reshape(40, 1, -1)
    data = Measured(omega=omega, matrix=h, covariance=covariance, noise_dof=np.inf, noise_lines=1.0, outputs=DOFS, inputs=FORCES[:n_input])
    return OutputError(data, model, fit_weights(data))


CASES = {
    "every entry": (FitSettings("mdof", symmetric=False, mass=(1.0, 1.0, 1.0)), 3),
    "symmetric": (FitSettings("mdof", symmetric=True, mass=(1.0, 1.0, 1.0)), 3),
    "with masses": (FitSettings("mdof", symmetric=False, mass="estimate"), 3),
    "a mass factor": (FitSettings("mdof", symmetric=True, mass=(1.0, 1.0, 1.0), scale_mass=True), 3),
    "proportional damping": (FitSettings("mdof", symmetric=True, mass=(1.0, 1.0, 1.0), damping="proportional"), 3),
    "two forces": (FitSettings("mdof", symmetric=True, mass=(1.0, 1.0, 1.0)), 2),
}


@pytest.mark.parametrize("case", CASES)
def test_products_are_those_of_the_derivatives(case: str, rng: np.random.Generator) -> None:
    problem = problem_of(*CASES[case], rng)
    here = starts(problem)[0].values * 1.02
    ours, plain = problem.linearised(here), linearised(problem, here)
    assert has_line_products(problem.model.linear, problem.weights)
    np.testing.assert_allclose(ours.scale, plain.scale, rtol=1e-12)
    np.testing.assert_allclose(ours.triangle.T @ ours.triangle, plain.triangle.T @ plain.triangle, atol=1e-11)
    by_jacobian = problem.jacobian(here).T @ problem.residual(here)
    np.testing.assert_allclose(ours.triangle.T @ ours.projected * ours.scale, by_jacobian, atol=1e-11 * np.abs(by_jacobian).max())
    assert ours.chi2 == pytest.approx(float(problem.residual(here) @ problem.residual(here)), rel=1e-13)
    assert ours.chi2 == pytest.approx(problem.chi2(here), rel=1e-13) and ours.n_equation == problem.residual(here).size


def test_starts_are_those_of_the_written_out_regressions(rng: np.random.Generator) -> None:
    problem = problem_of(*CASES["two forces"], rng)
    measured, model = problem.measured, problem.model.linear
    found = {start.name: start.values for start in starts(problem)}
    first = equation_solution(regression(measured, model, "none"), model)[0]
    np.testing.assert_allclose(found["least squares"], first, rtol=1e-10)
    terms = model.filtered(first, model.equation_terms(measured.matrix, measured.omega), measured.omega)
    side = model.filtered(first, model.equation_constant(measured.matrix, measured.omega)[None], measured.omega)[0]
    second = solve_scaled(problem.whitened(terms).T, problem.whitened(side))[0]
    np.testing.assert_allclose(found["reweighted least squares (pass 1)"], second, rtol=1e-10)


def test_noise_that_frfs_share_has_no_such_products(rng: np.random.Generator) -> None:
    problem = problem_of(*CASES["symmetric"], rng, correlated=True)
    assert not has_line_products(problem.model, problem.weights)
    here = starts(problem)[0].values
    np.testing.assert_array_equal(problem.linearised(here).triangle, linearised(problem, here).triangle)
    np.testing.assert_array_equal(problem.weights, whitener(problem.measured))


def test_weights_in_short_are_the_diagonals_of_the_whitener(rng: np.random.Generator) -> None:
    problem = problem_of(*CASES["symmetric"], rng)
    np.testing.assert_allclose(problem.weights, np.einsum("lnn->ln", whitener(problem.measured)), rtol=1e-15)
    assert np.count_nonzero(whitener(problem.measured)) == problem.weights.size
