"""Covariance from the residual's own scatter: its slow twin, and the scatter of repeated fits of a straight
line.
"""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.estimation.residual import line_scatter


def slow_twin(jacobian: np.ndarray, residual: np.ndarray, n_line: int, n_neighbour: int) -> np.ndarray:
    """The same sum, line by line and pair by pair, with the fit repeated without line l in place of the
    leverages.

    Leaving line l out moves the estimate by (J^T J)^-1 J_l^T (1 - H_ll)^-1 r_l (Cook and Weisberg 1982, eq.
    2.2.8).
    """
    lines = [np.flatnonzero(np.arange(residual.size) % n_line == line) for line in range(n_line)]
    shares = []
    for line in lines:
        left = np.setdiff1d(np.arange(residual.size), line)
        shares.append(-np.linalg.lstsq(jacobian[left], residual[left], rcond=None)[0])
    covariance = np.zeros((jacobian.shape[1],) * 2)
    for one in range(n_line):
        for other in range(n_line):
            weight = max(0.0, 1 - abs(one - other) / (n_neighbour + 1))
            covariance += weight * np.outer(shares[one], shares[other])
    return covariance


def test_it_is_the_weighted_sum_over_pairs_of_lines() -> None:
    """30 lines have round(30^(1/3)) = 3 neighbours. One element per line: real parts of all lines, then
    imaginary parts.
    """
    rng = np.random.default_rng(1)
    jacobian, noise = rng.normal(size=(60, 3)), rng.normal(size=60)
    residual = noise - jacobian @ np.linalg.lstsq(jacobian, noise, rcond=None)[0]
    np.testing.assert_allclose(
        line_scatter(jacobian, residual, 30).covariance, slow_twin(jacobian, residual, 30, 3), rtol=1e-9
    )


@pytest.mark.long
@pytest.mark.parametrize("shared", [0.0, 0.3])
def test_it_is_the_scatter_of_repeats_where_neighbours_share_noise_and_noise_grows(shared: float) -> None:
    """A straight line through 200 lines whose noise grows fivefold and is common to neighbours, 2000 repeats:
    10 % in variance.

    Bartlett's weights of 6 neighbours keep 6/7 of the correlation with the next line: a variance 10 % too
    small at most.
    """
    rng = np.random.default_rng(2)
    f = np.linspace(-1, 1, 200)
    jacobian = np.tile(np.column_stack([np.ones_like(f), f]), (2, 1))
    estimates, variances = [], []
    for _ in range(2000):
        white = rng.normal(size=(2, 201))
        noise = ((white[:, 1:] + shared * white[:, :-1]) * (3 + 2 * f)).reshape(-1)
        values = np.linalg.lstsq(jacobian, noise, rcond=None)[0]
        estimates.append(values)
        variances.append(np.diag(line_scatter(jacobian, noise - jacobian @ values, 200).covariance))
    ratio = np.mean(variances, axis=0) / np.var(estimates, axis=0)
    assert np.all((ratio > 0.85) & (ratio < 1.12)), ratio


def test_degrees_of_freedom_are_those_of_the_lines_that_matter() -> None:
    """A mean of 1000 lines: 10 neighbours, 1 + 2 sum (1 - d/11)^2 = 1 + 2 * 385/121 lines per degree of
    freedom.

    A parameter that ten lines alone determine has at most ten over the same.
    """
    rng = np.random.default_rng(3)
    share = 1 + 2 * 385 / 121
    (all_lines,) = line_scatter(np.ones((2000, 1)), rng.normal(size=2000), 1000).dof
    few = np.tile(np.where(np.arange(1000) < 10, 1.0, 1e-6), 2)[:, None]
    (ten_lines,) = line_scatter(few, rng.normal(size=2000), 1000).dof
    # By the shares seen, whose fourth moment scatters: 3 (sum g^2)^2 / sum g^4 of 1000 is 1000 +- 15 %.
    assert all_lines == pytest.approx(1000 / share, rel=0.15)
    assert ten_lines <= 10 / share + 1e-6


def test_a_residual_of_zero_scatters_nothing(rng: np.random.Generator) -> None:
    """FRFs computed from the model itself: no variance, and the degrees of freedom that the slopes alone
    give.
    """
    scatter = line_scatter(rng.normal(size=(80, 3)), np.zeros(80), 20)
    assert not np.any(scatter.covariance) and np.all((scatter.dof > 1) & (scatter.dof <= 20))
