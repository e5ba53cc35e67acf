"""Half-power points against the closed form of one degree of freedom."""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.errors import DataError
from labpipe.spectra.damping import half_power

ZETA, NATURAL = 0.02, 51.3
FREQUENCY = np.arange(20.0, 90.0, 0.5)


def receptance(frequency: np.ndarray, zeta: float = ZETA) -> np.ndarray:
    return 1e-5 / (NATURAL**2 - frequency**2 + 2j * zeta * NATURAL * frequency)


def test_points_are_those_of_the_closed_form() -> None:
    # |1/H|^2 = (w_n^2 - w^2)^2 + 4 z^2 w_n^2 w^2 is least at w^2 = w_n^2 (1 - 2 z^2), and twice that at w^2
    # -+ 2 z w_n^2 sqrt(1 - z^2).
    found = half_power(FREQUENCY, receptance(FREQUENCY), (40.0, 60.0))
    peak = NATURAL**2 * (1 - 2 * ZETA**2)
    side = 2 * ZETA * NATURAL**2 * np.sqrt(1 - ZETA**2)
    assert found.frequency == pytest.approx(np.sqrt(peak), rel=1e-9)
    assert found.low == pytest.approx(np.sqrt(peak - side), rel=1e-9)
    assert found.high == pytest.approx(np.sqrt(peak + side), rel=1e-9)
    assert found.amplitude == pytest.approx(1e-5 / (2 * ZETA * NATURAL**2 * np.sqrt(1 - ZETA**2)), rel=1e-9)
    assert found.damping_ratio == pytest.approx(ZETA, rel=2 * ZETA**2)


def test_the_scale_does_not_matter() -> None:
    plain, tiny = (
        half_power(FREQUENCY, factor * receptance(FREQUENCY), (40.0, 60.0)) for factor in (1.0, 1e-12)
    )
    assert tiny.low == pytest.approx(plain.low, rel=1e-12) and tiny.amplitude == pytest.approx(
        1e-12 * plain.amplitude
    )


def test_a_coarse_peak_of_two_modes_is_near() -> None:
    two = receptance(FREQUENCY) + 0.5e-5 / (75.0**2 - FREQUENCY**2 + 2j * 0.01 * 75.0 * FREQUENCY)
    assert half_power(FREQUENCY, two, (45.0, 60.0)).damping_ratio == pytest.approx(ZETA, rel=0.05)


def test_what_is_no_resonance_is_refused() -> None:
    with pytest.raises(DataError, match="no resonance within 60-70 Hz"):
        half_power(FREQUENCY, receptance(FREQUENCY), (60.0, 70.0))
    with pytest.raises(DataError, match="no resonance within 91-92 Hz"):
        half_power(FREQUENCY, receptance(FREQUENCY), (91.0, 92.0))
    near = FREQUENCY[(FREQUENCY > 45) & (FREQUENCY < 52.1)]
    with pytest.raises(DataError, match="does not fall to half power above"):
        half_power(near, receptance(near), (45.0, 52.0))


def test_lines_too_far_apart_for_a_sharp_peak_are_refused() -> None:
    """1/|H|^2 = 20, 1, 1 at equal steps of f^2 is a parabola whose least value, 1 - 19 / 8, is below zero."""
    inverse = np.array([90.0, 60.0, 20.0, 1.0, 1.0, 20.0, 60.0])
    with pytest.raises(DataError, match="too far apart for the peak at 20 Hz"):
        half_power(np.sqrt(400.0 + np.arange(-3.0, 4.0)), 1 / np.sqrt(inverse), (19.9, 20.1))


def test_points_on_a_straight_line_have_their_crossing_on_it() -> None:
    """1/|H|^2 = 1 + 3/4 |x| with x = f^2 - 400 beyond the parabola 1 + 3/4 x^2 of the peak: 2 at x =
    -+4/3.
    """
    x = np.arange(-4.0, 5.0)
    found = half_power(np.sqrt(400 + x), 1 / np.sqrt(1 + 0.75 * np.abs(x)), (19.9, 20.1))
    assert (found.low**2, found.high**2) == (pytest.approx(400 - 4 / 3), pytest.approx(400 + 4 / 3))


def test_both_edges_of_the_band_belong_to_it() -> None:
    """The highest line is that at 51.5 Hz."""
    wide = half_power(FREQUENCY, receptance(FREQUENCY), (40.0, 60.0))
    for band in ((51.5, 60.0), (40.0, 51.5)):
        assert half_power(FREQUENCY, receptance(FREQUENCY), band) == wide
