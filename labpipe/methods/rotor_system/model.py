"""The matrices of a rotor as sums of constant blocks times functions of unknowns, with all derivatives.

D(w, Omega) = K + Omega H - w^2 M + j w (C + Omega G). H = beta [[0, K_s], [-K_s, 0]] is what damping that
turns with the shaft does in standing coordinates: without it no shaft is unstable by its own damping (Childs
1993). Axes and dofs as in labpipe.methods.rotor.shaft, and two more dofs, y and z, for every pedestal.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np
import scipy
from scipy import linalg

from labpipe.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from labpipe.methods.rotor.response import LEAST_OSCILLATION, solve
from labpipe.methods.rotor.shaft import RotorMatrices

# The matrices with the powers of (j w) and of Omega that they have in D.
POWERS = {"stiffness": (0, 0), "circulatory": (0, 1), "mass": (2, 0), "damping": (1, 0), "gyroscopic": (1, 1)}
# Rigid motions of a free rotor in one plane.
RIGID = 2
# From spin speeds and frequencies of the motion (...) [rad/s] and the values of a term's inputs to its block
# there, (..., k, k).
Curve = Callable[[FloatArray, FloatArray, FloatArray], FloatArray]
# What follows the frequency, at frequencies of the motion (n_mode,) [rad/s]: power of the eigenvalue that the
# blocks are multiplied by, dofs, blocks (n_mode, k, k).
_Added = Callable[[FloatArray], Iterator[tuple[int, IntArray, FloatArray]]]
# What computes derivatives (n_unknown, ...) where they are asked for.
Derivatives = Callable[[], ComplexArray]
# Half-width of the difference that gives the slope of a block by an input, in its standard uncertainties, and
# by the frequency, as a part of it.
INPUT_STEP, FREQUENCY_STEP = 1e-3, 1e-4
# Rounds in which an eigenvalue meets the coefficients at its own frequency, and its last relative change.
ROUNDS, SETTLED = 30, 1e-10
# Two eigenvalues, and two shapes, nearer than this are one and the same.
ALIKE = 1e-6
# Middles of the bands of frequencies [rad/s] in each of which a controlled bearing is first constant.
MIDDLES = np.geomspace(30.0, 3e4, 9)
# Modes of the basis in which these are computed, and the step, as a part of the eigenvalue, from which its
# change with the frequency is counted.
START_MODES, NEAR = 24, 0.1


@dataclass(frozen=True)
class Unknown:
    """A parameter with its prior N(*mean*, *error*^2): the logarithm of a factor, or an amount where it has a
    *unit*.

    nominal: what the factor multiplies [nominal_unit], for people. tests: the tests in which it acts, all
    where none is named. group: the small errors it is one of, whose common size is estimated.
    """

    name: str
    error: float
    mean: float = 0.0
    unit: str = ""
    nominal: float = 1.0
    nominal_unit: str = "1"
    tests: frozenset[str] = frozenset()
    group: str = ""


@dataclass(frozen=True)
class MatrixBlock:
    """A *block* (k, k) [SI units] of one *matrix* at *dofs* (k,), times exp(sum of the unknowns *factors*),
    times the unknown *amount*; unknowns by their numbers.

    support: it is not part of the free rotor. A block may depend on the spin speed, on the unknowns *inputs*,
    and, where it *follows* that, on the frequency of the motion.
    """

    matrix: str
    dofs: tuple[int, ...]
    block: FloatArray | Curve
    factors: tuple[int, ...] = ()
    amount: int | None = None
    support: bool = False
    inputs: tuple[int, ...] = ()
    follows: bool = False

    def at(self, spin: FloatArray | float, omega: FloatArray | float, values: FloatArray) -> FloatArray:
        """The block at *spin* speeds and frequencies *omega* (...) [rad/s] and *values* (n_unknown,) [unit of
        each]: (..., k, k), or (k, k) where it is constant.
        """
        if not callable(self.block):
            return self.block
        speed, frequency = np.broadcast_arrays(spin, omega)
        return self.block(speed, frequency, values[list(self.inputs)])


@dataclass(frozen=True)
class _Stack:
    """Terms of one block size k, to be worked on at once: *numbers* (n_term,) of the terms, dofs (n_term, k),
    blocks (n_term, k, k), the powers of j w and Omega (n_term,), and which are supports.
    """

    numbers: IntArray
    dofs: IntArray
    blocks: FloatArray
    powers: IntArray
    turns: IntArray
    support: BoolArray


@dataclass(frozen=True)
class SystemMatrices(RotorMatrices):
    """The matrices of a rotor and what carries it at one spin speed; *circulatory* H (n_dof, n_dof) [N s/m]
    is multiplied by the spin speed and stands beside the stiffness.
    """

    circulatory: FloatArray

    def restoring(self, spin: float) -> FloatArray:
        """K + Omega H (n_dof, n_dof) [N/m]."""
        return self.stiffness + spin * self.circulatory


@dataclass(frozen=True)
class Roots:
    """Oscillating eigenvalues (n_mode,) [1/s] by rising modulus, displacement shapes (n_dof, n_mode), and
    their derivatives (n_mode, n_unknown) [1/s].
    """

    values: ComplexArray
    shapes: ComplexArray
    slopes: ComplexArray


@dataclass(frozen=True)
class SystemModel:
    """Unknowns, and terms of *n_dof* degrees of freedom, the first *n_shaft* of them the shaft's. Values are
    vectors (n_unknown,): logarithms of factors, and amounts in their units.
    """

    unknowns: tuple[Unknown, ...]
    terms: tuple[MatrixBlock, ...]
    n_dof: int
    n_shaft: int

    @cached_property
    def means(self) -> FloatArray:
        """Means of the priors (n_unknown,) [unit of each]."""
        return np.array([unknown.mean for unknown in self.unknowns])

    @cached_property
    def errors(self) -> FloatArray:
        """Standard uncertainties of the priors (n_unknown,) [unit of each]."""
        return np.array([unknown.error for unknown in self.unknowns])

    @cached_property
    def groups(self) -> dict[str, float]:
        """Declared standard deviations of the small errors, by group [unit of each]."""
        return {unknown.group: unknown.error for unknown in self.unknowns if unknown.group}

    def number(self, name: str) -> int:
        return [unknown.name for unknown in self.unknowns].index(name)

    def in_group(self, group: str) -> BoolArray:
        """Which unknowns are small errors of a *group*, or of none, "", (n_unknown,)."""
        return np.array([unknown.group == group for unknown in self.unknowns])

    def acting(self, test: str) -> BoolArray:
        """Which unknowns act in a test, (n_unknown,)."""
        return np.array([not unknown.tests or test in unknown.tests for unknown in self.unknowns])

    @cached_property
    def _exponents(self) -> tuple[FloatArray, IntArray]:
        """Which factors a term has (n_term, n_unknown), and its amount (n_term,), -1 for none."""
        factors = np.zeros((len(self.terms), len(self.unknowns)))
        for number, term in enumerate(self.terms):
            factors[number, list(term.factors)] = 1
        return factors, np.array([-1 if term.amount is None else term.amount for term in self.terms])

    def _weights(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """What multiplies every block (n_term,), and the derivatives (n_unknown, n_term) of that."""
        factors, amounts = self._exponents
        weights = np.exp(factors @ values)
        of_amount = amounts >= 0
        slopes = np.zeros((len(self.unknowns), weights.size))
        slopes[amounts[of_amount], np.flatnonzero(of_amount)] = weights[of_amount]
        weights[of_amount] *= values[amounts[of_amount]]
        return weights, slopes + factors.T * weights

    @cached_property
    def _stacks(self) -> tuple[_Stack, ...]:
        by_size: dict[int, list[tuple[Any, ...]]] = {}
        for number, term in enumerate(self.terms):
            if not callable(term.block):
                row = (number, term.dofs, term.block, *POWERS[term.matrix], term.support)
                by_size.setdefault(len(term.dofs), []).append(row)
        stacks = (zip(*by_size[size], strict=True) for size in sorted(by_size))
        return tuple(_Stack(*map(np.array, columns)) for columns in stacks)

    def _curve(self, supported: bool) -> Iterator[tuple[int, MatrixBlock]]:
        return (
            (number, term)
            for number, term in enumerate(self.terms)
            if callable(term.block) and (supported or not term.support)
        )

    def _parts(self, turning: bool, supported: bool) -> tuple[IntArray, ...]:
        """Dofs that move together: at rest mostly the two planes; without those that have no mass there, the
        pedestals of a free rotor.
        """
        key = (turning, supported)
        if key not in self._known_parts:
            coupled = np.zeros((self.n_dof, self.n_dof), dtype=bool)
            for term in self.terms:
                if (supported or not term.support) and (turning or not POWERS[term.matrix][1]):
                    shape = (len(term.dofs),) * 2
                    couples = np.ones(shape, bool) if callable(term.block) else term.block != 0
                    coupled[np.ix_(term.dofs, term.dofs)] |= couples
            graph = scipy.sparse.csr_array(coupled)
            number, of_dof = scipy.sparse.csgraph.connected_components(graph, directed=False)
            parts = (np.flatnonzero(of_dof == n) for n in range(number))
            self._known_parts[key] = tuple(part for part in parts if coupled[part].any())
        return self._known_parts[key]

    @cached_property
    def _known_parts(self) -> dict[tuple[bool, bool], tuple[IntArray, ...]]:
        return {}

    @cached_property
    def _spread(self) -> dict[bool, scipy.sparse.csr_array]:
        """From what multiplies the terms (n_term,) to the constant matrices in the order of POWERS, supported
        (True) and free: (5 n_dof^2, n_term).
        """
        n, order = self.n_dof, list(POWERS)
        shape = (len(order) * n * n, len(self.terms))
        standing = np.array([not term.support for term in self.terms])
        if not self._stacks:
            return dict.fromkeys((True, False), scipy.sparse.csr_array(shape))
        matrix = np.array([order.index(term.matrix) for term in self.terms])
        entries = []
        for stack in self._stacks:
            at = (matrix[stack.numbers, None, None] * n + stack.dofs[:, :, None]) * n + stack.dofs[:, None]
            of = np.broadcast_to(stack.numbers[:, None, None], at.shape)
            entries.append((at.ravel(), of.ravel(), stack.blocks.ravel()))
        at, of, values = (np.concatenate(parts) for parts in zip(*entries, strict=True))
        return {
            supported: scipy.sparse.coo_array((values * (supported | standing[of]), (at, of)), shape).tocsr()
            for supported in (True, False)
        }

    def _constant(self, weights: FloatArray, supported: bool) -> FloatArray:
        """The matrices in the order of POWERS without what depends on the spin speed, (5, n_dof, n_dof)."""
        return np.asarray(self._spread[supported] @ weights).reshape(len(POWERS), self.n_dof, self.n_dof)

    def matrices(
        self, values: FloatArray, spin: float, supported: bool = True, omega: float | None = None
    ) -> SystemMatrices:
        """The matrices at *values* (n_unknown,), a *spin* speed, and a frequency *omega* of the motion
        [rad/s], once per revolution where none is given.
        """
        weights, _ = self._weights(values)
        whole = dict(zip(POWERS, self._constant(weights, supported), strict=True))
        for number, term in self._curve(supported):
            block = term.at(spin, spin if omega is None else omega, values)
            whole[term.matrix][np.ix_(term.dofs, term.dofs)] += weights[number] * block
        return SystemMatrices(**whole)

    def dynamic(
        self,
        values: FloatArray,
        spin: FloatArray,
        omega: FloatArray,
        supported: bool = True,
        parts: Sequence[IntArray] | None = None,
    ) -> list[ComplexArray]:
        """D (n_line, n_kept, n_kept) [N/m] at *omega* and *spin* (n_line,) [rad/s], for the dofs (n_kept,) of
        each of the *parts*, which nothing couples; all in one without these.
        """
        weights, _ = self._weights(values)
        constant = self._constant(weights, supported)
        w, turn = np.asarray(omega, np.float64), np.asarray(spin, np.float64)
        of_real, of_imaginary = np.stack([np.ones(w.size), turn, -(w**2)], 1), np.stack([w, w * turn], 1)
        blocks: list[ComplexArray] = []
        for part in [np.arange(self.n_dof)] if parts is None else parts:
            n, kept = part.size, constant[:, part[:, None], part].reshape(len(POWERS), -1)
            whole = np.empty((w.size, n, n), np.complex128)
            whole.real, whole.imag = (
                (factors @ of).reshape(whole.shape)
                for factors, of in ((of_real, kept[:3]), (of_imaginary, kept[3:]))
            )
            for number, term in self._curve(supported):
                power, turns = POWERS[term.matrix]
                at = np.flatnonzero(np.isin(part, term.dofs))
                if at.size:
                    order = np.searchsorted(part, term.dofs)
                    added = weights[number] * term.at(turn, w, values)
                    factor = (1j * w) ** power * turn**turns
                    whole[:, order[:, None], order] += added * factor[:, None, None]
            blocks.append(whole)
        return blocks

    def slopes(
        self,
        values: FloatArray,
        spin: FloatArray | float,
        left: ComplexArray | FloatArray,
        right: ComplexArray | FloatArray,
        root: ComplexArray | complex,
        supported: bool = True,
    ) -> ComplexArray:
        """left D' right for the derivative D' by every unknown, (n_unknown, ...) [unit of left D right].

        left (..., n_row, n_dof), right (..., n_dof, n_column); *root*: j w or an eigenvalue, of the shape ...
        """
        weights, slopes = self._weights(values)
        shape = np.broadcast_shapes(left.shape[:-2], right.shape[:-2])
        whole = np.zeros((len(self.unknowns), *shape, left.shape[-2], right.shape[-1]), np.complex128)
        acting = np.any(slopes != 0, axis=0)
        root, spin = np.asarray(root), np.asarray(spin)

        def factor(power: IntArray | int, turns: IntArray | int) -> ComplexArray:
            return (root**power * spin**turns)[..., None, None]

        for stack in self._stacks:
            kept = acting[stack.numbers] & (supported | ~stack.support)
            if not kept.any():
                continue
            dofs = stack.dofs[kept]
            rows = np.moveaxis(left[..., dofs], -2, 0)
            columns = np.moveaxis(right[..., dofs, :], -3, 0)
            blocks = stack.blocks[kept].reshape(len(dofs), *(1,) * len(shape), *stack.blocks.shape[1:])
            ones = (-1, *(1,) * len(shape))
            parts = rows @ blocks @ columns
            parts *= factor(stack.powers[kept].reshape(ones), stack.turns[kept].reshape(ones))
            whole += np.tensordot(slopes[:, stack.numbers[kept]], parts, axes=1)
        for number, term in self._curve(supported):
            rows, columns = (part[..., list(term.dofs)] for part in (left, right.swapaxes(-1, -2)))
            rows, columns = rows * factor(*POWERS[term.matrix]), columns.swapaxes(-1, -2)
            omega = np.imag(root)
            if acting[number]:
                part = rows @ term.at(spin, omega, values) @ columns
                whole += slopes[:, number].reshape(-1, *(1,) * part.ndim) * part
            for at in term.inputs:
                step = np.zeros(values.size)
                step[at] = INPUT_STEP * self.errors[at]
                high, low = (term.at(spin, omega, values + sign * step) for sign in (1, -1))
                whole[at] += rows @ (weights[number] / (2 * step[at]) * (high - low)) @ columns
        return whole

    def response(
        self,
        values: FloatArray,
        spin: FloatArray,
        omega: FloatArray,
        forces: ComplexArray | FloatArray,
        outputs: Sequence[int],
        supported: bool = True,
    ) -> tuple[ComplexArray, Derivatives, ComplexArray]:
        """y = S D^-1 F (n_line, n_output, n_force) [m], its derivatives (n_unknown, n_line, n_output,
        n_force), and S D^-1 (n_line, n_output, n_dof) [m/N]. *forces* (n_dof, n_force) or (n_line, n_dof,
        n_force) [N]; *omega*, *spin* (n_line,) [rad/s]. By the adjoint: y' = -(S D^-1) D' (D^-1 F), one
        factorisation for all unknowns. Equation (system-adjoint).
        """
        n_line, n_force, n_output = np.size(omega), forces.shape[-1], len(outputs)
        right = np.zeros((n_line, self.n_dof, n_force), np.complex128)
        left = np.zeros((n_line, n_output, self.n_dof), np.complex128)
        parts = self._parts(bool(np.any(spin)), supported)
        for part, block in zip(parts, self.dynamic(values, spin, omega, supported, parts), strict=True):
            loads = np.empty((n_line, part.size, n_force + n_output), np.complex128)
            loads[:, :, :n_force] = forces[..., part, :]
            loads[:, :, n_force:] = part[:, None] == np.asarray(outputs)
            if np.array_equal(block, block.swapaxes(1, 2)):
                # Nothing turns and no bearing couples one way alone: one factorisation is both.
                both = solve(block, loads)
                right[:, part], turned = both[:, :, :n_force], both[:, :, n_force:]
            else:
                right[:, part] = solve(block, loads[:, :, :n_force])
                turned = solve(block.swapaxes(1, 2), loads[:, :, n_force:])
            left[:, :, part] = turned.swapaxes(1, 2)
        slopes = partial(self.slopes, values, spin, left, right, 1j * np.asarray(omega), supported)
        return right[:, list(outputs)], lambda: -slopes(), left

    def roots(
        self,
        values: FloatArray,
        spin: float,
        most: int = 0,
        *,
        dofs: IntArray | None = None,
        supported: bool = True,
        slopes: bool = True,
    ) -> Roots:
        """Eigenvalues of lambda^2 M + lambda (C + Omega G) + K + Omega H, the slowest *most* or all;
        *dofs* (n_kept,): of these alone, the others held. At *values* (n_unknown,) [unit of each]; controlled
        bearings at the frequency of each mode.

        d lambda = -p^H D' v / (p^H (2 lambda M + C + Omega G) v), p the left vector. Equation
        (system-eigenvalue).
        """
        if supported and self._follows:
            return self._following(values, spin, most, slopes)
        whole = self.matrices(values, spin, supported)
        kept = np.arange(self.n_dof) if dofs is None else dofs
        state, inverse = _state_matrix(whole, spin, kept)
        n = kept.size
        roots, *vectors = linalg.eig(state, left=slopes)
        chosen = self._slowest(roots, most, supported)
        eigenvalues = roots[chosen]
        shapes = np.zeros((self.n_dof, chosen.size), np.complex128)
        shapes[kept] = vectors[-1][:n, chosen]
        if not slopes:
            return Roots(eigenvalues, shapes, np.zeros((chosen.size, 0), np.complex128))
        left = np.zeros_like(shapes)
        left[kept] = linalg.lu_solve(inverse, vectors[0][n:, chosen])
        v, p = shapes.T[:, :, None], left.T[:, :, None]
        scale = project_between(p, 2 * eigenvalues[:, None, None] * whole.mass + whole.at_speed(spin), v)
        moved = self.slopes(values, spin, adjoint(p), v, eigenvalues, supported)[:, :, 0, 0]
        return Roots(eigenvalues, shapes, -(moved / scale).T)

    def eigenvalues(self, values: FloatArray, spin: float, most: int) -> ComplexArray:
        """Those of `roots` (n_mode,) [1/s] of all dofs, in about half of its time."""
        if self._follows:
            return self._following(values, spin, most, False).values
        state, _ = _state_matrix(self.matrices(values, spin), spin, np.arange(self.n_dof))
        roots = np.asarray(linalg.eigvals(state))
        return roots[self._slowest(roots, most)]

    @property
    def _follows(self) -> bool:
        return any(term.follows for term in self.terms)

    def _slowest(self, roots: ComplexArray, most: int, supported: bool = True) -> IntArray:
        # Rounding makes slow oscillations of the rigid motions of a free rotor, two for each plane.
        n_rigid = 0 if supported else 2 * RIGID * (roots.size // 2) // (self.n_shaft // 2)
        slowest = np.sort(np.abs(roots))[n_rigid]
        chosen = np.flatnonzero((roots.imag > LEAST_OSCILLATION * np.abs(roots)) & (np.abs(roots) >= slowest))
        return chosen[np.argsort(np.abs(roots[chosen]))][: most or None]

    @cached_property
    def _start_basis(self) -> FloatArray:
        """Orthonormal shapes (n_dof, n_shape) that hold the slow modes whatever the bearings do: modes of the
        rotor at the middle of the priors on springs, and the static shapes of forces at these.
        """
        free, whole = (self.matrices(self.means, 0.0, supported) for supported in (False, True))
        springs = np.abs(np.diag(whole.stiffness - free.stiffness))
        stiffness = free.stiffness + np.diag(springs)
        carried = np.flatnonzero(springs)
        last = min(self.n_dof, START_MODES) - 1
        _, modes = linalg.eigh(stiffness, whole.mass, subset_by_index=[0, last])
        static = np.linalg.solve(stiffness, np.eye(self.n_dof)[:, carried])
        return orthonormal(np.column_stack([modes, static]), 1e-6)

    def _following(self, values: FloatArray, spin: float, most: int, slopes: bool) -> Roots:
        """Eigenvalues with the coefficients at their own frequencies, from those in bands of frequencies with
        the coefficients at the middle of each: by inverse iteration of both vectors, the coefficients anew in
        every step. One that does not settle is left out. With D(lambda, w) at w = Im lambda, g = p^H dD/dw v
        and m = p^H dD/dlambda v: m d lambda + g Im d lambda = -p^H D v in every step, and -p^H D' v for the
        slopes.
        """
        weights, _ = self._weights(values)
        whole = SystemMatrices(**dict(zip(POWERS, self._constant(weights, True), strict=True)))
        restoring, damping = whole.restoring(spin), whole.at_speed(spin)
        curves = [(POWERS[t.matrix][0], np.array(t.dofs), weights[n], t) for n, t in self._curve(True)]

        def added_terms(omega: FloatArray) -> Iterator[tuple[int, IntArray, FloatArray]]:
            return ((power, dofs, weight * t.at(spin, omega, values)) for power, dofs, weight, t in curves)

        def at(root: ComplexArray) -> tuple[ComplexArray, ...]:
            """D, dD/dlambda and dD/dw, (n_mode, n_dof, n_dof)."""
            s, n, step = root[:, None, None], root.size, FREQUENCY_STEP * np.abs(root)
            stiffness: ComplexArray = np.asarray(s**2 * whole.mass + s * damping + restoring, np.complex128)
            by_root = np.asarray(2 * s * whole.mass + damping, np.complex128)
            by_omega = np.zeros(by_root.shape, np.complex128)
            # One evaluation of a bearing at all frequencies: it costs little more than at one.
            for power, dofs, block in added_terms(
                np.concatenate([root.imag, root.imag + step, root.imag - step])
            ):
                here = np.s_[:, dofs[:, None], dofs]
                stiffness[here] += s**power * block[:n]
                by_root[here] += power * block[:n]
                change = (block[n : 2 * n] - block[2 * n :]) / (2 * step[:, None, None])
                by_omega[here] += s**power * change
            return stiffness, by_root, by_omega

        root, shapes = self._solve_bands((whole.mass, damping, restoring), added_terms, most)
        right, left = shapes[:, :, None], shapes[:, :, None].copy()
        open_ones = np.arange(root.size)
        for _ in range(ROUNDS):
            r = root[open_ones]
            stiffness, by_root, by_omega = at(r)
            # A little beside the eigenvalue, where the matrix is regular.
            beside = stiffness + ALIKE**2 * np.abs(r)[:, None, None] * by_root
            v = np.linalg.solve(beside, by_root @ right[open_ones])
            p = np.linalg.solve(adjoint(beside), adjoint(by_root) @ left[open_ones])
            v, p = (vectors / np.linalg.norm(vectors, axis=1, keepdims=True) for vectors in (v, p))
            scale = project_between(p, by_root, v)
            step = -project_between(p, stiffness, v) / scale
            near = np.abs(step) < NEAR * np.abs(r)
            step = np.where(near, follow_frequency(step, project_between(p, by_omega, v) / scale), step)
            root[open_ones], right[open_ones], left[open_ones] = r + step, v, p
            open_ones = open_ones[np.abs(step) > SETTLED * np.abs(r)]
            if not open_ones.size:
                break
        # Two that began apart may have met, and one may oscillate no more.
        alike = np.abs(right[:, :, 0].conj() @ right[:, :, 0].T) > 1 - ALIKE
        alike &= np.abs(root[:, None] - root) < ALIKE * np.abs(root)
        good = (root.imag > LEAST_OSCILLATION * np.abs(root)) & ~np.tril(alike, -1).any(axis=1)
        good[open_ones] = False
        kept = np.flatnonzero(good)
        kept = kept[np.argsort(np.abs(root[kept]))]
        root, right, left = root[kept], right[kept], left[kept]
        if not slopes:
            return Roots(root, right[:, :, 0].T, np.zeros((root.size, 0), np.complex128))
        moved = self.slopes(values, spin, adjoint(left), right, root)[:, :, 0, 0]
        scale, by_omega = (project_between(left, matrix, right) for matrix in at(root)[1:])
        slope = follow_frequency(-moved / scale, by_omega / scale)
        return Roots(root, right[:, :, 0].T, slope.T)

    def _solve_bands(
        self, matrices: tuple[FloatArray, FloatArray, FloatArray], added: _Added, most: int
    ) -> tuple[ComplexArray, ComplexArray]:
        """The slowest eigenvalues (n_mode,) [1/s], and shapes (n_mode, n_dof), each with what is *added* to
        constant mass, damping and stiffness at the middle of its band of frequencies, in a basis.
        """
        basis, edges = self._start_basis, np.sqrt(MIDDLES[1:] * MIDDLES[:-1])
        n = basis.shape[1]
        mass, damping, restoring = (basis.T @ matrix @ basis for matrix in matrices)
        sums = [np.repeat(matrix[None], MIDDLES.size, axis=0) for matrix in (restoring, damping)]
        for power, dofs, block in added(MIDDLES):
            sums[power] += basis[dofs].T @ block @ basis[dofs]
        lower = -np.linalg.solve(mass, np.concatenate(sums, axis=2))
        roots: list[ComplexArray] = []
        shapes: list[ComplexArray] = []
        for band, rows in enumerate(lower):
            state = np.concatenate([np.eye(n, 2 * n, n), rows])
            root, vectors = (np.asarray(part, np.complex128) for part in np.linalg.eig(state))
            inside = np.searchsorted(edges, np.abs(root)) == band
            chosen = np.flatnonzero(inside & (root.imag > LEAST_OSCILLATION * np.abs(root)))
            roots.append(root[chosen])
            shapes.append(vectors[:n, chosen].T @ basis.T)
            if most and sum(map(len, roots)) >= most:
                break
        all_roots = np.concatenate(roots)
        first = np.argsort(np.abs(all_roots))[: most or None]
        return all_roots[first], np.concatenate(shapes)[first]


def orthonormal(shapes: FloatArray, least: float) -> FloatArray:
    """Basis (n_dof, n_kept) [1] of *shapes* (n_dof, n_shape) [any unit], without what is below a *least*
    singular value [1] of the shapes at length 1.
    """
    basis, size, _ = linalg.svd(shapes / np.linalg.norm(shapes, axis=0), full_matrices=False)
    return basis[:, size > least * size[0]]


def project_between(left: ComplexArray, matrices: ComplexArray, right: ComplexArray) -> ComplexArray:
    """p^H A v (n_mode,) [any unit] of vectors (n_mode, n_dof, 1) and matrices (n_mode, n_dof, n_dof)."""
    return (adjoint(left) @ matrices @ right)[:, 0, 0]


def _state_matrix(
    whole: SystemMatrices, spin: float, kept: IntArray
) -> tuple[FloatArray, tuple[FloatArray, IntArray]]:
    """The matrix (2 n_kept, 2 n_kept) of the first-order system of the dofs *kept*, and M factorised."""
    mass, damping, restoring = (
        matrix[np.ix_(kept, kept)] for matrix in (whole.mass, whole.at_speed(spin), whole.restoring(spin))
    )
    # A negative apparent mass may outweigh that of a short element: not positive definite, but regular.
    n, inverse = kept.size, linalg.lu_factor(mass)
    lower = -linalg.lu_solve(inverse, np.concatenate([restoring, damping], axis=1))
    return np.block([[np.zeros((n, n)), np.eye(n)], [lower]]), inverse


def follow_frequency(straight: ComplexArray, by_omega: ComplexArray) -> ComplexArray:
    """d (..., n_mode) [1/s] of d + b Im d = a, for the steps *straight* a (..., n_mode) [1/s] of eigenvalues
    whose coefficients stay, and *by_omega* b (n_mode,) [1] by the frequency that they follow.
    """
    return straight - by_omega * straight.imag / (1 + by_omega.imag)


def adjoint(matrices: ComplexArray) -> ComplexArray:
    """Conjugate transposes (..., n, m) of matrices (..., m, n) [any unit]."""
    return matrices.conj().swapaxes(-1, -2)
