"""Numbers along axes: round, evenly apart, as many as asked for, and the same as the page's script has."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from labpipe.document.ticks import LEAST, plain, ticks_of
from labpipe.report.chart import Axis, named_ticks

LINEAR, LOGARITHMIC = Axis("k", "N/m"), Axis("k", "N/m", logarithmic=True)


def texts(axis: Axis, low: float, high: float, most: int) -> list[str]:
    return [text for _, text in ticks_of(axis, (low, high), most)]


@pytest.mark.parametrize(
    ("low", "high", "most", "expected"),
    [
        (0, 1, 5, ["0.0", "0.2", "0.4", "0.6", "0.8", "1.0"]),
        (-0.05, 1.05, 4, ["0.0", "0.5", "1.0"]),
        (65, 80, 7, ["65.0", "67.5", "70.0", "72.5", "75.0", "77.5", "80.0"]),
        (0, 3e7, 3, ["0", "1e7", "2e7", "3e7"]),
        (-2e-5, 2e-5, 4, ["−2e−5", "−1e−5", "0", "1e−5", "2e−5"]),
    ],
)
def test_steps_are_one_two_two_and_a_half_or_five(low: float, high: float, most: int, expected: list[str]) -> None:
    assert texts(LINEAR, low, high, most) == expected


def test_degrees_go_in_parts_of_a_turn() -> None:
    assert texts(Axis("phase", "deg"), -198, 198, 3) == ["−180", "0", "180"]
    assert texts(Axis("phase", "deg"), -100, 10, 3) == ["−90", "−45", "0"]
    assert texts(Axis("phase", "deg"), 10.6, 11.1, 3) == ["10.6", "10.8", "11.0"]


def test_decades_are_told_with_few_within_them() -> None:
    assert texts(LOGARITHMIC, 0.9, 1.1e4, 6) == ["1", "10", "100", "1000", "10000"]
    assert texts(LOGARITHMIC, 0.09, 2.1, 6) == ["0.1", "0.2", "0.5", "1", "2"]
    assert texts(LOGARITHMIC, 1e-8, 1e4, 4) == ["1e−6", "0.001", "1", "1000"]
    # Less than five times from end to end: equal steps.
    assert texts(LOGARITHMIC, 6.4, 8.6, 4) == ["6.5", "7.0", "7.5", "8.0", "8.5"]


def test_places_with_names_keep_them() -> None:
    axis = Axis(ticks=named_ticks(["k", "c", "m"]))
    assert texts(axis, 1.5, -0.5, 2) == ["k", "c"]


@pytest.mark.parametrize(
    ("value", "text"), [(0.0, "0"), (-0.0, "0"), (1e6, "1e6"), (-123456, "−123456"), (1.5e-5, "1.5e−5"), (0.1 + 0.2, "0.3")]
)
def test_numbers_are_plain(value: float, text: str) -> None:
    assert plain(value) == text


@given(near=st.floats(-1e6, 1e6), length=st.floats(1e-3, 1e9), most=st.integers(2, 12))
def test_numbers_lie_within_evenly_and_not_far_too_many(near: float, length: float, most: int) -> None:
    """Up to a million lengths away from zero, where numbers still have ten digits to tell them apart."""
    low = near * length
    ticks = ticks_of(LINEAR, (low, low + length), most)
    places = [at for at, _ in ticks]
    assert LEAST <= len(places) <= max(most + 1, 2 * LEAST + 1)
    rounding = 1e-6 * length + 1e-12 * abs(low)
    assert low - rounding <= places[0] and places[-1] <= low + length + rounding
    steps = np.diff(places)
    assert np.ptp(steps) <= rounding
    mantissa = steps[0] / 10 ** math.floor(math.log10(steps[0] * (1 + 1e-9)))
    assert min(abs(mantissa - part) for part in (1, 2, 2.5, 5, 10)) < 1e-5
    assert len({text for _, text in ticks}) == len(ticks)
