"""A model linear in its parameters: dynamic stiffness Z(w) = Z_0(w) + sum_j p_j Z_j(w), forces,
constraints.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from labpipe.arrays import ComplexArray, FloatArray, IntArray
from labpipe.errors import ConfigError, FitError
from labpipe.estimation.settings import FitSettings
from labpipe.records.response import Port
from labpipe.records.rig import AXIS_ANGLES
from labpipe.registry import nearest

# Complex numbers of the derivatives that are made together, in the cache.
CACHED_ELEMENTS = 1 << 16


@dataclass(frozen=True)
class Matrices:
    """Contribution of one parameter (or of all constants) to the equation of motion: stiffness K [N/m]
    (complex with a loss factor), damping C [N.s/m], mass M [kg], each (n_dof, n_dof); force B (n_dof,
    n_input) [1].
    """

    stiffness: FloatArray
    damping: FloatArray
    mass: FloatArray
    force: FloatArray

    def plus(self, other: Matrices, factor: float = 1.0) -> Matrices:
        """The sum with *factor* times other matrices."""
        return Matrices(
            self.stiffness + factor * other.stiffness,
            self.damping + factor * other.damping,
            self.mass + factor * other.mass,
            self.force + factor * other.force,
        )


def no_matrices(n_dof: int, n_input: int) -> Matrices:
    square = np.zeros((n_dof, n_dof))
    return Matrices(square, square, square, np.zeros((n_dof, n_input)))


@dataclass(frozen=True)
class Term:
    """One parameter of a model and its matrices; *droppable*: backward elimination may set it to zero;
    *aliases*: further coefficients tied to its value.
    """

    name: str
    unit: str
    matrices: Matrices
    droppable: bool = True
    aliases: tuple[str, ...] = ()


class Receptance(Protocol):
    """An FRF as a function of parameters."""

    def receptance(self, parameters: FloatArray, omega: FloatArray) -> ComplexArray:
        """H(w) [m/N], (n_line, n_dof, n_input), at *omega* (n_line,) [rad/s]."""
        ...


class ReceptanceModel(Receptance, Protocol):
    """Such an FRF with its Jacobian."""

    def jacobian(self, parameters: FloatArray, omega: FloatArray) -> ComplexArray:
        """dH/dp, (n_parameter, n_line, n_dof, n_input) [m/N per parameter unit]."""
        ...


class FittedModel(ReceptanceModel, Protocol):
    """Model of a fit: the FRF and its Jacobian, and its parameters' names and units."""

    @property
    def names(self) -> tuple[str, ...]: ...
    @property
    def units(self) -> tuple[str, ...]: ...


class ResponseModel(FittedModel, Protocol):
    """Model of an output-error fit that has a model linear in its parameters for the start."""

    @property
    def linear(self) -> DynamicModel:
        """The model linear in its parameters of which this one is a special case."""
        ...

    def from_linear(self, values: FloatArray) -> FloatArray:
        """Start values (n_parameter,) [parameter units] from those of `linear`."""
        ...


@dataclass(frozen=True)
class ActingTerms:
    """The terms that have a matrix of one kind: their *place* among all, their *matrices* as columns
    (n_element, n_acting) [unit of the kind]; *single*: the only element of each, (n_acting,), where all have
    one; *plain*: all elements in order, factor 1.
    """

    place: IntArray | slice
    matrices: ComplexArray
    single: IntArray | None
    plain: bool

    @classmethod
    def of(cls, rows: FloatArray) -> ActingTerms | None:
        """Those of all terms' matrices as *rows* (n_term, n_element) [unit of the kind]; None if all zero."""
        there = np.flatnonzero(np.any(rows != 0, axis=1))
        if there.size == 0:
            return None
        # Neighbours as a slice: picking by numbers copies.
        are_neighbours = there[-1] - there[0] == there.size - 1
        place = slice(int(there[0]), int(there[-1]) + 1) if are_neighbours else there
        matrices, filled = rows[there].T.astype(np.complex128), rows[there] != 0
        single = np.argmax(filled, axis=1) if np.all(np.sum(filled, axis=1) == 1) else None
        return cls(place, matrices, single, np.array_equal(matrices, np.eye(there.size)))

    def combine(self, elements: ComplexArray) -> ComplexArray:
        """sum_e elements[..., e] matrices[e, p], (..., n_acting) [any unit], picked where terms have one."""
        if self.plain:
            return elements
        if self.single is not None:
            factors = self.matrices[self.single, np.arange(self.single.size)]
            return elements[..., self.single] * factors
        return elements @ self.matrices


