"""Leakage of random data as part of the model, and noise that lines of an FRF share."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Protocol, overload

import numpy as np
import scipy
from scipy import fft

from labpipe.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from labpipe.records.response import Blocks
from labpipe.spectra.matrices import hermitian, without_rounding
from labpipe.spectra.period_average import neighbourhood_mean
from labpipe.spectra.windows import POINTS, LeakageKernel, kernel_of

if TYPE_CHECKING:
    from labpipe.estimation.measured import Measured
    from labpipe.estimation.model import DynamicModel, FittedModel, Receptance, ResponseModel

# Columns of the correlation formed together, and complex numbers of a Jacobian that are held together.
COLUMNS_AT_ONCE, NUMBERS_AT_ONCE = 64, 4_000_000


@dataclass(frozen=True)
class SharedNoise:
    """Noise of the chosen lines, whitened element by element: e(k, a) = sum_j gains(k, j, a) z(k + j - m, a),
    cov(z_(k+d), z_k) = r_d.

    *numbers* (n_line,) of the lines; correlation r_1, r_2, ... (n_distance,) [1]; gains (n_line, 2 m + 1,
    n_element) [1], None where every line has the noise of its own number alone.
    """

    numbers: IntArray
    correlation: ComplexArray
    gains: ComplexArray | None = None

    def times(self, columns: ComplexArray) -> ComplexArray:
        """R X: the correlation matrix [1] times *columns* (n_line, n_element, n_column) [any unit]."""
        places = self._places
        spread = np.zeros((self._n_place, *columns.shape[1:]), np.complex128)
        for neighbour, gain in enumerate(self._factors):
            # Line numbers do not repeat, so that one neighbour of all lines can be added at once.
            spread[places + neighbour] += gain.conj()[:, :, None] * columns
        return self._gather(self._multiply_toeplitz(spread))

    def _gather(self, every: ComplexArray) -> ComplexArray:
        gains = enumerate(self._factors)
        return np.asarray(sum(gain[:, :, None] * every[self._places + n] for n, gain in gains))

    def draw(self, rng: np.random.Generator, n_element: int, n_draw: int = 1) -> ComplexArray:
        """Independent draws of circular normal noise of this correlation, (n_line, n_element, n_draw) [1]."""
        kernel = self._kernel(self._n_place)
        power = np.maximum(fft.fft(kernel).real, 0.0)
        white = rng.standard_normal((2, kernel.size, n_element, n_draw)) / np.sqrt(2)
        shared = fft.ifft(np.sqrt(power)[:, None, None] * fft.fft(white[0] + 1j * white[1], axis=0), axis=0)
        return self._gather(shared)

    @property
    def reach(self) -> int:
        """Largest distance [lines] of lines that share noise."""
        return self.correlation.size + self._factors.shape[0] - 1

    def at(self, lines: slice) -> SharedNoise:
        """That of some *lines* that follow each other."""
        gains = None if self.gains is None else self.gains[lines]
        return SharedNoise(self.numbers[lines], self.correlation, gains)

    @property
    def trace(self) -> float:
        """tr(R) of one element [1]: the number of lines."""
        return float(self.numbers.size)

    @cached_property
    def power(self) -> float:
        """tr(R^2) of one element, averaged over the elements: the sum of all squared correlations [1]."""
        n_line = self.numbers.size
        n_element = 1 if self.gains is None else self.gains.shape[2]
        total = 0.0
        for first in range(0, n_line, COLUMNS_AT_ONCE):
            lines = np.arange(first, min(first + COLUMNS_AT_ONCE, n_line))
            unit = np.zeros((n_line, n_element, lines.size))
            unit[lines, :, lines - first] = 1.0
            total += float(np.sum(np.abs(self.times(unit.astype(np.complex128))) ** 2))
        return total / n_element

    @cached_property
    def _factors(self) -> ComplexArray:
        """Gains by neighbour, (n_neighbour, n_line, n_element or 1)."""
        if self.gains is None:
            return np.ones((1, self.numbers.size, 1), np.complex128)
        return self.gains.swapaxes(0, 1)

    @cached_property
    def _places(self) -> IntArray:
        """Place of every line's first neighbour among all lines from the first to the last, (n_line,)."""
        return self.numbers - self.numbers[0]

    @property
    def _n_place(self) -> int:
        return int(self._places[-1]) + self._factors.shape[0]

    def _multiply_toeplitz(self, columns: ComplexArray) -> ComplexArray:
        """The correlation's Toeplitz matrix times *columns* (n_place, ...), as a circular convolution."""
        n = columns.shape[0]
        kernel = self._kernel(n)
        shape = (-1,) + (1,) * (columns.ndim - 1)
        spectrum = fft.fft(kernel).reshape(shape) * fft.fft(columns, kernel.size, axis=0)
        return fft.ifft(spectrum, axis=0)[:n]

    def _kernel(self, n: int) -> ComplexArray:
        """The correlation of *n* lines as that of a circle of lines so long that its ends do not meet."""
        used = self.correlation[: n - 1]
        kernel = np.zeros(fft.next_fast_len(n + used.size), np.complex128)
        kernel[: used.size + 1] = np.concatenate([[1.0], used])
        kernel[kernel.size - used.size :] = used[::-1].conj()
        return kernel


