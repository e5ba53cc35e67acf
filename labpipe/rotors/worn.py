"""Response of a rotor with a worn bearing, and its derivatives by the parameters of the bearing's coefficients.

With Z = K + j w C of the bearings and H the receptance of the rotor on them, dH/dp = -H_ob (dZ/dp) H_bf: exact, and from the few
dofs of the reduced rotor only.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import ConfigError
from labpipe.rotors.parts import Support
from labpipe.rotors.reduction import ReducedRotor
from labpipe.spectra.directional import FROM_DIRECTIONAL


@dataclass(frozen=True)
class VaryingSupport:
    """A bearing with the derivatives of its coefficients by *n* parameters: stiffness_slopes, damping_slopes (n, 2, 2) [SI]."""

    support: Support
    stiffness_slopes: FloatArray
    damping_slopes: FloatArray

    def __post_init__(self) -> None:
        if self.stiffness_slopes.shape != self.damping_slopes.shape or self.stiffness_slopes.shape[1:] != (2, 2):
            raise ConfigError(f"the bearing on node {self.support.node} needs one 2 x 2 derivative per parameter")


def response_with_slopes(
    rotor: ReducedRotor, bearings: Iterable[VaryingSupport], output: int, force: int
) -> tuple[ComplexArray, ComplexArray]:
    """H (n_line, 2, 2) [m/N] from forces in y and z at a node to displacements at another, and dH/dp (n, n_line, 2, 2).

    *bearings* are added to *rotor* and share their parameters; bearings, output and force are nodes of the reduced rotor.
    Equation (rotor-slopes).
    """
    bearings = list(bearings)
    response, to_output, from_force = rotor.paths([bearing.support for bearing in bearings], output, force)
    # Of every bearing and element of its coefficients H_ob H_bf: all parameters together are one product of matrices.
    places = [(2 * number + row, 2 * number + column) for number in range(len(bearings)) for row, column in np.ndindex(2, 2)]
    products = np.empty((2, len(places), rotor.omega.size, 2, 2), np.complex128)
    for product, (row, column) in zip(products[0], places, strict=True):
        np.multiply(to_output[:, :, row, None], from_force[:, column, None, :], out=product)
    np.multiply(products[0], 1j * rotor.omega[:, None, None], out=products[1])
    slopes = np.concatenate(
        [_flat(bearing.stiffness_slopes for bearing in bearings), _flat(bearing.damping_slopes for bearing in bearings)], axis=1
    )
    return response, -(slopes @ products.reshape(slopes.shape[1], -1)).reshape(-1, *response.shape)


def _flat(slopes: Iterable[FloatArray]) -> FloatArray:
    """Derivatives (n, 2, 2) of several bearings side by side, (n, 4 n_bearing)."""
    return np.concatenate([of_one.reshape(-1, 4) for of_one in slopes], axis=1)


def forward_backward(matrix: ComplexArray) -> ComplexArray:
    """The directional response A^-1 H A = [[H_ff, H_fb], [H_bf, H_bb]] of (..., 2, 2) [m/N] in y and z (Mendes et al. 2017, eq. 18)."""
    turned: ComplexArray = np.linalg.inv(FROM_DIRECTIONAL) @ matrix @ FROM_DIRECTIONAL
    return turned


@dataclass(frozen=True)
class WornRig:
    """A rotor on all its bearings except the worn one; made once per speed and set of lines.

    rotor: reduced to the worn bearing's *node*, *output*, the node of the sensors, and *force*, the node of the exciter;
    bearing: coefficients of the worn bearing with their derivatives by depth [m] and angle [rad], from a table or the film itself.
    """

    rotor: ReducedRotor
    bearing: Callable[[float, float], VaryingSupport]
    output: int
    force: int


def worn_response(depth: float, angle: float, rig: WornRig, directional: bool = False) -> tuple[ComplexArray, ComplexArray]:
    """Receptance (n_line, 2, 2) [m/N] with a wear of *depth* [m] at *angle* [rad] from the bottom, and its derivatives (2, n_line, 2, 2).

    The derivatives are by depth and by angle [1/N, m/(N rad)]. *directional*: forward and backward instead of y and z.
    """
    response, slopes = response_with_slopes(rig.rotor, [rig.bearing(depth, angle)], rig.output, rig.force)
    return (forward_backward(response), forward_backward(slopes)) if directional else (response, slopes)
