"""Polyreference least-squares complex frequency-domain estimator (p-LSCF): poles of all orders from one set of sums over the lines.

H A(z) = B(z) with real polynomials of z = e^(-s T) and a common right denominator A of size (n_input, n_input): Guillaume, Verboven,
Vanlanduit, Van der Auweraer and Peeters, IMAC 2003. All normal equations are Toeplitz in the powers of z, so that the sums of z^m, z^m H
and z^m H^H H over the lines are all that the data contribute.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray, IntArray

# Position of the highest line in the period of z: below 1, so that the conjugate images of the band stay apart.
TOP_OF_PERIOD = 0.95
# Largest part of the frequencies that may lie below the band without a new origin.
MOST_BELOW = 0.2
# Distance of a new origin from the band, as part of its width.
BELOW_BAND = 0.1
# Relative size of eigenvalues of the normal matrix that rounding leaves of zero (noise-free FRFs of few modes).
ROUNDING = 1e-13


@dataclass(frozen=True)
class Poles:
    """Stable poles: *values* (n,) [rad/s] with positive imaginary part, *participation* (n, n_input) [1] of length 1, *orders* (n,)."""

    values: ComplexArray
    participation: ComplexArray
    orders: IntArray


@dataclass(frozen=True)
class NormalEquations:
    """Normal matrices M of the denominator for every order, from order 1 up to the highest: (n_order, blocks, blocks), blocks = (order +
    1) n_input filled. z = exp(-(s - j origin) T): *origin* [rad/s], *period* T [s]; *scale* (n_input,) of the references.
    """

    matrices: tuple[FloatArray, ...]
    origin: float
    period: float
    scale: FloatArray

    @property
    def n_input(self) -> int:
        return int(self.scale.size)

    def poles(self, order: int, *, stable_noise: bool = False) -> Poles:
        """Poles of a model of *order*; *stable_noise*: constraint A_0 = I in place of A_n = I.

        With A_n = I poles of noise are unstable and the poles of the structure biased; with A_0 = I the bias is least, and poles of
        noise are stable too. Equation (modal-poles).
        """
        n = self.n_input
        matrix = self.matrices[order - 1]
        if stable_noise:
            coefficients = _solved(matrix[n:, n:], -matrix[n:, :n]).reshape(order, n, n)[::-1]
        else:
            coefficients = _solved(matrix[:-n, :-n], -matrix[:-n, -n:]).reshape(order, n, n)
        roots, vectors = _roots(coefficients)
        with np.errstate(divide="ignore"):
            values = np.asarray(np.log(roots) * (1 if stable_noise else -1) / self.period, np.complex128)
        keep = (values.real < 0) & (values.imag > 0)
        participation = vectors[:, keep].T / self.scale
        lengths = np.linalg.norm(participation, axis=1, keepdims=True)
        return Poles(values[keep] + 1j * self.origin, participation / lengths, np.full(int(np.sum(keep)), order))


def normal_equations(omega: FloatArray, matrix: ComplexArray, highest: int) -> NormalEquations:
    """Normal matrices of all orders up to *highest* from FRFs *matrix* (n_line, n_output, n_input) at *omega* (n_line,) [rad/s].

    Every output and every reference has the weight of the reciprocal of its root mean square. With R = L L^T of the highest order, order
    n is the leading block of T - sum over the first n + 1 rows of L^-1 S, so that one factor serves all orders. Equation (modal-lscf).
    """
    n_line, _n_output, n_input = matrix.shape
    scale = 1 / np.sqrt(np.mean(np.abs(matrix) ** 2, axis=(0, 1)))
    scaled = matrix * scale
    scaled = scaled / np.sqrt(np.mean(np.abs(scaled) ** 2, axis=(0, 2)))[None, :, None]
    # From a band far above 0 Hz z would see an arc only, and its powers be alike; a new origin makes the band half the circle again. It
    # lies below the band, since real coefficients make the FRF real there.
    lowest, top = float(omega[0]), float(omega[-1])
    origin = lowest - BELOW_BAND * (top - lowest) if lowest > MOST_BELOW * top else 0.0
    period = TOP_OF_PERIOD * np.pi / (top - origin)
    lags = np.exp(-1j * period * (omega - origin)[:, None] * np.arange(highest + 1))
    gram = np.matmul(scaled.conj().swapaxes(1, 2), scaled).reshape(n_line, -1)
    of_z = np.sum(lags, axis=0).real
    of_h = _both_lags(lags, scaled.reshape(n_line, -1)).reshape(2 * highest + 1, *matrix.shape[1:])
    of_g = _both_lags(lags, gram).reshape(2 * highest + 1, n_input, n_input)
    difference = np.arange(highest + 1)[None, :] - np.arange(highest + 1)[:, None]
    factor = np.linalg.cholesky(of_z[np.abs(difference)])
    right = -of_h[difference + highest].transpose(0, 2, 1, 3).reshape(highest + 1, -1)
    rows = np.linalg.solve(factor, right).reshape(highest + 1, -1, (highest + 1) * n_input)
    total = of_g[difference + highest].transpose(0, 2, 1, 3).reshape((highest + 1) * n_input, -1)
    matrices = []
    for order in range(highest + 1):
        size = (order + 1) * n_input
        total = total - rows[order].T @ rows[order]
        matrices.append((total[:size, :size] + total[:size, :size].T) / 2)
    return NormalEquations(tuple(matrices[1:]), origin, period, scale)


def _both_lags(lags: ComplexArray, values: ComplexArray) -> FloatArray:
    """Real part of the sums over lines of z^m *values* (n_line, n) for m = -highest ... highest, (2 highest + 1, n)."""
    forward = (lags.T @ values).real
    backward = (lags.conj().T @ values).real
    return np.concatenate([backward[:0:-1], forward])


def _solved(matrix: FloatArray, right_side: FloatArray) -> FloatArray:
    """Solution with the eigenvalues left out that are rounding: noise-free data leave the normal matrix singular."""
    try:
        factor = np.linalg.cholesky(matrix)
        diagonal = np.diag(factor)
        if diagonal.min() ** 2 > ROUNDING * diagonal.max() ** 2:
            return np.asarray(np.linalg.solve(matrix, right_side))
    except np.linalg.LinAlgError:
        pass
    values, vectors = np.linalg.eigh(matrix)
    keep = values > ROUNDING * values[-1]
    return np.asarray(vectors[:, keep] @ ((vectors[:, keep].T @ right_side) / values[keep, None]))


def _roots(coefficients: FloatArray) -> tuple[ComplexArray, ComplexArray]:
    """Roots (n,) of det(I z^order + sum A_k z^k) and the left null vectors (n_input, n) of the matrix polynomial there.

    *coefficients* (order, n_input, n_input), A_0 first: eigenvalues of the block companion matrix of the A_k^T, whose eigenvectors begin
    with the null vector.
    """
    order, n, _ = coefficients.shape
    companion = np.zeros((order * n, order * n))
    companion[:-n, n:] = np.eye((order - 1) * n)
    companion[-n:] = -coefficients.transpose(2, 0, 1).reshape(n, -1)
    roots, vectors = np.linalg.eig(companion)
    # The block of the largest modulus has the most digits: z^k of large roots buries the first one.
    blocks = vectors.reshape(order, n, -1)
    largest = np.argmax(np.sum(np.abs(blocks) ** 2, axis=1), axis=0)
    return roots.astype(np.complex128), blocks[largest, :, np.arange(roots.size)].T.astype(np.complex128)
