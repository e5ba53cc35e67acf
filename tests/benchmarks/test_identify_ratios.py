"""Speed of the identification as ratios within one run: against a literal twin, and over the number of
lines.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import pytest

from labpipe.arrays import ComplexArray
from labpipe.estimation import likelihood as start_values, output_error
from labpipe.estimation.descent import linearise_problem
from labpipe.estimation.fitting import identify
from labpipe.estimation.likelihood import starts
from labpipe.estimation.linear_models import form_view, mdof
from labpipe.estimation.measured import Measured, measured_part
from labpipe.estimation.model import Setup
from labpipe.estimation.output_error import OutputError
from labpipe.estimation.regression import instrumental_variables, least_squares
from labpipe.estimation.settings import FitSettings
from labpipe.estimation.weights import fit_weights
from labpipe.records.response import FactoredCovariance, FrequencyResponse, Port, diagonal_covariance
from tests.estimation.conftest import DAMPING, DOFS, FORCES, MASS, STIFFNESS, with_noise
from tests.estimation.literal import literal_iv

MODEL = mdof(Setup(DOFS, FORCES, FitSettings("mdof", mass=(1.0, 2.0, 3.0), symmetric=True)))


def measured(n_line: int) -> Measured:
    """The three-dof benchmark on *n_line* lines with 2 % noise."""
    omega = np.linspace(0.01, 2.41, n_line)
    h = np.linalg.inv(STIFFNESS + 1j * omega[:, None, None] * DAMPING - omega[:, None, None] ** 2 * MASS)
    rng = np.random.default_rng(1)
    noise = 0.02 * np.max(np.abs(h)) * (rng.standard_normal(h.shape) + 1j * rng.standard_normal(h.shape))
    return Measured(
        omega=omega,
        matrix=h + noise,
        covariance=None,
        noise_dof=np.inf,
        noise_lines=1.0,
        outputs=DOFS,
        inputs=FORCES,
    )


def cpu_time(work: Callable[[], object], repeats: int) -> float:
    """The least CPU time [s] of several calls."""
    spent = []
    for _ in range(repeats):
        begin = time.process_time()
        work()
        spent.append(time.process_time() - begin)
    return min(spent)


def both(data: Measured) -> None:
    least_squares(data, MODEL)
    instrumental_variables(data, MODEL)


def test_ls_and_iv_against_the_literal_twin(record_property) -> None:  # type: ignore[no-untyped-def]
    data = measured(1000)
    both(data)
    # The twin's iv begins with its own least squares.
    ratio = cpu_time(lambda: literal_iv(data.matrix, data.omega, MASS), 2) / cpu_time(lambda: both(data), 8)
    record_property("ls+iv_literal_over_own", round(ratio, 1))
    assert ratio > 12


def test_cost_is_linear_in_the_lines(record_property) -> None:  # type: ignore[no-untyped-def]
    few, many = measured(1000), measured(10_000)
    both(few)
    ratio = cpu_time(lambda: both(many), 4) / cpu_time(lambda: both(few), 8)
    record_property("ls+iv_10x_lines", round(ratio, 1))
    assert 4 < ratio < 20


def four_dofs() -> FrequencyResponse:
    """Four masses in a chain with skew stiffness and non-proportional damping, 300 lines, every FRF with
    noise of known variance.
    """
    rng = np.random.default_rng(1)
    springs, mass = 1e5 * np.array([1.1, 0.8, 1.3, 0.9]), np.diag([1.1, 0.9, 1.3, 1.0])
    stiffness = (
        np.diag(springs + np.append(springs[1:], 0.0)) - np.diag(springs[1:], 1) - np.diag(springs[1:], -1)
    )
    skew = 3e3 * rng.normal(size=(4, 4))
    damping = 2e-4 * stiffness + np.diag([3.0, 9.0, 5.0, 11.0])
    frequency = np.linspace(15.0, 110.0, 300)
    w = 2 * np.pi * frequency[:, None, None]
    h = np.linalg.inv(stiffness + skew - skew.T + 1j * w * damping - w**2 * mass)
    dofs = [f"x{number}" for number in range(1, 5)]
    outputs, inputs = (
        tuple(Port(dof, dof, dof) for dof in dofs),
        tuple(Port(f"f{dof}", f"f{dof}", dof) for dof in dofs),
    )
    return with_noise(frequency, h, outputs, inputs, 0.01 * float(np.median(np.abs(h))), rng)


def test_comparison_of_models_over_the_fit(record_property, monkeypatch: pytest.MonkeyPatch) -> None:  # type: ignore[no-untyped-def]
    """Over a fit that writes out its derivatives, as some of the models compared have to."""
    response = four_dofs()
    settings = FitSettings("mdof", symmetric=False)
    with monkeypatch.context() as patch:
        for module in (output_error, start_values):
            patch.setattr(module, "has_line_products", lambda *_: False)
        fit = cpu_time(lambda: identify(response, settings), 3)
    ratio = cpu_time(lambda: identify(response, FitSettings("mdof", symmetric=False, compare=True)), 1) / fit
    record_property("compared_over_fit_4x4", round(ratio, 1))
    # Seven models are compared, three of them with up to three times the parameters of the fit.
    assert ratio < 10


def chain(n_dof: int, n_line: int, is_shared: bool = False) -> FrequencyResponse:
    """Masses 1, 2, ... kg in a chain of springs with damping, all FRFs with noise of known size.

    *is_shared*: FRFs of neighbours share noise, by their responses and by their forces, as those of H1 from
    random data.
    """
    stiffness = 2 * np.eye(n_dof) - np.eye(n_dof, k=1) - np.eye(n_dof, k=-1)
    w = np.linspace(0.05, 2.41, n_line)[:, None, None]
    mass, damping = np.diag(1.0 + np.arange(n_dof)), 0.02 * stiffness + 0.01 * np.eye(n_dof)
    h = np.linalg.inv(stiffness + 1j * w * damping - w**2 * mass)
    rng, std = np.random.default_rng(1), 0.02 * np.median(np.abs(h))
    noise = std * (rng.standard_normal(h.shape) + 1j * rng.standard_normal(h.shape)) / np.sqrt(2)
    covariance: ComplexArray | FactoredCovariance = diagonal_covariance(np.full(h.shape, std**2))
    if is_shared:
        spread = np.eye(n_dof) + 0.5 * np.eye(n_dof, k=-1)
        noise = spread @ noise @ spread.T
        factors = np.broadcast_to(spread @ spread.T + 0j, h.shape)
        covariance = FactoredCovariance(factors * std**2, factors)
    dofs = [f"x{number}" for number in range(n_dof)]
    outputs, inputs = (
        tuple(Port(dof, dof, dof) for dof in dofs),
        tuple(Port(f"f{dof}", f"f{dof}", dof) for dof in dofs),
    )
    return FrequencyResponse(w[:, 0, 0] / (2 * np.pi), h + noise, outputs, inputs, covariance=covariance)


def test_likelihood_over_dofs_and_lines(record_property) -> None:  # type: ignore[no-untyped-def]
    """All coefficients of chains with known noise: 6 dofs over 3 (72 parameters over 18), and ten times the
    lines; goals 8 and 11.
    """

    def spent(n_dof: int, n_line: int, repeats: int) -> float:
        response = chain(n_dof, n_line)
        settings = FitSettings("mdof", symmetric=False, estimator="ml", mass=tuple(1.0 + np.arange(n_dof)))
        return cpu_time(lambda: identify(response, settings), repeats)

    few, more_dofs, more_lines = spent(3, 1000, 4), spent(6, 1000, 2), spent(3, 10_000, 2)
    record_property("ml_6_over_3_dofs", round(more_dofs / few, 1))
    record_property("ml_10x_lines", round(more_lines / few, 1))
    assert more_dofs < 12 * few and more_lines < 16 * few


def test_likelihood_of_frfs_that_share_noise_over_independent_ones(record_property) -> None:  # type: ignore[no-untyped-def]
    """6 dofs, the covariance of H1: 17 times as long while its whole matrices weighted the lines."""
    settings = FitSettings("mdof", symmetric=False, estimator="ml", mass=tuple(1.0 + np.arange(6)))
    responses = [chain(6, 1000, is_shared) for is_shared in (False, True)]
    alone, shared = (
        cpu_time(lambda response=response: identify(response, settings), 3) for response in responses
    )
    record_property("ml_shared_over_independent_noise", round(shared / alone, 1))
    assert shared < 5 * alone


def test_a_linearisation_over_its_derivatives(record_property) -> None:  # type: ignore[no-untyped-def]
    """What the products line by line spare at 6 dofs: the derivatives, their whitening and their triangle."""
    response = chain(6, 1000)
    data = measured_part(
        response,
        list(range(6)),
        list(range(6)),
        np.ones(1000, bool),
        form_view(response.form, FitSettings("mdof")),
    )
    model = mdof(
        Setup(
            response.outputs,
            response.inputs,
            FitSettings("mdof", mass=tuple(1.0 + np.arange(6)), symmetric=False),
        )
    )
    problem = OutputError(data, model, fit_weights(data))
    here = starts(problem)[0].values
    ratio = cpu_time(lambda: linearise_problem(problem, here), 3) / cpu_time(
        lambda: problem.linearise(here), 8
    )
    record_property("ml_linearisation_derivatives_over_own", round(ratio, 1))
    assert ratio > 3