@dataclass(frozen=True)
class DynamicModel:
    """Z(w) H(w) = B with Z = K + j w C - w^2 M; *constant*: known part of the matrices, *terms*: parameters
    to estimate.
    """

    name: str
    terms: tuple[Term, ...]
    constant: Matrices

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(term.name for term in self.terms)

    @property
    def units(self) -> tuple[str, ...]:
        return tuple(term.unit for term in self.terms)

    @property
    def linear(self) -> DynamicModel:
        return self

    def from_linear(self, values: FloatArray) -> FloatArray:
        """The parameters (n_parameter,) [parameter units], unchanged."""
        return values

    def fix(self, name: str, value: float = 0.0) -> DynamicModel:
        """The model with one parameter fixed instead of estimated."""
        (term,) = (term for term in self.terms if term.name == name)
        others = tuple(other for other in self.terms if other is not term)
        return replace(self, terms=others, constant=self.constant.plus(term.matrices, value))

    def tie(self, names: Sequence[str]) -> DynamicModel:
        """The model with one common value for several parameters, named after the first."""
        first, *others = (term for term in self.terms if term.name in names)
        common = first
        for term in others:
            aliases = (*common.aliases, term.name, *term.aliases)
            common = replace(common, matrices=common.matrices.plus(term.matrices), aliases=aliases)
        kept = (term for term in self.terms if term not in others)
        return replace(self, terms=tuple(common if term is first else term for term in kept))

    def whole(self, parameters: FloatArray) -> Matrices:
        """K [N/m], C [N.s/m], M [kg] and B of *parameters* (n_parameter,); cases in leading dimensions."""
        n_dof, n_input = self.constant.force.shape
        joined = parameters @ self._joined[:-1] + self._joined[-1]
        square = joined[..., : 3 * n_dof**2].reshape(*joined.shape[:-1], 3, n_dof, n_dof)
        force = joined[..., 3 * n_dof**2 :].reshape(*joined.shape[:-1], n_dof, n_input)
        stiffness, damping, mass = (square[..., kind, :, :] for kind in range(3))
        return Matrices(stiffness, damping.real, mass.real, force.real)

    def dynamic_stiffness(self, parameters: FloatArray, omega: FloatArray) -> ComplexArray:
        """Z(w) = K + j w C - w^2 M [N/m], (n_line, n_dof, n_dof); *omega* (n_line,) [rad/s]. Equation
        (est-stiffness).
        """
        return _dynamic_stiffness(self.whole(parameters), omega)

    def receptance(self, parameters: FloatArray, omega: FloatArray) -> ComplexArray:
        """H(w) = Z^-1 B [m/N], (n_line, n_dof, n_input); FitError where Z is singular. Equation
        (est-receptance).
        """
        whole = self.whole(parameters)
        force = whole.force.astype(np.complex128)[None]
        return _regular(np.linalg.solve, _dynamic_stiffness(whole, omega), force)

    def jacobian(self, parameters: FloatArray, omega: FloatArray) -> ComplexArray:
        """dH/dp_j = -Z^-1 (Z_j H - B_j), (n_parameter, n_line, n_dof, n_input) [m/N per parameter unit];
        parameters last in memory.

        Every element e_a e_b^T of a Z_j gives the outer product of column a of Z^-1 and row b of H, which all
        terms share. Equation (est-jacobian).
        """
        whole = self.whole(parameters)
        n_line, (n_dof, n_input), n_parameter = omega.size, whole.force.shape, len(self.terms)
        slopes = np.zeros((n_line, n_dof, n_input, n_parameter), np.complex128)
        n_chunk = max(16, CACHED_ELEMENTS // (n_dof**3 * n_input))
        for start in range(0, n_line, n_chunk):
            lines = slice(start, start + n_chunk)
            self._add_slopes(whole, omega[lines], slopes[lines])
        return slopes.transpose(3, 0, 1, 2)

    def _add_slopes(self, whole: Matrices, omega: FloatArray, slopes: ComplexArray) -> None:
        n_line, n_dof, n_input = slopes.shape[:3]
        inverse = _regular(np.linalg.inv, _dynamic_stiffness(whole, omega))
        by_input = (inverse @ whole.force).swapaxes(1, 2)
        outer = inverse[:, :, None, :, None] * by_input[:, None, :, None, :]
        outer = outer.reshape(n_line, n_dof, n_input, n_dof**2)
        for kind, factor in _line_factors(omega).items():
            acting = self.acting[kind]
            if acting is not None:
                slopes[..., acting.place] -= acting.combine(outer) * factor[:, None, None, None]
        acting = self.acting["force"]
        if acting is not None:
            moved = np.einsum("loa,pai->loip", inverse, acting.matrices.T.reshape(-1, n_dof, n_input))
            slopes[..., acting.place] += moved

    def filter(self, parameters: FloatArray, sides: ComplexArray, omega: FloatArray) -> ComplexArray:
        """Z^-1 times all *sides* (n_side, n_line, n_dof, n_input) [N]; of many, one inverse per line is
        cheaper than solving.
        """
        n_side, n_line, n_dof, n_input = sides.shape
        joined = sides.transpose(1, 2, 0, 3).reshape(n_line, n_dof, n_side * n_input)
        solved = compliance(self, parameters, omega) @ joined
        return solved.reshape(n_line, n_dof, n_side, n_input).transpose(2, 0, 1, 3)

    def equation_terms(self, h: ComplexArray, omega: FloatArray) -> ComplexArray:
        """Z_j H - B_j: the regressors of the equation of motion, (n_parameter, n_line, n_dof, n_input) [1 per
        parameter unit].
        """
        n_line, n_dof, n_input = h.shape
        # Lines in the last axis but one: every product below is one contiguous matrix product.
        terms = np.zeros((len(self.terms), n_dof, n_line, n_input), np.complex128)
        by_dof = np.ascontiguousarray(h.transpose(1, 0, 2))
        for kind, factor in _line_factors(omega).items():
            acting = self.acting[kind]
            if acting is not None:
                moved = (by_dof * factor[:, None]).reshape(n_dof, -1).astype(np.complex128, copy=False)
                stack = self._stacks[kind][acting.place].reshape(-1, n_dof).astype(np.complex128)
                terms[acting.place] += (stack @ moved).reshape(-1, n_dof, n_line, n_input)
        if self.acting["force"] is not None:
            terms -= self._stacks["force"][:, :, None]
        return terms.transpose(0, 2, 1, 3)

    def equation_constant(self, h: ComplexArray, omega: FloatArray) -> ComplexArray:
        """B_0 - Z_0 H [1]: the right side of the equation of motion, (n_line, n_dof, n_input)."""
        return self.constant.force - _dynamic_stiffness(self.constant, omega) @ h

    @cached_property
    def _joined(self) -> FloatArray:
        """K, C, M and B of every term and of the constants as rows, whose sum is one matrix product."""
        every = (*(term.matrices for term in self.terms), self.constant)
        parts = [(m.stiffness, m.damping, m.mass, m.force) for m in every]
        joined = np.array([np.concatenate([matrix.reshape(-1) for matrix in row]) for row in parts])
        if joined.dtype.kind not in "fc":
            hint = "of a plug-in: settings.mass is 'estimate' where no mass is given"
            raise ConfigError(f"model {self.name} has matrices that do not hold numbers", hint=hint)
        return joined

    @cached_property
    def acting(self) -> dict[str, ActingTerms | None]:
        """Of each kind of matrix, the terms that have one; None where no term has."""
        n = len(self.terms)
        return {kind: ActingTerms.of(stack.reshape(n, -1)) for kind, stack in self._stacks.items()}

    @cached_property
    def _stacks(self) -> dict[str, FloatArray]:
        stacks = {}
        for kind in UNITS:
            shape = getattr(self.constant, kind).shape
            stacks[kind] = np.array([getattr(term.matrices, kind) for term in self.terms]).reshape(-1, *shape)
        return stacks


class Equation:
    """e = B F - Z X of a model on its lines, and its derivatives by the coefficients.

    *view* (n_line,) [1/s^n] and *offset* [1] make receptance of the measured form: X = (Y - offset F) / view.
    """

    def __init__(
        self, model: DynamicModel, omega: FloatArray, view: ComplexArray | None = None, offset: float = 0.0
    ) -> None:
        self.model, self.omega = model, omega
        self._view = np.ones(omega.size, np.complex128) if view is None else view
        self._offset = offset
        self.n_output, self.n_force = model.constant.force.shape

    @cached_property
    def _terms(self) -> tuple[ComplexArray, FloatArray]:
        """Z_p(w) (n_parameter, n_line, n_output, n_output) and B_p (n_parameter, n_output, n_force)."""
        w = self.omega[:, None, None]
        stiffness = [
            t.matrices.stiffness + 1j * w * t.matrices.damping - w**2 * t.matrices.mass
            for t in self.model.terms
        ]
        return np.array(stiffness, np.complex128), np.array([t.matrices.force for t in self.model.terms])

    def gain(self, values: FloatArray) -> ComplexArray:
        """G of e = G z at the coefficients, (n_line, n_output, n_channel) [N per channel's unit]."""
        stiffness = self.model.dynamic_stiffness(values, self.omega)
        of_motion = -stiffness / self._view[:, None, None]
        shape = (self.omega.size, self.n_output, self.n_force)
        force = np.broadcast_to(self.model.whole(values).force.astype(np.complex128), shape)
        force = force - self._offset * of_motion if self._offset else force
        return np.concatenate([of_motion, force], axis=2)

    def slopes(self, z: ComplexArray) -> ComplexArray:
        """de/dp of *z*, (n_line, n_experiment, n_output, n_parameter) [N per parameter unit]."""
        force = z[..., self.n_output :]
        shift = self._offset * force[..., : self.n_output] if self._offset else 0.0
        motion = (z[..., : self.n_output] - shift) / self._view[:, None, None]
        stiffness, factors = self._terms
        moved = np.einsum("plij,lej->leip", stiffness, motion)
        if np.any(factors):
            moved = moved - np.einsum("pij,lej->leip", factors, force)
        return -moved


def compliance(model: DynamicModel, parameters: FloatArray, omega: FloatArray) -> ComplexArray:
    """Z(w)^-1 [m/N], (n_line, n_dof, n_dof), at *parameters* (n_parameter,) and *omega* (n_line,) [rad/s];
    FitError where Z is singular.
    """
    return _regular(np.linalg.inv, model.dynamic_stiffness(parameters, omega))


def _line_factors(omega: FloatArray) -> dict[str, NDArray[np.inexact]]:
    return {"stiffness": np.ones_like(omega), "damping": 1j * omega, "mass": -(omega**2)}


def _dynamic_stiffness(matrices: Matrices, omega: FloatArray) -> ComplexArray:
    w = omega[:, None, None]
    whole = matrices.stiffness - w**2 * matrices.mass + 1j * w * matrices.damping
    return np.asarray(whole, np.complex128)


def _regular(operation: Callable[..., ComplexArray], *matrices: ComplexArray) -> ComplexArray:
    """An operation of numpy on dynamic stiffness; FitError where that is singular."""
    try:
        return operation(*matrices)
    except np.linalg.LinAlgError:
        what = "the dynamic stiffness of the model is singular at a line"
        raise FitError(what, hint="check the band and the mass") from None


UNITS = {"stiffness": "N/m", "damping": "N.s/m", "mass": "kg", "force": "1"}


@dataclass(frozen=True)
class Setup:
    """What a model needs to know: ports of a measurement, maybe in a closed loop, and the fit's settings."""

    outputs: tuple[Port, ...]
    inputs: tuple[Port, ...]
    settings: FitSettings
    closed_loop: bool = False

    @property
    def shape(self) -> tuple[int, int]:
        """(n_output, n_input)."""
        return len(self.outputs), len(self.inputs)


def entry_term(
    name: str, kind: str, places: list[tuple[int, int]], shape: tuple[int, int], droppable: bool = True
) -> Term:
    """A parameter that enters the same in all *places* of one matrix; *shape* is (n_dof, n_input)."""
    empty = no_matrices(*shape)
    matrix = getattr(empty, kind).copy()
    for place in places:
        matrix[place] = 1.0
    return Term(name, UNITS[kind], replace(empty, **{kind: matrix}), droppable)


def fixed_matrices(mass: FloatArray, force: FloatArray) -> Matrices:
    """Fixed mass (n, n) [kg] and force factors (n, n_input); no prior of stiffness and damping."""
    return replace(no_matrices(*force.shape), mass=mass, force=force)


def labels(ports: tuple[Port, ...]) -> str:
    """Labels of the ports, for messages."""
    return ", ".join(port.label for port in ports)


def angle_of(port: Port) -> float | None:
    """Direction [rad] from x towards y, None if unknown."""
    return port.angle if port.angle is not None else AXIS_ANGLES.get(port.dof)


# Constraints on single coefficients: fixed values, equal values.


def constrain(model: DynamicModel, settings: FitSettings) -> DynamicModel:
    """*model* with its `fixed` and `tied` settings applied; ConfigError for names the model does not have."""
    for name, value in settings.fixed:
        _check_names(model, name, "fixed")
        model = model.fix(name, value)
    for group in settings.tied:
        for name in group:
            _check_names(model, name, "tied")
        units = {term.unit for term in model.terms if term.name in group}
        if len(set(group)) < 2 or len(units) > 1:
            what = f"tied: {', '.join(group)} cannot have one value"
            raise ConfigError(what, hint="name two or more coefficients of one unit")
        model = model.tie(group)
    if not model.terms:
        what = "every coefficient is fixed, so nothing is left to estimate"
        raise ConfigError(what, hint="shorten `fixed`")
    return model


def _check_names(model: DynamicModel, name: str, key: str) -> None:
    if name not in model.names:
        hint = nearest(name, model.names)
        raise ConfigError(f"{key}: {model.name} has no coefficient '{name}' (left to estimate)", hint=hint)
