"""The receptance of a rotor on its bearings from the matrices of all its nodes, without reduction."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.methods.rotor.response import dynamic_stiffness, solve
from labpipe.methods.rotor.shaft import NodeSupport, Rotor, supported_rotor


def frequency_response(
    rotor: Rotor,
    supports: Iterable[NodeSupport],
    frequency: FloatArray,
    speed: float,
    outputs: list[int],
    inputs: list[int],
) -> ComplexArray:
    """Receptance H [m/N], (n_line, n_output, n_input), at *frequency* (n_line,) [Hz].

    Dof indices from `Rotor.dofs`.
    """
    matrices = supported_rotor(rotor, supports)
    forces = np.zeros((matrices.mass.shape[0], len(inputs)))
    forces[inputs, np.arange(len(inputs))] = 1
    z = dynamic_stiffness(matrices, 2 * np.pi * np.asarray(frequency), speed)
    return solve(z, np.broadcast_to(forces, (z.shape[0], *forces.shape)))[:, outputs]
