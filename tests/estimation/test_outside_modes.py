"""Residual terms beside a model: what modes outside the band leave in it."""

from __future__ import annotations

import numpy as np

from labpipe.estimation.linear_models import sdof
from labpipe.estimation.mismatch import with_outside_modes
from labpipe.estimation.model import Setup
from labpipe.estimation.settings import FitSettings
from labpipe.records.response import FrequencyResponse, Port
from tests.estimation.noisy import measured

FREQUENCY = np.linspace(20.0, 60.0, 41)
PORTS = (Port("x", "x", "x"),), (Port("f", "f", "x"),)
MODEL = sdof(Setup(*PORTS, FitSettings("sdof")))
DATA = measured(FrequencyResponse(FREQUENCY, np.full((41, 1, 1), 3e-5 + 4e-5j), *PORTS))
# m, k and c in whatever order, then a + b x + c (2 x^2 - 1) of the real and of the imaginary part, times |H|
# = 5e-5.
OWN = {"k": 1e5, "c": 30.0, "m": 2.0}
VALUES = np.array([*(OWN[name] for name in MODEL.names), 1.0, 0.5, -0.25, 0.0, 2.0, 1.0])


def test_terms_are_chebyshev_polynomials_over_the_band() -> None:
    """Place x is -1 at the first line, 0 in the middle, 1 at the last.

    Sizes are shares of the rms response.
    """
    model = with_outside_modes(MODEL, DATA, 3, 3)
    x = (FREQUENCY - 40) / 20
    added = 5e-5 * ((1 + 0.5 * x - 0.25 * (2 * x**2 - 1)) + 1j * (2 * x + (2 * x**2 - 1)))
    own = MODEL.receptance(VALUES[:3], DATA.omega)
    np.testing.assert_allclose(
        model.receptance(VALUES, DATA.omega)[:, 0, 0], own[:, 0, 0] + added, rtol=1e-12
    )


def test_slopes_are_central_differences() -> None:
    model = with_outside_modes(MODEL, DATA, 3, 3)
    slopes = model.jacobian(VALUES, DATA.omega)
    for number, value in enumerate(VALUES):
        step = 1e-5 * max(abs(value), 1.0) * np.eye(VALUES.size)[number]
        ends = [model.receptance(VALUES + sign * step, DATA.omega) for sign in (1, -1)]
        np.testing.assert_allclose(
            slopes[number], (ends[0] - ends[1]) / (2 * step[number]), rtol=1e-6, atol=1e-15
        )


def test_the_start_is_the_model_without_terms() -> None:
    model = with_outside_modes(MODEL, DATA, 3, 3)
    start = model.start(VALUES[:3])
    np.testing.assert_array_equal(start, [*VALUES[:3], *np.zeros(6)])
    np.testing.assert_array_equal(
        model.receptance(start, DATA.omega), MODEL.receptance(VALUES[:3], DATA.omega)
    )
