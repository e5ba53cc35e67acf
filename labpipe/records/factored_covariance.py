"""The covariance of an FRF matrix as two small factors per line, made whole only where somebody asks for it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import DataError
from labpipe.records.arrays import frozen_array


@dataclass(frozen=True)
class FactoredCovariance:
    """cov(H_oi, H_pj) = R[o, p] G[i, j], one line after the other: a Kronecker product.

    *outputs* R (n_line, n_output, n_output) [output unit^2] and *inputs* G (n_line, n_input, n_input) [1 / input unit^2], both Hermitian
    to the last digit. Of 16 responses and 3 forces these are 265 numbers per line, the whole matrix has 2304.
    """

    outputs: ComplexArray
    inputs: ComplexArray

    def __post_init__(self) -> None:
        n_line, n_output, n_input = self.outputs.shape[0], self.outputs.shape[-1], self.inputs.shape[-1]
        for name, n in (("outputs", n_output), ("inputs", n_input)):
            frozen = frozen_array(getattr(self, name), np.complex128, f"covariance of the {name}", (n_line, n, n))
            object.__setattr__(self, name, frozen)

    def check_shape(self, shape: tuple[int, ...]) -> None:
        """DataError unless the whole covariance has this *shape* (n_line, n, n)."""
        if self.shape != shape:
            raise DataError(f"covariance has the shape {self.shape}, {shape} is needed")

    @property
    def shape(self) -> tuple[int, int, int]:
        """(n_line, n, n) of the whole covariance, n = n_output * n_input."""
        n = self.outputs.shape[1] * self.inputs.shape[1]
        return (self.outputs.shape[0], n, n)

    def element(self, p: int, q: int) -> ComplexArray:
        """The covariance of elements *p* and *q* of vec(H), row-major, (n_line,) [unit^2 of H]."""
        (o, i), (r, j) = (divmod(number, self.inputs.shape[1]) for number in (p, q))
        element: ComplexArray = self.outputs[:, o, r] * self.inputs[:, i, j]
        return element

    @property
    def variance(self) -> FloatArray:
        """E|H - E H|^2 of every element, (n_line, n_output, n_input) [unit^2 of H]."""
        left, right = (np.einsum("lii->li", factor).real for factor in (self.outputs, self.inputs))
        return np.asarray(np.maximum(left[:, :, None] * right[:, None, :], 0.0))

    def whole(self) -> ComplexArray:
        """The covariance of vec(H), row-major, (n_line, n, n) [unit^2 of H], Hermitian; lines are last in memory."""
        n_line, n_output = self.outputs.shape[:2]
        n = self.shape[1]
        by_axes = np.empty((n_output, n // n_output, n_output, n // n_output, n_line), np.complex128)
        np.multiply(self.outputs.transpose(1, 2, 0)[:, None, :, None], self.inputs.transpose(1, 2, 0)[None, :, None], out=by_axes)
        covariance: ComplexArray = by_axes.reshape(n, n, n_line).transpose(2, 0, 1)
        diagonal = np.einsum("fii->fi", covariance)
        diagonal[...] = np.maximum(diagonal.real, 0.0)
        return covariance


class HeldCovariance:
    """An attribute that is given as a whole array (n_line, n, n), in factors, or as None, and read as an array, which is made once."""

    def __get__(self, instance: object | None, owner: type) -> ComplexArray | None:
        if instance is None:
            # The default of a data class.
            return None
        covariance: ComplexArray | FactoredCovariance | None = instance.__dict__["covariance"]
        if isinstance(covariance, FactoredCovariance):
            covariance = covariance.whole()
            covariance.flags.writeable = False
            instance.__dict__["covariance"] = covariance
        return covariance

    def __set__(self, instance: object, value: ComplexArray | FactoredCovariance | None) -> None:
        instance.__dict__["covariance"] = value
