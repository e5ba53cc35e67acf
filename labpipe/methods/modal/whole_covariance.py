"""Modes refined with the full measured covariance of the FRF: poles, participation, shapes and residual terms
as one output-error fit.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from labpipe.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from labpipe.errors import FitError
from labpipe.estimation.descent import Linearisation, Minimum, linearise_blocks, minimise
from labpipe.estimation.leakage import leaking_noise, line_blocks
from labpipe.estimation.measured import Measured
from labpipe.estimation.output_error import OutputError
from labpipe.estimation.regression import inverse_of
from labpipe.estimation.weights import (
    complex_rows,
    fitted_uncertainty,
    has_noise,
    singular_lines,
    weight_uncertainty,
    white_columns,
    whitener,
)
from labpipe.methods.modal.likelihood import (
    PoleFunctions,
    Refined,
    ResidualTerms,
    pole_functions,
    refine_lines,
)

# Largest number of products that J^T J of one step takes: 35 s on one core at 2.8e10 products a second.
MOST_PRODUCTS = 1e12
# Lines whose covariance has no inverse, as a share of all, that may have their variances instead.
FEW_SINGULAR = 0.05


@dataclass(frozen=True)
class ModalEstimate:
    """Refined modes, their receptance *fitted* (n_line, n_output, n_input) [m/N], degrees of freedom of the
    residual, and where the covariance of the FRF is used chi-square per degree of freedom and its p-value;
    *unused*: why a measured one could not be.
    """

    refined: Refined
    fitted: ComplexArray
    dof: int
    chi2_reduced: float | None = None
    chi2_p: float | None = None
    unused: str = ""


@dataclass(frozen=True)
class ModalReceptance:
    """The receptance (n_line, n_output, n_input) [m/N] of modes and residual terms as a function of real
    parameters.

    These are Re and Im in turn of the poles, of the participation other than the fixed 1 of each mode, of the
    shapes (output by output) and of the factors of the terms (element by element). *real* modes lack the
    imaginary parts of the participation and the real parts of the shapes.
    """

    terms: ResidualTerms
    fixed: IntArray
    n_output: int
    n_input: int
    real: bool = False

    @classmethod
    def of(
        cls, terms: ResidualTerms, refined: Refined, measured: Measured, *, real: bool = False
    ) -> ModalReceptance:
        """The model of refined modes of a measured matrix; *real*: real modes."""
        _, n_output, n_input = measured.matrix.shape
        return cls(terms, np.argmax(refined.participation == 1, axis=1), n_output, n_input, real)

    @property
    def n_mode(self) -> int:
        return int(self.fixed.size)

    @property
    def n_parameter(self) -> int:
        return int(np.count_nonzero(self.free))

    @cached_property
    def free(self) -> BoolArray:
        """Which of the real numbers of `split` are parameters, (n,)."""
        numbers = (self.n_mode, self.n_mode * (self.n_input - 1), self.n_mode * self.n_output)
        free = np.ones((sum(numbers) + self.n_output * self.n_input * self.terms.count, 2), np.bool_)
        if self.real:
            ends = np.cumsum(numbers)
            free[ends[0] : ends[1], 1] = False
            free[ends[1] : ends[2], 0] = False
        return free.ravel()

    def places_of(self, output: int) -> IntArray:
        """Places (n,) among the parameters of those that move the FRFs of one *output*."""
        places = np.where(self.free, np.cumsum(self.free) - 1, -1)
        ends = 2 * self.n_mode * np.array([self.n_input, self.n_input + self.n_output])
        common, *own = np.split(places, ends)
        moving = np.concatenate([common, *(part.reshape(self.n_output, -1)[output] for part in own)])
        return moving[moving >= 0]

    @cached_property
    def basis(self) -> ComplexArray:
        """Residual terms of the receptance, (n_line, n_term) [m/N per factor]."""
        return self.terms.basis / self._form[:, None]

    @property
    def _form(self) -> ComplexArray:
        """Factor (n_line,) from the receptance to the weighted FRF of the measured form."""
        lines = self.terms.lines
        return lines.s**lines.power * lines.weight

    def split(self, parameters: FloatArray) -> tuple[ComplexArray, ComplexArray, ComplexArray, ComplexArray]:
        """Poles (n_mode,) [rad/s], participation (n_mode, n_input), shapes (n_output, n_mode), factors
        (n_output, n_input, n_term) [1].

        *parameters* (n_parameter,) [parameter units].
        """
        numbers = np.zeros(self.free.size)
        numbers[self.free] = parameters
        values = numbers[0::2] + 1j * numbers[1::2]
        ends = np.cumsum([self.n_mode, self.n_mode * (self.n_input - 1), self.n_mode * self.n_output])
        poles, free_factors, shapes, factors = np.split(values, ends)
        participation = np.ones((self.n_mode, self.n_input), np.complex128)
        participation[self._free] = free_factors
        by_element = factors.reshape(self.n_output, self.n_input, -1)
        return poles, participation, shapes.reshape(self.n_output, -1), by_element

    def join(self, refined: Refined, measured: Measured) -> FloatArray:
        """The parameters (n,) [parameter units] of refined modes, with the factors of the terms that fit the
        rest best.
        """
        functions = self.terms.lines.functions(refined.poles)[0]
        modes = _sum(functions, refined.participation, refined.shapes)
        residual = (measured.matrix - modes).reshape(measured.omega.size, -1)
        factors = (self.terms.basis.conj().T @ (residual * self._form[:, None])).T
        free = refined.participation[self._free]
        values = np.concatenate([refined.poles, free, refined.shapes.ravel(), factors.ravel()])
        return np.stack([values.real, values.imag], axis=-1).ravel()[self.free]

    @cached_property
    def _free(self) -> tuple[IntArray, IntArray]:
        rows, columns = np.nonzero(np.arange(self.n_input) != self.fixed[:, None])
        return rows, columns

    def receptance(self, parameters: FloatArray, omega: FloatArray) -> ComplexArray:  # noqa: ARG002
        """H (n_line, n_output, n_input) [m/N] on the lines of the terms, of random data the expected H1."""
        poles, participation, shapes, factors = self.split(parameters)
        residual_terms = np.einsum("lt,oit->loi", self.basis, factors)
        return _sum(self.terms.lines.functions(poles)[0], participation, shapes) + residual_terms

    def jacobian(self, parameters: FloatArray, omega: FloatArray) -> ComplexArray:  # noqa: ARG002
        """dH/dp (n_parameter, n_line, n_output, n_input) [m/N per parameter unit]."""
        functions = self.terms.lines.functions(self.split(parameters)[0])
        return self.slopes(parameters, functions, slice(None))

    def slopes(self, parameters: FloatArray, functions: PoleFunctions, lines: slice) -> ComplexArray:
        """dH/dp (n_parameter, n_line, n_output, n_input) [m/N per parameter unit] of some *lines*, with the
        *functions* of the poles at *parameters* (n_parameter,) [parameter units] on all.
        """
        _, participation, shapes, _ = self.split(parameters)
        (a, b), (a_slope, b_slope) = (tuple(part[lines] for part in pair) for pair in functions)
        slopes = np.zeros((self.free.size // 2, 2, len(a), self.n_output, self.n_input), np.complex128)
        entry = iter(slopes)
        for mode in range(self.n_mode):
            residue = np.outer(shapes[:, mode], participation[mode])
            next(entry)[:] = _pair(a_slope[:, mode], b_slope[:, mode], residue)
        for mode, column in zip(*self._free, strict=True):
            next(entry)[..., column] = _pair(a[:, mode], b[:, mode], shapes[:, mode])
        for output, mode in np.ndindex(self.n_output, self.n_mode):
            next(entry)[:, :, output] = _pair(a[:, mode], b[:, mode], participation[mode])
        for output, column in np.ndindex(self.n_output, self.n_input):
            for term in self.basis[lines].T:
                next(entry)[:, :, output, column] = term, 1j * term
        return slopes.reshape(self.free.size, *slopes.shape[2:])[self.free]


@dataclass(frozen=True)
class ModalRows:
    """The whitened Jacobian of a *problem* at *values* (n_parameter,) [parameter units], made for some lines
    at a time: complex rows (n_line, n_element, n_parameter) [1 per parameter unit].
    """

    problem: OutputError[ModalReceptance]
    values: FloatArray
    given: PoleFunctions | None = None

    @property
    def shape(self) -> tuple[int, ...]:
        model = self.problem.model
        return self.problem.measured.omega.size, model.n_output * model.n_input, self.values.size

    @cached_property
    def functions(self) -> PoleFunctions:
        """Those of the poles at *values* on all lines: *given*, where they are known."""
        model = self.problem.model
        return self.given or model.terms.lines.functions(model.split(self.values)[0])

    def __getitem__(self, lines: slice, /) -> ComplexArray:
        slopes = self.problem.model.slopes(self.values, self.functions, lines)
        return -np.sqrt(2.0) * white_columns(self.problem.weights, lines, slopes.transpose(1, 2, 3, 0))

    def linearise(self) -> Linearisation:
        """The linearisation there, block by block."""
        residual = complex_rows(self.problem.residual(self.values), self.shape[0])

        def blocks() -> Iterator[tuple[IntArray, FloatArray, FloatArray]]:
            for part, places, elements in self._parts():
                for lines in line_blocks(part):
                    both = part[lines].reshape(-1, places.size), residual[lines, elements].ravel()
                    jacobian, right_side = (np.concatenate([side.real, side.imag]) for side in both)
                    yield places, jacobian, right_side

        return linearise_blocks(blocks, self.values.size)

    def _parts(self) -> Iterator[tuple[ModalRows, IntArray, slice]]:
        """These rows, or where the noise of outputs is independent those of each, which shapes and terms of
        the others do not move; with the places of their parameters, and their elements.
        """
        model, weights = self.problem.model, self.problem.whitener
        assert isinstance(weights, np.ndarray)
        n_output, n_input = model.n_output, model.n_input
        blocks = weights.reshape(-1, n_output, n_input, n_output, n_input)
        blocks = np.einsum("loiok->olik", blocks)
        if np.count_nonzero(blocks) < np.count_nonzero(weights):
            yield self, np.arange(self.values.size), slice(None)
            return
        one_output = replace(model, n_output=1)
        for output, block in enumerate(blocks):
            places = model.places_of(output)
            problem = OutputError(self.problem.measured, one_output, block)
            elements = slice(output * n_input, (output + 1) * n_input)
            yield ModalRows(problem, self.values[places], self.functions), places, elements

    def project(self, changes: ComplexArray) -> FloatArray:
        """J^T W dH (n_parameter, n_change) [parameter units inverse] of *changes* dH (n_change, n_line,
        n_output, n_input) [m/N].
        """
        white = [complex_rows(self.problem.whiten(change), len(change)) for change in changes]
        side = np.moveaxis(np.array(white), 0, -1)
        blocks = ((self[lines], side[lines]) for lines in line_blocks(self))
        return sum(np.einsum("lep,lec->pc", rows.conj(), part).real for rows, part in blocks)


@dataclass(frozen=True)
class _Modes:
    """The modes of a *model* at any frequency, for what leaks; residual terms are smooth there."""

    model: ModalReceptance

    def receptance(self, parameters: FloatArray, omega: FloatArray) -> ComplexArray:
        poles, participation, shapes, _ = self.model.split(parameters)
        functions, _ = pole_functions(1j * omega, poles, self.model.terms.lines.hysteretic)
        return _sum(functions, participation, shapes)


def _sum(
    functions: tuple[ComplexArray, ComplexArray], participation: ComplexArray, shapes: ComplexArray
) -> ComplexArray:
    residue = shapes[:, None, :] * participation.T[None]
    a, b = (
        np.einsum("lm,oim->loi", function, factor)
        for function, factor in zip(functions, (residue, residue.conj()), strict=True)
    )
    return a + b


def _pair(a: ComplexArray, b: ComplexArray, factor: ComplexArray) -> ComplexArray:
    """Slopes by the real and the imaginary part of x of factor x a + conj(factor x) b, (2, n_line, ...)."""
    first, second = np.multiply.outer(a, factor), np.multiply.outer(b, factor.conj())
    return np.stack([first + second, 1j * (first - second)])


def covariance_fit(
    measured: Measured, terms: ResidualTerms, refined: Refined, *, real: bool
) -> ModalEstimate:
    """The refined modes again, with the covariance of the FRF as weight where there is one and the products
    of the Jacobian, of which some lines are held at a time, do not take too long.

    Without it the estimate is that of *refined*, whose noise comes from the residual; *real*: real modes.
    """
    model = ModalReceptance.of(terms, refined, measured, real=real)
    start = model.join(refined, measured)
    dof = measured.n_equation - model.n_parameter
    if not has_noise(measured) or model.n_parameter**2 * measured.n_equation > MOST_PRODUCTS:
        # The scatter of every line by itself holds what its elements share, and noise that grows with H.
        if refined.converged:
            refined = refine_lines(terms, refined, real=real)
        return ModalEstimate(refined, model.receptance(start, measured.omega), dof)
    try:
        weights, uncertainty = whitener(regular(measured)), weight_uncertainty(measured, dof)
    except FitError as error:
        return ModalEstimate(refined, model.receptance(start, measured.omega), dof, unused=error.what)
    problem = OutputError(measured, model, weights)
    minimum = minimise(problem, start, linearise=lambda values: ModalRows(problem, values).linearise())
    rows = ModalRows(problem, minimum.values)
    linearisation = rows.linearise()
    inverse = inverse_of(linearisation)
    covariance = uncertainty.inflation * inverse
    noise = measured.noise or leaking_noise(measured, _Modes(model), minimum.values)
    if noise is not None:
        covariance, uncertainty = fitted_uncertainty(measured, noise, uncertainty, rows, inverse)
    reduced = linearisation.chi2 / dof / uncertainty.excess
    final = _refine(model, minimum, covariance, refined)
    fitted = model.receptance(minimum.values, measured.omega)
    return ModalEstimate(final, fitted, dof, reduced, uncertainty.p_value(reduced, dof))


def regular(measured: Measured) -> Measured:
    """The measured FRF with the variances alone on the lines whose covariance (n, n) [m^2/N^2] has no
    inverse, where these are few.

    Noise of neighbouring lines can make the covariance of a line singular by chance. As it was where more
    than a share FEW_SINGULAR of the lines are so, or a variance is zero.
    """
    assert measured.covariance is not None
    singular = singular_lines(measured)
    if not np.any(singular) or np.mean(singular) > FEW_SINGULAR:
        return measured
    variance = np.einsum("lii->li", measured.covariance).real
    diagonal = variance[:, :, None] * np.eye(variance.shape[1])
    return replace(measured, covariance=np.where(singular[:, None, None], diagonal, measured.covariance))


def _refine(model: ModalReceptance, minimum: Minimum, covariance: FloatArray, before: Refined) -> Refined:
    poles, participation, shapes, _ = model.split(minimum.values)
    all_numbers = np.zeros((model.free.size, model.free.size))
    all_numbers[np.ix_(model.free, model.free)] = covariance
    n, k = 2 * model.n_mode * model.n_input, 2 * model.n_mode
    blocks = [slice(n + k * output, n + k * (output + 1)) for output in range(model.n_output)]
    return replace(
        before,
        poles=poles,
        participation=participation,
        shapes=shapes,
        covariance=all_numbers[:n, :n],
        shape_covariance=np.array([all_numbers[block, block] for block in blocks]),
        crossed=np.array([all_numbers[block, :n] for block in blocks]),
        converged=minimum.converged,
        steps=minimum.steps,
    )
