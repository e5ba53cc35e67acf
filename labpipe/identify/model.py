"""A model linear in its parameters: dynamic stiffness Z(w) = sum_j p_j Z_j(w) + Z_0(w), forces B = sum_j p_j B_j + B_0."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from labpipe.errors import FitError


@dataclass(frozen=True)
class Term:
    """One parameter of a model: where it enters K, C, M (each n_dof, n_dof) and the force matrix B (n_dof, n_input).

    *droppable*: whether backward elimination may set it to zero.
    """

    name: str
    unit: str
    stiffness: NDArray[np.floating]
    damping: NDArray[np.floating]
    mass: NDArray[np.floating]
    force: NDArray[np.floating]
    droppable: bool = True


@dataclass(frozen=True)
class DynamicModel:
    """Z(w) H(w) = B with Z = K + j w C - w^2 M; *known_mass* (n_dof, n_dof) and *known_force* (n_dof, n_input) are given."""

    name: str
    terms: tuple[Term, ...]
    known_mass: NDArray[np.floating]
    known_force: NDArray[np.floating]

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(term.name for term in self.terms)

    @property
    def units(self) -> tuple[str, ...]:
        return tuple(term.unit for term in self.terms)

    def without(self, name: str) -> DynamicModel:
        """The model with one parameter fixed at zero."""
        return replace(self, terms=tuple(term for term in self.terms if term.name != name))

    def stiffness_terms(self, omega: NDArray[np.floating]) -> NDArray[np.complexfloating]:
        """Z_j(w) of every parameter, (n_parameter, n_line, n_dof, n_dof); *omega* (n_line,) [rad/s]."""
        w = omega[None, :, None, None]
        k, c, m = (np.stack([getattr(term, kind) for term in self.terms])[:, None] for kind in ("stiffness", "damping", "mass"))
        terms: NDArray[np.complexfloating] = k + 1j * w * c - w**2 * m
        return terms

    def force_terms(self) -> NDArray[np.floating]:
        """B_j of every parameter, (n_parameter, 1, n_dof, n_input)."""
        return np.stack([term.force for term in self.terms])[:, None]

    def inertia(self, omega: NDArray[np.floating]) -> NDArray[np.complexfloating]:
        """Z_0(w) = -w^2 M_0, (n_line, n_dof, n_dof)."""
        return (-(omega**2)[:, None, None] * self.known_mass).astype(np.complex128)

    def dynamic_stiffness(self, parameters: NDArray[np.floating], omega: NDArray[np.floating]) -> NDArray[np.complexfloating]:
        """Z(w) [N/m], (n_line, n_dof, n_dof)."""
        z: NDArray[np.complexfloating] = np.einsum("p,plab->lab", parameters, self.stiffness_terms(omega)) + self.inertia(omega)
        return z

    def forces(self, parameters: NDArray[np.floating]) -> NDArray[np.floating]:
        """B, (n_dof, n_input)."""
        b: NDArray[np.floating] = np.einsum("p,plab->ab", parameters, self.force_terms()) + self.known_force
        return b

    def receptance(self, parameters: NDArray[np.floating], omega: NDArray[np.floating]) -> NDArray[np.complexfloating]:
        """H(w) = Z^-1 B [m/N], (n_line, n_dof, n_input); FitError where Z is singular."""
        b = np.broadcast_to(self.forces(parameters).astype(np.complex128), (omega.size, *self.known_force.shape))
        try:
            h: NDArray[np.complexfloating] = np.linalg.solve(self.dynamic_stiffness(parameters, omega), b)
        except np.linalg.LinAlgError:
            raise FitError("the dynamic stiffness of the model is singular at a line", hint="check the band and the mass") from None
        return h

    def jacobian(self, parameters: NDArray[np.floating], omega: NDArray[np.floating]) -> NDArray[np.complexfloating]:
        """dH/dp_j = -Z^-1 (Z_j H - B_j), (n_parameter, n_line, n_dof, n_input)."""
        z = self.dynamic_stiffness(parameters, omega)
        h = self.receptance(parameters, omega)
        jacobian: NDArray[np.complexfloating] = -np.linalg.solve(z[None], self.equation_terms(h, omega))
        return jacobian

    def equation_terms(self, h: NDArray[np.complexfloating], omega: NDArray[np.floating]) -> NDArray[np.complexfloating]:
        """Z_j H - B_j: the regressors of the equation of motion, (n_parameter, n_line, n_dof, n_input)."""
        return self.stiffness_terms(omega) @ h[None] - self.force_terms()

    def equation_known(self, h: NDArray[np.complexfloating], omega: NDArray[np.floating]) -> NDArray[np.complexfloating]:
        """B_0 - Z_0 H: the known side of the equation of motion, (n_line, n_dof, n_input)."""
        return self.known_force.astype(np.complex128) - self.inertia(omega) @ h
