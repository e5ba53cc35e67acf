"""Units by their algebra: products, powers, prefixes and round trips, for generated units.

Suggestions for slips of the pen.
"""

from __future__ import annotations

import math

import pytest
from hypothesis import assume, given, strategies as st

from labpipe.quantities import (
    QUANTITIES,
    UnitError,
    check_dimension,
    nearest_unit,
    parse_unit,
    parse_value,
    si_amount,
    to_display,
)

PREFIXES = {"G": 1e9, "M": 1e6, "k": 1e3, "c": 1e-2, "m": 1e-3, "u": 1e-6, "n": 1e-9, "p": 1e-12}
BASES = ["m", "s", "A", "K", "N", "Pa", "V", "Hz", "J", "W", "T", "H"]
# Prefix and base that are another unit, or that read as one.
AMBIGUOUS = {"min", "mil", "cd", "Pa", "pA", "h"}
FORMS = [
    f"{prefix}{base}" for prefix in ["", *PREFIXES] for base in BASES if f"{prefix}{base}" not in AMBIGUOUS
]
UNITS = st.sampled_from(FORMS)
POWERS = st.integers(1, 4)


@given(st.sampled_from(list(PREFIXES)), st.sampled_from(BASES))
def test_a_prefix_multiplies(prefix: str, base: str) -> None:
    assume(f"{prefix}{base}" not in AMBIGUOUS)
    plain, scaled = parse_unit(base), parse_unit(prefix + base)
    assert scaled.dimension == plain.dimension
    assert scaled.factor == pytest.approx(PREFIXES[prefix] * plain.factor, rel=1e-12)


@given(UNITS, UNITS, st.sampled_from([".", "*", " ", "·"]))
def test_a_product_multiplies_factors_and_adds_dimensions(one: str, other: str, sign: str) -> None:
    first, second, both = parse_unit(one), parse_unit(other), parse_unit(f"{one}{sign}{other}")
    assert both.factor == pytest.approx(first.factor * second.factor, rel=1e-12)
    assert both.dimension == tuple(a + b for a, b in zip(first.dimension, second.dimension, strict=True))
    assert parse_unit(f"{other}{sign}{one}").dimension == both.dimension


@given(UNITS, UNITS)
def test_a_quotient_is_a_product_with_a_negative_power(one: str, other: str) -> None:
    quotient, product = parse_unit(f"{one}/{other}"), parse_unit(f"{one}.{other}^-1")
    assert quotient.dimension == product.dimension and quotient.factor == pytest.approx(
        product.factor, rel=1e-12
    )


@given(UNITS, POWERS)
def test_a_power_is_a_repeated_product(unit: str, power: int) -> None:
    raised, repeated = parse_unit(f"{unit}^{power}"), parse_unit(".".join([unit] * power))
    assert raised.dimension == repeated.dimension and raised.factor == pytest.approx(
        repeated.factor, rel=1e-12
    )


@given(UNITS, UNITS, UNITS)
def test_everything_behind_the_slash_is_divided_by(one: str, two: str, three: str) -> None:
    bare, bracketed = parse_unit(f"{one}/({two}.{three})"), parse_unit(f"{one}/{two}/{three}")
    assert bare.dimension == bracketed.dimension and bare.factor == pytest.approx(bracketed.factor, rel=1e-12)


@pytest.mark.parametrize(
    ("text", "same"),
    [
        ("N.m", "J"),
        ("J/s", "W"),
        ("N/m^2", "Pa"),
        ("V.A", "W"),
        ("kg.m/s^2", "N"),
        ("Wb/m^2", "T"),
        ("V.s/A", "H"),
        ("A.s", "C"),
        ("1/s", "Hz"),
        ("N/m²", "Pa"),
    ],
)
def test_derived_units_are_what_they_are_derived_from(text: str, same: str) -> None:
    assert parse_unit(text).dimension == parse_unit(same).dimension
    assert parse_unit(text).factor == pytest.approx(parse_unit(same).factor, rel=1e-12)


@pytest.mark.parametrize(("text", "si"), [("1 in", 0.0254), ("1 mil", 2.54e-5), ("1000 mil", 0.0254)])
def test_inches(text: str, si: float) -> None:
    assert parse_value(text, "m") == pytest.approx(si, rel=1e-14)


def test_pressure_in_pounds_per_square_inch() -> None:
    """1 psi = 4.4482216152605 N / (0.0254 m)^2 = 6894.757 Pa."""
    assert parse_value("1 psi", "Pa") == pytest.approx(6894.757, abs=1e-3)


@given(st.floats(-1e6, 1e6))
def test_temperatures_have_an_offset_that_cancels_on_the_way_back(celsius: float) -> None:
    kelvin = parse_value(f"{celsius!r} degC", "K")
    assert kelvin == pytest.approx(celsius + 273.15, rel=1e-12, abs=1e-9)
    assert to_display(kelvin, "degC") == pytest.approx(celsius, rel=1e-9, abs=1e-9)


@given(st.floats(1e-3, 1e6))
def test_hertz_rpm_and_radians_are_one_speed(hertz: float) -> None:
    assert parse_value(f"{60 * hertz!r} rpm", "Hz") == pytest.approx(hertz, rel=1e-12)
    assert parse_value(f"{hertz!r} Hz", "rad/s") == pytest.approx(2 * math.pi * hertz, rel=1e-12)
    assert parse_value(f"{2 * math.pi * hertz!r} rad/s", "Hz") == pytest.approx(hertz, rel=1e-12)


