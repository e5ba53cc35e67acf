"""Reciprocity over tests: symmetric matrices with noise, a cross-coupled one, dofs that are not coupled, the
number of pairs.
"""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.errors import DataError
from labpipe.records.response import FrequencyResponse, Port, diagonal_covariance
from labpipe.uncertainty.compare import reciprocal
from labpipe.uncertainty.settings import CompareSettings

SETTINGS = CompareSettings(kind="reciprocity", name="symmetry")
NOISE = 2e-8


def response(rng, skew: float = 0.0, coupled: bool = True, name: str = "t") -> FrequencyResponse:
    """Receptance of two coupled masses and a third one for itself, K_xy - K_yx = 2 *skew*.

    White noise of known variance.
    """
    frequency = np.arange(10.0, 60.0, 0.5)
    w = 2 * np.pi * frequency[:, None, None]
    cross = 4e4 if coupled else 0.0
    k = np.array([[2e5, cross + skew, 0], [cross - skew, 1.5e5, 0], [0, 0, 1e5]])
    h = np.linalg.inv(k + 30j * w * np.eye(3) - 2 * w**2 * np.eye(3))
    h = h + NOISE * (rng.standard_normal(h.shape) + 1j * rng.standard_normal(h.shape)) / np.sqrt(2)
    outputs = tuple(Port(dof, dof, dof) for dof in "xyz")
    inputs = tuple(Port(f"f{dof}", f"f{dof}", dof) for dof in "xyz")
    return FrequencyResponse(
        frequency, h, outputs, inputs, covariance=diagonal_covariance(np.full(h.shape, NOISE**2)), name=name
    )


def test_a_symmetric_structure_is_reciprocal(rng) -> None:
    found = reciprocal(SETTINGS, [response(rng, name="a"), response(rng, name="b")])
    assert found.verdict == "reciprocal"
    assert [(point.test, point.group) for point in found.points] == [
        (t, g) for t in "ab" for g in ("x-y", "x-z", "y-z")
    ]
    assert found.amount("difference").value < 0.05
    assert "6 pair(s) of dofs in 2 test(s), 2 of them coupled" in found.statement


def test_cross_coupling_of_unequal_size_is_not(rng) -> None:
    found = reciprocal(SETTINGS, [response(rng), response(rng, skew=2e3, name="b")])
    assert found.verdict == "not reciprocal"
    worst = min(found.points, key=lambda point: point.p_value)
    assert (worst.test, worst.group) == ("b", "x-y")
    # H_xy - H_yx = -2 skew / det Z, H_xy + H_yx = -2 cross / det Z: relative rms 2 x 2e3 / rms of (4.2e4,
    # 3.8e4).
    assert worst.value == pytest.approx(4e3 / np.sqrt((4.2e4**2 + 3.8e4**2) / 2), rel=0.05)


def test_dofs_that_are_not_coupled_do_not_count_as_different(rng) -> None:
    found = reciprocal(SETTINGS, [response(rng, coupled=False)])
    assert found.verdict == "reciprocal"
    assert np.isnan(found.amount("difference").value)
    assert "no pair is coupled above the noise" in found.statement


def test_the_number_of_pairs_is_accounted_for(rng) -> None:
    """150 reciprocal campaigns of 3 pairs: at most 5 % + 3.5 binomial standard deviations are refused."""
    refused = sum(reciprocal(SETTINGS, [response(rng)]).verdict == "not reciprocal" for _ in range(150))
    assert refused / 150 <= 0.05 + 3.5 * np.sqrt(0.05 * 0.95 / 150)


def test_the_corrected_p_value_is_the_least_times_the_pairs(rng) -> None:
    found = reciprocal(SETTINGS, [response(rng)])
    assert found.amount("p_value").value == pytest.approx(
        min(1.0, 3 * min(point.p_value for point in found.points))
    )


def test_without_responses_nothing_is_judged() -> None:
    with pytest.raises(DataError, match="no response whose reciprocity"):
        reciprocal(SETTINGS, [])
