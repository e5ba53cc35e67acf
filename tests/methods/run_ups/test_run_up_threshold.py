"""Threshold of instability of the two-disc rotor against a calculation that shares nothing with labpipe.

Film: reynolds_reference (own vertices, exact complementarity), grooves of 20 deg, extrapolated from 360 x 60
and 720 x 120. Rotor: Ritz with sines for the deflection and cosines for the rotation of a pinned Timoshenko
shaft, discs as in the rotor file.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import brentq

from labpipe.methods.run_ups.rotor_file import load_run_up_rotor
from tests.methods.journal_bearing.reynolds_reference import Bearing, coefficients

RIG = load_run_up_rotor(Path(__file__).parents[3] / "configs/rotors/falah.yaml")
RPM = np.pi / 30
FILM = Bearing(16.5e-3, 8.25e-3, 0.2e-3, 0.55, groove=float(np.deg2rad(20)))
DIAMETER, SPAN, MODULUS, DENSITY, POISSON = 16.5e-3, 0.76, 2.1e11, 7800.0, 0.3
# Place [m], mass [kg], transverse and polar inertia [kg m^2].
DISCS = [(0.19, 4.3, 4.453e-3, 5.375e-3), (0.57, 4.3, 4.453e-3, 5.375e-3)]
# Growth rate [1/s] that counts as unstable.
GROWTH = 1e-3
# Highest frequency [rad/s] of the modes looked at.
FAST = 2000.0


def shaft(n_wave: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """K, M and gyroscopic matrix (per rad/s) of one plane in amplitudes of sines and cosines, and the
    deflection at mid span.
    """
    area, inertia = np.pi * DIAMETER**2 / 4, np.pi * DIAMETER**4 / 64
    shear = MODULUS / (2 * (1 + POISSON)) * 6 * (1 + POISSON) / (7 + 6 * POISSON) * area
    wave, zero = np.arange(1, n_wave + 1) * np.pi / SPAN, np.zeros(n_wave)
    stiffness = np.block(
        [
            [np.diag(shear * wave**2), np.diag(-shear * wave)],
            [np.diag(-shear * wave), np.diag(shear + MODULUS * inertia * wave**2)],
        ]
    )
    mass = np.diag(np.concatenate([zero + DENSITY * area, zero + DENSITY * inertia]))
    gyroscopic = np.diag(np.concatenate([zero, zero + 2 * DENSITY * inertia]))
    stiffness, mass, gyroscopic = (matrix * SPAN / 2 for matrix in (stiffness, mass, gyroscopic))
    for place, weight, transverse, polar in DISCS:
        deflection, rotation = (
            np.concatenate([np.sin(wave * place), zero]),
            np.concatenate([zero, np.cos(wave * place)]),
        )
        mass = mass + weight * np.outer(deflection, deflection) + transverse * np.outer(rotation, rotation)
        gyroscopic = gyroscopic + polar * np.outer(rotation, rotation)
    return stiffness, mass, gyroscopic, np.concatenate([np.sin(wave * SPAN / 2), zero])


def growth(n_wave: int, speed: float, film: tuple[np.ndarray, np.ndarray]) -> float:
    """Largest growth rate of the modes that move the journal."""
    stiffness, mass, gyroscopic, journal = shaft(n_wave)
    n, at_journal = 2 * journal.size, np.outer(journal, journal)
    spring = np.kron(np.eye(2), stiffness) + np.kron(film[0], at_journal)
    damper = speed * np.kron(np.array([[0.0, 1.0], [-1.0, 0.0]]), gyroscopic) + np.kron(film[1], at_journal)
    inverse = np.linalg.inv(np.kron(np.eye(2), mass))
    roots, vectors = np.linalg.eig(
        np.block([[np.zeros((n, n)), np.eye(n)], [-inverse @ spring, -inverse @ damper]])
    )
    motion = np.stack([journal @ vectors[: n // 2], journal @ vectors[n // 2 : n]])
    moves = (np.abs(motion) ** 2).sum(axis=0) > 1e-8 * (np.abs(vectors[:n]) ** 2).sum(axis=0)
    return float(roots.real[moves & (np.abs(roots.imag) < FAST)].max())


def threshold(load: float, about: float, mesh: tuple[int, int], n_wave: int = 24) -> float:
    """Threshold [rpm]; the film solved at three speeds within 1 %, its coefficients as parabolas between."""
    speeds = about * np.array([0.99, 1.0, 1.01]) * RPM
    films = np.array([coefficients(FILM, (0.0, -load), speed, *mesh)[1:] for speed in speeds]).reshape(3, 8)
    parabolas = [np.poly1d(np.polyfit(speeds / speeds[1] - 1, column, 2)) for column in films.T]

    def excess(speed: float) -> float:
        stiffness, damping = np.array([parabola(speed / speeds[1] - 1) for parabola in parabolas]).reshape(
            2, 2, 2
        )
        return growth(n_wave, speed, (stiffness, damping)) - GROWTH

    return float(brentq(excess, speeds[0], speeds[-1], xtol=1e-4)) / RPM


@pytest.mark.long
@pytest.mark.parametrize(
    ("load", "about"), [(3.660886, 2814.0), pytest.param(10.302081, 3308.0, marks=pytest.mark.long)]
)
def test_the_threshold_is_that_of_an_independent_calculation(load: float, about: float) -> None:
    """Within .01 %, met .005; a curve of 288 x 40 cells alone lies .03 and .06 % above."""
    coarse, fine = (threshold(load, about, mesh) for mesh in ((360, 60), (720, 120)))
    expected = (4 * fine - coarse) / 3
    found = RIG.threshold(RIG.start(load))
    assert found is not None
    print(f"\n{load} N: {coarse:.2f}, {fine:.2f}, extrapolated {expected:.2f}; labpipe {found / RPM:.2f} rpm")
    np.testing.assert_allclose(found / RPM, expected, rtol=1e-4)


@pytest.mark.long
def test_the_shaft_of_the_calculation_converges() -> None:
    """Twelve waves or twenty-four: .01 % of the threshold on a film of 360 x 60 vertices."""
    few, many = (threshold(3.660886, 2814.0, (360, 60), n_wave) for n_wave in (12, 24))
    np.testing.assert_allclose(few, many, rtol=1e-4)
