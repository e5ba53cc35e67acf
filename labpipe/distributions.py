"""Tails and quantiles of the distributions by which results are judged.

Thin names over scipy.special: scipy.stats gives the same numbers, but takes longer to import than all the
rest of labpipe together. scipy.special itself takes as long as numpy: it is imported when a tail is first
asked for, which commands that only look never do.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

Value = float | np.floating


def _special() -> Any:
    from scipy import special

    return special


def normal_tail(z: Value) -> float:
    """P(Z > z) of the standard normal distribution."""
    return float(_special().ndtr(-z))


def normal_quantile(p: Value) -> float:
    """z with P(Z <= z) = p."""
    return float(_special().ndtri(p))


def student_tail(t: Value, dof: Value) -> float:
    """P(T > t) of Student's distribution with *dof* degrees of freedom."""
    return float(_special().stdtr(dof, -t))


def two_sided(t: Value, dof: Value) -> float:
    """P(|T| > |t|) of Student's distribution, of the normal one where *dof* is infinite."""
    size = math.fabs(t)
    return 2 * (student_tail(size, dof) if math.isfinite(dof) else normal_tail(size))


def student_quantile(p: Value, dof: Value) -> float:
    """t with P(T <= t) = p."""
    return float(_special().stdtrit(dof, p))


def coverage_factor(coverage: float, dof: float) -> float:
    """t with P(|T| <= t) = *coverage* [1] for effective degrees of freedom, of the normal distribution where
    they are infinite.

    Equation (unc-coverage).
    """
    p = (1 + coverage) / 2
    return student_quantile(p, dof) if math.isfinite(dof) else normal_quantile(p)


def factor_at_coverage(factor: float, coverage: float) -> float:
    """The factor for a *coverage* [1] by the degrees of freedom at which that for 95 % is *factor*."""
    least = normal_quantile(0.975)
    if factor <= (1 + 1e-9) * least:
        return factor * normal_quantile((1 + coverage) / 2) / least
    return coverage_factor(coverage, float(_special().stdtridf(0.975, factor)))


def chi2_tail(x: Value, dof: Value) -> float:
    """P(X > x) of chi-square with *dof* degrees of freedom, which need not be whole."""
    return float(_special().chdtrc(dof, x))


def chi2_quantile(p: Value, dof: Value) -> float:
    """x with P(X <= x) = p."""
    return 2.0 * float(_special().gammaincinv(dof / 2, p))


def f_tail(x: Value, numerator: Value, denominator: Value) -> float:
    """P(F > x) of Fisher's distribution with *numerator* and *denominator* degrees of freedom."""
    return float(_special().fdtrc(numerator, denominator, x))


def f_quantile(p: Value, numerator: Value, denominator: Value) -> float:
    """x with P(F <= x) = p."""
    return float(_special().fdtri(numerator, denominator, p))


def gamma_tail(x: Value, shape: Value) -> float:
    """P(X > x) of the gamma distribution of scale one."""
    return float(_special().gammaincc(shape, x))
