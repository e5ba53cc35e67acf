"""Speed of the identification as ratios within one run: against a literal twin, and over the number of lines."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from labpipe.identify.instrumental import instrumental_variables
from labpipe.identify.mdof import mdof
from labpipe.identify.measured import Measured
from labpipe.identify.regression import least_squares
from labpipe.identify.settings import FitSettings
from labpipe.identify.setup import Setup
from tests.unit.identify.conftest import DAMPING, DOFS, FORCES, MASS, STIFFNESS
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
