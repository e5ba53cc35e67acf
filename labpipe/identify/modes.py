"""Modes of an identified model: natural frequencies, damping ratios, mode shapes, participation; many models at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.identify.model import Matrices

# A shape is scaled by its first entry above this share of the largest one: among nearly equal entries the largest is random.
LEADING = 0.8
# Name -> (unit, value of every case).
Quantities = dict[str, tuple[str, FloatArray]]


@dataclass(frozen=True)
class Modes:
    """Oscillating modes in ascending order of frequency, of (n_case,) systems.

    frequency (n_case, n_mode) [Hz] = |lambda| / 2 pi; damping (n_case, n_mode) = -Re lambda / |lambda|; shapes
    (n_case, n_dof, n_mode) real, the first large entry 1; participation (n_case, n_mode, n_input) [1/kg]:
    H = sum_r shape_r participation_r / (w_r^2 - w^2) without damping. Shapes and participation are those of the undamped system.
    """

    frequency: FloatArray
    damping: FloatArray
    shapes: FloatArray
    participation: FloatArray


def modes(matrices: Matrices) -> Modes | None:
    """Eigenvalues of (lambda^2 M + lambda C + K) x = 0, matrices (n_case, n_dof, n_dof).

    None where in any case the mass is singular, or a mode does not oscillate. Equation (est-modes).
    """
    k, c, m = matrices.stiffness, matrices.damping, matrices.mass
    n_case, n = k.shape[0], k.shape[1]
    if np.any(np.linalg.cond(m) > 1 / np.finfo(float).eps):
        return None
    by_mass = np.linalg.solve(m, np.concatenate([k, c], axis=2))
    identity = np.broadcast_to(np.eye(n), k.shape)
    state = np.block([[np.zeros_like(k), identity], [-by_mass[:, :, :n], -by_mass[:, :, n:]]])
    values = np.linalg.eigvals(state)
    undamped, right = np.linalg.eig(by_mass[:, :, :n])
    if np.any(np.sum(values.imag > 0, axis=1) != n) or np.any(undamped.real <= 0) or np.any(undamped.imag != 0):
        return None
    upper = values[values.imag > 0].reshape(n_case, n)
    upper = np.take_along_axis(upper, np.argsort(np.abs(upper), axis=1), axis=1)
    shapes = np.take_along_axis(right.real, np.argsort(undamped.real, axis=1)[:, None], axis=2)
    size = np.abs(shapes)
    leading = np.argmax(size >= LEADING * np.max(size, axis=1, keepdims=True), axis=1)
    shapes = shapes / np.take_along_axis(shapes, leading[:, None], axis=1)
    # Rows of (M Phi)^-1 are the left vectors with y^T M x = 1.
    participation = np.linalg.solve(m @ shapes, matrices.force)
    return Modes(np.abs(upper) / (2 * np.pi), -upper.real / np.abs(upper), shapes, participation)


def modal_quantities(matrices: Matrices, outputs: tuple[str, ...], inputs: tuple[str, ...]) -> Quantities:
    """f_n_r, zeta_r, shape_r_dof and participation_r_force of every mode r; empty without modes."""
    mode_set = modes(matrices)
    if mode_set is None:
        return {}
    quantities: Quantities = {}
    for r in range(mode_set.frequency.shape[1]):
        quantities[f"f_n_{r + 1}"] = ("Hz", mode_set.frequency[:, r])
        quantities[f"zeta_{r + 1}"] = ("1", mode_set.damping[:, r])
    for r in range(mode_set.frequency.shape[1]):
        quantities.update({f"shape_{r + 1}_{dof}": ("1", mode_set.shapes[:, row, r]) for row, dof in enumerate(outputs)})
        quantities.update({f"participation_{r + 1}_{force}": ("1/kg", mode_set.participation[:, r, i]) for i, force in enumerate(inputs)})
    return quantities
