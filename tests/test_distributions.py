"""Tails and quantiles against scipy.stats, which computes them its own way, and against printed tables."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from labpipe import distributions as d

DOFS = [1, 2, 3.7, 12, 250, 1e5]
CHANCES = [1e-9, 0.003, 0.025, 0.5, 0.95, 0.975, 0.9999]


@pytest.mark.parametrize("dof", DOFS)
@pytest.mark.parametrize("x", [0.0, 0.3, 1.96, 8.0, 40.0])
def test_tails(x: float, dof: float) -> None:
    assert d.normal_tail(x) == pytest.approx(stats.norm.sf(x), rel=1e-12)
    assert d.student_tail(x, dof) == pytest.approx(stats.t.sf(x, dof), rel=1e-9)
    assert d.chi2_tail(x * dof, dof) == pytest.approx(stats.chi2.sf(x * dof, dof), rel=1e-9, abs=1e-300)
    assert d.f_tail(x, dof, 7) == pytest.approx(stats.f.sf(x, dof, 7), rel=1e-9)
    assert d.gamma_tail(x, dof) == pytest.approx(stats.gamma.sf(x, dof), rel=1e-9, abs=1e-300)


@pytest.mark.parametrize("dof", DOFS)
@pytest.mark.parametrize("p", CHANCES)
def test_quantiles(p: float, dof: float) -> None:
    assert d.normal_quantile(p) == pytest.approx(stats.norm.ppf(p), rel=1e-12, abs=1e-15)
    assert d.student_quantile(p, dof) == pytest.approx(stats.t.ppf(p, dof), rel=1e-7, abs=1e-9)
    assert d.chi2_quantile(p, dof) == pytest.approx(stats.chi2.ppf(p, dof), rel=1e-8)
    assert d.f_quantile(p, dof, 7) == pytest.approx(stats.f.ppf(p, dof, 7), rel=1e-7)


def test_printed_values() -> None:
    """Two-sided 95 % points as every table prints them."""
    assert round(d.student_quantile(0.975, 10), 3) == 2.228
    assert round(d.chi2_quantile(0.95, 5), 2) == 11.07
    assert round(d.f_quantile(0.95, 4, 10), 2) == 3.48
    assert round(d.normal_quantile(0.975), 4) == 1.96


def test_quantiles_take_numpy_numbers() -> None:
    assert d.student_quantile(np.float64(0.975), np.int64(10)) == pytest.approx(2.2281388519649385)
