"""Timoshenko shaft elements with rotary inertia and gyroscopics (Nelson & McVaugh 1976, Nelson 1980).

One bending plane has w and its rotation at both ends, (w1, r1, w2, r2); with xi = x / l and the shear parameter Phi the deflection
is N(xi) and the rotation of the cross-section D(xi) times these four.
"""

from __future__ import annotations

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.rotors.parts import ShaftElement

# Plane 1: y and the rotation about z. Plane 2: z and the rotation about y, which is minus the slope of z.
PLANE_Y = np.array([0, 3, 4, 7])
PLANE_Z = np.array([1, 2, 5, 6])
SIGNS_Z = np.array([1.0, -1.0, 1.0, -1.0])
# Exact for the polynomials of sixth degree under the integrals.
GAUSS_POINTS, GAUSS_WEIGHTS = np.polynomial.legendre.leggauss(4)


def shape_functions(element: ShaftElement, xi: FloatArray) -> tuple[FloatArray, FloatArray]:
    """N(xi) and D(xi), (4, n_point) each: deflection [m] and rotation [rad] per end displacement and rotation. Equation (rotor-shapes)."""
    l, phi = element.length, element.shear_parameter
    deflection = np.stack(
        [
            1 - 3 * xi**2 + 2 * xi**3 + phi * (1 - xi),
            l * (xi - 2 * xi**2 + xi**3 + phi / 2 * (xi - xi**2)),
            3 * xi**2 - 2 * xi**3 + phi * xi,
            l * (xi**3 - xi**2 + phi / 2 * (xi**2 - xi)),
        ]
    )
    bend = 6 * (xi**2 - xi) / l
    rotation = np.stack([bend, 1 - 4 * xi + 3 * xi**2 + phi * (1 - xi), -bend, 3 * xi**2 - 2 * xi + phi * xi])
    return deflection / (1 + phi), rotation / (1 + phi)


def plane_stiffness(element: ShaftElement) -> FloatArray:
    """Bending and shear stiffness of one plane, (4, 4) [N/m, N, N m]. Equation (rotor-stiffness)."""
    l, phi = element.length, element.shear_parameter
    near, far = (4 + phi) * l**2, (2 - phi) * l**2
    matrix = np.array([[12, 6 * l, -12, 6 * l], [6 * l, near, -6 * l, far], [-12, -6 * l, 12, -6 * l], [6 * l, far, -6 * l, near]])
    return element.material.elastic_modulus * element.second_moment / (l**3 * (1 + phi)) * matrix


def plane_inertia(element: ShaftElement, ring: ShaftElement | None = None) -> tuple[FloatArray, FloatArray]:
    """Translational mass rho A l int N N' and rotary inertia rho I l int D D' of one plane, (4, 4) each [kg, kg m, kg m^2].

    *ring*: cross-section of a sleeve that follows the deflection of *element*; by default the element's cross-section.
    Equation (rotor-inertia).
    """
    tube = ring or element
    deflection, rotation = shape_functions(element, (GAUSS_POINTS + 1) / 2)
    density = tube.material.density * element.length * GAUSS_WEIGHTS / 2
    return (deflection * (density * tube.area)) @ deflection.T, (rotation * (density * tube.second_moment)) @ rotation.T


def inertia_matrices(element: ShaftElement, ring: ShaftElement | None = None) -> tuple[FloatArray, FloatArray]:
    """M and G of an element or its sleeve, (8, 8) [kg, kg m, kg m^2], in the order y, z, rotation about y, about z, left end, right end.

    G is multiplied by the spin speed: a rotation rate about z turns the angular momentum towards y, 2 rho I per length.
    Equation (rotor-gyroscopic).
    """
    translation, rotary = plane_inertia(element, ring)
    coupling = 2 * rotary * SIGNS_Z
    gyroscopic = np.zeros((8, 8))
    gyroscopic[np.ix_(PLANE_Y, PLANE_Z)] = coupling
    gyroscopic[np.ix_(PLANE_Z, PLANE_Y)] = -coupling.T
    return in_both_planes(translation + rotary), gyroscopic


def in_both_planes(plane: FloatArray) -> FloatArray:
    """A symmetric matrix of one plane (4, 4) applied to both planes, (8, 8) [same unit]."""
    both = np.zeros((8, 8))
    both[np.ix_(PLANE_Y, PLANE_Y)] = plane
    both[np.ix_(PLANE_Z, PLANE_Z)] = plane * np.outer(SIGNS_Z, SIGNS_Z)
    return both
