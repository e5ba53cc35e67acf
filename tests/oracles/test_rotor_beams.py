"""Rotors against closed forms: Timoshenko and Euler-Bernoulli beams, a spinning cylinder's whirl, static deflection with shear."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import brentq

from labpipe.rotors.assembly import supported_rotor
from labpipe.rotors.modes import modes
from labpipe.rotors.parts import STEEL, Disc, Rotor, ShaftElement, Support

RIGID = 1e13 * np.eye(2)
NO_DAMPING = np.zeros((2, 2))


def beam(length: float, diameter: float, n: int) -> Rotor:
    return Rotor(tuple(ShaftElement(length / n, diameter) for _ in range(n)))


def pinned(n: int) -> list[Support]:
    return [Support(1, RIGID, NO_DAMPING), Support(n + 1, RIGID, NO_DAMPING)]


def simply_supported_timoshenko(length: float, diameter: float, mode: int, spin: float) -> tuple[float, float]:
    """Backward and forward frequency [Hz] of a spinning shaft, from w = sin(m pi x / l) in the Timoshenko equations with gyroscopics.

    With k = m pi / l: [kGA k^2 - rho A w^2, -kGA k; -kGA k, E I k^2 + kGA - rho I w^2 + 2 rho I Omega w] singular, w signed
    (positive backward). Exact for pinned ends; solved here as the polynomial it is.
    """
    e = ShaftElement(length, diameter)
    shear = e.shear_coefficient * STEEL.shear_modulus * e.area
    k = mode * np.pi / length
    bending, mass, inertia = STEEL.elastic_modulus * e.second_moment * k**2, STEEL.density * e.area, STEEL.density * e.second_moment
    first = np.polynomial.Polynomial([shear * k**2, 0, -mass])
    second = np.polynomial.Polynomial([bending + shear, 2 * inertia * spin, -inertia])
    roots = (first * second - (shear * k) ** 2).roots().real / (2 * np.pi)
    ordered = roots[np.argsort(np.abs(roots))][:2]
    backward, forward = np.sort(np.abs(ordered))
    return float(backward), float(forward)


@pytest.mark.parametrize("spin", [0.0, 3000.0])
@pytest.mark.parametrize("mode", [1, 2, 3])
def test_pinned_thick_shaft_with_and_without_spin(spin: float, mode: int) -> None:
    """l 1 m, d .1 m, 48 elements: shear and rotary inertia lower mode 3 by 9 %; within 3e-4, an error of the mesh."""
    found = modes(beam(1.0, 0.1, 48), pinned(48), spin)
    expected = simply_supported_timoshenko(1.0, 0.1, mode, spin)
    np.testing.assert_allclose(found.damped_frequency[2 * mode - 2 : 2 * mode], expected, rtol=3e-4)
    if spin:
        np.testing.assert_allclose(found.whirl[2 * mode - 2 : 2 * mode], [-1, 1], atol=1e-3)


@pytest.mark.parametrize(("mode", "root"), [(1, 4.730041), (2, 7.853205)])
def test_free_slender_beam(mode: int, root: float) -> None:
    """cos x cosh x = 1 (Blevins): f = x^2 / (2 pi l^2) sqrt(E I / rho A); d / l = 1/200; tolerance 5e-4."""
    assert abs(np.cos(root) * np.cosh(root) - 1) < 1e-3
    e = ShaftElement(2.0, 0.01)
    expected = root**2 / (2 * np.pi * 4) * np.sqrt(STEEL.elastic_modulus * e.second_moment / (STEEL.density * e.area))
    weak = [Support(node, 1e-3 * np.eye(2), NO_DAMPING) for node in (1, 13)]
    found = modes(beam(2.0, 0.01, 12), weak, 0.0).damped_frequency
    elastic = found[found > 0.3]
    np.testing.assert_allclose(elastic[2 * mode - 2 : 2 * mode], expected, rtol=5e-4)


def test_tip_deflection_of_a_short_cantilever_is_exact_with_shear() -> None:
    """F l^3 / 3 E I + F l / kappa G A, exact in one element."""
    e = ShaftElement(0.1, 0.06)
    matrices = supported_rotor(Rotor((e,)), [])
    displacement = np.linalg.solve(matrices.stiffness[4:, 4:], [1.0, 0, 0, 0])[0]
    expected = 0.1**3 / (3 * STEEL.elastic_modulus * e.second_moment) + 0.1 / (e.shear_coefficient * STEEL.shear_modulus * e.area)
    np.testing.assert_allclose(displacement, expected, rtol=1e-12)


def test_gyroscopic_split_of_an_overhung_disc() -> None:
    """Clamped massless shaft with a disc at its end: frequencies from the 2 x 2 complex pencil (Den Hartog), both whirl directions."""
    length, spin, mass, transverse, polar = 0.3, 600.0, 3.0, 0.01, 0.02
    e = ShaftElement(length, 0.015)
    ei = STEEL.elastic_modulus * e.second_moment
    phi = e.shear_parameter
    k = ei / (length**3 * (1 + phi)) * np.array([[12, -6 * length], [-6 * length, (4 + phi) * length**2]])

    def determinant(omega: float) -> float:
        """r = y + j z turning with exp(j omega t); the gyroscopic moment stiffens forward whirl."""
        z = k - np.diag([mass * omega**2, transverse * omega**2 - polar * spin * omega])
        return float(np.linalg.det(z / k[0, 0]))

    grid = np.linspace(-300, 300, 6001)
    signs = np.sign([determinant(w) for w in grid])
    roots = sorted(abs(brentq(determinant, grid[i], grid[i + 1])) for i in np.flatnonzero(np.diff(signs)))
    light = ShaftElement(length, 0.015, material=type(STEEL)(1e-3, STEEL.elastic_modulus, STEEL.shear_modulus))
    stub = ShaftElement(0.02, 0.5, material=light.material)
    clamped = [Support(1, RIGID, NO_DAMPING), Support(2, RIGID, NO_DAMPING)]
    found = modes(Rotor((stub, light), (Disc(3, mass, transverse, polar),)), clamped, spin)
    np.testing.assert_allclose(2 * np.pi * found.damped_frequency[:2], roots[:2], rtol=2e-3)
