"""The part of a response that a wear fit uses: frames by hand, lines and terms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labpipe.errors import ConfigError, FitError, LabpipeError
from labpipe.methods.wear.model import WornReceptance, worn_receptance
from labpipe.records.response import FrequencyResponse, Port, diagonal_covariance
from labpipe.spectra.convert import directional
from tests.methods.wear.worn_cases import PORTS, Y, Z, fit_settings, turned, wear_settings

A = np.array([[1, 1], [-1j, 1j]])
LINES = np.arange(10.0, 100.5, 0.5)
F, B = Port("f", "f", "f"), Port("b", "b", "b")


@pytest.fixture
def response(rng: np.random.Generator) -> FrequencyResponse:
    """Any 2 x 2 response in y and z, each term with its own variance."""
    matrix = rng.standard_normal((LINES.size, 2, 2)) + 1j * rng.standard_normal((LINES.size, 2, 2))
    variance = rng.uniform(0.5, 1.0, (LINES.size, 2, 2)) * 1e-4
    return FrequencyResponse(LINES, matrix, PORTS, PORTS, covariance=diagonal_covariance(variance))


def data_of(
    measured: FrequencyResponse, band: tuple[float, float] | None = None, **changes: object
) -> WornReceptance:
    return worn_receptance(measured, replace(fit_settings(), band=band), wear_settings(**changes))


def test_y_and_z_in_any_order(response: FrequencyResponse) -> None:
    swap = np.array([[0.0, 1.0], [1.0, 0.0]])
    mixed = turned(response, (Z, Y), swap, swap)
    np.testing.assert_allclose(data_of(mixed).measured.matrix, response.matrix)


def test_lines_are_those_of_the_fit(response: FrequencyResponse) -> None:
    """As a mask of the response: f and 2 pi f / (2 pi) differ in the last bit at one line in eight."""
    assert np.array_equal(np.flatnonzero(data_of(response, lines=(20.5, 34.3)).lines), [21, 49])
    assert data_of(response).lines.all() and not np.isin(LINES, data_of(response).frequency).all()


def test_forward_and_backward_by_hand(response: FrequencyResponse) -> None:
    data = data_of(response, response="dFRF")
    np.testing.assert_allclose(data.measured.matrix, np.linalg.inv(A) @ response.matrix @ A, atol=1e-12)
    assert data.names == ("f", "b")


def test_directional_frf_of_the_pipeline_is_turned_back(response: FrequencyResponse) -> None:
    """A response whose frf: section has directional: true.

    Its ports are f and b, its angles were x (horizontal) and y (up).
    """
    xy = tuple(
        Port(port.label, port.label, dof, angle)
        for port, dof, angle in zip(PORTS, "xy", (0.0, np.pi / 2), strict=True)
    )
    forward = directional(replace(response, outputs=xy, inputs=xy))
    data = data_of(forward)
    np.testing.assert_allclose(data.measured.matrix, response.matrix, atol=1e-12)
    np.testing.assert_allclose(
        np.einsum("lii->li", data.measured.covariance).real, response.variance.reshape(-1, 4), rtol=1e-9
    )


def test_sensors_at_45_degrees(response: FrequencyResponse) -> None:
    """(q45, q135) = R (y, z), forces likewise: H' = R H R^T."""
    rotation = np.array([[1, 1], [-1, 1]]) / np.sqrt(2)
    slanted = (Port("u", "u", "45 deg", np.pi / 4), Port("v", "v", "135 deg", 3 * np.pi / 4))
    np.testing.assert_allclose(
        data_of(turned(response, slanted, rotation, rotation.T)).measured.matrix, response.matrix, atol=1e-12
    )


