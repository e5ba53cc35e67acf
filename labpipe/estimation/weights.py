"""Weights of the lines in an output-error fit, and the effect of estimated weights.

A covariance S estimated from nu complex degrees of freedom is complex Wishart, S = C W / nu. With a = nu - n,
n outputs, any number of forces: E[S^-1] = nu / a C^-1 and E[S^-1 C S^-1] = nu^3 / (a (a^2 - 1)) C^-1 (Maiwald
and Kraus 2000, IEE Proc. Radar 147:162).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg

from labpipe.arrays import BoolArray, ComplexArray, FloatArray
from labpipe.distributions import chi2_tail, f_tail
from labpipe.errors import FitError
from labpipe.estimation.leakage import LineBlocks, LineRows, SharedNoise, shared_residual
from labpipe.estimation.measured import Measured
from labpipe.estimation.statistics import bisect, stack
from labpipe.records.response import BlockCovariance

# Share of the standard deviations by which a covariance may differ from such a product: rounding.
ROUNDING = 1e-12
# Complex numbers that are looked at, or whitened, together in the cache.
CACHED_NUMBERS = 1 << 16


@dataclass(frozen=True)
class ProductWeights:
    """W_o (n_line, n_output, n_output) of the *outputs* and W_i (n_line, n_input, n_input) of the *inputs*,
    their product [N/m]: FRFs H become uncorrelated as W_o H W_i^T. Equation (est-product-weights).
    """

    outputs: ComplexArray
    inputs: ComplexArray

    def at(self, lines: slice) -> ProductWeights:
        return ProductWeights(self.outputs[lines], self.inputs[lines])

    def whiten(self, values: ComplexArray) -> ComplexArray:
        """FRFs (..., n_line, n_output, n_input) [m/N] uncorrelated and of variance 1, same shape [1]."""
        return self.outputs @ values @ self.inputs.swapaxes(1, 2)

    def whitened_columns(self, by_line: ComplexArray) -> ComplexArray:
        """Terms (n_line, n_output, n_input, n_term) [m/N per unit of the term] likewise, (n_line, n_output *
        n_input, n_term).
        """
        n_line, n_output, _, n_term = by_line.shape
        across = (self.outputs @ by_line.reshape(n_line, n_output, -1)).reshape(by_line.shape)
        return (self.inputs[:, None] @ across).reshape(n_line, -1, n_term)


def correlation_factors(
    covariance: ComplexArray, deviations: FloatArray
) -> tuple[ComplexArray, ComplexArray] | None:
    """R_o (n_line, n_output, n_output) and R_i (n_line, n_input, n_input) [1] whose product is the
    correlation of a *covariance* (n_line, n, n) [m^2/N^2] with the *deviations* (n_line, n_output, n_input)
    [m/N]; None where these or it are no such product, as where each force's own recordings tell its noise. A
    few lines at a time: of many FRFs the covariance is large.
    """
    n_line, n_output, n_input = deviations.shape
    crossed = deviations[:, :, :1] * deviations[:, :1] / (deviations * deviations[:, :1, :1])
    if np.max(np.abs(crossed - 1)) > ROUNDING:
        return None
    by_axes = covariance.reshape(n_line, n_output, n_input, n_output, n_input)
    outputs = by_axes[:, :, 0, :, 0] / (deviations[:, :, None, 0] * deviations[:, None, :, 0])
    inputs = by_axes[:, 0, :, 0, :] / (deviations[:, 0, :, None] * deviations[:, 0, None, :])
    n_chunk = max(16, CACHED_NUMBERS // (n_output * n_input) ** 2)
    for start in range(0, n_line, n_chunk):
        lines = slice(start, start + n_chunk)
        difference = outputs[lines, :, None, :, None] * inputs[lines, None, :, None, :]
        difference -= by_axes[lines] / (deviations[lines, :, :, None, None] * deviations[lines, None, None])
        if np.max(np.abs(difference), initial=0.0) > ROUNDING:
            return None
    return outputs, inputs


# Relative standard deviation of an FRF below which its scatter is rounding, not measured noise.
NOISE_FREE = 1e-10
# Roundings below which the smallest eigenvalue of a covariance of normalised FRFs is zero.
SINGULAR_ROUNDINGS = 100
# Standard errors by which noise of the forces may move an estimate through its weights; how far the noise of
# a line may reach in its deviations, and as a part of a force.
LEAST_SHIFT, FARTHEST, MOST_MOVED = 0.05, 3.0, 0.5


# A whitener (n_line, n, n) [N/m], its diagonals (n_line, n) where all else is zero, or its factors.
Weights = ComplexArray | ProductWeights


@dataclass(frozen=True)
class WeightUncertainty:
    """Effect of weights from an estimated covariance on a fit; all 1 and infinite for a known covariance.

    excess: E[d^H S^-1 d] / E[d^H C^-1 d]. inflation: true covariance of the estimates / (J^H S^-1 J)^-1.
    residual_dof: second degree of freedom of the F distribution of the reduced chi-square. shared: equations
    per degree of freedom of the residual, since lines share noise.
    """

    excess: float = 1.0
    inflation: float = 1.0
    residual_dof: float = np.inf
    shared: float = 1.0

    def p_value(self, reduced: float, dof: int) -> float:
        """Probability of a reduced chi-square at least this large for a correct model; chi-square, or F
        scaled to the mean 1. Equation (est-chi2).
        """
        effective_dof = dof / self.shared
        if not np.isfinite(self.residual_dof):
            return chi2_tail(reduced * effective_dof, effective_dof)
        return f_tail(reduced * self.residual_dof / (self.residual_dof - 2), effective_dof, self.residual_dof)


def weight_uncertainty(measured: Measured, dof: int) -> WeightUncertainty:
    """excess = nu / a, inflation = s nu^2 / (a^2 - 1), residual_dof by the variance of the weighted residual;
    *dof* of the fit.

    s = sum of the correlation of a line's noise with all lines' (Hann: 1.9): exact where the model varies
    little from line to line, slightly too large where neighbours have a common noise estimate. FitError for
    nu <= n + 1. Equations (est-weights), (est-weight-dof).
    """
    nu, n = _weight_dof(measured), _responses_of_one(measured)[0]
    # Where nothing is left of the residual the weights have no say.
    if not np.isfinite(nu) or not dof:
        return WeightUncertainty(inflation=measured.shared_noise, shared=measured.shared_power)
    a = nu - n
    if a <= 1:
        what = f"the covariance of {n} response(s) was estimated from {nu:.3g} degrees of freedom only"
        raise FitError(
            what, hint="average more periods or blocks, raise `smooth`, or of a table leave `averages` out"
        )
    inflation, shared = measured.shared_noise * nu**2 / (a**2 - 1), measured.shared_power
    return WeightUncertainty(nu / a, inflation, _residual_dof(measured, dof, shared), shared)


def _weight_dof(measured: Measured) -> float:
    """Complex degrees of freedom nu of the covariance S of n responses by what its inverse shows, E[S^-1] =
    nu / (nu - n) C^-1. Lines under an exponential window share noise: their mean is sum_i l_i W_i, W_i of the
    degrees of freedom nu_0 of one line and l the eigenvalues of the lines' correlation over their number, of
    which 1 / s = sum_i l_i / (1 + s l_i n / nu_0) tells E[S^-1] = s C^-1 (Couillet and Debbah 2011, sec. 6).
    """
    n, shared = _responses_of_one(measured)[0], measured.noise
    if shared is None or measured.noise_lines <= 1:
        return measured.noise_dof
    correlation = shared.correlation
    kernel = np.concatenate([[1.0], correlation, np.zeros(measured.omega.size)])
    n_line = round(measured.noise_lines * (1 + 2 * float(np.sum(np.abs(correlation) ** 2))))
    shares = np.maximum(np.linalg.eigvalsh(linalg.toeplitz(kernel[:n_line])), 0.0) / n_line
    ratio = n * measured.noise_lines / measured.noise_dof

    def is_below(s: float) -> bool:
        return bool(s * np.sum(shares / (1 + s * shares * ratio)) < 1)

    # As s grows the sum nears its number of lines over n / nu_0.
    if np.count_nonzero(shares > 0) <= ratio:
        return measured.noise_dof
    highest = 2.0
    while is_below(highest):
        highest *= 2
    s = bisect(is_below, 1.0, highest)
    return n * s / (s - 1)


def fitted_uncertainty(
    measured: Measured,
    noise: SharedNoise | LineBlocks,
    uncertainty: WeightUncertainty,
    rows: LineRows,
    inverse: FloatArray,
) -> tuple[FloatArray, WeightUncertainty]:
    """Covariance of the estimates (n_parameter, n_parameter) [parameter units] and the uncertainty of the
    residual of a fit with complex *rows* (n_line, n_element, n_parameter) of J and *inverse* (J^T J)^-1.

    The matrix *noise* replaces *inflation* and *shared* of the *uncertainty*. Under an exponential window
    errors of the noise are common to a resonance: of one response a factor of its weights, which costs no
    efficiency; of n the factor (nu / (nu - n + 1))^2 on the covariance that one set of weights of nu degrees
    of freedom states (Reed, Mallett and Brennan 1974). Equation (est-ml-covariance).
    """
    residual = shared_residual(noise, rows, inverse)
    dof = measured.n_equation - rows.shape[2]
    shared = dof / residual.dof
    estimated = np.isfinite(measured.noise_dof)
    excess = uncertainty.excess * residual.mean / dof
    residual_dof = _residual_dof(measured, dof, shared) if estimated else np.inf
    of_residual = replace(uncertainty, excess=excess, shared=shared, residual_dof=residual_dof)
    inflation = uncertainty.inflation / measured.shared_noise
    if measured.noise is not None and estimated:
        nu = _weight_dof(measured)
        inflation = (nu / (nu - _responses_of_one(measured)[0] + 1)) ** 2
    return inflation * residual.covariance, of_residual


def complex_rows(jacobian: FloatArray, n_line: int) -> ComplexArray:
    """A Jacobian (n_equation, n_parameter) of real parts, then imaginary parts, as complex (n_line,
    n_element, n_parameter) [its unit]; likewise a residual (n_equation,).
    """
    half = jacobian.shape[0] // 2
    return (jacobian[:half] + 1j * jacobian[half:]).reshape(n_line, -1, *jacobian.shape[1:])


def _responses_of_one(measured: Measured) -> tuple[int, int, int]:
    """Responses and forces of one estimated covariance, and how many independent ones there are: of points
    measured one after the other, and of a table, each has its own.
    """
    _, n, q = measured.matrix.shape
    covariance = measured.stored_covariance
    if isinstance(covariance, BlockCovariance):
        block = covariance.elements[0]
    elif isinstance(covariance, np.ndarray):
        block = np.flatnonzero(np.any(covariance[:, 0] != 0, axis=0))
    else:
        return n, q, 1
    n_response = len(np.unique(block // q))
    if n_response < n:
        return n_response, len(block) // n_response, n * q // len(block)
    return n, q, 1


def _residual_dof(measured: Measured, dof: int, shared: float) -> float:
    """The second degree of freedom of the F distribution with the variance of the weighted residual.

    Relative variance of the residual: [g nu a / (q n (a^2 - 1)) + W nu / (n (a^2 - 1))] / L for L lines, q
    forces, W lines with a common noise estimate and g, the lines' *shared* power; of F with d1 = dof / g, d2:
    2 (d1 + d2 - 2) / (d1 (d2 - 4)).
    """
    n, q, n_independent = _responses_of_one(measured)
    n_line = measured.omega.size
    nu = _weight_dof(measured)
    a = nu - n
    # Lines whose noise is averaged count as often as their noise is correlated anyway.
    estimates = max(min(measured.noise_lines * measured.shared_power, n_line), measured.shared_noise)
    variance = nu * (shared * a / q + estimates) / (n * (a**2 - 1) * n_line * n_independent)
    # The fit reduces the residual: both parts scale with the remainder.
    remaining = variance * measured.n_equation / shared
    return float((2 * dof / shared - 4 + 4 * remaining) / (remaining - 2))


def has_noise(measured: Measured) -> bool:
    """Whether the FRF has a measured covariance above rounding."""
    variance = measured.variance
    if variance is None:
        return False
    return bool(np.max(variance) > NOISE_FREE**2 * np.max(np.abs(measured.matrix) ** 2))


def weighted_by_model(measured: Measured, fitted: ComplexArray) -> Measured:
    """The data with the covariance that noise of the forces has at the *fitted* FRF H (n_line, n_output,
    n_input) [m/N] and the likeliest forces; as they are where that moves no estimate by LEAST_SHIFT.

    In cov = S (x) (U U^H)^-1, S = H N_u H^H + N_y, of the measured H + E and U, lines at which noise made
    U large and H small weigh too much: H is low by 2 a v, v its relative variance, a the part of the forces
    in it. With K = N_u H^H S^-1, errors dH become (1 - E K) dH (1 + K E)^-1: the first takes E out of S, the
    second is the likeliest U over the measured one. N as of forces of one size. Equation (est-model-weights).
    """
    variance, channels = measured.variance, measured.noise_of_channels
    if channels is None or variance is None or not has_noise(measured):
        return measured
    measured_frf, model_frf = measured.plus_offset(measured.matrix), measured.plus_offset(fitted)
    _, n_output, n_input = measured_frf.shape
    largest = np.max(np.abs(model_frf) ** 2, axis=2)
    if not np.all(largest > 0):
        return measured
    force_noise = channels[:, :n_input, None] * model_frf.conj().swapaxes(1, 2)
    output_noise = (channels[:, n_input:] * largest)[..., None] * np.eye(n_output)
    gain = force_noise @ np.linalg.inv(model_frf @ force_noise + output_noise)
    share = np.einsum("loi,lio->lo", model_frf, gain).real
    variance = variance.reshape(measured_frf.shape)
    if np.sqrt(8 * np.sum((share**2 / largest)[..., None] * variance)) < LEAST_SHIFT:
        return measured
    error = measured_frf - model_frf
    # What is further off is not noise; where noise is most of a force, nothing tells it.
    is_noise = np.all(np.abs(error) <= FARTHEST * np.sqrt(variance), axis=(1, 2))
    is_noise &= np.max(np.sum(np.abs(gain @ error), axis=2), axis=1) < MOST_MOVED
    error *= is_noise[:, None, None]
    left, right = np.eye(n_output) - error @ gain, np.linalg.inv(np.eye(n_input) + gain @ error)
    n = n_output * n_input
    change = np.einsum("lop,lji->loipj", left, right).reshape(-1, n, n)
    assert measured.covariance is not None
    return replace(measured, covariance=change @ measured.covariance @ change.conj().swapaxes(1, 2))


def whitener(measured: Measured) -> ComplexArray:
    """L^-1 of C = L L^H per line, (n_line, n, n) [N/m]; FitError for a zero variance or a singular C."""
    std, scaled = _scale(measured)
    _check_regular(measured, np.linalg.eigvalsh(scaled)[:, 0])
    return np.linalg.inv(np.linalg.cholesky(scaled)) / std[:, None, :]


def fit_weights(measured: Measured) -> Weights:
    """The whitener, in the shortest form that the covariance has; where no noise is known, equal weights of
    the measured form over its size. FitError as for whitener.
    """
    if not has_noise(measured):
        size = np.sqrt(np.mean(np.abs(measured.form_size[:, None, None] * measured.matrix) ** 2))
        return np.outer(measured.form_size / size, np.ones(measured.matrix[0].size)).astype(np.complex128)
    assert measured.covariance is not None
    std = _deviations(measured)
    if np.count_nonzero(measured.covariance) == std.size:
        return (1 / std).astype(np.complex128)
    by_port = std.reshape(measured.matrix.shape)
    factors = correlation_factors(measured.covariance, by_port)
    if factors is None:
        return short_weights(whitener(measured))
    smallest = [np.linalg.eigvalsh(factor)[:, 0] for factor in factors]
    _check_regular(measured, smallest[0] * smallest[1])
    # Standard deviations are s_o [m/N] of the outputs times s_i [1] of the inputs.
    deviations = by_port[:, :, 0], by_port[:, 0] / by_port[:, 0, :1]
    by_axis = zip(factors, deviations, strict=True)
    roots = (np.linalg.inv(np.linalg.cholesky(factor)) / size[:, None] for factor, size in by_axis)
    return ProductWeights(*roots)


def _check_regular(measured: Measured, smallest: FloatArray) -> None:
    """FitError where the *smallest* eigenvalues (n_line,) [1] of the FRFs' correlations are rounding."""
    n = measured.matrix[0].size
    singular = _is_singular(smallest, n)
    if np.any(singular):
        what = f"the covariance of the {n} FRFs is singular at {_first(measured, singular[:, None])}"
        raise FitError(what, hint="average more periods or blocks, or name fewer responses with `output`")


