"""A model between the measured lines is drawn as it is, however light the damping.

All lines are among its frequencies.
"""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.estimation.derived import FEWEST, MOST, drawn_densely, lines_between
from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import FitSettings, Sliding
from labpipe.records.response import FrequencyResponse, Port


def receptance(frequency: np.ndarray, f_n: float, zeta: float) -> np.ndarray:
    """H = 1 / (1 - r^2 + 2 j zeta r), r = f / f_n: at its peak 1 / (2 zeta sqrt(1 - zeta^2))."""
    r = frequency / f_n
    return (1 / (1 - r**2 + 2j * zeta * r))[:, None, None]


@pytest.mark.parametrize("zeta", [0.2, 0.01, 1e-3, 1e-4])
@pytest.mark.parametrize("f_n", [65.5, 65.31])
def test_a_peak_between_two_lines_has_its_height(zeta: float, f_n: float) -> None:
    lines = np.arange(40.0, 91.0)
    frequency, values = drawn_densely(lambda f: receptance(f, f_n, zeta), lines)
    assert np.max(np.abs(values)) == pytest.approx(1 / (2 * zeta * np.sqrt(1 - zeta**2)), rel=0.01)
    assert (
        set(lines) <= set(frequency) and np.all(np.diff(frequency) > 0) and FEWEST <= frequency.size <= MOST
    )


def test_straight_lines_between_the_points_follow_the_model() -> None:
    lines = np.arange(40.0, 91.0, 0.5)
    frequency, values = drawn_densely(lambda f: receptance(f, 65.3, 0.005), lines)
    fine = np.linspace(40.0, 90.0, 20001)
    drawn = np.interp(fine, frequency, np.abs(values[:, 0, 0]))
    np.testing.assert_allclose(drawn, np.abs(receptance(fine, 65.3, 0.005))[:, 0, 0], rtol=0.01)


def test_a_straight_model_gets_no_more_than_equal_parts() -> None:
    frequency, values = drawn_densely(lambda f: np.ones((f.size, 1, 1), complex), np.arange(1.0, 12.0))
    np.testing.assert_allclose(frequency, lines_between(np.arange(1.0, 12.0)))
    assert frequency.size == 201 and values.shape == (201, 1, 1)


def test_number_of_frequencies_is_bounded_and_one_line_stays_one() -> None:
    assert lines_between(np.arange(3000.0)).size == 3000 and lines_between(np.array([7.0])).tolist() == [7.0]
    rng = np.random.default_rng(1)
    rough, _ = drawn_densely(lambda f: rng.normal(size=(f.size, 1, 1)) + 0j, np.arange(500.0))
    assert rough.size == MOST
    alone, value = drawn_densely(lambda f: np.ones((f.size, 1, 1), complex), np.array([7.0]))
    assert alone.tolist() == [7.0] and value.shape == (1, 1, 1)


def response(form: str = "receptance") -> FrequencyResponse:
    """A 0.79 kg mass on 134.5 kN/m, 65.67 Hz, zeta 0.01: its peak lies between the lines at 65 and 66 Hz."""
    frequency = np.arange(40.0, 91.0)
    k, m = 134.5e3, 0.79
    w = 2 * np.pi * frequency
    h = (1 / (k - m * w**2 + 2j * 0.01 * np.sqrt(k * m) * w))[:, None, None]
    factor = {"receptance": np.ones_like(w), "accelerance": -(w**2)}[form][:, None, None]
    return FrequencyResponse(frequency, h * factor, (Port("y", "y", "y"),), (Port("f", "f", "y"),), form=form)


def test_the_curve_of_a_fit_has_the_height_of_its_peak() -> None:
    (fit,) = identify(response(), FitSettings("sdof", mass=0.79, estimator="ls"))
    assert fit.curve is not None
    _, drawn = fit.curve.drawn
    height = 1 / (134.5e3 * 2 * 0.01 * np.sqrt(1 - 0.01**2))
    assert np.max(np.abs(drawn)) == pytest.approx(height, rel=0.01)
    assert np.max(np.abs(fit.curve.fitted)) < 0.9 * height


def test_the_curve_is_in_the_measured_form_and_meets_the_fit_on_the_lines() -> None:
    (fit,) = identify(response("accelerance"), FitSettings("sdof", mass=0.79, estimator="ls"))
    assert fit.curve is not None and fit.curve.dense_frequency is not None and fit.curve.dense is not None
    lines = np.searchsorted(fit.curve.dense_frequency, fit.curve.frequency)
    np.testing.assert_allclose(fit.curve.dense[lines], fit.curve.fitted, rtol=1e-12)


def test_bands_of_a_sliding_fit_keep_their_lines_only() -> None:
    fits = identify(response(), FitSettings("sdof", mass=0.79, estimator="ls", sliding=Sliding(15.0, 5.0)))
    assert len(fits) > 1
    for fit in fits:
        assert fit.curve is not None and fit.curve.dense is None and fit.curve.drawn[0] is fit.curve.frequency