def test_an_angle_is_no_pure_number() -> None:
    """45 deg is refused where 0.5 is meant, and the other way round."""
    with pytest.raises(UnitError, match="wrong dimension"):
        parse_value("45 deg", "1")
    with pytest.raises(UnitError, match="wrong dimension"):
        parse_value("50 %", "rad")


@pytest.mark.parametrize(
    ("one", "other"), [("m", "N"), ("Hz", "s"), ("Pa", "N"), ("V", "A"), ("rad", "1"), ("K", "s")]
)
def test_dimensions_that_differ_are_refused(one: str, other: str) -> None:
    with pytest.raises(UnitError, match=f"'{one}' has the wrong dimension, {other} is needed"):
        check_dimension(one, parse_unit(one), other)


@given(st.sampled_from(sorted(QUANTITIES)))
def test_every_quantity_reads_its_own_unit(name: str) -> None:
    quantity = QUANTITIES[name]
    assert parse_value(f"2.5 {quantity.si_unit}" if quantity.si_unit != "1" else 2.5, quantity.si_unit) == 2.5


@pytest.mark.parametrize(
    ("text", "amount"),
    [
        ("427 N", (427.0, "N")),
        ("0.427 kN", (427.0, "N")),
        ("3000 rpm", (50.0, "Hz")),
        ("20 degC", (293.15, "K")),
        ("50 %", (0.5, "1")),
        ("3", (3.0, "1")),
        ("5 mm", (0.005, "m")),
        ("2 bar", (2e5, "Pa")),
        ("10 N.m", (10.0, "N.m")),
        ("314.1592653589793 rad/s", (50.0, "Hz")),
        ("2 m/s^2", (2.0, "m/s^2")),
        ("12 g.mm", (12e-6, "kg.m")),
    ],
)
def test_an_amount_of_any_usual_dimension(text: str, amount: tuple[float, str]) -> None:
    value, unit = si_amount(text)
    assert (value, unit) == (pytest.approx(amount[0], rel=1e-12), amount[1])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("up", "is not an amount"),
        ("3 m^7", "has an unusual dimension"),
        ("3 foo", "unknown unit 'foo'"),
        ("1e999 N", "finite"),
    ],
)
def test_what_is_no_amount(text: str, said: str) -> None:
    with pytest.raises(UnitError, match=said):
        si_amount(text)


@pytest.mark.parametrize(
    ("slip", "meant"),
    [("umm", "um"), ("hz", "Hz"), ("RPM", "rpm"), ("KN", "kN"), ("pa", "Pa"), ("degg", "deg"), ("Nn", "nN")],
)
def test_a_slip_of_the_pen_is_named(slip: str, meant: str) -> None:
    assert nearest_unit(slip) == f"did you mean '{meant}'?"


@pytest.mark.parametrize("text", ["", "/", "()", "^2", "m^", "m^x", "m^(1/0x)", "m/(N", "m)"])
def test_unreadable_units_are_refused(text: str) -> None:
    with pytest.raises(UnitError):
        parse_unit(text)


@pytest.mark.long
@given(st.text(max_size=12))
def test_no_text_ends_in_anything_but_a_unit_or_a_refusal(text: str) -> None:
    try:
        unit = parse_unit(text)
    except UnitError:
        return
    assert isinstance(unit.factor, float) and len(unit.dimension) == 6


@given(st.floats(allow_nan=False, allow_infinity=False, width=32))
def test_a_pure_number_is_read_to_the_last_digit(number: float) -> None:
    assert parse_value(number, "1") == number


@pytest.mark.parametrize(
    ("text", "si_unit", "value"),
    [
        ("5 g", "kg", 5e-3),
        ("5 g", "m/s^2", 49.03325),
        ("5 mg", "m/s^2", 0.04903325),
        ("2 t", "kg", 2000.0),
        ("1 lbf", "N", 4.4482216152605),
        ("1 in/s", "m/s", 0.0254),
        ("1 ft", "m", 0.3048),
        ("3 mil", "m", 7.62e-5),
        ("1 g/lbf", "m/(N.s^2)", 9.80665 / 4.4482216152605),
        ("1 g.mm", "kg.m", 1e-6),
    ],
)
def test_units_of_workshops_and_the_two_meanings_of_g(text: str, si_unit: str, value: float) -> None:
    """Definitions: g = 9.80665 m/s^2 (CGPM 1901), lbf = 0.45359237 kg times it, in = 25.4 mm.

    The dimension says which g is meant.
    """
    assert parse_value(text, si_unit) == pytest.approx(value, rel=1e-12)


@pytest.mark.parametrize("text", ["5 g", "5 kg"])
def test_a_mass_is_no_force(text: str) -> None:
    with pytest.raises(UnitError, match="wrong dimension, N is needed"):
        parse_value(text, "N")


@pytest.mark.parametrize(
    ("nested", "plain"),
    [
        ("V/(m/s^2)", "V.s^2/m"),
        ("mV/(mm/ms^2)", "mV.ms^2/mm"),
        ("N/(m/s)^2", "N.s^2/m^2"),
        ("(m/s)^2", "m^2/s^2"),
        ("m/(N.(s/A)^2).K", "m.A^2/(N.s^2.K)"),
        ("kg/m/s", "kg/(m.s)"),
    ],
)
def test_quotients_and_powers_of_parentheses(nested: str, plain: str) -> None:
    assert parse_unit(nested).dimension == parse_unit(plain).dimension
    assert parse_unit(nested).factor == pytest.approx(parse_unit(plain).factor, rel=1e-12)