def singular_lines(measured: Measured) -> BoolArray:
    """Whether the covariance of a line (n, n) [m^2/N^2] has no inverse, for every line. FitError for a zero
    variance.
    """
    scaled = _scale(measured)[1]
    return _is_singular(np.linalg.eigvalsh(scaled)[:, 0], scaled.shape[1])


def _scale(measured: Measured) -> tuple[FloatArray, ComplexArray]:
    """Standard deviations (n_line, n) [m/N] and correlations (n_line, n, n) [1] of the FRFs."""
    assert measured.covariance is not None
    std = _deviations(measured)
    return std, measured.covariance / (std[:, :, None] * std[:, None, :])


def _deviations(measured: Measured) -> FloatArray:
    """Standard deviations (n_line, n) [m/N] of the FRFs; FitError for a zero variance."""
    assert measured.covariance is not None
    std: FloatArray = np.sqrt(np.einsum("lii->li", measured.covariance).real)
    if np.any(std == 0):
        lines = np.flatnonzero(np.any(std == 0, axis=1))
        what = f"the variance of the FRF is zero at {_first(measured, std == 0)}"
        if lines.size > 1:
            what += f" and {lines.size - 1} more of {len(std)} lines"
            hint = "a coherence rounded to 1? Export it with more digits, or leave its `averages` out"
            raise FitError(what, hint=f"{hint}: the noise is then that of the residual")
        raise FitError(what, hint="leave this line out with `exclude`")
    return std


