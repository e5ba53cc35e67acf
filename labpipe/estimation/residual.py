"""Whether the residual of a fit is noise, and the scatter of the residual along the lines as its covariance.

Every line gives a share of the estimate; the shares of lines near each other may have common noise (a window
spreads it), and lines may differ in noise. The sum of their products with Bartlett's weights allows for both
(Newey and West 1987, Econometrica 55:703).

Where the size of the noise is not known, the structure of the residual is compared with that of noise under
the same fit: a residual is (I - P) n with P the projection on the Jacobian's columns, so noise is drawn,
projected likewise, and the same statistics are computed: their p-values are exact whatever the band.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.distributions import chi2_tail
from labpipe.estimation.leakage import SharedNoise
from labpipe.estimation.weights import complex_rows

# Lines whose noise may be common: a window's main lobe at least, and more where more lines show it, as
# n^(1/3).
FEWEST_NEIGHBOURS = 3


@dataclass(frozen=True)
class LineScatter:
    """*covariance* of the estimates (n_parameter, n_parameter), and degrees of freedom behind each variance,
    (n_parameter,) [1].
    """

    covariance: FloatArray
    dof: FloatArray


def line_scatter(
    jacobian: FloatArray, residual: FloatArray, n_line: int, *, alone: bool = False
) -> LineScatter:
    """sum over lines l, d of w_d g_l g_{l+d}^T, with g_l = (J^T J)^-1 J_l^T (1 - H_ll)^-1 r_l and w_d = 1 - d
    / (D + 1).

    *jacobian* (n_equation, n_parameter) [1 per parameter unit], *residual* (n_equation,) [1]: real before
    imaginary parts. (1 - H_ll)^-1 undoes what the line takes from its own residual (jackknife, MacKinnon and
    White 1985). Degrees of freedom of a quadratic form of independent lines (Bell and McCaffrey 2002, Survey
    Methodology 28:169). *alone*: D = 0, lines differ in the size of their noise (HC3). LinAlgError for
    dependent columns. Equation (est-line-scatter).
    """
    orthogonal, triangle = np.linalg.qr(jacobian)
    by_line = _split_by_line(orthogonal, n_line)
    leverage = by_line @ by_line.swapaxes(1, 2)
    scatter = jackknife_residual(leverage, _split_by_line(residual[:, None], n_line))
    to_parameters = np.linalg.inv(triangle)
    shares = (by_line.swapaxes(1, 2) @ scatter)[:, :, 0] @ to_parameters.T
    # Bartlett's weights.
    n_near = 0 if alone else min(max(FEWEST_NEIGHBOURS, round(n_line ** (1 / 3))), n_line - 1)
    weights = 1 - np.arange(1, n_near + 1) / (n_near + 1)
    covariance = shares.T @ shares
    for distance, weight in enumerate(weights, start=1):
        product = weight * (shares[:-distance].T @ shares[distance:])
        covariance += product + product.T
    influence = np.sum((by_line @ to_parameters.T) ** 2, axis=1)
    return LineScatter(covariance, _effective(influence, shares**2) / (1 + 2 * float(weights @ weights)))


def jackknife_residual(leverage: FloatArray, residual: FloatArray) -> FloatArray:
    """(1 - H_ll)^-1 r_l: residuals (n_line, n, 1) [1] without what each line takes from its own, by its
    *leverage* H_ll (n_line, n, n) [1].
    """
    return np.linalg.solve(np.eye(leverage.shape[1]) - leverage, residual)


def _split_by_line(columns: FloatArray, n_line: int) -> FloatArray:
    n = columns.shape[1]
    return columns.reshape(2, n_line, -1, n).swapaxes(0, 1).reshape(n_line, -1, n)


def _effective(influence: FloatArray, squares: FloatArray) -> FloatArray:
    """Number of lines that determine each variance, (n_parameter,) [1], by the model's slopes and by the
    shares seen: (sum v)^2 / sum v^2 of their variances v, (n_line, n_parameter); normal ones have E g^4 =
    3 v^2.
    """
    by_slopes = np.sum(influence, axis=0) ** 2 / np.sum(influence**2, axis=0)
    fourth = np.sum(squares**2, axis=0)
    by_shares = np.divide(3 * np.sum(squares, axis=0) ** 2, fourth, out=by_slopes.copy(), where=fourth > 0)
    return np.minimum(by_slopes, by_shares)


# Draws of noise: the least p-value of four statistics cannot be below about 4 / draws. Few tell one that is
# usual of noise: of .01 they make .1 less than once in 10^15.
DRAWS, FEWEST_DRAWS, FEW_DRAWS, USUAL_P = 1999, 599, 299, 0.1
# Complex values in all draws together, and beyond which there is no test.
VALUES, MOST_VALUES = 2_000_000, 20_000_000
# Values of draws looked at together: they stay in the processor's cache.
AT_ONCE = 32_000
LAGS = 8
WIDTHS = (3, 6, 12)
DEGREE = 3
SAID = (
    "it is alike on neighbouring lines",
    "it stays on one side over several lines",
    "it grows with the response",
    "it follows a smooth curve",
)


@dataclass(frozen=True)
class Structure:
    """*p_value*: probability [1] of so much structure in noise, the best of all statistics counted once.
    *said*: what it looks like.
    """

    p_value: float
    said: str


# Power of noise along the lines: one for all, a + b |H|^2, or that between neighbours of the residual, a mean
# of this part of the lines.
EVEN, GROWING, LOCAL = "even", "growing", "local"
NEIGHBOURHOOD = 0.1


@dataclass(frozen=True)
class Null:
    """The noise that a residual is compared with: *shared* from line to line, None for independent lines; of
    a *power* along them. *few*: by few draws alone.
    """

    shared: SharedNoise | None = None
    power: str = EVEN
    few: bool = False


def residual_structure(
    residual: FloatArray, jacobian: FloatArray, size: FloatArray, null: Null | None = None
) -> Structure | None:
    """The structure of a residual (n_equation,) [1] of a fit with *jacobian* (n_equation, n_parameter) [1 per
    parameter unit]; *size* (n_line, n_element) [m/N] of the response. None of too few lines. A p-value that
    is usual of noise is by few draws. Equation (est-structure).
    """
    null, n_line = null or Null(), size.shape[0]
    if n_line <= LAGS + DEGREE + 1:
        return None
    errors = complex_rows(residual, n_line)
    levels = _levels(errors, size, null.power)
    if np.any(levels == 0):
        return None
    n_draw = FEW_DRAWS if null.few else int(np.clip(VALUES // errors.size, FEWEST_DRAWS, DRAWS))
    if n_draw * errors.size > MOST_VALUES:
        return None
    basis = np.linalg.qr(jacobian)[0]
    rows = np.tile(levels.reshape(-1), 2)[:, None]
    # Orthonormal polynomials of the line number.
    curves = np.polynomial.chebyshev.chebvander(np.linspace(-1, 1, n_line), DEGREE)
    smooth = np.linalg.qr(curves)[0]
    observed = _statistics(errors[:, :, None], size, smooth)[0]

    def against(n_draw: int) -> Structure:
        noise, statistics = _draw(n_line, size.shape[1], n_draw, null.shared), []
        for part in np.array_split(noise, 1 + noise.size // AT_ONCE, axis=1):
            drawn = rows * part
            drawn -= basis @ (basis.T @ drawn)
            statistics.append(_statistics(complex_rows(drawn, n_line), size, smooth))
        return _least_p(observed, np.concatenate(statistics))

    by_few = against(FEW_DRAWS)
    return by_few if null.few or by_few.p_value >= USUAL_P else against(n_draw)


def _levels(errors: ComplexArray, size: FloatArray, kind: str) -> FloatArray:
    """Root of the power along the lines (n_line, n_element) [1]: the mean, a + b *size*^2, both >= 0, or the
    local mean of second differences.
    """
    power = np.abs(errors) ** 2
    mean = np.mean(power, axis=0)
    if kind == EVEN:
        return np.broadcast_to(np.sqrt(mean), power.shape)
    if kind == LOCAL:
        second = np.abs(np.diff(errors, 2, axis=0)) ** 2
        sums = np.cumsum(np.concatenate([np.zeros_like(second[:1]), second]), axis=0)
        half = max(LAGS, round(NEIGHBOURHOOD * len(power) / 2))
        centre = np.arange(len(power)) - 1
        low, high = np.clip(centre - half, 0, None), np.clip(centre + half + 1, None, len(second))
        return np.sqrt((sums[high] - sums[low]) / (high - low)[:, None])
    square = size**2 / np.mean(size**2, axis=0)
    spread = np.mean((square - 1) ** 2, axis=0)
    together = np.mean((square - 1) * power, axis=0)
    slope = np.divide(together, spread, out=np.zeros_like(spread), where=spread > 0)
    return np.sqrt(mean + np.clip(slope, 0.0, mean) * (square - 1))


def _draw(n_line: int, n_element: int, n_draw: int, shared: SharedNoise | None) -> FloatArray:
    rng = np.random.default_rng(n_line)
    if shared is None:
        return rng.standard_normal((2 * n_line * n_element, n_draw))
    noise = shared.draw(rng, n_element, n_draw).reshape(n_line * n_element, n_draw)
    return np.concatenate([noise.real, noise.imag])


def _statistics(residual: ComplexArray, size: FloatArray, smooth: FloatArray) -> FloatArray:
    """Four statistics (n_draw, 4) of residuals (n_line, n_element, n_draw) that structure makes large, of any
    size; *size* (n_line, n_element) [m/N], *smooth* (n_line, n_curve) [1].
    """
    # Lines last: neighbours beside each other.
    along = np.ascontiguousarray(residual.T)
    scaled = along / np.sqrt(_square(along).mean(axis=2, keepdims=True))
    lags = (np.vecdot(scaled[:, :, :-d], scaled[:, :, d:]) for d in range(1, LAGS + 1))
    alike = sum(_square(lag).sum(axis=1) for lag in lags)
    sums = np.zeros((*scaled.shape[:2], scaled.shape[2] + 1), complex)
    np.cumsum(scaled, axis=2, out=sums[:, :, 1:])
    moving = [_square(sums[:, :, n:] - sums[:, :, :-n]).max(axis=(1, 2)) / n for n in WIDTHS]
    weight = size**2 / np.mean(size**2, axis=0)
    grown = _square(scaled).reshape(len(scaled), -1) @ weight.T.reshape(-1)
    curved = _square(scaled @ smooth).sum(axis=(1, 2))
    return np.column_stack([alike, np.max(moving, axis=0), grown, curved])


def _square(values: ComplexArray) -> FloatArray:
    return values.real**2 + values.imag**2


def _least_p(observed: FloatArray, draws: FloatArray) -> Structure:
    n_draw = draws.shape[0]
    beyond = np.sum(draws >= observed, axis=0)
    # Of several beyond all draws the one that is furthest.
    best = int(np.lexsort((-observed / np.mean(draws, axis=0), beyond))[0])
    # A draw's least p-value is no larger where one of its statistics is among as many of the largest.
    last = max(n_draw - 1 - int(beyond[best]), 0)
    among = np.any(draws >= np.partition(draws, last, axis=0)[last], axis=1)
    p_value = float((1 + np.sum(among)) / (n_draw + 1))
    if beyond[best] == 0:
        # Beyond all draws: of the gamma distribution with their mean and variance.
        mean, variance = float(np.mean(draws[:, best])), float(np.var(draws[:, best]))
        tail = chi2_tail(2 * float(observed[best]) * mean / variance, 2 * mean**2 / variance)
        p_value = min(p_value, len(SAID) * tail)
    return Structure(p_value, SAID[best])
