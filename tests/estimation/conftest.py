"""Responses of known systems, with noise of known covariance."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from labpipe.records.response import FrequencyResponse, Port, diagonal_covariance

PEDESTAL = {"k": 134.5e3, "c": 3.682, "m": 0.79}
COUPLED_K = np.array([[180e3, 25e3], [-18e3, 210e3]])
COUPLED_C = np.array([[120.0, 15.0], [-10.0, 150.0]])
X, Y = Port("x", "x", "x", 0.0), Port("y", "y", "y", np.pi / 2)
FX, FY = Port("fx", "fx", "x", 0.0), Port("fy", "fy", "y", np.pi / 2)
F45 = Port("f", "f", "45 deg", np.pi / 4)

Responder = Callable[..., FrequencyResponse]


def with_noise(
    frequency: np.ndarray,
    matrix: np.ndarray,
    outputs: tuple[Port, ...],
    inputs: tuple[Port, ...],
    std: float,
    rng: np.random.Generator | None,
) -> FrequencyResponse:
    """Independent circular noise of standard deviation *std* on every element; its variance is known."""
    variance = np.full(matrix.shape, std**2)
    if rng is not None:
        matrix = matrix + std * (
            rng.normal(size=matrix.shape) + 1j * rng.normal(size=matrix.shape)
        ) / np.sqrt(2)
    return FrequencyResponse(
        frequency, matrix, outputs, inputs, covariance=diagonal_covariance(variance) if std else None
    )


@pytest.fixture
def sdof_response() -> Responder:
    """Receptance 1 / (k - m w^2 + j c w) of the pedestal, 60-70 Hz every 0.5 Hz, times *scale*."""

    def respond(
        std: float = 0.0, rng: np.random.Generator | None = None, scale: float = 1.0, **other: float
    ) -> FrequencyResponse:
        k, c, m = ({**PEDESTAL, **other}[name] for name in ("k", "c", "m"))
        frequency = np.arange(60, 70.25, 0.5)
        w = 2 * np.pi * frequency
        matrix = (scale / (k - m * w**2 + 1j * c * w))[:, None, None]
        return with_noise(frequency, matrix, (Y,), (Port("f", "f", "y"),), std * scale, rng)

    return respond


@pytest.fixture
def coupled_response() -> Responder:
    """The cross-coupled support under two force directions, 40-120 Hz every 1 Hz, m = 0.92 kg."""

    def respond(std: float = 0.0, rng: np.random.Generator | None = None) -> FrequencyResponse:
        frequency = np.arange(40.0, 121.0)
        w = 2 * np.pi * frequency[:, None, None]
        matrix = np.linalg.inv(COUPLED_K + 1j * w * COUPLED_C - w**2 * 0.92 * np.eye(2))
        return with_noise(frequency, matrix, (X, Y), (FX, FY), std, rng)

    return respond


@pytest.fixture
def symmetric_response() -> Responder:
    """A symmetric rotor under one force at 45 deg: x and y move alike.

    1-250 Hz, k = 180 kN/m, c = 190 N s/m, m = 0.92 kg.
    """

    def respond(std: float = 0.0, rng: np.random.Generator | None = None) -> FrequencyResponse:
        frequency = np.arange(1.0, 251.0)
        w = 2 * np.pi * frequency
        one = np.cos(np.pi / 4) / (180e3 + 190j * w - 0.92 * w**2)
        return with_noise(frequency, np.stack([one, one], 1)[:, :, None], (X, Y), (F45,), std, rng)

    return respond


# The three-dof benchmark of Knaapen (1997), eq. 4.18-4.20: springs between masses of 1, 2 and 3 kg, B = 0.1
# K.
MASS = np.diag([1.0, 2.0, 3.0])
STIFFNESS = np.array([[2.0, -1.0, 0.0], [-1.0, 2.0, -1.0], [0.0, -1.0, 2.0]])
DAMPING = 0.1 * STIFFNESS
DOFS = tuple(Port(str(n), str(n), str(n)) for n in (1, 2, 3))
FORCES = tuple(Port(f"f{n}", f"f{n}", str(n)) for n in (1, 2, 3))


@pytest.fixture(scope="session")
def three_dof_response() -> Responder:
    """Receptances of the benchmark, by default its 25 lines 0.01 to 2.41 rad/s; *stiffness* etc.

    replace its matrices.
    """

    def respond(
        std: float = 0.0,
        rng: np.random.Generator | None = None,
        omega: np.ndarray | None = None,
        stiffness: np.ndarray = STIFFNESS,
        damping: np.ndarray = DAMPING,
        columns: tuple[int, ...] = (0, 1, 2),
        scale: float = 1.0,
    ) -> FrequencyResponse:
        w = 0.01 + 0.1 * np.arange(25) if omega is None else omega
        z = stiffness + 1j * w[:, None, None] * damping - w[:, None, None] ** 2 * MASS
        matrix = scale * np.linalg.inv(z)[:, :, list(columns)]
        return with_noise(w / (2 * np.pi), matrix, DOFS, tuple(FORCES[n] for n in columns), std * scale, rng)

    return respond
