"""Every kind of value: what is read, and what is said where it cannot be."""

from __future__ import annotations

import contextlib
import math
from typing import Any

import pytest
from hypothesis import given, strategies as st

from labpipe.project.marked_yaml import parse_marked
from labpipe.project.settings_reader import read_value
from labpipe.quantities import UnitError
from labpipe.records.settings import CONVERTERS, Setting
from labpipe.records.uncertain import Uncertain, parse_uncertain


def read(kind: str, text: str, unit: str = "", choices: tuple[str, ...] = ()) -> Any:
    """The value behind `key:` in a YAML file."""
    node = parse_marked(f"key: {text}", "p.yaml").content["key"]
    return read_value(node, Setting(kind, "help", unit=unit, choices=choices))


def fault(kind: str, text: str, unit: str = "", choices: tuple[str, ...] = ()) -> tuple[str, str]:
    """(what, hint) of the refusal."""
    with pytest.raises(UnitError) as caught:
        read(kind, text, unit, choices)
    return caught.value.what, caught.value.hint


NUMBERS = st.floats(1e-6, 1e6).map(lambda number: float(f"{number:.6g}"))


# values


@given(NUMBERS, st.sampled_from([("um", 1e-6), ("mm", 1e-3), ("m", 1.0), ("in", 0.0254)]))
def test_a_value_is_its_number_times_its_unit(number: float, unit: tuple[str, float]) -> None:
    assert read("value", f"{number!r} {unit[0]}", "m") == pytest.approx(number * unit[1], rel=1e-12)


@pytest.mark.parametrize(
    ("text", "unit", "value"),
    [
        ("15 Hz", "Hz", 15.0),
        ("900 rpm", "Hz", 15.0),
        ("50 %", "1", 0.5),
        ("0.5", "1", 0.5),
        ("0", "kg", 0.0),
        ("-3 um", "m", -3e-6),
    ],
)
def test_values(text: str, unit: str, value: float) -> None:
    assert read("value", text, unit) == pytest.approx(value, rel=1e-14)


@pytest.mark.parametrize(
    ("text", "what", "hint"),
    [
        ("[1 Hz]", "'(a list)' is not a value with its unit, for example '1 Hz'", ""),
        ("{a: 1 Hz}", "'(a mapping)' is not a value with its unit, for example '1 Hz'", ""),
        ("", "'(nothing)' is not a value with its unit, for example '1 Hz'", ""),
        ("15", "'15' has no unit", "write it with its unit, e.g. '15 Hz'"),
        ("15 m", "'m' has the wrong dimension, Hz is needed", "for example '0.5 Hz'"),
        ("fast", "'fast' is not a value with a unit", "for example '0.5 Hz'"),
        ("15 hz", "unknown unit 'hz'", "did you mean 'Hz'?"),
    ],
)
def test_what_is_no_value(text: str, what: str, hint: str) -> None:
    assert fault("value", text, "Hz") == (what, hint)


# values with their uncertainty


@given(NUMBERS, NUMBERS, st.sampled_from(["+-", "±"]), st.booleans())
def test_an_uncertain_value_in_the_same_unit(value: float, error: float, sign: str, spaced: bool) -> None:
    gap = " " if spaced else ""
    found = parse_uncertain(f"{value!r} kN/m {sign}{gap}{error!r} N/m", "N/m")
    assert found.value == pytest.approx(1e3 * value, rel=1e-12) and found.std_error == pytest.approx(
        error, rel=1e-12
    )


@given(NUMBERS, st.booleans(), st.floats(0, 100).map(lambda number: float(f"{number:.4g}")))
def test_a_share_is_of_the_size_of_the_value(size: float, negative: bool, percent: float) -> None:
    found = parse_uncertain(f"{'-' if negative else ''}{size!r} N +- {percent!r} %", "N")
    assert found.std_error == pytest.approx(size * percent / 100, rel=1e-12) and found.std_error >= 0


def test_without_a_stated_uncertainty_a_value_is_exact() -> None:
    assert read("uncertain", "134.5 kN/m", "N/m") == Uncertain(134500.0)
    assert read("uncertain", "134.5 kN/m +- 0.4 kN/m", "N/m") == Uncertain(134500.0, pytest.approx(400.0))


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("3 N +- -1 N", "'3 N +- -1 N' has a negative uncertainty"),
        ("3 N +- 1 m", "'m' has the wrong dimension, N is needed"),
        ("+- 1 N", "'' is not a value with a unit"),
        ("3 N +- much", "'much' is not a value with a unit"),
    ],
)
def test_an_uncertainty_that_cannot_be(text: str, what: str) -> None:
    assert fault("uncertain", text, "N")[0] == what


# bands