def test_covariance_turns_with_the_response(response: FrequencyResponse, rng: np.random.Generator) -> None:
    """Scatter of 20,000 turned draws at one line against the turned covariance."""
    data = data_of(response, response="dFRF")
    std = np.sqrt(response.variance[5] / 2)
    noise = std * (rng.standard_normal((20000, 2, 2)) + 1j * rng.standard_normal((20000, 2, 2)))
    draws = (np.linalg.inv(A) @ noise @ A).reshape(-1, 4)
    scatter = np.einsum("na,nb->ab", draws, draws.conj()) / 20000
    np.testing.assert_allclose(scatter, data.measured.covariance[5], atol=0.05 * np.abs(scatter).max())


@pytest.mark.parametrize(("terms", "places"), [("full", [0, 1, 2, 3]), ("direct", [0, 3]), ("cross", [1, 2])])
def test_terms(response: FrequencyResponse, terms: str, places: list[int]) -> None:
    chosen = data_of(response, terms=terms).chosen
    np.testing.assert_allclose(chosen.matrix[:, :, 0], response.matrix.reshape(-1, 4)[:, places])
    assert chosen.covariance is not None and chosen.covariance.shape == (LINES.size, len(places), len(places))
    np.testing.assert_allclose(
        np.einsum("lii->li", chosen.covariance).real, response.variance.reshape(-1, 4)[:, places]
    )


def test_lines_by_band_list_and_half_power(response: FrequencyResponse) -> None:
    np.testing.assert_allclose(data_of(response, (20.0, 30.0)).frequency, np.arange(20, 30.5, 0.5))
    np.testing.assert_allclose(data_of(response, lines=(15.9, 81.3)).frequency, [16.0, 81.5])
    # One degree of freedom at 60 Hz with 5 % damping: half power at 57.0 and 63.0 Hz but for zeta^2.
    one = 1 / (60**2 - LINES**2 + 2j * 0.05 * 60 * LINES)
    peaked = replace(response, matrix=one[:, None, None] * np.ones((1, 2, 2)), covariance=None)
    np.testing.assert_allclose(
        data_of(peaked, half_power=((40.0, 80.0),)).frequency, np.arange(57.0, 63.0, 0.5)
    )


@pytest.mark.parametrize(
    ("changes", "band", "message"),
    [
        ({"lines": (9.0,)}, None, "no line near 9 Hz; the nearest is 10 Hz"),
        ({"lines": (30.0, 50.0)}, (40.0, 80.0), "no line near 30 Hz; the nearest is 40 Hz"),
        ({}, (200.0, 300.0), "no frequency line is left"),
        ({"half_power": ((200.0, 300.0),)}, None, "no resonance within 200-300 Hz"),
    ],
)
def test_lines_that_are_not_there(
    response: FrequencyResponse, changes: dict, band: tuple[float, float] | None, message: str
) -> None:
    with pytest.raises(LabpipeError, match=message):
        data_of(response, band, **changes)


@pytest.mark.parametrize(
    ("ports", "message"),
    [
        ((Y,), "two responses and two forces, found responses y"),
        ((Port("a", "a", "1"), Port("b2", "b2", "2")), "known directions"),
        ((Port("a", "a", "x", 0.0), Port("c", "c", "5 deg", 1e-5)), "one direction"),
    ],
)
def test_ports_that_say_no_direction(
    response: FrequencyResponse, ports: tuple[Port, ...], message: str
) -> None:
    n = len(ports)
    other = replace(response, outputs=ports, inputs=ports, matrix=response.matrix[:, :n, :n], covariance=None)
    with pytest.raises(ConfigError, match=message):
        data_of(other)


def test_accelerance_is_taken_as_receptance(response: FrequencyResponse) -> None:
    w = 2 * np.pi * LINES[:, None, None]
    other = replace(response, matrix=-(w**2) * response.matrix, form="accelerance", covariance=None)
    np.testing.assert_allclose(data_of(other).measured.matrix, response.matrix)
    with pytest.raises(FitError, match="0 Hz"):
        data_of(replace(other, frequency=LINES - 10.0))
