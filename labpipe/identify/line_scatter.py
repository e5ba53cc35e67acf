"""Covariance of an output-error fit from the scatter of its residual along the lines, for noise that is not known or not all there is.

Every line gives a share of the estimate; the shares of lines near each other may have common noise (a window spreads it), and lines may
differ in noise. The sum of their products with Bartlett's weights allows for both (Newey and West 1987, Econometrica 55:703).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labpipe.arrays import FloatArray

# Lines whose noise may be common: a window's main lobe at least, and more where more lines show it, as n^(1/3).
FEWEST_NEIGHBOURS = 3


@dataclass(frozen=True)
class LineScatter:
    """*covariance* of the estimates (n_parameter, n_parameter), and degrees of freedom behind each variance, (n_parameter,) [1]."""

    covariance: FloatArray
    dof: FloatArray


def line_scatter(jacobian: FloatArray, residual: FloatArray, n_line: int, *, alone: bool = False) -> LineScatter:
    """sum over lines l, d of w_d g_l g_{l+d}^T, with g_l = (J^T J)^-1 J_l^T (1 - H_ll)^-1 r_l and w_d = 1 - d / (D + 1).

    *jacobian* (n_equation, n_parameter) [1 per parameter unit], *residual* (n_equation,) [1] of output_error.OutputError: real parts, then
    imaginary parts. (1 - H_ll)^-1 undoes what the line itself takes from its residual (jackknife, MacKinnon and White 1985). The degrees
    of freedom are those of a quadratic form of independent lines (Bell and McCaffrey 2002, Survey Methodology 28:169).
    *alone*: the noise of every line is its own, so that D = 0 and only its size differs (HC3, MacKinnon and White 1985).
    numpy.linalg.LinAlgError for dependent columns. Equation (est-line-scatter).
    """
    orthogonal, triangle = np.linalg.qr(jacobian)
    by_line = _by_line(orthogonal, n_line)
    leverage = by_line @ by_line.swapaxes(1, 2)
    scatter = np.linalg.solve(np.eye(leverage.shape[1]) - leverage, _by_line(residual[:, None], n_line))
    to_parameters = np.linalg.inv(triangle)
    shares = (by_line.swapaxes(1, 2) @ scatter)[:, :, 0] @ to_parameters.T
    weights = np.zeros(0) if alone else _bartlett(n_line)
    covariance = shares.T @ shares
    for distance, weight in enumerate(weights, start=1):
        product = weight * (shares[:-distance].T @ shares[distance:])
        covariance += product + product.T
    influence = np.sum((by_line @ to_parameters.T) ** 2, axis=1)
    return LineScatter(covariance, _effective(influence, shares**2) / (1 + 2 * float(weights @ weights)))


def _by_line(columns: FloatArray, n_line: int) -> FloatArray:
    """Columns (n_equation, n) as (n_line, n_equation / n_line, n): the real and imaginary parts of one line together."""
    return columns.reshape(2, n_line, -1, columns.shape[1]).swapaxes(0, 1).reshape(n_line, -1, columns.shape[1])


def _bartlett(n_line: int) -> FloatArray:
    n = min(max(FEWEST_NEIGHBOURS, round(n_line ** (1 / 3))), n_line - 1)
    return 1 - np.arange(1, n + 1) / (n + 1)


def _effective(influence: FloatArray, squares: FloatArray) -> FloatArray:
    """Number of lines that determine each variance, (n_parameter,) [1]: by the model's slopes and by the shares seen, whichever is less.

    (sum v)^2 / sum v^2 of the variances v of the shares, (n_line, n_parameter); normal shares g have E g^4 = 3 v^2. A residual of zero
    has no shares.
    """
    by_slopes = np.sum(influence, axis=0) ** 2 / np.sum(influence**2, axis=0)
    fourth = np.sum(squares**2, axis=0)
    by_shares = np.divide(3 * np.sum(squares, axis=0) ** 2, fourth, out=by_slopes.copy(), where=fourth > 0)
    return np.asarray(np.minimum(by_slopes, by_shares))