@given(NUMBERS, NUMBERS, st.sampled_from(["-", " - ", "–", "..", " to "]))
def test_a_band_is_read_in_any_way_of_writing(low: float, width: float, dash: str) -> None:
    high = float(f"{low + width:.7g}")
    if not low < high:
        return
    assert read("band", f"'{low!r}{dash}{high!r} Hz'", "Hz") == (low, high)


@pytest.mark.parametrize(
    ("text", "band"),
    [
        ("1-250 Hz", (1.0, 250.0)),
        ("1 Hz - 0.25 kHz", (1.0, 250.0)),
        ("900-1800 rpm", (15.0, 30.0)),
        ("1e1-2e1 Hz", (10.0, 20.0)),
        ("1e-1-2e+1 Hz", (0.1, 20.0)),
        ("0-10 Hz", (0.0, 10.0)),
        ("1..2 Hz", (1.0, 2.0)),
        (".5..1.5 Hz", (0.5, 1.5)),
        ("1e-3 to 2e-2 kHz", (1.0, 20.0)),
        ("1 Hz to 1e-2 kHz", (1.0, 10.0)),
        ("5e-3–6e-3 kHz", (5.0, 6.0)),
    ],
)
def test_bands(text: str, band: tuple[float, float]) -> None:
    assert read("band", text, "Hz") == pytest.approx(band)


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("10 Hz", "'10 Hz' is not a band"),
        ("-10 Hz", "'-10 Hz' is not a band"),
        ("low-high Hz", "'low-high Hz' is not a band"),
        ("20-10 Hz", "the band '20-10 Hz' is empty"),
        ("10-10 Hz", "the band '10-10 Hz' is empty"),
        ("10-20 m", "'m' has the wrong dimension, Hz is needed"),
        ("10-20", "'10' has no unit"),
    ],
)
def test_what_is_no_band(text: str, what: str) -> None:
    assert fault("band", text, "Hz")[0] == what


def test_one_band_is_a_list_of_one() -> None:
    assert read("bands", "49-51 Hz", "Hz") == ((49.0, 51.0),)
    assert read("bands", "[49-51 Hz, 99-101 Hz]", "Hz") == ((49.0, 51.0), (99.0, 101.0))
    assert read("bands", "[]", "Hz") == ()


def test_peaks_belong_to_their_dofs() -> None:
    text = "{x: 700-1100 Hz, z: [300-500 Hz, 900-950 Hz]}"
    assert read("peaks", text, "Hz") == (("x", ((700.0, 1100.0),)), ("z", ((300.0, 500.0), (900.0, 950.0))))
    for wrong in ("700-1100 Hz", "[700-1100 Hz]"):
        assert fault("peaks", wrong, "Hz")[0].endswith("is not a mapping of dofs to bands")


# whole numbers, flags, texts, choices, names


@given(st.integers(0, 10**9))
def test_whole_numbers(number: int) -> None:
    assert read("integer", str(number)) == number


@pytest.mark.parametrize("text", ["-1", "2.5", "true", "two", "'3'", "[3]", "", "1e3"])
def test_what_is_no_whole_number(text: str) -> None:
    assert fault("integer", text)[0].endswith("is not a whole number of at least 0")


def test_a_number_of_pieces_beyond_all_counting_is_refused() -> None:
    """Of blocks, balls or draws: a billion is none, 10^21 fits no array."""
    assert fault("integer", "1" + 21 * "0")[0].endswith("is beyond what can be counted here")


def test_flags_are_true_or_false_and_nothing_else() -> None:
    assert read("flag", "true") is True and read("flag", "false") is False
    for text in ("yes", "1", "'true'", "", "[true]"):
        assert fault("flag", text)[0].endswith("is neither true nor false")


@pytest.mark.parametrize(
    ("text", "value"),
    [("hello", "hello"), ("1e3", "1e3"), ("007", "007"), ("'a: b'", "a: b"), ("true", "true")],
)
def test_a_text_is_taken_as_written(text: str, value: str) -> None:
    assert read("text", text) == value


@pytest.mark.parametrize("text", ["", "[a]", "{a: b}"])
def test_what_is_no_text(text: str) -> None:
    assert fault("text", text)[0].endswith("is not a text")


def test_an_empty_text_is_missing() -> None:
    assert fault("text", "''") == ("a text is missing", "")


@pytest.mark.parametrize(
    ("text", "hint"),
    [
        ("han", "did you mean 'hann'? (known: hann, flattop)"),
        ("kaiser", "known: hann, flattop"),
        ("HANN", "did you mean 'hann'? (known: hann, flattop)"),
    ],
)
def test_an_unknown_choice_names_the_nearest_and_all(text: str, hint: str) -> None:
    assert fault("choice", text, choices=("hann", "flattop")) == (f"unknown choice '{text}'", hint)
    assert read("choice", "flattop", choices=("hann", "flattop")) == "flattop"


