"""Values with uncertainty and unit as people read them, against JCGM 100:2008, 7.2.6, and by what rounding
must keep.
"""

from __future__ import annotations

import math

import pytest
from hypothesis import assume, given, strategies as st

from labpipe.display import (
    NOT_DETERMINED,
    amount_text,
    as_printed,
    chance_text,
    number,
    plain_text,
    shown_unit,
    significant,
    two_digits,
    with_error,
    write_values,
)
from labpipe.quantities import parse_unit

SIZES = st.floats(min_value=1e-12, max_value=1e15)
SIGNED = st.one_of(SIZES, SIZES.map(lambda size: -size))
# Numbers of twelve digits and the decimal point are doubles: halves of a digit are met to this share.
ROUNDING = 1e-9


@pytest.mark.parametrize(
    ("value", "error", "texts"),
    [
        # The examples of the guide, 7.2.2 and 7.2.6: 100.02147 g with 0.35 mg, 10.057 62 ohm with 27 mohm.
        (100.02147, 0.00035, ("100.02147", "0.00035")),
        (10.05762, 0.027, ("10.058", "0.027")),
        (134.49812, 0.0087, ("134.4981", "0.0087")),
        (557.502, 480.0, ("560", "480")),
        (3.0, 0.0996, ("3.00", "0.10")),
        (3.0, 0.00995, ("3.000", "0.010")),
        (9.9996, 0.012, ("10.000", "0.012")),
        (0.0, 0.12, ("0.00", "0.12")),
        (-0.001, 0.12, ("0.00", "0.12")),
        (-42.31, 1.5, ("-42.3", "1.5")),
        (106179e3, 12e3, ("1.06179e8", "0.00012e8")),
        (1.234e-7, 1.1e-9, ("1.234e-7", "0.011e-7")),
        (1.234e-7, 5.0e-3, ("0.0000", "0.0050")),
        (5.0e8, 4.2e9, ("0.5e9", "4.2e9")),
        (12.3, 1e-12, ("12.3", "1.0e-12")),
    ],
)
def test_the_value_ends_where_the_second_digit_of_its_uncertainty_stands(
    value: float, error: float, texts: tuple[str, str]
) -> None:
    assert write_values(value, error) == texts


def test_no_chance_is_zero() -> None:
    texts = [chance_text(p) for p in (None, 1.0, 0.0123, 2.6e-9, 0.0)]
    assert texts == ["p unknown", "p = 1", "p = 0.012", "p = 2.6e-09", "p < 1e-15"]


def test_without_an_uncertainty_six_digits_stand() -> None:
    assert write_values(134498.1234, None) == ("134498", "")
    assert write_values(134498.1234, 0.0) == ("134498", "0")
    assert write_values(0.0, None, 1.23456789) == ("0", "", "1.23457")
    assert write_values(2.0, math.inf, -math.inf) == ("2", NOT_DETERMINED, NOT_DETERMINED)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_what_is_not_finite_is_not_determined(value: float) -> None:
    assert write_values(value, None)[0] == write_values(value, 0.5)[0] == number(value) == NOT_DETERMINED
    assert write_values(value, 0.5)[1] == "0.50" and write_values(1.0, math.nan) == ("1", NOT_DETERMINED)


@given(value=SIGNED, error=SIZES)
def test_the_uncertainty_has_two_digits_and_the_value_is_within_half_a_unit_of_the_last_place(
    value: float, error: float
) -> None:
    shown, uncertainty = write_values(value, error)
    place = 10.0 ** (int(f"{error:.1e}".partition("e")[2]) - 1)
    assert float(uncertainty) == pytest.approx(float(f"{error:.1e}"), rel=ROUNDING)
    assert abs(float(uncertainty) - error) <= place * (0.5 + ROUNDING)
    assert abs(float(shown) - value) <= max(place * (0.5 + 1e-6), abs(value) * 5.1e-12)
    assert shown != "-0" and len(shown) < 20


@given(value=SIGNED, error=SIZES)
def test_value_and_uncertainty_end_at_one_place_and_share_a_power(value: float, error: float) -> None:
    assume(abs(value) < 1e10 * error)  # Beyond twelve digits the uncertainty has a power of its own.
    shown, uncertainty = write_values(value, error)
    (mantissa, _, power), (small, _, other) = shown.partition("e"), uncertainty.partition("e")
    assert power == other and len(mantissa.partition(".")[2]) == len(small.partition(".")[2])


