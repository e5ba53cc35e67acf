"""Values with units. Expected values: definitions of the SI, and 1 lbf = 0.45359237 * 9.80665 N."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings, strategies as st

from labpipe.quantities import (
    QUANTITIES,
    UnitError,
    display_unit,
    parse_unit,
    parse_value,
    readable_unit,
    to_display,
)


@pytest.mark.parametrize(
    ("text", "unit", "expected"),
    [
        ("90 um", "m", 90e-6),
        ("90 µm", "m", 90e-6),
        ("134.5 kN/m", "N/m", 134.5e3),
        ("15 Hz", "Hz", 15.0),
        ("50 %", "1", 0.5),
        ("8 V/mm", "V/m", 8000.0),
        ("0.1044 Pa.s", "Pa.s", 0.1044),
        ("1.10e10 N/m^1.5", "N/m^1.5", 1.10e10),
        ("6e9 N/m^(10/9)", "N/m^(10/9)", 6e9),
        ("3.682 N.s/m", "N.s/m", 3.682),
        ("3.682 N*s/m", "N.s/m", 3.682),
        ("3.682 N s/m", "N.s/m", 3.682),
        ("2 m/(N.s^2)", "m/(N.s^2)", 2.0),
        ("45 deg", "rad", math.pi / 4),
        ("3000 rpm", "Hz", 50.0),
        ("3000 rpm", "rad/s", 100 * math.pi),
        ("50 Hz", "rad/s", 100 * math.pi),
        ("20 degC", "K", 293.15),
        ("20 C", "K", 293.15),
        ("20 C", "A.s", 20.0),
        ("68 °F", "K", 293.15),
        ("1 lbf", "N", 0.45359237 * 9.80665),
        ("0", "m", 0.0),
        (0.5, "1", 0.5),
    ],
)
def test_value_in_si(text: str | float, unit: str, expected: float) -> None:
    assert parse_value(text, unit) == pytest.approx(expected, rel=1e-14)


@pytest.mark.parametrize(
    ("text", "unit", "message", "hint"),
    [
        ("90 umm", "m", "unknown unit 'umm'", "did you mean 'um'?"),
        # A slip of the finger, which was read as a ten-thousandth.
        ("1 %%", "1", "unknown unit '%%'", "did you mean '%'?"),
        ("90", "m", "'90' has no unit", "write it with its unit, e.g. '90 m'"),
        ("3 N", "m", "'N' has the wrong dimension, m is needed", "for example '0.5 m'"),
        ("ninety um", "m", "'ninety um' is not a value with a unit", "for example '0.5 m'"),
        ("45", "rad", "'45' has no unit", "write it with its unit, e.g. '45 rad'"),
        ("1e999 m", "m", "'1e999 m' is not a finite value", ""),
        ("1 m/(N", "m/N", "unreadable unit 'm/(N'", "write it as N.s/m or m/(N.s^2)"),
        ("1 degC/s", "K/s", "'degC' has an offset and cannot be part of a compound unit", "use K"),
        ("50 %", "m", "'%' has the wrong dimension, m is needed", "for example '0.5 m'"),
    ],
)
def test_what_cannot_be_read_says_why(text: str, unit: str, message: str, hint: str) -> None:
    with pytest.raises(UnitError) as caught:
        parse_value(text, unit)
    assert (caught.value.what, caught.value.hint) == (message, hint)


def test_every_quantity_reads_and_displays_its_own_units() -> None:
    for quantity in QUANTITIES.values():
        si, display = parse_unit(quantity.si_unit), parse_unit(quantity.display_unit)
        assert si.factor == pytest.approx(1.0), quantity.name
        periods = {(0, 0, -1, 0, 0, 0), (0, 0, -1, 0, 0, 1)}
        assert si.dimension == display.dimension or {si.dimension, display.dimension} <= periods, (
            quantity.name
        )


@settings(derandomize=True, max_examples=50)
@given(st.floats(-1e9, 1e9), st.sampled_from(["um", "kN/m", "deg", "N.s/m", "degC"]))
def test_display_is_the_inverse_of_parsing(value: float, unit: str) -> None:
    si_unit = {"um": "m", "kN/m": "N/m", "deg": "rad", "N.s/m": "N.s/m", "degC": "K"}[unit]
    assert to_display(parse_value(f"{value!r} {unit}", si_unit), unit) == pytest.approx(
        value, rel=1e-9, abs=1e-9
    )


@pytest.mark.parametrize(
    ("si_unit", "values", "shown"),
    [
        ("N/m", [3e5, -2.26e8], "MN/m"),
        ("N/m", [999e3], "kN/m"),
        ("N/m", [12.0, float("nan")], "N/m"),
        ("N/m", [], "N/m"),
        ("N.s/m", [2.1e6], "kN.s/m"),
        ("N.s/m", [-500.0], "N.s/m"),
        ("N", [2000.0, 0.0], "kN"),
        ("m", [1e-4], "um"),
        ("1", [1e9], "1"),
    ],
)
def test_the_unit_of_a_table_suits_its_largest_value(si_unit: str, values: list[float], shown: str) -> None:
    assert readable_unit(si_unit, values) == shown


def test_display_unit_of_what_people_read() -> None:
    assert [display_unit(unit) for unit in ("N/m", "m", "rad", "kg")] == ["kN/m", "um", "deg", "kg"]


@pytest.mark.parametrize(
    ("printed", "written"),
    [("cm/s2", "cm/s^2"), ("m/s**2", "m/s^2"), ("m/(N.s2)", "m/(N.s^2)"), ("N/m2", "N/m^2")],
)
def test_powers_as_loggers_print_them_are_those_of_engineers(printed: str, written: str) -> None:
    assert parse_unit(printed) == parse_unit(written)