@dataclass(frozen=True)
class LinePairs:
    """Noise e of the lines *first* and *second* (n_pair,): E[e_k e_l^H] and E[e_k e_l^T], (n_pair, n_element,
    n_element) [1].
    """

    first: IntArray
    second: IntArray
    correlation: ComplexArray
    turned: ComplexArray


@dataclass(frozen=True)
class LineBlocks:
    """Noise of *n_line* lines that only near lines share: pairs of lines 0, 1, 2 ... apart."""

    n_line: int
    pairs: tuple[LinePairs, ...]

    def times(self, columns: ComplexArray) -> ComplexArray:
        """R X + T X*: the noise's covariance times *columns* (n_line, n_element, n_column) [any unit]."""
        product = np.zeros_like(columns)
        for distance, pair in enumerate(self.pairs):
            # A line occurs once among the first ones, and once among the second ones of its distance.
            of_second = columns[pair.second]
            product[pair.first] += pair.correlation @ of_second + pair.turned @ of_second.conj()
            if distance:
                product[pair.second] += pair.correlation.conj().swapaxes(1, 2) @ columns[pair.first]
                product[pair.second] += pair.turned.swapaxes(1, 2) @ columns[pair.first].conj()
        return product

    @property
    def reach(self) -> int:
        """Largest distance [lines] of lines that share noise."""
        return len(self.pairs) - 1

    def at(self, lines: slice) -> LineBlocks:
        """That of some *lines* that follow each other."""
        pairs = []
        for pair in self.pairs:
            inside = (pair.first >= lines.start) & (pair.second < lines.stop)
            places = pair.first[inside] - lines.start, pair.second[inside] - lines.start
            pairs.append(LinePairs(*places, pair.correlation[inside], pair.turned[inside]))
        return LineBlocks(lines.stop - lines.start, tuple(pairs))

    @property
    def trace(self) -> float:
        """tr(R), averaged over the elements [1]."""
        return float(np.einsum("kaa->", self.pairs[0].correlation).real) / self.pairs[0].correlation.shape[1]

    @property
    def power(self) -> float:
        """tr(R^2) + tr(T T*), averaged over the elements [1]."""
        squares = [np.sum(np.abs(p.correlation) ** 2) + np.sum(np.abs(p.turned) ** 2) for p in self.pairs]
        return float(squares[0] + 2 * sum(squares[1:])) / self.pairs[0].correlation.shape[1]


@dataclass(frozen=True)
class SharedResidual:
    """Of a weighted fit: the *covariance* (n_parameter, n_parameter) [parameter units] of its estimates; the
    residual's sum of squares is like chi-square of *dof* degrees of freedom, scaled to *mean* [1].
    """

    covariance: FloatArray
    mean: float
    dof: float


class LineRows(Protocol):
    """Complex rows (n_line, n_element, n_parameter) of a whitened Jacobian, held or made line by line."""

    @property
    def shape(self) -> tuple[int, ...]: ...
    def __getitem__(self, lines: slice, /) -> ComplexArray: ...


