"""Noise that lines of an FRF share: its correlation from line to line as a matrix that is never formed, and what it does to a fit."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import fft

from labpipe.arrays import ComplexArray, FloatArray, IntArray

# Columns of the correlation formed together: enough to keep the overhead small, few enough for the memory.
COLUMNS_AT_ONCE = 64


@dataclass(frozen=True)
class SharedNoise:
    """Noise of the chosen lines, whitened element by element: e(k, a) = sum_j gains(k, j, a) z(k + j - m, a), cov(z_(k+d), z_k) = r_d.

    numbers (n_line,): numbers of the chosen lines; correlation r_1, r_2, ... (n_distance,) [1]; gains (n_line, 2 m + 1, n_element) [1],
    or None where every line has the noise of its own number alone.
    """

    numbers: IntArray
    correlation: ComplexArray
    gains: ComplexArray | None = None

    def times(self, columns: ComplexArray) -> ComplexArray:
        """R X: the correlation matrix (n_line n_element)^2 [1] times *columns* (n_line, n_element, n_column) [any unit]."""
        places = self._places
        spread = np.zeros((self._n_place, *columns.shape[1:]), np.complex128)
        for neighbour, gain in enumerate(self._factors):
            # Line numbers do not repeat, so that one neighbour of all lines can be added at once.
            spread[places + neighbour] += gain.conj()[:, :, None] * columns
        spread = self._by_distance(spread)
        return np.asarray(sum(gain[:, :, None] * spread[places + neighbour] for neighbour, gain in enumerate(self._factors)))

    def drawn(self, rng: np.random.Generator, n_element: int) -> ComplexArray:
        """Circular normal noise of this correlation, (n_line, n_element) [1]."""
        return self.drawn_often(rng, n_element, 1)[:, :, 0]

    def drawn_often(self, rng: np.random.Generator, n_element: int, n_draw: int) -> ComplexArray:
        """*n_draw* independent draws of it, (n_line, n_element, n_draw) [1]."""
        kernel = self._kernel(self._n_place)
        power = np.maximum(fft.fft(kernel).real, 0.0)
        white = rng.standard_normal((2, kernel.size, n_element, n_draw)) / np.sqrt(2)
        shared = fft.ifft(np.sqrt(power)[:, None, None] * fft.fft(white[0] + 1j * white[1], axis=0), axis=0)
        drawn = sum(gain[:, :, None] * shared[self._places + neighbour] for neighbour, gain in enumerate(self._factors))
        return np.asarray(drawn)

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
        return np.ones((1, self.numbers.size, 1), np.complex128) if self.gains is None else self.gains.swapaxes(0, 1)

    @cached_property
    def _places(self) -> IntArray:
        """Where the first neighbour of every line stands among all lines from the first to the last one, (n_line,)."""
        return self.numbers - self.numbers[0]

    @property
    def _n_place(self) -> int:
        return int(self._places[-1]) + self._factors.shape[0]

    def _by_distance(self, columns: ComplexArray) -> ComplexArray:
        """The Toeplitz matrix of the correlation times *columns* (n_place, ...) [any unit], as a circular convolution."""
        n = columns.shape[0]
        kernel = self._kernel(n)
        shape = (-1,) + (1,) * (columns.ndim - 1)
        product: ComplexArray = fft.ifft(fft.fft(kernel).reshape(shape) * fft.fft(columns, kernel.size, axis=0), axis=0)[:n]
        return product

    def _kernel(self, n: int) -> ComplexArray:
        """The correlation of *n* lines as that of a circle of lines so long that its ends do not meet."""
        used = self.correlation[: n - 1]
        kernel = np.zeros(fft.next_fast_len(n + used.size), np.complex128)
        kernel[: used.size + 1] = np.concatenate([[1.0], used])
        kernel[kernel.size - used.size :] = used[::-1].conj()
        return kernel


@dataclass(frozen=True)
class LinePairs:
    """Noise e of the lines *first* and *second* (n_pair,): E[e_k e_l^H] and E[e_k e_l^T], (n_pair, n_element, n_element) [1]."""

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
        """R X + T X*: the covariance of real and imaginary parts times *columns* (n_line, n_element, n_column) [any unit]."""
        product = np.zeros_like(columns)
        for distance, pair in enumerate(self.pairs):
            # A line occurs once among the first ones, and once among the second ones of its distance.
            product[pair.first] += pair.correlation @ columns[pair.second] + pair.turned @ columns[pair.second].conj()
            if distance:
                product[pair.second] += pair.correlation.conj().swapaxes(1, 2) @ columns[pair.first]
                product[pair.second] += pair.turned.swapaxes(1, 2) @ columns[pair.first].conj()
        return product

    @property
    def trace(self) -> float:
        """tr(R), averaged over the elements [1]."""
        return float(np.einsum("kaa->", self.pairs[0].correlation).real) / self.pairs[0].correlation.shape[1]

    @property
    def power(self) -> float:
        """tr(R^2) + tr(T T*), averaged over the elements [1]."""
        squares = [float(np.sum(np.abs(pair.correlation) ** 2) + np.sum(np.abs(pair.turned) ** 2)) for pair in self.pairs]
        return (squares[0] + 2 * sum(squares[1:])) / self.pairs[0].correlation.shape[1]


@dataclass(frozen=True)
class SharedResidual:
    """What shared noise does to a weighted fit: the covariance of its estimates and the moments of its residual.

    covariance (n_parameter, n_parameter) [parameter units]; mean and dof [1]: the sum of squares of the residual is like
    chi-square of *dof* degrees of freedom, scaled to *mean*.
    """

    covariance: FloatArray
    mean: float
    dof: float


def shared_residual(noise: SharedNoise | LineBlocks, jacobian: ComplexArray, inverse: FloatArray) -> SharedResidual:
    """With R the noise's correlation, A = (J^H J)^-1 and P = 1 - J A J^H: A J^H R J A, tr(P R) and tr(P R)^2 / tr(P R P R).

    *jacobian* (n_line, n_element, n_parameter) complex, whitened to unit variance of real and imaginary part [1 per parameter unit];
    *inverse* A (n_parameter, n_parameter). The residual's mean and variance as of a sum of squares of correlated normal values
    (Satterthwaite 1946). Equation (est-shared-residual).
    """
    columns = jacobian.reshape(-1, jacobian.shape[2])
    product = noise.times(jacobian).reshape(columns.shape)
    middle = (columns.conj().T @ product).real
    square = (product.conj().T @ product).real
    mean = 2 * noise.trace * jacobian.shape[1] - float(np.sum(inverse * middle))
    half = inverse @ middle
    spread = 2 * noise.power * jacobian.shape[1] - 2 * float(np.sum(inverse * square)) + float(np.trace(half @ half))
    return SharedResidual(half @ inverse, mean, mean**2 / spread)
