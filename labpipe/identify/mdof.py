"""mdof: any number of degrees of freedom, (K + j w C - w^2 M) H = B, one parameter per entry of K, C (and M)."""

from __future__ import annotations

import dataclasses

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.errors import ConfigError
from labpipe.identify.model import DynamicModel, Term
from labpipe.identify.model_kinds import linear_kind
from labpipe.identify.settings import ESTIMATE, Mass
from labpipe.identify.setup import Setup, angle_of, entry_term, fixed_matrices, labels
from labpipe.records.response import Port

MASS_SCALE = "mass_scale"


def mdof(setup: Setup) -> DynamicModel:
    """Stiffness k_i_j, damping c_i_j and, if unknown, mass m_i_j between the dofs i, j of the outputs.

    One force is sufficient: every row of the equation of motion has its own coefficients (Knaapen 1997, ch. 4). *symmetric* settings
    give k_i_j = k_j_i. The mass is a list (diagonal), a matrix, `estimate`, or, with `scale_mass`, known up to a factor.
    ConfigError for a force on a dof without output, or a mass of the wrong size.
    """
    settings = setup.settings
    dofs = [port.dof or port.label for port in setup.outputs]
    if len(set(dofs)) < len(dofs):
        raise ConfigError(f"two of the responses {labels(setup.outputs)} have one dof", hint="choose with `output`")
    force = _forces(setup, dofs)
    kinds = {"k": "stiffness", "c": "damping"}
    terms = [term for letter, kind in kinds.items() for term in _entries(letter, kind, dofs, setup.shape, settings.symmetric)]
    mass = _fixed_mass(settings.mass, len(dofs))
    if mass is None:
        terms.extend(_mass_entries(setup, dofs))
        mass = np.zeros((len(dofs), len(dofs)))
    elif settings.scale_mass:
        terms.append(_mass_factor(setup, mass))
        mass = np.zeros_like(mass)
    return DynamicModel("mdof", tuple(terms), fixed_matrices(mass, force))


def _entries(letter: str, kind: str, dofs: list[str], shape: tuple[int, int], symmetric: bool, droppable: bool = True) -> list[Term]:
    """One parameter per entry of a matrix; of a symmetric one, those on and above the diagonal."""
    places = [(r, c) for r in range(len(dofs)) for c in range(r if symmetric else 0, len(dofs))]
    return [
        entry_term(f"{letter}_{dofs[r]}_{dofs[c]}", kind, [(r, c), (c, r)] if symmetric else [(r, c)], shape, droppable) for r, c in places
    ]


def _mass_entries(setup: Setup, dofs: list[str]) -> list[Term]:
    entries = _entries("m", "mass", dofs, setup.shape, setup.settings.symmetric, droppable=False)
    if not setup.settings.lumped_mass:
        return entries
    return [term for term in entries if np.count_nonzero(np.diag(term.matrices.mass))]


def _mass_factor(setup: Setup, mass: FloatArray) -> Term:
    term = entry_term(MASS_SCALE, "mass", [], setup.shape, droppable=False)
    return dataclasses.replace(term, unit="1", matrices=dataclasses.replace(term.matrices, mass=mass))


def _fixed_mass(mass: Mass, n_dof: int) -> FloatArray | None:
    """The mass matrix [kg], (n_dof, n_dof); None when it is to be estimated."""
    if mass == ESTIMATE:
        return None
    entries = np.array(mass, dtype=float) if _rectangular(mass) else np.empty(0)
    if entries.ndim == 0:
        return float(entries) * np.eye(n_dof)
    if entries.shape == (n_dof,):
        entries = np.diag(entries)
    if entries.shape != (n_dof, n_dof):
        hint = f"a list of {n_dof} masses, a {n_dof} x {n_dof} matrix, or `estimate`"
        raise ConfigError(f"the mass does not fit {n_dof} responses", hint=hint)
    if not np.allclose(entries, entries.T, rtol=1e-9, atol=0) or np.linalg.eigvalsh(entries)[0] < 0:
        raise ConfigError("the mass matrix is not symmetric with positive kinetic energy")
    return entries


def _rectangular(mass: Mass) -> bool:
    """True for a number, a list of numbers, or a list of equally long lists of numbers."""
    if not isinstance(mass, tuple):
        return True
    rows = [row if isinstance(row, tuple) else (row,) for row in mass]
    return len({len(row) for row in rows}) == 1 and all(isinstance(entry, (int, float)) for row in rows for entry in row)


def _forces(setup: Setup, dofs: list[str]) -> FloatArray:
    """Force distribution (n_dof, n_input): on the output of its dof, or by its angle on x and y."""
    return np.column_stack([_direction(port, dofs, setup) for port in setup.inputs])


def _direction(port: Port, dofs: list[str], setup: Setup) -> FloatArray:
    if port.dof in dofs:
        return np.eye(len(dofs))[dofs.index(port.dof)]
    angle = angle_of(port)
    output_angles = [angle_of(output) for output in setup.outputs]
    if angle is None or None in output_angles:
        hint = f"known dofs: {', '.join(dofs)}; measure there as well, or name forces with `input`"
        raise ConfigError(f"the force {port.label} acts on dof '{port.dof}', which has no response", hint=hint)
    shares = np.cos(angle - np.array(output_angles, dtype=float))
    return np.where(np.abs(shares) < 1e-15, 0.0, shares)


MDOF = linear_kind(mdof, "tied", "damping", "symmetric", "lumped_mass", "scale_mass", matrix_modes=True, frees_mass=True)