def line_blocks(rows: LineRows) -> Iterator[slice]:
    """Lines that follow each other, of which NUMBERS_AT_ONCE or one line are held."""
    n_line, n_element, n_parameter = rows.shape
    size = max(NUMBERS_AT_ONCE // (n_element * n_parameter), 1)
    return (slice(start, min(start + size, n_line)) for start in range(0, n_line, size))


def shared_residual(
    noise: SharedNoise | LineBlocks, jacobian: LineRows, inverse: FloatArray
) -> SharedResidual:
    """With R the noise's correlation, A = (J^H J)^-1 and P = 1 - J A J^H: A J^H R J A, tr(P R) and tr(P R)^2
    / tr(P R P R).

    *jacobian* (n_line, n_element, n_parameter) complex, whitened to unit variance of real and imaginary part
    [1 per parameter unit]; *inverse* A (n_parameter, n_parameter). The residual's mean and variance as of a
    sum of squares of correlated normal values (Satterthwaite 1946). Equation (est-shared-residual).
    """
    n_line, n_element, n_parameter = jacobian.shape
    middle, square = np.zeros((2, n_parameter, n_parameter))
    for lines in line_blocks(jacobian):
        wide = slice(max(lines.start - noise.reach, 0), min(lines.stop + noise.reach, n_line))
        here, columns = slice(lines.start - wide.start, lines.stop - wide.start), jacobian[wide]
        product = noise.at(wide).times(columns)[here].reshape(-1, n_parameter)
        middle += (columns[here].reshape(product.shape).conj().T @ product).real
        square += (product.conj().T @ product).real
    half = inverse @ middle
    mean = 2 * noise.trace * n_element - float(np.sum(inverse * middle))
    spread = 2 * (noise.power * n_element - float(np.sum(inverse * square))) + float(np.trace(half @ half))
    return SharedResidual(half @ inverse, mean, mean**2 / spread)


# Lines to either side over which the noise beside the leakage is averaged, and rounds of that average.
HALF_WIDTH, ROUNDS = 8, 4
# Smallest noise beside the leakage, as a share of both.
SMALLEST_NOISE = 1e-6


@dataclass(frozen=True)
class Leakage:
    """Leakage of the chosen lines.

    kernel of the window; numbers (n_line,) [1]: frequency times length of a block; correlation c_d
    (n_distance,) [1] of noise between lines, see windows.line_correlation; derivatives: of the measured form
    against the receptance.
    """

    kernel: LeakageKernel
    numbers: IntArray
    correlation: FloatArray
    derivatives: int

    @cached_property
    def grid(self) -> tuple[FloatArray, IntArray]:
        """(omega (n_every,) [rad/s] of all points, place of every line's points among them (n_line,
        n_point)).
        """
        points = self.numbers[:, None] * POINTS + self.kernel.offsets.astype(np.intp)
        every, place = np.unique(points, return_inverse=True)
        return 2 * np.pi * every / (POINTS * self.kernel.blocks.length), place.reshape(points.shape)

    @cached_property
    def _factors(self) -> FloatArray:
        """(v / w)^n of every line's points, (n_line, n_point) [1]: the measured form is averaged, not the
        receptance.
        """
        omega, place = self.grid
        centre = 2 * np.pi * self.numbers[:, None] / self.kernel.blocks.length
        return (omega[place] / centre) ** self.derivatives

    def choose(self, lines: BoolArray) -> Leakage:
        """That of the chosen *lines* (n_line,)."""
        return replace(self, numbers=self.numbers[lines])

    def pairs(self, distance: int) -> tuple[IntArray, IntArray]:
        """The lines (n_pair,) that have a line *distance* further on, and those (n_pair,)."""
        second = np.searchsorted(self.numbers, self.numbers + distance)
        there = self.numbers[np.minimum(second, self.numbers.size - 1)] == self.numbers + distance
        return np.flatnonzero(there), second[there]

    def points_of(self, model: Receptance, parameters: FloatArray) -> ComplexArray:
        """H [m/N] of the model at every line's points, (n_line, n_point, n_dof, n_input)."""
        omega, place = self.grid
        return model.receptance(parameters, omega)[place] * self._factors[:, :, None, None]

    def average(self, values: ComplexArray) -> ComplexArray:
        """Mean over the kernel of values (..., n_every, n_dof, n_input) at all points, (..., n_line, n_dof,
        n_input) [unit of values].
        """
        # Cases last, as the derivatives of a model lie in memory: one pass over all of them.
        cases = values.reshape(-1, *values.shape[-3:])
        every = np.ascontiguousarray(np.moveaxis(cases, 0, -1), np.complex128)
        flat, weights = every.reshape(every.shape[0], -1), self.weights
        if np.iscomplexobj(weights.data):
            means = weights @ flat
        else:  # real weights on pairs of real and imaginary part
            means = (weights @ flat.view(np.float64)).view(np.complex128)
        cases_last = means.reshape(self.numbers.size, *every.shape[1:])
        shape = *values.shape[:-3], self.numbers.size, *values.shape[-2:]
        return np.moveaxis(cases_last, -1, 0).reshape(shape)

    @cached_property
    def weights(self) -> Any:
        """Of the mean over the kernel, sparse (n_line, n_every) [1]."""
        omega, place = self.grid
        n_line, n_point = place.shape
        weights = (self.kernel.weights * self._factors).ravel()
        return scipy.sparse.csr_array(
            (weights, place.ravel(), np.arange(0, n_line * n_point + 1, n_point)), shape=(n_line, omega.size)
        )


def leakage_of(
    blocks: Blocks | None, frequency: FloatArray, correlation: FloatArray, derivatives: int
) -> Leakage | None:
    """The leakage at *frequency* (n_line,) [Hz]; None where it is not known."""
    if blocks is None or (kernel := kernel_of(blocks)) is None:
        return None
    numbers = np.round(frequency * blocks.length).astype(np.intp)
    return Leakage(kernel, numbers, correlation, derivatives + blocks.derivatives)


@dataclass(frozen=True)
class SmearedModel:
    """A model whose FRF is its expected H1 on the lines of *leakage*."""

    model: ResponseModel
    leakage: Leakage

    @property
    def names(self) -> tuple[str, ...]:
        return self.model.names

    @property
    def units(self) -> tuple[str, ...]:
        return self.model.units

    @property
    def linear(self) -> DynamicModel:
        return self.model.linear

    def from_linear(self, values: FloatArray) -> FloatArray:
        """Start values (n_parameter,) [parameter units] from those of `linear`."""
        return self.model.from_linear(values)

    def receptance(
        self,
        parameters: FloatArray,
        omega: FloatArray,  # noqa: ARG002 (the lines are the leakage's)
    ) -> ComplexArray:
        """Expected H1 [m/N] at *parameters* (n_parameter,), (n_line, n_dof, n_input). Equation
        (frf-smeared).
        """
        return self.leakage.average(self.model.receptance(parameters, self.leakage.grid[0]))

    def jacobian(self, parameters: FloatArray, omega: FloatArray) -> ComplexArray:  # noqa: ARG002
        """Its derivatives, (n_parameter, n_line, n_dof, n_input) [m/N per parameter unit]."""
        return self.leakage.average(self.model.jacobian(parameters, self.leakage.grid[0]))


@overload
def expected_model(measured: Measured, model: ResponseModel) -> ResponseModel: ...
@overload
def expected_model(measured: Measured, model: FittedModel) -> FittedModel: ...
def expected_model(measured: Measured, model: Any) -> Any:
    """The model as random data show it: with the leakage of their blocks, where that is known."""
    return model if measured.leakage is None else SmearedModel(model, measured.leakage)


def leaking_noise(
    measured: Measured, model: Receptance, parameters: FloatArray
) -> SharedNoise | LineBlocks | None:
    """Correlation of noise and leakage of all lines [1] at *parameters* (n_parameter,), relative to what
    their residual's power gives; None without leakage or noise.

    The residual y - H1 u of a block is leakage sum_v (H(v) - H1(w)) W(w - v) u(v) and noise. What one block
    loses at its end the next has too much: the mean of overlapping blocks scatters less than that tells.
    """
    leakage = measured.leakage
    if leakage is None or measured.covariance is None or not np.isfinite(measured.noise_dof):
        return None
    blocks = leakage.kernel.blocks
    if blocks.degree or blocks.bursts or blocks.after_hit:
        # Local polynomials take off what passes from block to block; little does of bursts.
        return None if blocks.degree else measured.line_noise
    points = leakage.points_of(model, parameters)
    deviation = points - np.einsum("m,lmoi->loi", leakage.kernel.weights, points)[:, None]
    # Power of every force over that of each, by the noise of H, which is over it.
    _, n_output, n_input = measured.matrix.shape
    variance = np.einsum("lii->li", measured.covariance).real.reshape(-1, n_output, n_input)
    # Against the mean of all forces, not one of them: their order is none of the data.
    size = np.log(variance)
    power = np.exp(np.median(np.mean(size, axis=2, keepdims=True) - size, axis=(0, 1)))
    ratios = np.outer(power, 1 / power)
    alone = np.eye(len(ratios))
    of_residual = alone if blocks.apart else ratios
    apparent = _force_products(deviation * leakage.kernel.weights[:, None, None], deviation, of_residual)
    # What responses share is not in the variances of a table, yet they share what leaks.
    apparent *= np.any(measured.covariance != 0, axis=0) / measured.noise_dof
    noise = _noise_beside(measured.covariance, apparent)
    # As the rows of a fit are whitened, and from there by roots that turn with the order of the channels.
    white = np.asarray(np.linalg.inv(np.linalg.cholesky(measured.covariance)), np.complex128)
    white = _power(white @ (noise + apparent) @ hermitian(white), -0.5) @ white
    of_noise = white @ _power(noise, 0.5)
    pairs = []
    for distance, shared in enumerate([1.0, *leakage.correlation.tolist(), 0.0]):
        first, second = leakage.pairs(distance)
        covariance, turned = _scatter(leakage, deviation, alone if blocks.by_force else ratios, distance)
        correlated = white[first] @ covariance @ hermitian(white[second]) + shared * (
            of_noise[first] @ hermitian(of_noise[second])
        )
        other = white[first] @ turned @ white[second].swapaxes(1, 2)
        pairs.append(LinePairs(first, second, correlated, other))
    return LineBlocks(measured.omega.size, tuple(pairs))


def _scatter(
    leakage: Leakage, deviation: ComplexArray, ratios: FloatArray, distance: int
) -> tuple[ComplexArray, ComplexArray]:
    """E[d_k d_l^H] and E[d_k d_l^T] (n_pair, n, n) [m^2/N^2] of the leakage d of lines *distance* apart.

    Of circular normal values, over blocks t apart: sum_t (1 - |t| / K) E_t conj(P_t) / K with E_t of the
    residuals, P_t of the forces, and sum_t (1 - |t| / K) Q_t(k, l) Q_-t(l, k) / K with Q_t between the
    residual of one line and block and the force of the other; K: blocks of a force.
    """
    kernel = leakage.kernel
    first, second = leakage.pairs(distance)
    step = distance * POINTS
    both = kernel.amplitude[step:] * kernel.amplitude[: kernel.amplitude.size - step]
    left, right = deviation[first][:, step:], deviation[second][:, : deviation.shape[1] - step]
    n = deviation[0, 0].size
    rows, columns = (np.ascontiguousarray(side).reshape(*side.shape[:2], n) for side in (left, right))
    covariance, turned = np.zeros((2, first.size, n, n), np.complex128)
    for weight, phases in kernel.shifts():
        shifted = both * phases[step:]
        of_forces = _force_products(left * shifted[:, None, None], right, weight * ratios)
        covariance += of_forces * np.vdot(phases[step:], both)
        there = (shifted @ rows).reshape(-1, *deviation.shape[2:])
        back = (both * phases[step:].conj() @ columns).reshape(-1, *deviation.shape[2:])
        turned += np.einsum("koj,kpi,ij->koipj", there, back, weight * (ratios > 0)).reshape(-1, n, n)
    return covariance, turned


def _force_products(left: ComplexArray, right: ComplexArray, ratios: FloatArray) -> ComplexArray:
    """Sums over points of *left* times conjugate *right* (n_line, n_point, n_output, n_input) of the forces
    by their *ratios*, (n_line, n, n).
    """
    products = left.transpose(0, 3, 2, 1) @ right.conj().transpose(0, 3, 1, 2)
    by_force = np.einsum("kiop,ij,jl->kojpl", products, ratios, np.eye(len(ratios)), optimize=True)
    n = left.shape[2] * left.shape[3]
    return by_force.reshape(-1, n, n)


def _noise_beside(covariance: ComplexArray, apparent: ComplexArray) -> ComplexArray:
    """The noise (n_line, n, n) beside the leakage: a mean over neighbours weighted by the sum of both."""
    every = np.ones(covariance.shape[0], bool)
    beside = covariance - apparent
    noise = neighbourhood_mean(covariance, every, HALF_WIDTH)
    for _ in range(ROUNDS):
        weight = 1 / _sizes(noise + apparent) ** 2
        noise = neighbourhood_mean(weight * beside, every, HALF_WIDTH)
        noise /= neighbourhood_mean(weight, every, HALF_WIDTH)
        noise = _positive(noise, covariance + apparent)
    return noise


def _positive(noise: ComplexArray, whole: ComplexArray) -> ComplexArray:
    """The noise (n_line, n, n) without negative parts: at least SMALLEST_NOISE of the *whole*."""
    sizes = _sizes(whole)
    return _power(without_rounding(noise / sizes), 1.0, SMALLEST_NOISE) * sizes


def _power(matrices: ComplexArray, exponent: float, least: float = 0.0) -> ComplexArray:
    """Hermitian *matrices* (n_line, n, n) to a power, their eigenvalues *least* or more."""
    values, vectors = np.linalg.eigh(matrices)
    raised = np.maximum(values, least) ** exponent
    return (vectors * raised[:, None, :]) @ hermitian(vectors)


def _sizes(covariance: ComplexArray) -> FloatArray:
    """Products s_a s_b of the standard deviations, (n_line, n, n)."""
    size = np.sqrt(np.einsum("lii->li", covariance).real)
    return size[:, :, None] * size[:, None, :]
