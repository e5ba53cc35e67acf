"""Receptance, mobility, accelerance, dynamic stiffness, and forward and backward terms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labpipe.errors import ConfigError, DataError
from labpipe.records.response import FrequencyResponse, Port
from labpipe.spectra.convert import convert, directional

FREQUENCY = np.array([10.0, 20.0, 40.0])
OMEGA = 2 * np.pi * FREQUENCY
MASS, DAMPING = 2.0, 30.0


def rotor(
    stiffness: np.ndarray,
    angles: tuple[float, float] = (0.0, np.pi / 2),
    covariance: np.ndarray | None = None,
) -> FrequencyResponse:
    """Receptance of a mass on a 2 x 2 stiffness, responses at x and y, forces at *angles*."""
    matrix = stiffness + (1j * OMEGA * DAMPING - OMEGA**2 * MASS)[:, None, None] * np.eye(2)
    directions = np.array([[np.cos(a) for a in angles], [np.sin(a) for a in angles]])
    outputs = (Port("x", "x", "x", 0.0), Port("y", "y", "y", np.pi / 2))
    inputs = tuple(Port(f"f{n}", f"f{n}", f"f{n}", angle) for n, angle in enumerate(angles))
    return FrequencyResponse(
        FREQUENCY, np.linalg.inv(matrix) @ directions, outputs, inputs, covariance=covariance
    )


def some_covariance(rng: np.random.Generator) -> np.ndarray:
    root = rng.normal(size=(3, 4, 4)) + 1j * rng.normal(size=(3, 4, 4))
    return 1e-18 * root @ root.conj().swapaxes(1, 2)


ISOTROPIC = np.array([[5e4, 2e3], [-2e3, 5e4]])
ANISOTROPIC = np.array([[5e4, 2e3], [1e3, 9e4]])


def test_accelerance_is_receptance_twice_differentiated(rng: np.random.Generator) -> None:
    receptance = rotor(ANISOTROPIC, covariance=some_covariance(rng))
    accelerance = convert(receptance, "accelerance")
    np.testing.assert_allclose(accelerance.matrix, -(OMEGA**2)[:, None, None] * receptance.matrix, rtol=1e-12)
    np.testing.assert_allclose(
        accelerance.variance, (OMEGA**4)[:, None, None] * receptance.variance, rtol=1e-12
    )
    back = convert(convert(accelerance, "mobility"), "receptance")
    np.testing.assert_allclose(back.matrix, receptance.matrix, rtol=1e-12)
    np.testing.assert_allclose(back.covariance, receptance.covariance, rtol=1e-12)


def test_the_line_at_0_hz_can_be_differentiated_but_not_integrated() -> None:
    port = (Port("a", "a", "a"),)
    still = FrequencyResponse(np.array([0.0, 1.0]), np.ones((2, 1, 1)), port, port)
    accelerance = convert(still, "accelerance")
    assert accelerance.matrix[0, 0, 0] == 0
    np.testing.assert_array_equal(convert(still, "receptance").matrix, still.matrix)
    with pytest.raises(DataError, match="0 Hz of a accelerance"):
        convert(accelerance, "receptance")
    with pytest.raises(ConfigError, match="form 'other'"):
        convert(
            FrequencyResponse(np.array([1.0]), np.ones((1, 1, 1)), port, port, form="other"), "receptance"
        )


@pytest.mark.parametrize("form", ["receptance", "mobility", "accelerance"])
def test_dynamic_stiffness_is_the_matrix_inverse(form: str) -> None:
    stiffness = np.linalg.inv(convert(convert(rotor(ANISOTROPIC), form), "receptance").matrix)
    expected = ANISOTROPIC + (1j * OMEGA * DAMPING - OMEGA**2 * MASS)[:, None, None] * np.eye(2)
    np.testing.assert_allclose(stiffness, expected, rtol=1e-9, atol=1e-6)


def test_an_isotropic_rotor_has_no_mixed_terms() -> None:
    # Closed form: cross-coupling q gives H_ff = 1 / (k - j q + j w c - w^2 m), H_bb with + j q (x + j y
    # whirls forward).
    response = directional(rotor(ISOTROPIC))
    common = 5e4 + 1j * OMEGA * DAMPING - OMEGA**2 * MASS
    np.testing.assert_allclose(response.matrix[:, 0, 0], 1 / (common - 2e3j), rtol=1e-12)
    np.testing.assert_allclose(response.matrix[:, 1, 1], 1 / (common + 2e3j), rtol=1e-12)
    assert np.max(np.abs(response.matrix[:, [0, 1], [1, 0]])) < 1e-15
    assert [port.label for port in (*response.outputs, *response.inputs)] == ["f", "b", "f", "b"]


def test_the_force_directions_do_not_matter() -> None:
    straight, turned = (
        directional(rotor(ANISOTROPIC, angles)).matrix for angles in ((0.0, np.pi / 2), (0.6, 2.5))
    )
    np.testing.assert_allclose(turned, straight, rtol=1e-12)


def test_directional_covariance_is_that_of_turned_errors(rng: np.random.Generator) -> None:
    # Literal twin: any d has d_d = A^-1 d A; the covariance of one d is its outer product.
    error = 1e-9 * (rng.normal(size=(3, 2, 2)) + 1j * rng.normal(size=(3, 2, 2)))
    flat = error.reshape(3, 4)
    response = directional(rotor(ANISOTROPIC, covariance=flat[:, :, None] * flat[:, None, :].conj()))
    a = np.array([[1, 1], [-1j, 1j]])
    turned = (np.linalg.inv(a) @ error @ a).reshape(3, 4)
    np.testing.assert_allclose(
        response.covariance, turned[:, :, None] * turned[:, None, :].conj(), rtol=1e-9, atol=1e-32
    )


def test_directional_needs_two_known_directions() -> None:
    ports = (Port("x", "x", "x", 0.0), Port("1", "1", "1"))
    with pytest.raises(DataError, match="two responses in known directions, found x, 1"):
        directional(FrequencyResponse(np.array([1.0]), np.ones((1, 2, 2)), ports, ports))
    with pytest.raises(DataError, match="stand in one direction"):
        directional(rotor(ANISOTROPIC, (0.5, 0.5)))


def test_what_goes_with_the_response_is_converted_with_it() -> None:
    """H of every recording alone is turned as their mean is, and distortion is in the unit of H."""
    one = rotor(ANISOTROPIC)
    size = np.abs(one.matrix)
    whole = replace(one, repeats=one.matrix[None], repeat_names=("run",), distortion=size)
    turned, mobility = directional(whole), convert(whole, "mobility")
    assert turned.repeats is not None and mobility.repeats is not None
    np.testing.assert_array_equal(turned.repeats[0], turned.matrix)
    np.testing.assert_array_equal(mobility.repeats[0], mobility.matrix)
    np.testing.assert_allclose(mobility.distortion, OMEGA[:, None, None] * size, rtol=1e-15)
