"""Independent motions of the responses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labpipe.estimation.diagnostics import independent_motions, motion_notes
from tests.estimation.noisy import measured


def test_two_responses_that_move_alike_are_one_motion(symmetric_response, coupled_response, rng) -> None:
    alike = measured(symmetric_response(1e-8, rng))
    values, count = independent_motions(alike)
    assert count == 1 and values[0] > 100 * values[1]
    assert "one independent motion" in motion_notes(alike)[0]
    assert motion_notes(measured(coupled_response(1e-8, rng))) == ()
    assert motion_notes(measured(symmetric_response())) == ()


def test_noise_alone_is_no_motion(symmetric_response, rng) -> None:
    response = symmetric_response(1e-8, rng)
    noise = (
        1e-8
        * (rng.normal(size=response.matrix.shape) + 1j * rng.normal(size=response.matrix.shape))
        / np.sqrt(2)
    )
    values, count = independent_motions(measured(replace(response, matrix=noise)))
    # Largest singular value of 250 x 2 circular noise: sqrt(250) + sqrt(2) = 17.2.
    assert count == 0 and values[0] == pytest.approx(np.sqrt(250), rel=0.15)


def test_few_lines_of_noise_are_no_motion_either(symmetric_response) -> None:
    """Rows (1.2, 0), (0, 1.2) in turn at four lines, in units of the noise: singular values sqrt(4/2) 1.2 =
    1.7, below 1.5 (2 + 1.4).
    """
    whole = symmetric_response(1e-8, np.random.default_rng(1))
    rows = 1.2e-8 * np.eye(2)[[0, 1, 0, 1]][:, :, None] * np.ones(whole.matrix.shape[2])
    few = replace(
        whole,
        frequency=whole.frequency[:4],
        matrix=rows,
        covariance=whole.covariance[:4],
        coherence=None,
        multiple_coherence=None,
    )
    values, count = independent_motions(measured(few))
    np.testing.assert_allclose(values, values[0])
    assert 1 < values[0] < 4 and count == 0


@pytest.mark.filterwarnings("error")
def test_without_the_noise_of_a_response_nothing_is_said_of_motions(symmetric_response, rng) -> None:
    alike = measured(symmetric_response(1e-8, rng))
    covariance = np.array(alike.covariance)
    covariance[:, 1, 1] = 0.0
    assert motion_notes(replace(alike, covariance=covariance)) == ()