def test_one_name_is_a_list_of_one() -> None:
    assert read("names", "x") == ("x",)
    assert read("names", "[x, 2, 45 deg]") == ("x", "2", "45 deg")
    assert fault("names", "[x, [y]]")[0] == "'(a list)' is not a text"


# masses, matrices, coefficients, groups, series


@pytest.mark.parametrize(
    ("text", "mass"),
    [
        ("0.92 kg", 0.92),
        ("920 g", 0.92),
        ("estimate", "estimate"),
        ("[1 kg, 2 kg]", (1.0, 2.0)),
        ("[[1 kg, 0], [0, 2 kg]]", ((1.0, 0.0), (0.0, 2.0))),
        ("0 kg", 0.0),
    ],
)
def test_masses(text: str, mass: Any) -> None:
    assert (
        read("mass", text, "kg") == pytest.approx(mass)
        if not isinstance(mass, (str, tuple))
        else read("mass", text, "kg") == mass
    )


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("-1 kg", "the mass '-1 kg' is negative"),
        ("[1 kg, -1 kg]", "the mass '-1 kg' is negative"),
        ("1 N", "'N' has the wrong dimension, kg is needed"),
    ],
)
def test_masses_that_cannot_be(text: str, what: str) -> None:
    assert fault("mass", text, "kg")[0] == what


@given(st.lists(st.lists(NUMBERS, min_size=2, max_size=2), min_size=1, max_size=3))
def test_a_matrix_is_its_rows(rows: list[list[float]]) -> None:
    text = "[" + ", ".join("[" + ", ".join(f"{number!r} N/m" for number in row) + "]" for row in rows) + "]"
    assert read("matrix", text, "N/m") == tuple(map(tuple, rows))


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("3 N/m", "'3 N/m' is not a matrix"),
        ("[1 N/m, 2 N/m]", "'(a list)' is not a matrix"),
        ("[[1 N/m, 2 N/m], [3 N/m]]", "the rows of the matrix are not equally long"),
        ("[]", "the rows of the matrix are not equally long"),
    ],
)
def test_what_is_no_matrix(text: str, what: str) -> None:
    assert fault("matrix", text, "N/m")[0] == what


def test_the_first_letter_of_a_coefficient_says_its_unit() -> None:
    found = read("coefficients", "{k_1_2: 3 kN/m, c_1_2: 5 N.s/m, m_1_1: 2 kg, k: 1 N/m}")
    assert found == (("k_1_2", 3000.0), ("c_1_2", 5.0), ("m_1_1", 2.0), ("k", 1.0))


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("{q_1_2: 3 N/m}", "'q_1_2' is not a coefficient"),
        ("{kk: 3 N/m}", "'kk' is not a coefficient"),
        ("{k_1_2: 3 kg}", "'kg' has the wrong dimension, N/m is needed"),
        ("[k_1_2]", "'(a list)' is not a mapping of coefficients"),
    ],
)
def test_what_is_no_coefficient(text: str, what: str) -> None:
    assert fault("coefficients", text)[0] == what


def test_values_series_and_groups() -> None:
    assert read("values", "2 %", "1") == (0.02,)
    assert read("values", "[2 %, 0.04]", "1") == (0.02, 0.04)
    assert read("series", "{ls: [0.03, 0.2], ml: 0.1}", "1") == (("ls", (0.03, 0.2)), ("ml", (0.1,)))
    assert read("groups", "[k_xx, k_yy]") == (("k_xx", "k_yy"),)
    assert read("groups", "[[k_xx, k_yy], [c_xx]]") == (("k_xx", "k_yy"), ("c_xx",))


@pytest.mark.parametrize(
    ("kind", "text", "what"),
    [
        ("series", "[1, 2]", "'(a list)' is not a mapping of names to lists of values"),
        ("groups", "k_xx", "'k_xx' is not a list of names"),
        ("values", "{a: 1}", "'(a mapping)' is not a value with its unit, for example '1 1'"),
    ],
)
def test_what_is_no_list(kind: str, text: str, what: str) -> None:
    assert fault(kind, text, "1")[0] == what


@pytest.mark.parametrize("kind", sorted(set(CONVERTERS) - {"section", "sections", "entries"}))
@pytest.mark.parametrize("text", ["[[[]]]", "{a: {b: {}}}", "''", ".", "nan", "'\\u0000'", "1e999 Hz"])
def test_nothing_odd_ends_in_anything_but_a_refusal(kind: str, text: str) -> None:
    """Whatever stands there is read or refused; a number is finite in any case."""
    found: Any = None
    with contextlib.suppress(UnitError):
        found = read(kind, text, "Hz", ("a", "b"))
    assert not isinstance(found, float) or math.isfinite(found)
