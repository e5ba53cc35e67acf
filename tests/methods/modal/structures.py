"""Structures with known modes, written as sums over modes or as matrices of masses and springs."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from labpipe.records.response import FrequencyResponse, Port
from labpipe.records.rig import Geometry

FREQUENCIES = np.array([20.0, 33.0, 46.0, 46.46, 61.0, 78.0, 95.0, 118.0, 140.0])
DAMPING = np.array([0.01, 0.004, 0.002, 0.0025, 0.0005, 0.006, 0.003, 0.008, 0.0015])
OUTSIDE = ((4.0, 0.02), (7.0, 0.03), (190.0, 0.004), (240.0, 0.005), (310.0, 0.006), (420.0, 0.004))
REFERENCES = (3, 30, 61)


@dataclass(frozen=True)
class Structure:
    """Accelerance (n_line, n_point, 3) without noise, and the poles [rad/s] and shapes (n_mode, n_point)
    inside the band.
    """

    frequency: np.ndarray
    matrix: np.ndarray
    poles: np.ndarray
    shapes: np.ndarray

    def noisy(self, level: float, seed: int) -> np.ndarray:
        """With circular noise of *level* times the root mean square of each FRF."""
        rng = np.random.default_rng(1000 + seed)
        std = level * np.sqrt(np.mean(np.abs(self.matrix) ** 2, axis=0))
        return self.matrix + std * (
            rng.normal(size=self.matrix.shape) + 1j * rng.normal(size=self.matrix.shape)
        ) / np.sqrt(2)


@lru_cache(maxsize=8)
def nine_modes(n_point: int = 79, n_line: int = 1501, seed: int = 0) -> Structure:
    """Nine slightly complex modes in 10-160 Hz, two of them 1 % apart, and six real modes outside.

    Three references.
    """
    rng = np.random.default_rng(seed)
    frequency = np.linspace(10.0, 160.0, n_line)
    s = 2j * np.pi * frequency
    place = np.linspace(0, 1, n_point)
    references = [reference * n_point // 79 for reference in REFERENCES]
    matrix = np.zeros((n_line, n_point, len(references)), complex)
    poles, shapes = [], []
    for number, (f, zeta) in enumerate([*zip(FREQUENCIES, DAMPING, strict=True), *OUTSIDE]):
        w = 2 * np.pi * f
        pole = -zeta * w + 1j * w * np.sqrt(1 - zeta**2)
        shape = np.sin((number % 9 + 1) * np.pi * place * 0.93 + 0.3 * number) + 0.3 * rng.normal(
            size=n_point
        )
        if number < FREQUENCIES.size:
            shape = shape * np.exp(0.06j * rng.normal(size=n_point))
            poles.append(pole)
            shapes.append(shape)
        residue = shape[:, None] * shape[references] / (2j * w)
        matrix += (s**2)[:, None, None] * (
            residue / (s - pole)[:, None, None] + residue.conj() / (s - pole.conjugate())[:, None, None]
        )
    matrix.flags.writeable = False
    return Structure(frequency, matrix, np.array(poles), np.array(shapes))


def response_of(structure: Structure, matrix: np.ndarray) -> FrequencyResponse:
    """The structure's FRFs as a record, references at the points they belong to."""
    n_point = matrix.shape[1]
    outputs = tuple(Port(f"p{point}", f"p{point}", f"p{point}") for point in range(n_point))
    places = [reference * n_point // 79 for reference in REFERENCES[: matrix.shape[2]]]
    inputs = tuple(Port(f"f{place}", f"f{place}", f"p{place}") for place in places)
    return FrequencyResponse(
        structure.frequency, matrix, outputs, inputs, form="accelerance", name="nine modes"
    )


def chain(n_dof: int = 2) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mass, damping and stiffness of unequal masses in a row, damped in proportion to the stiffness."""
    mass = np.diag(1.0 + 0.3 * np.arange(n_dof))
    springs = 1e5 * (1.0 + 0.4 * np.arange(n_dof + 1))
    stiffness = np.diag(springs[:-1] + springs[1:]) - np.diag(springs[1:-1], 1) - np.diag(springs[1:-1], -1)
    return mass, 2e-5 * stiffness, stiffness


def chain_response(frequency: np.ndarray, n_dof: int = 2) -> FrequencyResponse:
    """Receptance of the chain without noise, force and response at every mass."""
    mass, damping, stiffness = chain(n_dof)
    w = 2 * np.pi * frequency[:, None, None]
    matrix = np.linalg.inv(stiffness + 1j * w * damping - w**2 * mass)
    outputs = tuple(Port(f"x{n}", f"x{n}", f"x{n}") for n in range(n_dof))
    inputs = tuple(Port(f"f{n}", f"f{n}", f"x{n}") for n in range(n_dof))
    return FrequencyResponse(frequency, matrix, outputs, inputs, name="chain")


BEAM_FREQUENCIES, BEAM_DAMPING, BEAM_POINTS = np.array([20.0, 80.0, 180.0]), 0.01, 9


def beam_shapes() -> np.ndarray:
    """sin(n pi x / l) of a beam on two hinges at nine points between them, (n_point, 3), the largest 1
    (Euler-Bernoulli).
    """
    place = np.arange(1, BEAM_POINTS + 1) / (BEAM_POINTS + 1)
    shapes = np.sin(np.pi * place[:, None] * np.arange(1, 4))
    return shapes / np.max(np.abs(shapes), axis=0)


def beam(seed: int, detuned: float = 0.0) -> FrequencyResponse:
    """Receptance of this beam along z under a force at its second point, 1 % noise; f_n in the ratio 1 : 4 :
    9, lower by *detuned*.
    """
    frequency = np.arange(10.0, 230.0, 0.25)
    w, w_n, shapes = 2 * np.pi * frequency, 2 * np.pi * BEAM_FREQUENCIES * (1 - detuned), beam_shapes()
    modal = 1 / (w_n**2 - w[:, None] ** 2 + 2j * BEAM_DAMPING * w_n * w[:, None])
    matrix = (modal @ (shapes * shapes[1]).T)[:, :, None]
    noise = np.random.default_rng(seed).normal(size=(2, *matrix.shape))
    matrix = matrix + 0.01 * np.sqrt(np.mean(np.abs(matrix) ** 2, axis=0)) * (
        noise[0] + 1j * noise[1]
    ) / np.sqrt(2)
    outputs = tuple(Port(f"{n}.z", f"{n}.z", f"{n}.z") for n in range(1, BEAM_POINTS + 1))
    return FrequencyResponse(frequency, matrix, outputs, (Port("f", "f", "2.z"),), name="beam")


def beam_geometry() -> Geometry:
    """The points of the beam along x, 100 mm apart, and its ends, which nothing measures."""
    names = ("left", *(str(n) for n in range(1, BEAM_POINTS + 1)), "right")
    x = 0.1 * np.arange(len(names))
    lines = np.stack([np.arange(len(names) - 1), np.arange(1, len(names))], axis=-1)
    return Geometry(names, np.stack([x, 0 * x, 0 * x], axis=-1), lines)