@given(low=SIGNED, value=SIGNED, error=SIZES)
def test_ends_of_an_interval_stand_at_the_place_of_the_value(low: float, value: float, error: float) -> None:
    shown, _, end = write_values(value, error, low)
    assert (
        end.partition("e")[2] == shown.partition("e")[2] or "e" not in shown + end or number(low, 12) == end
    )


@pytest.mark.parametrize(
    ("si_unit", "sizes", "unit"),
    [
        ("N/m", (134498.1,), "kN/m"),
        ("N/m", (106179e3,), "MN/m"),
        ("N/m", (9999e3,), "kN/m"),
        ("N/m", (1e7,), "MN/m"),
        ("N/m", (99.0,), "N/m"),
        ("N/m", (2.0, 4.8e8), "MN/m"),
        ("N/m", (0.0, None, math.nan), "kN/m"),
        ("m", (9e-5,), "um"),
        ("m", (5e-8,), "nm"),
        ("m", (0.025,), "mm"),
        ("s", (1.6e-4,), "us"),
        ("s", (2.5,), "s"),
        ("N.s/m", (5e5,), "kN.s/m"),
        ("kg", (0.005,), "g"),
        ("Hz", (1e9,), "Hz"),
        ("1", (1e9,), "1"),
        ("N/A", (1e9,), "N/A"),
    ],
)
def test_the_prefix_is_that_of_the_largest(si_unit: str, sizes: tuple[float | None, ...], unit: str) -> None:
    assert shown_unit(si_unit, *sizes) == unit


@given(value=SIGNED, unit=st.sampled_from(["N/m", "m", "s", "N.s/m", "kg", "N", "Pa", "Pa.s"]))
def test_a_prefix_is_of_the_same_dimension(value: float, unit: str) -> None:
    assert parse_unit(shown_unit(unit, value)).dimension == parse_unit(unit).dimension


@pytest.mark.parametrize(
    ("text", "printed"),
    [
        ("(1.234 +- 0.011)e-7 m^2", "(1.234 ± 0.011) × 10⁻⁷ m²"),
        ("k = 4.590e+05 N/m, 3 m/s^2", "k = 4.590 × 10⁵ N/m, 3 m/s²"),
        ("N/m^1.5, x^2", "N/m^1.5, x²"),
        ("12e5a7, 3.2e-9x, v1e5, 100 +-2", "12e5a7, 3.2e-9x, v1e5, 100 +-2"),
    ],
)
def test_powers_as_a_hand_writes_them(text: str, printed: str) -> None:
    """By hand; a digest, a name and a power that is no whole number stay as they are."""
    assert as_printed(text) == printed


def test_one_text() -> None:
    assert amount_text(134498.12, 8.7, "N/m") == "134.4981 ± 0.0087 kN/m"
    assert amount_text(557.502e3, 480e3, "N/m", "+-") == "560 +- 480 kN/m"
    assert amount_text(106179e3, 12e3, "N/m") == "106.179 ± 0.012 MN/m"
    assert amount_text(0.00568812, 0.0000321, "1") == "0.005688 ± 0.000032"
    assert amount_text(65.6697, None, "Hz") == "65.6697 Hz"
    assert with_error(1.234e-7, 1.1e-9, "m^2") == "(1.234 ± 0.011)e-7 m^2"
    assert with_error(12.3, 1e-12) == "12.3 ± 1.0e-12"
    assert with_error(293.15 - 273.15, 0.51, "degC") == "20.00 ± 0.51 degC"
    assert two_digits(4.8e2) == "480" and two_digits(0.1) == "0.10" and two_digits(3.2e-9) == "3.2e-9"
    assert (
        two_digits(3.2e-5) == "3.2e-5"
        and two_digits(3.2e-5, 0.0057) == "0.000032"
        and two_digits(0.0, 3.0) == "0"
    )


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        (1.38e-5, "m", "13.8 um"),
        (8.7617e5, "Pa", "876.17 kPa"),
        (16.0, "1", "16"),
        (2.147e8, "N/m", "214.7 MN/m"),
        (0.0, "N", "0 N"),
    ],
)
def test_amounts_without_an_uncertainty_have_the_unit_that_suits_them(
    value: float, unit: str, text: str
) -> None:
    assert plain_text(value, unit) == text


def test_digits_of_a_table_are_counted_with_their_zeros() -> None:
    assert [significant(value, 4) for value in (459000.0, 22.8, 1486.0, 0.0, -4893.2)] == [
        "4.590e+05",
        "22.80",
        "1486",
        "0",
        "-4893",
    ]
