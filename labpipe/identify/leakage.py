"""Leakage of random data as part of the model: the expected H1 of a model, and the part of its scatter that is leakage, not noise."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, overload

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray, IntArray
from labpipe.identify.shared_noise import LineBlocks, LinePairs
from labpipe.spectra.leakage import POINTS, LeakageKernel
from labpipe.spectra.matrices import hermitian, without_rounding
from labpipe.spectra.periodic import neighbourhood_mean

if TYPE_CHECKING:
    from labpipe.identify.measured import Measured
    from labpipe.identify.model import DynamicModel, FittedModel, ReceptanceModel, ResponseModel

# Lines to either side over which the noise beside the leakage is averaged, and rounds of that average.
HALF_WIDTH, ROUNDS = 8, 4
# Smallest noise beside the leakage, as a share of both.
SMALLEST_NOISE = 1e-6


@dataclass(frozen=True)
class Leakage:
    """Leakage of the chosen lines.

    kernel of the window; numbers (n_line,) [1]: frequency times length of a block; correlation c_d (n_distance,) [1] of noise between
    lines, see windows.line_correlation; derivatives: of the measured form against the receptance.
    """

    kernel: LeakageKernel
    numbers: IntArray
    correlation: FloatArray
    derivatives: int

    @cached_property
    def grid(self) -> tuple[FloatArray, IntArray]:
        """(omega (n_every,) [rad/s] of all points, place of every line's points among them (n_line, n_point))."""
        points = self.numbers[:, None] * POINTS + self.kernel.offsets.astype(np.intp)
        every, place = np.unique(points, return_inverse=True)
        return 2 * np.pi * every / (POINTS * self.kernel.blocks.length), place.reshape(points.shape)

    @cached_property
    def _factors(self) -> FloatArray:
        """(v / w)^n of every line's points, (n_line, n_point) [1]: the measured form is averaged, not the receptance."""
        omega, place = self.grid
        return (omega[place] / (2 * np.pi * self.numbers[:, None] / self.kernel.blocks.length)) ** self.derivatives

    def pairs(self, distance: int) -> tuple[IntArray, IntArray]:
        """The lines (n_pair,) that have a line *distance* further on, and those (n_pair,)."""
        second = np.searchsorted(self.numbers, self.numbers + distance)
        there = self.numbers[np.minimum(second, self.numbers.size - 1)] == self.numbers + distance
        return np.flatnonzero(there), second[there]

    def points_of(self, model: ReceptanceModel, parameters: FloatArray) -> ComplexArray:
        """H [m/N] of the model at every line's points, (n_line, n_point, n_dof, n_input)."""
        omega, place = self.grid
        values: ComplexArray = model.receptance(parameters, omega)[place] * self._factors[:, :, None, None]
        return values

    def averaged(self, values: ComplexArray) -> ComplexArray:
        """Mean over the kernel of values (..., n_every, n_dof, n_input) at all points, (..., n_line, n_dof, n_input) [unit of values]."""
        # Cases last, as the derivatives of a model lie in memory: one pass over all of them.
        every = np.ascontiguousarray(np.moveaxis(values.reshape(-1, *values.shape[-3:]), 0, -1), np.complex128)
        # Real weights on pairs of real and imaginary part.
        means = (self._weights @ every.reshape(every.shape[0], -1).view(np.float64)).view(np.complex128)
        cases_last = means.reshape(self.numbers.size, *every.shape[1:])
        return np.moveaxis(cases_last, -1, 0).reshape(*values.shape[:-3], self.numbers.size, *values.shape[-2:])

    @cached_property
    def _weights(self) -> Any:
        """Weights of the points of every line as a sparse matrix (n_line, n_every) [1]."""
        from scipy import sparse

        omega, place = self.grid
        n_line, n_point = place.shape
        weights = (self.kernel.weights * self._factors).ravel()
        return sparse.csr_array((weights, place.ravel(), np.arange(0, n_line * n_point + 1, n_point)), shape=(n_line, omega.size))


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

    def receptance(self, parameters: FloatArray, omega: FloatArray) -> ComplexArray:  # noqa: ARG002 (the lines are the leakage's)
        """Expected H1 [m/N] at *parameters* (n_parameter,), (n_line, n_dof, n_input). Equation (frf-smeared)."""
        return self.leakage.averaged(self.model.receptance(parameters, self.leakage.grid[0]))

    def jacobian(self, parameters: FloatArray, omega: FloatArray) -> ComplexArray:  # noqa: ARG002
        """Its derivatives, (n_parameter, n_line, n_dof, n_input) [m/N per parameter unit]."""
        return self.leakage.averaged(self.model.jacobian(parameters, self.leakage.grid[0]))


@overload
def expected(measured: Measured, model: ResponseModel) -> ResponseModel: ...
@overload
def expected(measured: Measured, model: FittedModel) -> FittedModel: ...
def expected(measured: Measured, model: Any) -> Any:
    """The model as random data show it: with the leakage of their blocks, where that is known."""
    return model if measured.leakage is None else SmearedModel(model, measured.leakage)


def leaking_noise(measured: Measured, model: ReceptanceModel, parameters: FloatArray) -> LineBlocks | None:
    """Correlation of noise and leakage of all lines [1] at *parameters* (n_parameter,), relative to what their residual's power gives.

    The residual y - H1 u of a block is leakage sum_v (H(v) - H1(w)) W(w - v) u(v) and noise. What one block loses at its end the next
    one has too much, so that the mean over overlapping blocks scatters less than its residual tells; from line to line it is correlated
    otherwise than noise. None without leakage or noise.
    """
    leakage = measured.leakage
    if leakage is None or measured.covariance is None or not np.isfinite(measured.noise_dof):
        return None
    points = leakage.points_of(model, parameters)
    deviation = points - np.einsum("m,lmoi->loi", leakage.kernel.weights, points)[:, None]
    power = _force_power(measured)
    apparent = _apparent(leakage, deviation, power) / measured.noise_dof
    noise = _noise_beside(measured.covariance, apparent)
    white = np.asarray(np.linalg.inv(np.linalg.cholesky(noise + apparent)), np.complex128)
    of_noise = white @ np.linalg.cholesky(noise)
    pairs = []
    for distance in range(leakage.correlation.size + 2):
        first, second = leakage.pairs(distance)
        covariance, turned = _scatter(leakage, deviation, power, distance)
        shared = float(([1.0, *leakage.correlation, 0.0])[distance])
        correlated = white[first] @ covariance @ hermitian(white[second]) + shared * (of_noise[first] @ hermitian(of_noise[second]))
        pairs.append(LinePairs(first, second, correlated, white[first] @ turned @ white[second].swapaxes(1, 2)))
    return LineBlocks(measured.omega.size, tuple(pairs))


def _force_power(measured: Measured) -> FloatArray:
    """Power of every force relative to the first, (n_input,) [1]: noise of H is as large as that of the outputs over the force."""
    assert measured.covariance is not None
    _, n_output, n_input = measured.matrix.shape
    variance = np.einsum("lii->li", measured.covariance).real.reshape(-1, n_output, n_input)
    ratio: FloatArray = np.median(variance[:, :, :1] / variance, axis=(0, 1))
    return ratio


def _apparent(leakage: Leakage, deviation: ComplexArray, power: FloatArray) -> ComplexArray:
    """Covariance (n_line, n, n) [m^2/N^2] of H from the leakage in a single block's residual, as if blocks were independent."""
    weighted = deviation * (leakage.kernel.weights[:, None, None] * power)
    return _by_force(_rows(weighted) @ hermitian(_rows(deviation)), power)


def _rows(deviation: ComplexArray) -> ComplexArray:
    """Values (n_line, n_point, n_output, n_input) as rows of an output's numbers, (n_line, n_output, n_point n_input) [their unit]."""
    n_line, n_point, n_output, n_input = deviation.shape
    return deviation.transpose(0, 2, 1, 3).reshape(n_line, n_output, n_point * n_input)


def _scatter(leakage: Leakage, deviation: ComplexArray, power: FloatArray, distance: int) -> tuple[ComplexArray, ComplexArray]:
    """E[d_k d_l^H] and E[d_k d_l^T] (n_pair, n, n) [m^2/N^2] of the leakage d in H1 of lines *distance* apart.

    Of circular normal values, over blocks t apart: sum_t (1 - |t| / K) E_t conj(P_t) / K with E_t of the residuals, P_t of the forces, and
    sum_t (1 - |t| / K) Q_t(k, l) Q_-t(l, k) / K with Q_t between the residual of one line and block and the force of the other.
    """
    kernel = leakage.kernel
    first, second = leakage.pairs(distance)
    step = distance * POINTS
    both = kernel.amplitude[step:] * kernel.amplitude[: kernel.amplitude.size - step]
    left, right = deviation[first][:, step:], deviation[second][:, : deviation.shape[1] - step]
    n = deviation.shape[2] * power.size
    left_rows, right_rows = _rows(left * power), hermitian(_rows(right))
    left, right = (np.ascontiguousarray(side).reshape(*side.shape[:2], n) for side in (left, right))
    covariance, turned = np.zeros((2, first.size, n, n), np.complex128)
    for weight, phases in kernel.shifts():
        shifted = weight / kernel.blocks.number * both * phases[step:]
        products = (left_rows * np.repeat(shifted, power.size)) @ right_rows
        covariance += _by_force(products, power) * np.vdot(phases[step:], both)
        there = (shifted @ left).reshape(-1, *deviation.shape[2:])
        back = (both * phases[step:].conj() @ right).reshape(-1, *deviation.shape[2:])
        turned += np.einsum("koj,kpi->koipj", there, back).reshape(-1, n, n)
    return covariance, turned


def _by_force(products: ComplexArray, power: FloatArray) -> ComplexArray:
    """Covariance (n_pair, n, n) of vec(H) from that of the outputs (n_pair, n_output, n_output): each force for itself, over its power."""
    n_pair, n_output, _ = products.shape
    n = n_output * power.size
    return np.einsum("kop,ij->koipj", products, np.diag(1 / power)).reshape(n_pair, n, n)


def _noise_beside(covariance: ComplexArray, apparent: ComplexArray) -> ComplexArray:
    """The noise (n_line, n, n) in the measured covariance beside the leakage: the mean over neighbours, weighted by the sum of both."""
    every = np.ones(covariance.shape[0], bool)
    beside = covariance - apparent
    noise = neighbourhood_mean(covariance, every, HALF_WIDTH)
    for _ in range(ROUNDS):
        size = np.sqrt(np.einsum("lii->li", noise + apparent).real)
        weight = 1 / (size[:, :, None] * size[:, None, :]) ** 2
        noise = neighbourhood_mean(weight * beside, every, HALF_WIDTH) / neighbourhood_mean(weight, every, HALF_WIDTH)
        noise = _positive(noise, covariance + apparent)
    return noise


def _positive(noise: ComplexArray, whole: ComplexArray) -> ComplexArray:
    """The noise (n_line, n, n) without negative parts: at least SMALLEST_NOISE of the *whole* (n_line, n, n)."""
    size = np.sqrt(np.einsum("lii->li", whole).real)
    outer = size[:, :, None] * size[:, None, :]
    values, vectors = np.linalg.eigh(without_rounding(noise / outer))
    raised = np.maximum(values, SMALLEST_NOISE)
    return (vectors * raised[:, None, :]) @ hermitian(vectors) * outer