def _is_singular(smallest: FloatArray, n: int) -> BoolArray:
    return smallest < SINGULAR_ROUNDINGS * n * np.finfo(float).eps


def whiten_values(whitener: Weights, values: ComplexArray) -> FloatArray:
    """FRFs (..., n_line, n_output, n_input) [m/N] as uncorrelated real equations (..., n_equation) [1] of
    variance 1. Equation (est-whitened).
    """
    flat, whitener = values.reshape(*values.shape[:-2], -1), short_weights(whitener)
    if isinstance(whitener, ProductWeights):
        whitened = whitener.whiten(values)
    elif whitener.ndim == 2:
        whitened = flat * whitener
    else:
        by_line = np.moveaxis(flat, -2, 0).reshape(flat.shape[-2], -1, flat.shape[-1])
        whitened = np.moveaxis(np.matmul(whitener, by_line.swapaxes(1, 2)), 2, 0)
    return np.sqrt(2.0) * stack(whitened.reshape(*values.shape[:-3], -1))


def whitened_columns(whitener: Weights, terms: ComplexArray) -> FloatArray:
    """Terms (n_term, n_line, n_output, n_input) [m/N per unit of the term] whitened as by `whiten_values`, as
    columns (n_equation, n_term).
    """
    n_term, n_line, n = terms.shape[0], terms.shape[1], terms.shape[2] * terms.shape[3]
    by_line = terms.transpose(1, 2, 3, 0)
    whitener = short_weights(whitener)
    stacked_columns = np.empty((2, n_line, n, n_term))
    n_chunk = max(16, CACHED_NUMBERS // (n * n_term))
    for start in range(0, n_line, n_chunk):
        lines = slice(start, start + n_chunk)
        white = white_columns(whitener, lines, by_line[lines])
        np.multiply(white.real, np.sqrt(2.0), out=stacked_columns[0, lines])
        np.multiply(white.imag, np.sqrt(2.0), out=stacked_columns[1, lines])
    return stacked_columns.reshape(2 * n_line * n, n_term)


def white_columns(whitener: Weights, lines: slice, by_line: ComplexArray) -> ComplexArray:
    """Terms (n_line, n_output, n_input, n_term) [m/N] of some *lines* of a whitener, (n_line, n, n_term)."""
    if isinstance(whitener, ProductWeights):
        return whitener.at(lines).whitened_columns(by_line)
    columns = by_line.reshape(by_line.shape[0], -1, by_line.shape[3])
    return whitener[lines] @ columns if whitener.ndim == 3 else columns * whitener[lines, :, None]


def is_short(weights: Weights) -> bool:
    """Whether *weights* give the noise by less than a whole matrix (n_line, n, n) [N/m]."""
    return isinstance(weights, ProductWeights) or weights.ndim == 2


def short_weights(whitener: Weights) -> Weights:
    """Weights (n_line, n, n) [N/m] as diagonals (n_line, n) where all else is zero: independent noise."""
    if is_short(whitener):
        return whitener
    assert isinstance(whitener, np.ndarray)
    diagonal: ComplexArray = np.einsum("lnn->ln", whitener)
    return diagonal if np.count_nonzero(whitener) == np.count_nonzero(diagonal) else whitener


def _first(measured: Measured, affected: BoolArray) -> str:
    line = int(np.argmax(np.any(affected, axis=1)))
    return f"{measured.omega[line] / (2 * np.pi):g} Hz"
