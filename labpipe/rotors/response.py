"""Steady vibration of a rotor on its bearings: frequency response between chosen dofs, and unbalance response."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import FitError
from labpipe.rotors.assembly import RotorMatrices, supported_rotor
from labpipe.rotors.parts import Rotor, Support
from labpipe.spectra.directional import FROM_DIRECTIONAL


def dynamic_stiffness(matrices: RotorMatrices, omega: FloatArray, speed: float | FloatArray) -> ComplexArray:
    """Z(w) = K - w^2 M + j w (C + Omega G), (n_line, n_dof, n_dof) [N/m]; *omega* (n_line,) and *speed* in [rad/s].

    Equation (rotor-dynamic-stiffness).
    """
    w = np.asarray(omega, np.float64)[:, None, None]
    spin = np.broadcast_to(speed, np.shape(omega))[:, None, None]
    static = matrices.stiffness - w**2 * matrices.mass
    z: ComplexArray = static + 1j * w * (matrices.damping + spin * matrices.gyroscopic)
    return z


def solved(stiffness: ComplexArray, forces: ComplexArray | FloatArray) -> ComplexArray:
    """Displacements (..., n_dof, n_force) [m] under *forces* [N], same shape; FitError at an undamped resonance.

    *stiffness*: dynamic stiffness (..., n_dof, n_dof) [N/m].
    """
    try:
        displacements: ComplexArray = np.linalg.solve(stiffness, forces)
    except np.linalg.LinAlgError:
        raise FitError("the rotor has a resonance without damping on a line", hint="move the line or add damping") from None
    return displacements


def frequency_response(
    rotor: Rotor, supports: Iterable[Support], frequency: FloatArray, speed: float, outputs: list[int], inputs: list[int]
) -> ComplexArray:
    """Receptance H [m/N], (n_line, n_output, n_input), at *frequency* (n_line,) [Hz]; dof indices from `Rotor.dofs`."""
    matrices = supported_rotor(rotor, supports)
    forces = np.zeros((matrices.mass.shape[0], len(inputs)))
    forces[inputs, np.arange(len(inputs))] = 1
    z = dynamic_stiffness(matrices, 2 * np.pi * np.asarray(frequency), speed)
    return solved(z, np.broadcast_to(forces, (z.shape[0], *forces.shape)))[:, outputs]


def unbalance_response(
    rotor: Rotor, supports: Iterable[Support], speed: FloatArray, unbalance: Mapping[int, complex], outputs: list[int]
) -> ComplexArray:
    """Displacements [m], 0-to-peak phasors, (n_speed, n_output), at spin *speed* (n_speed,) [rad/s].

    *unbalance* [kg m] by node, its angle from the y axis at time zero: F_y = u Omega^2, F_z = -j u Omega^2, so that the force rotates
    from y to z. The bearings do not change with speed. Equation (rotor-unbalance).
    """
    speed = np.asarray(speed, np.float64)
    matrices = supported_rotor(rotor, supports)
    forces = np.zeros((speed.size, matrices.mass.shape[0], 1), np.complex128)
    for node, amount in unbalance.items():
        y, z = rotor.dofs(node)
        forces[:, y, 0] += amount * speed**2
        forces[:, z, 0] += -1j * amount * speed**2
    return solved(dynamic_stiffness(matrices, speed, speed), forces)[:, outputs, 0]


def forward_backward_motion(displacements: ComplexArray) -> ComplexArray:
    """[f, b] = A^-1 [y, z] of phasors (..., 2) in y and z [m]: radii of the forward and the backward circle of an orbit, 0-to-peak.

    Equation (rotor-orbit).
    """
    turned: ComplexArray = displacements @ np.linalg.inv(FROM_DIRECTIONAL).T
    return turned
