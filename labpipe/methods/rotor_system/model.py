"""The matrices of a rotor as sums of constant blocks times functions of unknowns, with all derivatives.

D(w, Omega) = K + Omega H - w^2 M + j w (C + Omega G). H = beta [[0, K_s], [-K_s, 0]] is what damping that
turns with the shaft does in standing coordinates: without it no shaft is unstable by its own damping (Childs
1993). Axes and dofs as in labpipe.methods.rotor.shaft, and two more dofs, y and z, for every pedestal.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

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
# From spin speeds (...) [rad/s] to the block of a term there, (..., k, k).
Curve = Callable[[FloatArray], FloatArray]


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

    def acts_in(self, test: str) -> bool:
        return not self.tests or test in self.tests


@dataclass(frozen=True)
class Term:
    """A *block* (k, k) [SI units] of one *matrix* at *dofs* (k,), times exp(sum of the unknowns *factors*),
    times x^*power* of the unknown *amount*; unknowns by their numbers.

    support: it is no part of the free rotor. A block may depend on the spin speed.
    """

    matrix: str
    dofs: tuple[int, ...]
    block: FloatArray | Curve
    factors: tuple[int, ...] = ()
    amount: int | None = None
    power: int = 1
    support: bool = False

    def at(self, spin: FloatArray | float) -> FloatArray:
        """The block at *spin* speeds (...) [rad/s]: (..., k, k), or (k, k) where it is constant."""
        return self.block(np.asarray(spin)) if callable(self.block) else self.block


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
    terms: tuple[Term, ...]
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

    def number(self, name: str) -> int:
        return [unknown.name for unknown in self.unknowns].index(name)

    def acting(self, test: str) -> BoolArray:
        """Which unknowns act in a test, (n_unknown,)."""
        return np.array([unknown.acts_in(test) for unknown in self.unknowns])

    @cached_property
    def _exponents(self) -> tuple[FloatArray, IntArray, FloatArray]:
        """Which factors a term has (n_term, n_unknown), its amount (n_term,), -1 for none, and its power."""
        factors = np.zeros((len(self.terms), len(self.unknowns)))
        for number, term in enumerate(self.terms):
            factors[number, list(term.factors)] = 1
        amounts = np.array([-1 if term.amount is None else term.amount for term in self.terms])
        return factors, amounts, np.array([float(term.power) for term in self.terms])

    def _weights(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """What multiplies every block (n_term,), and the derivatives (n_unknown, n_term) of that."""
        factors, amounts, powers = self._exponents
        weights = np.exp(factors @ values)
        of_amount = amounts >= 0
        x, n = values[amounts[of_amount]], powers[of_amount]
        slopes = np.zeros((len(self.unknowns), weights.size))
        slopes[amounts[of_amount], np.flatnonzero(of_amount)] = weights[of_amount] * n * x ** (n - 1)
        weights[of_amount] *= x**n
        return weights, slopes + factors.T * weights

    @cached_property
    def _stacks(self) -> tuple[_Stack, ...]:
        """The terms of constant blocks by their size."""
        constant = [number for number, term in enumerate(self.terms) if not callable(term.block)]
        stacks = []
        for size in sorted({len(self.terms[number].dofs) for number in constant}):
            numbers = [number for number in constant if len(self.terms[number].dofs) == size]
            terms = [self.terms[number] for number in numbers]
            powers, turns = zip(*(POWERS[term.matrix] for term in terms), strict=True)
            stacks.append(
                _Stack(
                    np.array(numbers),
                    np.array([term.dofs for term in terms]),
                    np.array([term.block for term in terms]),
                    np.array(powers),
                    np.array(turns),
                    np.array([term.support for term in terms]),
                )
            )
        return tuple(stacks)

    def _curve(self, supported: bool) -> Iterator[tuple[int, Term]]:
        """Terms that depend on the spin speed, with their numbers."""
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
            number, of_dof = scipy.sparse.csgraph.connected_components(
                scipy.sparse.csr_array(coupled), directed=False
            )
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
        n, order = self.n_dof, list(POWERS.values())
        rows, columns, entries = [], [], []
        for stack in self._stacks:
            matrix = np.array(
                [order.index(key) for key in zip(stack.powers.tolist(), stack.turns.tolist(), strict=True)]
            )
            at = (matrix[:, None, None] * n + stack.dofs[:, :, None]) * n + stack.dofs[:, None, :]
            rows.append(at.ravel())
            columns.append(np.broadcast_to(stack.numbers[:, None, None], at.shape).ravel())
            entries.append(stack.blocks.ravel())
        shape = (len(order) * n * n, len(self.terms))
        standing = np.array([not term.support for term in self.terms])
        if not rows:
            return dict.fromkeys((True, False), scipy.sparse.csr_array(shape))
        at, of, values = (np.concatenate(each) for each in (rows, columns, entries))
        return {
            supported: scipy.sparse.coo_array((values * (supported | standing[of]), (at, of)), shape).tocsr()
            for supported in (True, False)
        }

    def _constant(self, weights: FloatArray, supported: bool) -> FloatArray:
        """The matrices in the order of POWERS without what depends on the spin speed, (5, n_dof, n_dof)."""
        return np.asarray(self._spread[supported] @ weights).reshape(len(POWERS), self.n_dof, self.n_dof)

    def matrices(self, values: FloatArray, spin: float, supported: bool = True) -> SystemMatrices:
        """The matrices at *values* (n_unknown,) and a *spin* speed [rad/s]."""
        weights, _ = self._weights(values)
        whole = dict(zip(POWERS, self._constant(weights, supported), strict=True))
        for number, term in self._curve(supported):
            whole[term.matrix][np.ix_(term.dofs, term.dofs)] += weights[number] * term.at(spin)
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
                    added = weights[number] * term.at(spin)
                    whole[:, order[:, None], order] += (
                        added * ((1j * w) ** power * turn**turns)[:, None, None]
                    )
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
        _, slopes = self._weights(values)
        shape = np.broadcast_shapes(left.shape[:-2], right.shape[:-2])
        whole = np.zeros((len(self.unknowns), *shape, left.shape[-2], right.shape[-1]), np.complex128)
        acting = np.any(slopes != 0, axis=0)
        root, spin = np.asarray(root), np.asarray(spin)

        def factor(power: IntArray | int, turns: IntArray | int) -> ComplexArray:
            return np.asarray((root**power * spin**turns)[..., None, None])

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
            if acting[number]:
                dofs = list(term.dofs)
                part = left[..., dofs] @ term.at(spin) @ right[..., dofs, :] * factor(*POWERS[term.matrix])
                whole += slopes[:, number].reshape(-1, *(1,) * part.ndim) * part
        return whole

    def response(
        self,
        values: FloatArray,
        spin: FloatArray,
        omega: FloatArray,
        forces: ComplexArray | FloatArray,
        outputs: Sequence[int],
        supported: bool = True,
    ) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
        """y = S D^-1 F (n_line, n_output, n_force) [m], its derivatives (n_unknown, n_line, n_output,
        n_force), and S D^-1 (n_line, n_output, n_dof) [m/N].

        *forces* (n_dof, n_force) or (n_line, n_dof, n_force) [N]; *omega*, *spin* (n_line,) [rad/s]. By the
        adjoint: y' = -(S D^-1) D' (D^-1 F), one factorisation for all unknowns. Equation (system-adjoint).
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
        slopes = -self.slopes(values, spin, left, right, 1j * np.asarray(omega), supported)
        return right[:, list(outputs)], slopes, left

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
        *dofs* (n_kept,): of these alone, the others held. At *values* (n_unknown,) [unit of each].

        d lambda = -p^H D' v / (p^H (2 lambda M + C + Omega G) v), p the left vector. Equation
        (system-eigenvalue).
        """
        whole = self.matrices(values, spin, supported)
        kept = np.arange(self.n_dof) if dofs is None else dofs
        mass, damping, restoring = (
            matrix[np.ix_(kept, kept)] for matrix in (whole.mass, whole.at_speed(spin), whole.restoring(spin))
        )
        # A negative apparent mass may outweigh that of a short element: not positive definite, but regular.
        n, inverse = kept.size, linalg.lu_factor(mass)
        lower = -linalg.lu_solve(inverse, np.concatenate([restoring, damping], axis=1))
        state = np.block([[np.zeros((n, n)), np.eye(n)], [lower]])
        roots, *vectors = linalg.eig(state, left=slopes)
        # Rounding makes slow oscillations of the rigid motions of a free rotor, two for each plane.
        slowest = np.sort(np.abs(roots))[0 if supported else 2 * RIGID * n // (self.n_shaft // 2)]
        chosen = np.flatnonzero((roots.imag > LEAST_OSCILLATION * np.abs(roots)) & (np.abs(roots) >= slowest))
        chosen = chosen[np.argsort(np.abs(roots[chosen]))][: most or None]
        eigenvalues = roots[chosen]
        shapes = np.zeros((self.n_dof, chosen.size), np.complex128)
        shapes[kept] = vectors[-1][:n, chosen]
        if not slopes:
            return Roots(eigenvalues, shapes, np.zeros((chosen.size, 0), np.complex128))
        adjoint = np.zeros_like(shapes)
        adjoint[kept] = linalg.lu_solve(inverse, vectors[0][n:, chosen])
        rows, columns = adjoint.conj().T[:, None, :], shapes.T[:, :, None]
        moved = self.slopes(values, spin, rows, columns, eigenvalues, supported)[:, :, 0, 0]
        middle = 2 * eigenvalues[:, None, None] * whole.mass + whole.at_speed(spin)
        return Roots(eigenvalues, shapes, -(moved / (rows @ middle @ columns)[:, 0, 0]).T)
