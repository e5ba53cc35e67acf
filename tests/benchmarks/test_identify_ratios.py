"""Speed of the identification as ratios within one run: against a literal twin, and over the number of lines."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from labpipe.identify.fitting import identify
from labpipe.identify.instrumental import instrumental_variables
from labpipe.identify.mdof import mdof
from labpipe.identify.measured import Measured
from labpipe.identify.regression import least_squares
from labpipe.identify.settings import FitSettings
from labpipe.identify.setup import Setup
from labpipe.records.response import FrequencyResponse, Port
from tests.unit.identify.conftest import DAMPING, DOFS, FORCES, MASS, STIFFNESS, with_noise
from tests.unit.identify.literal import literal_iv

MODEL = mdof(Setup(DOFS, FORCES, FitSettings("mdof", mass=(1.0, 2.0, 3.0), symmetric=True)))


def measured(n_line: int) -> Measured:
    """The three-dof benchmark on *n_line* lines with 2 % noise."""
    omega = np.linspace(0.01, 2.41, n_line)
    h = np.linalg.inv(STIFFNESS + 1j * omega[:, None, None] * DAMPING - omega[:, None, None] ** 2 * MASS)
    rng = np.random.default_rng(1)
    noise = 0.02 * np.max(np.abs(h)) * (rng.standard_normal(h.shape) + 1j * rng.standard_normal(h.shape))
    return Measured(omega=omega, matrix=h + noise, covariance=None, noise_dof=np.inf, noise_lines=1.0, outputs=DOFS, inputs=FORCES)


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
    """Four masses in a chain with skew stiffness and non-proportional damping, 300 lines, every FRF with noise of known variance."""
    rng = np.random.default_rng(1)
    springs, mass = 1e5 * np.array([1.1, 0.8, 1.3, 0.9]), np.diag([1.1, 0.9, 1.3, 1.0])
    stiffness = np.diag(springs + np.append(springs[1:], 0.0)) - np.diag(springs[1:], 1) - np.diag(springs[1:], -1)
    skew = 3e3 * rng.normal(size=(4, 4))
    damping = 2e-4 * stiffness + np.diag([3.0, 9.0, 5.0, 11.0])
    frequency = np.linspace(15.0, 110.0, 300)
    w = 2 * np.pi * frequency[:, None, None]
    h = np.linalg.inv(stiffness + skew - skew.T + 1j * w * damping - w**2 * mass)
    dofs = [f"x{number}" for number in range(1, 5)]
    outputs, inputs = tuple(Port(dof, dof, dof) for dof in dofs), tuple(Port(f"f{dof}", f"f{dof}", dof) for dof in dofs)
    return with_noise(frequency, h, outputs, inputs, 0.01 * float(np.median(np.abs(h))), rng)


def test_comparison_of_models_over_the_fit(record_property) -> None:  # type: ignore[no-untyped-def]
    response = four_dofs()
    settings = FitSettings("mdof", symmetric=False)
    fit = cpu_time(lambda: identify(response, settings), 3)
    ratio = cpu_time(lambda: identify(response, FitSettings("mdof", symmetric=False, compare=True)), 1) / fit
    record_property("compared_over_fit_4x4", round(ratio, 1))
    # Seven models are compared, three of them with up to three times the parameters of the fit.
    assert ratio < 10
